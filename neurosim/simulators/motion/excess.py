r"""Motion beyond what a robot's commands explain, where it lasts: slip, or a push of the ground.

A robot that is seen to move with another twist than the simulated one goes on so for a while. The
difference e (m/s, m/s, rad/s in the robot's frame) is learned as an Ornstein-Uhlenbeck process of
variance P and time constant T, that is seen with errors: those of two poses, s seconds apart, make
one of the speed, of variance R / s^2. Of the measured twist m and the simulated one v follows

.. math:: e_{new} = e + g\,(m - (v + e)), \qquad e(t) = e\, \exp(-t / T)

.. math:: g = \frac{a}{b + R / (P s^2)}, \quad
    a = \frac{1 - e^{-z}}{z}, \quad b = 2\,\frac{z - 1 + e^{-z}}{z^2}, \quad z = s / T

for each of the three. P a is the covariance of e at the end with its mean over s, and P b the
variance of that mean. This is a Kalman filter's correction (Kalman 1960), of one state for each
component, with the gain of a first measurement.
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
        clarity: P / R of each, [3] 1/s^2, 0 or more; 0: a measurement tells nothing.
        shortest: time of the shortest measurement in the rows, [1] s; shorter ones count like it,
            because poses between two that were seen have no errors of their own.
    """

    lasts: Tensor
    clarity: Tensor
    shortest: Tensor

    def __post_init__(self) -> None:
        for name, size in (("lasts", 3), ("clarity", 3), ("shortest", 1)):
            value = getattr(self, name).detach().double()
            if tuple(value.shape) != (size,):
                raise ValueError(f"{name} must be of shape ({size},), not {tuple(value.shape)}")
            object.__setattr__(self, name, value)
        if (self.lasts <= 0).any() or (self.clarity < 0).any() or (self.shortest <= 0).any():
            raise ValueError("lasts and shortest must be above 0, and clarity 0 or more")

    def faded(self, excess: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances [B, 3] by an excess [B, 3] in times [B, 1] s, and what is left."""
        left = excess * torch.exp(-time / self.lasts)
        return self.lasts * (excess - left), left

    def believed(self, seconds: Tensor | float) -> Tensor:
        """Return the gains g of measurements over times [B, 1] s, or one time: [B, 3] or [3]."""
        time = torch.as_tensor(seconds, dtype=torch.float64).clamp(min=self.shortest)
        z = time / self.lasts
        fades = -torch.expm1(-z)
        certain = self.clarity * time**2
        return certain * (fades / z) / (1.0 + certain * 2.0 * (z - fades) / z**2)

    def corrected(self, excess: Tensor, off: Tensor, seconds: float) -> Tensor:
        """Return an excess [B, 3] by which speeds were measured; NaN: they were not.

        Args:
            excess: until now, [B, 3].
            off: measured minus simulated twists, [B, 3].
            seconds: time over which they were measured, s.
        """
        return excess + self.believed(seconds) * off.nan_to_num(0.0)
