"""How large an error is to be expected of a row: a product of powers of its inputs.

The logarithm of the errors is regressed on those of the inputs' magnitudes (Harvey, Estimating
regression models with multiplicative heteroscedasticity, Econometrica 44, 1976).
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Inputs count as at least so large, and a column's errors as larger by this share of their mean:
#: zero has no logarithm.
_LEAST_INPUT, _LEAST_ERROR = 0.05, 0.1


def size_features(x: Tensor) -> Tensor:
    """Return what the logarithm of an error is linear in, [N, F], of scaled inputs [N, I]."""
    size = x.abs()
    return torch.cat([size.clamp(min=_LEAST_INPUT).log(), size, torch.ones_like(size[:, :1])], 1)


def size_weights(features: Tensor, errors: Tensor, ridge: float) -> Tensor:
    """Return the weights [F, E] of features [N, F] in the logarithm of errors' sizes [N, E].

    Args:
        features: of :func:`size_features`.
        errors: of the rows, a column each.
        ridge: added to the diagonal of the equations, as a share of its mean.
    """
    square = features.T @ features
    square.diagonal().add_(ridge * square.diagonal().mean())
    size = errors.abs()
    log_size = (size + _LEAST_ERROR * size.mean(0)).clamp(min=1e-12).log()
    return torch.linalg.solve(square, features.T @ log_size)
