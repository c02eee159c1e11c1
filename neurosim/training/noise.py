"""Learning a noise model from predictions for unseen rows.

Scales, tails and sources are fitted together by maximum likelihood, with a weak pull to zero for
coefficients that the rows hardly determine. The learned noise includes the camera's noise of the
poses at both ends of a command, which remains while a robot stands.
"""

from __future__ import annotations

import torch
from numpy.polynomial.hermite_e import hermegauss
from torch import Tensor

from neurosim.base.threads import one_thread
from neurosim.simulators.motion.noise import (
    SCALE_FEATURES,
    TAIL_FEATURES,
    CommandFeatures,
    NoiseModel,
    cholesky,
    components,
    features,
    heaviness,
    in_motion,
    residual,
)
from neurosim.training.base import minimise, root_mean_square

#: Strength of the pull to zero, in rows: a coefficient of 1 costs as much likelihood as half a row.
PULL = 1.0

#: The same for logarithms of the factors of spread, in separate windows.
SPREAD_PULL = 4.0

#: Smallest difference of residuals, m and rad.
FINEST = 1e-6

#: First sources of the search, as fractions of the residuals' root mean squares: one of turn and
#: one forward, for turns and distances ahead, and one of a curve to the side.
BEGIN = (
    ((0.2, 0.1, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.0, 0.0, 0.0), (0.1, 0.2, 0.0), (0.0, 0.0, 0.0)),
    ((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)),
)

#: Nodes and weights of Gauss-Hermite quadrature over a standard normal number.
_PLACES, _WEIGHTS = (torch.from_numpy(part) for part in hermegauss(11))

#: Degrees of freedom of the errors of windows, and half widths of 80 % intervals of a standard
#: normal number and of Student's t.
_FREEDOM, _OF_NORMAL, _OF_STUDENT = 4.0, 1.2816, 1.5332

#: Default ln tau: slight tails.
SLIGHT = -0.7


def fit_noise(
    columns: CommandFeatures,
    inputs: Tensor,
    mean: Tensor,
    actual: Tensor,
    weight: Tensor | None = None,
) -> NoiseModel:
    """Learn the noise between predicted and actual displacements.

    Args:
        columns: of the inputs.
        inputs: scaled inputs of rows, [N, I].
        mean: displacements predicted by models that had not seen the row, [N, 3].
        actual: actual displacements, [N, 3].
        weight: weights of the rows, [N]; equal by default.
    """
    weight = torch.ones_like(mean[:, 0]) if weight is None else weight
    unit = root_mean_square(components(mean))
    scale, tail = features(unit, columns, inputs, mean)
    error = residual(mean, actual)
    size = error.square().mean(0).sqrt().clamp(min=FINEST)
    error = error / size
    rows = weight.sum()
    w = torch.zeros(3, len(SCALE_FEATURES), dtype=torch.float64, requires_grad=True)
    h = torch.zeros(len(TAIL_FEATURES), dtype=torch.float64)
    h[0] = SLIGHT
    h.requires_grad_()
    u = torch.tensor(BEGIN, dtype=torch.float64, requires_grad=True)
    log_weights = (_WEIGHTS / _WEIGHTS.sum()).log()

    def loss() -> Tensor:
        w.grad = h.grad = u.grad = None
        width = heaviness(tail, h).unsqueeze(1) * _PLACES  # [N, places]
        log_s = (w @ scale.T).unsqueeze(2) + width  # [3, N, places]
        moving = in_motion(unit, u * size.unsqueeze(-1), mean)
        moving = (moving / torch.outer(size, size)).unsqueeze(1)
        lower = cholesky(moving, (2.0 * log_s).exp().unbind(0))
        z: list[Tensor] = []
        power, log_size = torch.zeros(()), torch.zeros(())
        for k, row in enumerate(lower):
            explained = sum(
                (part * one for part, one in zip(row[:-1], z, strict=True)), torch.zeros(())
            )
            z.append((error[:, k : k + 1] - explained) / row[-1])
            # The resolution limits the likelihood of a residual.
            power = power + z[-1].square() + (FINEST / size[k] / row[-1]).square()
            log_size = log_size + row[-1].log()
        likelihood = (log_weights - power / 2.0 - log_size).logsumexp(-1)
        pull = w[:, 1:].square().sum() + (h[0] - SLIGHT).square() + h[1:].square().sum()
        value = -(weight * likelihood).sum() / rows
        value = value + PULL * (pull + u.square().sum()) / (2 * rows)
        value.backward()
        return value

    with one_thread():
        minimise([w, h, u], loss, steps=150)
    w = w.detach()
    w[:, 0] += size.log()
    return NoiseModel(
        unit=unit,
        log_scale=w,
        tail=h.detach(),
        sources=u.detach() * size.unsqueeze(-1),
    )


def fit_spread(
    error: Tensor, noise: Tensor, members: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Return factors of the noise and of the members' differences [3] for windows of rows.

    Errors have Student's t distribution, whose central 80 % are those of the sum of both.

    Args:
        error: turn, forward and sideways, of models that had not seen the rows, [W, 3].
        noise: samples of the noise, [D, W, 3].
        members: differences of the members from the mean, [M, W, 3].
        weight: of the windows, [W]; together, they count as many as there are separate ones.

    Returns:
        Factors of turn, forward and sideways; 1 without windows.
    """
    if not len(weight):
        return torch.ones(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    places = torch.tensor([0.1, 0.9], dtype=noise.dtype)
    low, high = noise.quantile(places, dim=0)
    of_noise = ((high - low) / (2.0 * _OF_NORMAL)).square()
    of_members = members.square().sum(0) / max(len(members), 1)
    logs = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)

    def loss() -> Tensor:
        logs.grad = None
        first, second = (2.0 * logs).exp()
        variance = (of_noise * first + of_members * second).clamp(min=FINEST**2)
        off = error.square() / variance * (_OF_STUDENT / _OF_NORMAL) ** 2 / _FREEDOM
        each = (_FREEDOM + 1.0) / 2.0 * off.log1p() + variance.log() / 2.0
        value = (weight @ each).sum() + SPREAD_PULL / 2.0 * logs.square().sum()
        value.backward()
        return value

    with one_thread():
        minimise([logs], loss, steps=150)
    first, second = logs.detach().exp()
    return first, second
