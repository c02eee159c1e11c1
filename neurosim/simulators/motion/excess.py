r"""Motion beyond what a robot's commands explain, where it lasts: slip, or a push of the ground.

A robot that is seen to move with another twist than the simulated one goes on so for a while. The
difference e (m/s, m/s, rad/s in the robot's frame) counts as far as measurements were worth it on
the rows, and fades exponentially:

.. math:: e_{new} = e + g\,(m - (v + e)), \qquad e(t) = e\, \exp(-t / T)

with the measured twist m, the simulated one v, and g and T of each of the three. This is a Kalman
filter's correction with a constant gain (Kalman 1960), of one state for each component.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

#: Names of the columns of a state.
NAMES = ("excess_x", "excess_y", "excess_theta")


@dataclass(frozen=True)
class Excess:
    """How much a measured speed counts, and how long; tensors are float64.

    Attributes:
        lasts: time constants T of x, y (robot frame) and heading, [3] s.
        believed: the gain g of each, [3], 0 to 1.
    """

    lasts: Tensor
    believed: Tensor

    def __post_init__(self) -> None:
        for name in ("lasts", "believed"):
            value = getattr(self, name).detach().double()
            if tuple(value.shape) != (3,):
                raise ValueError(f"{name} must be of shape (3,), not {tuple(value.shape)}")
            object.__setattr__(self, name, value)
        if (self.lasts <= 0).any() or (self.believed < 0).any() or (self.believed > 1).any():
            raise ValueError("lasts must be above 0, and believed from 0 to 1")

    def faded(self, excess: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances [B, 3] by an excess [B, 3] in times [B, 1] s, and what is left."""
        left = excess * torch.exp(-time / self.lasts)
        return self.lasts * (excess - left), left

    def corrected(self, excess: Tensor, off: Tensor) -> Tensor:
        """Return an excess [B, 3] by which speeds were measured; NaN: they were not.

        Args:
            excess: until now, [B, 3].
            off: measured minus simulated twists, [B, 3].
        """
        return excess + self.believed * off.nan_to_num(0.0)
