"""The expected size of a row's error: a product of powers of its inputs.

The logarithm of the errors is regressed on those of the inputs' magnitudes (Harvey, Estimating
regression models with multiplicative heteroscedasticity, Econometrica 44, 1976).
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Smallest magnitude of an input, and fraction of a column's mean that is added to errors, because
#: zero has no logarithm.
_LEAST_INPUT, _LEAST_ERROR = 0.05, 0.1


def size_features(x: Tensor) -> Tensor:
    """Return the features of an error's logarithm, [N, F], for scaled inputs [N, I]."""
    size = x.abs()
    return torch.cat([size.clamp(min=_LEAST_INPUT).log(), size, torch.ones_like(size[:, :1])], 1)


def size_weights(features: Tensor, errors: Tensor, ridge: float) -> Tensor:
    """Return the weights [F, E] of features [N, F] in the logarithm of errors' sizes [N, E].

    Args:
        features: of :func:`size_features`.
        errors: of the rows, a column each.
        ridge: added to the diagonal of the equations, as a fraction of its mean.
    """
    square = features.T @ features
    square.diagonal().add_(ridge * square.diagonal().mean())
    size = errors.abs()
    log_size = (size + _LEAST_ERROR * size.mean(0)).clamp(min=1e-12).log()
    return torch.linalg.solve(square, features.T @ log_size)


def relative_size(x: Tensor, residuals: Tensor) -> Tensor:
    """Return logarithms of the expected sizes of errors, minus their mean, [E, N].

    Args:
        x: scaled inputs, [N, I].
        residuals: [E, N].
    """
    features = size_features(x)
    scale = (features @ size_weights(features, residuals.T, ridge=1e-3)).T
    return (scale - scale.mean(1, keepdim=True)).clamp(-3.0, 3.0)


def row_weights(x: Tensor, residuals: Tensor) -> Tensor:
    """Return weights of rows whose errors differ in size, for a more robust fit.

    The size of an error is what :mod:`neurosim.training.error_size` expects. The weight is the
    reciprocal of its square root, half way between equal weights, which suit the mean squared
    error, and the full correction, which trusts the smallest errors most. Rows whose errors are
    still large have the weights of Huber's estimator (Huber 1964), with the corner at 1.35 standard
    deviations.

    Args:
        x: scaled inputs, [N, I].
        residuals: [E, N].

    Returns:
        [E, N], with a mean square of one.
    """
    weights = torch.exp(-0.5 * relative_size(x, residuals))
    size = residuals.abs() * weights
    # Twice the median of normal errors' magnitudes is 1.35 standard deviations.
    corner = (2.0 * size.median(1, keepdim=True).values).clamp(min=1e-300)
    weights = weights * (corner / torch.maximum(size, corner)).sqrt()
    return weights / weights.square().mean(1, keepdim=True).sqrt()
