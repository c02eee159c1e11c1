"""Hidden units that measure how near an input is to a training row.

The mean of a Gaussian process with a squared-exponential covariance (Rasmussen and Williams 2006,
section 2.2) on a subset of its rows is a sum of such units.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class KernelUnits:
    """Units exp(-|(x - c) / l|^2 / 2) and their weights in the networks' outputs.

    Attributes:
        centres: c of each unit, [K, J]: scaled inputs and derived ones.
        lengths: l of each input, [J].
        weights: of the units in every network's output, in the simulator's order of networks, [M,
            O, K].
    """

    centres: Tensor
    lengths: Tensor
    weights: Tensor

    def __post_init__(self) -> None:
        fits = self.centres.shape[1:] == self.lengths.shape and self.lengths.ndim == 1
        if not fits or self.weights.ndim != 3 or self.weights.shape[2] != len(self.centres):
            raise ValueError("centres, lengths and weights of kernel units do not fit each other")
        if (self.lengths <= 0).any():
            raise ValueError("the lengths of kernel units must be above 0")

    def __len__(self) -> int:
        """Return the number of units."""
        return len(self.centres)

    def units(self, x: Tensor) -> Tensor:
        """Return the units' values [B, K] for networks' inputs [B, J]."""
        return covariance(x, self.centres, self.lengths)


def covariance(a: Tensor, b: Tensor, lengths: Tensor) -> Tensor:
    """Return exp(-|(a - b) / lengths|^2 / 2) of all pairs of rows, [A, B]."""
    a, b = a / lengths, b / lengths
    square = a.square().sum(1).unsqueeze(1) + b.square().sum(1) - 2.0 * a @ b.T
    return torch.exp(-0.5 * square.clamp(min=0.0))
