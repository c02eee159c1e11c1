"""A Gaussian process of several functions that share their lengths, on some of the rows.

Rasmussen and Williams 2006: section 5.4.1 (lengths by the marginal likelihood), section 8.3.1
(subset of regressors); the rows that represent the others are chosen one by one, each with the
largest variance given the earlier ones (Fine and Scheinberg 2001, incomplete Cholesky decomposition
with pivots).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurosim.simulators.motion.kernel_units import covariance
from neurosim.training.base import minimise

#: Number of steps of the search for the lengths.
_STEPS = 30
#: Prior ln of a length in spreads of its input: smooth.
_USUAL, _PULL = 0.7, 0.1
#: Smallest such logarithm: with shorter lengths, squares of far inputs leave too few digits for
#: factoring the covariance.
_LEAST = -3.0
#: Largest magnitude of a logarithm.
_MOST = 7.0
#: Added to the diagonal of a covariance.
_JITTER = 1e-7
#: Remaining fraction of a row's variance below which the other rows determine it.
_RELATIVE = 1e-6


@dataclass(frozen=True)
class Process:
    """A learned Gaussian process of F functions of J inputs.

    Attributes:
        centres: [K, J].
        lengths: [J].
        power: prior variance of each function, [F].
        noise: noise variance of rows with weight 1, [F].
    """

    centres: Tensor
    lengths: Tensor
    power: Tensor
    noise: Tensor

    def units(self, x: Tensor) -> Tensor:
        """Return the units [N, K] of inputs [N, J]."""
        return covariance(x, self.centres, self.lengths)

    def _precision(self, function: int) -> Tensor:
        """Return the weights' prior precision [K, K].

        It is the centres' covariance over the power; the weights' covariance is its inverse.
        """
        return covariance(self.centres, self.centres, self.lengths) / self.power[function]

    def prior(self, function: int) -> Tensor:
        """Return the Cholesky factor [K, K] of the prior precision."""
        precision = self._precision(function)
        precision.diagonal().add_(_JITTER * precision.diagonal().mean())
        return torch.linalg.cholesky(precision)

    def posterior(
        self, columns: Tensor, y: Tensor, trust: Tensor, function: int
    ) -> tuple[Tensor, Tensor]:
        """Return mean [K] and Cholesky factor [K, K] of the precision of a function's weights.

        Args:
            columns: factors of the units' weights in ``y``, [N, K].
            y: the observed values, [N], such as the function's times a known factor, with noise.
            trust: weights of the values, reciprocals of their relative noise variances, [N].
            function: number of the function.
        """
        trust = trust / self.noise[function]
        precision = self._precision(function) + columns.T @ (trust.unsqueeze(1) * columns)
        precision.diagonal().add_(_JITTER * precision.diagonal().mean())
        triangle = torch.linalg.cholesky(precision)
        mean = torch.cholesky_solve((columns.T @ (trust * y)).unsqueeze(1), triangle).squeeze(1)
        return mean, triangle


def learn_process(
    x: Tensor,
    y: Tensor,
    weights: Tensor,
    centres: int,
    elsewhere: Tensor,
    chosen: Tensor,
) -> tuple[Process, float]:
    """Learn lengths, power and noise, and choose the centres.

    Returns:
        The process, and minus the log-likelihood of its lengths.

    Args:
        x: inputs, [N, J].
        y: functions' values, [N, F].
        weights: weight of each value, the reciprocal of its relative noise variance, [N, F].
        centres: largest number of centres.
        elsewhere: inputs [M, J] that may occur later: a third of the centres are among those
            farthest from the rows, so that draws from the posterior differ there.
        chosen: indices of the rows for the search of the lengths.
    """
    spread = x.std(0).clamp(min=1e-2) if len(x) > 1 else torch.ones_like(x[0])
    size = ((y.square() * weights).sum(0) / weights.sum(0).clamp(min=1e-12)).sqrt()
    size = size.clamp(min=1e-9)
    own, values, trust = x[chosen], y[chosen] / size, weights[chosen].clamp(min=1e-9)
    inputs, functions = x.shape[1], y.shape[1]
    start = torch.cat(
        [
            torch.full((inputs,), _USUAL, dtype=x.dtype),
            torch.full((functions,), -0.3, dtype=x.dtype),
            torch.full((functions,), -0.7, dtype=x.dtype),
        ]
    )
    logs = start.clone()

    def loss() -> float:
        value, logs.grad = unlikelihood(logs, own, values, trust, spread)
        return value

    minimise([logs], loss, steps=_STEPS)
    least, result = loss(), _bounded(logs, inputs)
    lengths = result[:inputs].exp() * spread
    power, noise = (2.0 * result[inputs:]).exp().view(2, functions) * size.square()
    process = Process(choose_centres(x, elsewhere, lengths, centres), lengths, power, noise)
    return process, least


def _bounded(logs: Tensor, inputs: int) -> Tensor:
    lowest = torch.full_like(logs, -_MOST)
    lowest[:inputs] = _LEAST
    return torch.maximum(logs, lowest).clamp(max=_MOST)


def unlikelihood(
    logs: Tensor, x: Tensor, y: Tensor, trust: Tensor, spread: Tensor
) -> tuple[float, Tensor]:
    """Return minus the log-likelihood of rows, with the pull to usual values, and its gradient.

    Rasmussen and Williams 2006, equations 5.8 and 5.9.

    Args:
        logs: logarithms of lengths in spreads of their inputs, and of the functions' standard
            deviations and those of their noise, [J + 2 F].
        x: inputs, [N, J].
        y: values, [N, F].
        trust: reciprocals of their relative noise variances, [N, F].
        spread: of the inputs, [J].
    """
    inputs, functions = x.shape[1], y.shape[1]
    bounded = _bounded(logs, inputs)
    lengths = bounded[:inputs].exp() * spread
    power, noise = (2.0 * bounded[inputs:]).exp().view(2, functions)
    shared = covariance(x, x, lengths)
    matrix = power[:, None, None] * shared
    diagonal = matrix.diagonal(dim1=1, dim2=2)
    diagonal.add_(_JITTER * power[:, None] + (noise / trust).T + 1e-9)
    triangle = torch.linalg.cholesky(matrix)
    solved = torch.cholesky_solve(y.T.unsqueeze(2), triangle)
    off = logs[:inputs] - _USUAL
    value = 0.5 * (y.T.unsqueeze(2) * solved).sum()
    value = value + triangle.diagonal(dim1=1, dim2=2).log().sum() + _PULL * off.square().sum()
    value = value + _PULL / 2.0 * logs[inputs : inputs + functions].square().sum()
    # By each covariance, [F, N, N]; then by what it is made of.
    slope = 0.5 * (torch.cholesky_inverse(triangle) - solved @ solved.mT)
    own = slope.diagonal(dim1=1, dim2=2)
    of_power = ((slope * shared).sum((1, 2)) + _JITTER * own.sum(1)) * power
    of_noise = (own.T / trust).sum(0) * noise
    by_pairs = shared * torch.einsum("f,fnm->nm", power, slope)
    ahead = 2.0 * (by_pairs.sum(1) @ x.square() - (x * (by_pairs @ x)).sum(0))
    gradient = torch.cat([ahead / lengths.square(), 2.0 * of_power, 2.0 * of_noise])
    gradient = torch.where(bounded == logs, gradient, 0.0)
    gradient[:inputs] += 2.0 * _PULL * off
    gradient[inputs : inputs + functions] += _PULL * logs[inputs : inputs + functions]
    return float(value), gradient


def choose_centres(x: Tensor, elsewhere: Tensor, lengths: Tensor, count: int) -> Tensor:
    """Return centres [K, J], two thirds among rows x [N, J], the others ``elsewhere`` [M, J].

    Args:
        x: rows.
        elsewhere: inputs that may occur later.
        lengths: of the covariance, [J].
        count: largest number of centres.
    """
    near = _pivots(x, lengths, count - count // 3)
    return _pivots(torch.cat([near, elsewhere]), lengths, len(near) + count // 3, len(near))


def _pivots(x: Tensor, lengths: Tensor, count: int, given: int = 0) -> Tensor:
    """Return the rows [K, J], each with the largest variance given the earlier ones.

    Args:
        x: rows, [N, J].
        lengths: of the covariance, [J].
        count: largest number of rows.
        given: number of first rows that are chosen before the others.
    """
    left = torch.ones(len(x), dtype=x.dtype)
    factor = x.new_zeros(len(x), min(count, len(x)))
    chosen = []
    for place in range(factor.shape[1]):
        row = place if place < given else int(left.argmax())
        if left[row] < _RELATIVE:
            if place < given:
                continue
            break
        chosen.append(row)
        column = covariance(x, x[row : row + 1], lengths).squeeze(1)
        column = column - factor[:, :place] @ factor[row, :place]
        factor[:, place] = column / left[row].sqrt()
        left = (left - factor[:, place].square()).clamp(min=0.0)
    return x[chosen]
