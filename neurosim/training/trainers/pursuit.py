"""Growing networks by one product unit at a time, everything linear solved exactly.

Orthogonal least squares (Chen, Cowan, Grant, Orthogonal least squares learning algorithm for
radial basis function networks, IEEE Trans. Neural Networks 2, 1991) with product units for basis
functions: of many candidate units the one is taken whose part orthogonal to all earlier ones
explains most of what they leave. Candidates are drawn and improved by a small evolution strategy.
Now and then the exponents of all units are moved together by variable projection (Golub and
Pereyra 1973), a Gauss-Newton method on the residual of the best linear read-out.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neurosim.networks import LOG_LIMIT
from neurosim.training.base import PursuitSettings
from neurosim.training.error_size import size_features, size_weights

#: A candidate whose square is orthogonal to the units there by less than this share says nothing
#: new, only what rounding left.
_LEAST_NEW = 1e-4
#: A unit may be so many times as large as it was on any row: among few rows there are seldom the
#: largest inputs all at once, and how it grew up to there says something of a little further.
_HEADROOM = 1.25


class Pursuit:
    """Several functions of the same inputs, fitted together to weighted mixtures of them.

    With functions f_o, mixture e of row n should be
    ``targets[e, n] = sum_o factors[e, o, n] * f_o(x_n)``. Every function is a sum of
    product units with phases, a linear map and a constant.

    Attributes:
        exponents, phases: of each function's units, lists of [P_o, I].
        finished: whether more units would not generalise better, or there are as many as asked for.
    """

    def __init__(
        self,
        x: Tensor,
        factors: Tensor,
        targets: Tensor,
        settings: PursuitSettings,
        most_units: int,
        generator: torch.Generator,
        floor: float,
    ):
        """Begin with linear functions.

        Args:
            x: scaled inputs, [N, I].
            factors: [E, O, N].
            targets: [E, N].
            settings: of the search.
            most_units: of one function.
            generator: of all random numbers.
            floor: the smallest magnitude of an input in a product unit.
        """
        self._settings, self._most = settings, most_units
        self._generator = generator
        self._factors, self._targets = factors, targets
        self._log = x.abs().clamp(min=floor).log()
        self._negative = (x < 0).to(x)
        self._linear = torch.cat([x, torch.ones_like(x[:, :1])], dim=1)
        self._signed = (x < 0).any(0)  # elsewhere a phase has no effect
        self._x = x
        self._weights = torch.ones_like(targets)
        self._damping = 1e-2
        empty = x.new_zeros(0, x.shape[1])
        self.exponents = [empty.clone() for _ in range(factors.shape[1])]
        self.phases = [empty.clone() for _ in range(factors.shape[1])]
        self.finished = False
        self._best: tuple[list[Tensor], list[Tensor]] = (self.exponents, self.phases)
        self._best_score = math.inf
        self._since_best = 0
        self._solve()
        self._keep_best()

    @property
    def units(self) -> int:
        """How many product units there are."""
        return sum(len(e) for e in self.exponents)

    def grow(self) -> None:
        """Add the best unit that can be found; from time to time improve all of them."""
        if self.finished:
            return
        settings = self._settings
        found = [self._candidate(o) for o, e in enumerate(self.exponents) if len(e) < self._most]
        gain, function, exponents, phases = max(found, key=lambda entry: entry[0])
        if gain > 0.0:
            self.exponents[function] = torch.cat([self.exponents[function], exponents[None]])
            self.phases[function] = torch.cat([self.phases[function], phases[None]])
            self._solve()
            if self.units % settings.refine_every == 0:
                self._refine(settings.refine_steps)
            if self.units in settings.reweigh_at:
                self._reweigh()
            self._keep_best()
        full = all(len(e) >= self._most for e in self.exponents)
        self.finished = full or gain <= 0.0 or self._since_best >= settings.patience

    def settle(self) -> None:
        """Go back to the units that generalise best, and solve for their read-out."""
        self.exponents, self.phases = ([e.clone() for e in part] for part in self._best)
        self._solve()

    def readout(self) -> list[tuple[Tensor, Tensor]]:
        """Return each function's weights of its units, [P_o], and of inputs and one, [I + 1]."""
        parts, start = [], 0
        width = self._linear.shape[1]
        for exponents in self.exponents:
            middle = start + len(exponents)
            parts.append((self._solution[start:middle], self._solution[middle : middle + width]))
            start = middle + width
        return parts

    def ceilings(self) -> list[Tensor]:
        """Return what the logarithm of each function's units is to be kept below, [P_o]."""
        return self._ceilings(self.exponents)

    def _ceilings(self, exponents: list[Tensor]) -> list[Tensor]:
        headroom = math.log(_HEADROOM)
        return [(self._log @ own.T).amax(0) + headroom for own in exponents]

    def best_units(self) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Return exponents, phases and ceilings of the units that generalise best."""
        exponents, phases = self._best
        return exponents, phases, self._ceilings(exponents)

    @property
    def mean_squared_error(self) -> Tensor:
        """Of each mixture, [E], rows weighing alike."""
        return (self._residual / self._weights).square().mean(1)

    def score(self) -> float:
        """Return the generalised cross-validation score (Golub, Heath, Wahba 1979).

        A unit that was searched for costs more than its read-out weight.
        """
        rows = self._residual.numel()
        cost = self._settings.unit_cost * self.units + len(self.exponents) * self._linear.shape[1]
        if cost >= 0.9 * rows:
            return math.inf
        return self._residual.square().mean().item() / (1.0 - cost / rows) ** 2

    # The linear part

    def _solve(self) -> None:
        factors = self._factors * self._weights.unsqueeze(1)
        columns = []
        for o, (exponents, phases) in enumerate(zip(self.exponents, self.phases, strict=True)):
            features = torch.cat([self._units(exponents, phases), self._linear], dim=1)
            columns.append(factors[:, o, :, None] * features)
        self._columns = torch.cat(columns, dim=2).flatten(0, 1)  # [E N, F]
        target = (self._targets * self._weights).flatten()
        square = self._columns.T @ self._columns
        self._size = square.diagonal().sqrt().clamp(min=1e-12)
        square = square / self._size / self._size.unsqueeze(1)
        square.diagonal().add_(self._settings.ridge)
        self._triangle = torch.linalg.cholesky(square)
        cross = (self._columns.T @ target / self._size).unsqueeze(1)
        self._solution = torch.cholesky_solve(cross, self._triangle).squeeze(1) / self._size
        residual = target - self._columns @ self._solution
        self._residual = residual.view(self._targets.shape)

    def _units(self, exponents: Tensor, phases: Tensor) -> Tensor:
        magnitude = (self._log @ exponents.T).clamp_(-LOG_LIMIT, LOG_LIMIT).exp_()
        return magnitude.mul_(torch.cos(torch.pi * (self._negative @ phases.T)))

    def _project(self, columns: Tensor) -> Tensor:
        """Return columns [E N, C] in the orthonormal basis of those there, [F, C]."""
        inner = (self._columns.T @ columns) / self._size.unsqueeze(1)
        return torch.linalg.solve_triangular(self._triangle, inner, upper=False)

    # Candidates

    def _candidate(self, function: int) -> tuple[float, int, Tensor, Tensor]:
        """Return the best unit found for a function, and how much of the residual it explains."""
        settings = self._settings
        exponents, phases = self._draw(function)
        best = (0.0, function, exponents[0], phases[0])
        for scale in (*settings.mutation_scales, None):
            gain = self._gain(function, exponents, phases)
            top = gain.topk(min(settings.parents, len(gain)))
            if top.values[0].item() > best[0]:
                place = top.indices[0]
                best = (top.values[0].item(), function, exponents[place], phases[place])
            if scale is None:
                return best
            parents = top.indices[self._integers(len(top.indices), settings.children)]
            exponents, phases = (
                torch.cat([part[top.indices], children])
                for part, children in zip(
                    (exponents, phases),
                    self._mutated(exponents[parents], phases[parents], scale),
                    strict=True,
                )
            )
        raise AssertionError("unreachable")

    def _draw(self, function: int) -> tuple[Tensor, Tensor]:
        """Draw units of few inputs with halved exponents, half of them like units there."""
        count, inputs = self._settings.candidates, self._x.shape[1]
        low, high = self._settings.limits
        steps = int(2 * (min(high, 2.0) - max(low, -1.0))) + 1
        exponents = max(low, -1.0) + 0.5 * self._integers(steps, (count, inputs)).to(self._x)
        exponents *= self._uniform((count, inputs)) < 0.5
        phases = (self._uniform((count, inputs)) < 0.4).to(self._x) * self._signed
        known = len(self.exponents[function])
        if known:
            like = self._integers(known, count // 2)
            near = self._mutated(
                self.exponents[function][like], self.phases[function][like], 0.5, 0.4, 0.15
            )
            exponents[: count // 2], phases[: count // 2] = near
        return exponents, phases

    def _mutated(
        self,
        exponents: Tensor,
        phases: Tensor,
        scale: float,
        share: float = 0.6,
        flips: float = 0.08,
    ) -> tuple[Tensor, Tensor]:
        noise = torch.randn(
            exponents.shape, generator=self._generator, device=self._x.device, dtype=self._x.dtype
        )
        change = scale * noise * (self._uniform(exponents.shape) < share)
        flip = (self._uniform(phases.shape) < flips).to(phases) * self._signed
        return (exponents + change).clamp(*self._settings.limits), (phases - flip).abs()

    def _gain(self, function: int, exponents: Tensor, phases: Tensor) -> Tensor:
        """Return by how much each candidate would lessen the sum of squares."""
        factor = (self._factors[:, function] * self._weights).unsqueeze(-1)
        columns = (factor * self._units(exponents, phases)).flatten(0, 1)
        power = columns.square().sum(0)
        new = power - self._project(columns).square().sum(0)
        gain = (self._residual.flatten() @ columns).square() / new.clamp(min=1e-300)
        return torch.where(new > _LEAST_NEW * power, gain, 0.0)

    def _uniform(self, shape: tuple[int, ...]) -> Tensor:
        return torch.rand(
            shape, generator=self._generator, device=self._x.device, dtype=self._x.dtype
        )

    def _integers(self, below: int, shape: int | tuple[int, ...]) -> Tensor:
        shape = (shape,) if isinstance(shape, int) else shape
        return torch.randint(below, shape, generator=self._generator, device=self._x.device)

    # All units together

    def _refine(self, steps: int) -> None:
        """Move all exponents by Levenberg-Marquardt steps of the variable projection."""
        for _ in range(steps):
            jacobian = self._jacobian()
            inner = self._project(jacobian)
            square = jacobian.T @ jacobian - inner.T @ inner
            slope = jacobian.T @ self._residual.flatten()
            size = square.diagonal().clamp(min=1e-9 * square.diagonal().max())
            before, error = self.exponents, self._residual.square().sum()
            for _ in range(5):
                step = torch.linalg.solve(square + torch.diag(self._damping * size), slope)
                self.exponents = self._moved(before, step)
                self._solve()
                if self._residual.square().sum() < error:
                    self._damping = max(self._damping / 3.0, 1e-6)
                    break
                self._damping *= 4.0
            else:
                self.exponents = before
                self._damping = 1e-2
                self._solve()
                return

    def _jacobian(self) -> Tensor:
        """Return the derivatives of all mixtures by all exponents, [E N, sum_o P_o I]."""
        factors = self._factors * self._weights.unsqueeze(1)
        parts = []
        for o, (weights, _) in enumerate(self.readout()):
            units = self._units(self.exponents[o], self.phases[o]) * weights
            slopes = (units.unsqueeze(-1) * self._log.unsqueeze(1)).flatten(1)
            parts.append((factors[:, o, :, None] * slopes).flatten(0, 1))
        return torch.cat(parts, dim=1)

    def _moved(self, exponents: list[Tensor], step: Tensor) -> list[Tensor]:
        parts = step.split([e.numel() for e in exponents])
        return [
            (e + part.view_as(e).clamp(-0.5, 0.5)).clamp(*self._settings.limits)
            for e, part in zip(exponents, parts, strict=True)
        ]

    def _reweigh(self) -> None:
        self._weights = row_weights(self._x, self._residual / self._weights)
        self._best_score, self._since_best = math.inf, 0  # scores of before are of other weights
        self._solve()

    def _keep_best(self) -> None:
        score = self.score()
        self._since_best += 1
        if score < self._best_score * (1.0 - self._settings.least_gain):
            self._best_score, self._since_best = score, 0
            self._best = ([*self.exponents], [*self.phases])


def row_weights(x: Tensor, residuals: Tensor) -> Tensor:
    """Return weights of rows whose errors differ in size, for a fit that they spoil less.

    The size of an error is what :mod:`neurosim.training.error_size` expects. The weight is the
    reciprocal of its square root, half way between rows that weigh alike, which suits the
    mean squared error, and the full correction, which trusts the smallest errors most. Rows whose
    errors are large even so weigh as Huber's estimator has it (Huber 1964), corner at 1.35
    standard deviations.

    Args:
        x: scaled inputs, [N, I].
        residuals: [E, N].

    Returns:
        [E, N], with a mean square of one.
    """
    features = size_features(x)
    scale = (features @ size_weights(features, residuals.T, ridge=1e-3)).T
    scale = scale - scale.mean(1, keepdim=True)
    weights = torch.exp(-0.5 * scale.clamp(-3.0, 3.0))
    size = residuals.abs() * weights
    # Twice the median of normal errors' magnitudes is 1.35 standard deviations.
    corner = (2.0 * size.median(1, keepdim=True).values).clamp(min=1e-300)
    weights = weights * (corner / torch.maximum(size, corner)).sqrt()
    return weights / weights.square().mean(1, keepdim=True).sqrt()
