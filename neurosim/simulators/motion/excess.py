r"""Motion beyond what a robot's commands explain, where it lasts: slip, or a push of the ground.

A robot that is seen to move with another twist than the simulated one goes on so for a while. The
difference e (m/s, m/s, rad/s in the robot's frame) is learned as an Ornstein-Uhlenbeck process of
covariance P and time constants T, that is seen with errors: those of two poses, s seconds apart,
make one of the speed, of variances R / s^2. Of the measured twist m and the simulated one v follows

.. math:: e_{new} = e + G\,(m - (v + e)), \qquad e(t) = e\, \exp(-t / T)

.. math:: G = A\,(B + R / s^2)^{-1}, \quad A_{ij} = P_{ij} \sqrt{a_i a_j}, \quad
    B_{ij} = P_{ij} \sqrt{b_i b_j}

.. math:: a = \frac{1 - e^{-z}}{z}, \quad b = 2\,\frac{z - 1 + e^{-z}}{z^2}, \quad z = s / T

A is the covariance of e at the end with its mean over s, and B that of the mean; between parts with
different time constants, both are approximations. This is a Kalman filter's correction (Kalman
1960), with the gain of a first measurement. Of a ship that turns more than expected, P tells that
it also drifts more.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

#: Names of the columns of a state.
NAMES = ("excess_x", "excess_y", "excess_theta")
#: Largest difference of a measured speed that counts, in standard deviations.
MOST = 8.0


@dataclass(frozen=True)
class Excess:
    """How much a measured speed counts, and how long; tensors are float64.

    Attributes:
        lasts: time constants T of x, y (robot frame) and heading, [3] s.
        covariance: P, [3, 3] in m^2/s^2, m rad/s^2, rad^2/s^2; 0 for a part of which a measurement
            tells nothing.
        errors: R of distances and turns between two poses, [3] m^2, m^2, rad^2.
        shortest: time of the shortest measurement in the rows, [1] s; shorter ones count like it,
            because poses between two that were seen have no errors of their own.
    """

    lasts: Tensor
    covariance: Tensor
    errors: Tensor
    shortest: Tensor

    def __post_init__(self) -> None:
        shapes = {"lasts": (3,), "covariance": (3, 3), "errors": (3,), "shortest": (1,)}
        for name, shape in shapes.items():
            value = getattr(self, name).detach().double()
            if tuple(value.shape) != shape:
                raise ValueError(f"{name} must be of shape {shape}, not {tuple(value.shape)}")
            object.__setattr__(self, name, value)
        if any((each <= 0).any() for each in (self.lasts, self.errors, self.shortest)):
            raise ValueError("lasts, errors and shortest must be above 0")
        size = float(self.covariance.abs().max())
        own = torch.linalg.eigvalsh((self.covariance + self.covariance.T) / 2.0)
        same = torch.allclose(self.covariance, self.covariance.T, rtol=0, atol=1e-9 * size)
        if not same or float(own.min()) < -1e-9 * size:
            raise ValueError("covariance must be symmetric, with no eigenvalue below 0")

    def faded(self, excess: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances [B, 3] by an excess [B, 3] in times [B, 1] s, and what is left."""
        left = excess * torch.exp(-time / self.lasts)
        return self.lasts * (excess - left), left

    def believed(self, seconds: float) -> Tensor:
        """Return the gains G of a measurement over a time, s: a column for each part, [3, 3]."""
        seen, end = self._seen(seconds)
        return torch.linalg.solve(seen, end.T).T

    def corrected(self, excess: Tensor, off: Tensor, seconds: float) -> Tensor:
        """Return an excess [B, 3] by which speeds were measured; NaN: they were not.

        A robot that was seen to jump, by mistake or by a hand, does not go on so: a difference
        counts up to :data:`MOST` standard deviations.

        Args:
            excess: until now, [B, 3].
            off: measured minus simulated twists, [B, 3].
            seconds: time over which they were measured, s.
        """
        most = MOST * self._seen(seconds)[0].diagonal().sqrt()
        off = torch.maximum(torch.minimum(off.nan_to_num(0.0), most), -most)
        return excess + off @ self.believed(seconds).T

    def _seen(self, seconds: float) -> tuple[Tensor, Tensor]:
        """Return the covariances [3, 3] of what is seen, and of the excess at its end with it."""
        time = self.shortest.clamp(min=seconds)
        end, mean = (part.sqrt() for part in variances(time, self.lasts))
        of_end, of_mean = (self.covariance * part[:, None] * part for part in (end, mean))
        return of_mean + torch.diag(self.errors / time**2), of_end


def variances(time: Tensor, lasts: Tensor) -> tuple[Tensor, Tensor]:
    """Return a and b of the module for times and time constants, s, of shapes that fit."""
    z = time / lasts
    fades = -torch.expm1(-z)
    return fades / z, 2.0 * (z - fades) / z**2
