"""What a robot samples of itself, and what it must be able to for that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.robots.base import Counters, Proximity, Robot, WholeSpeeds

#: A robot with more whole speeds of a motor than this drives a grid of them.
MOST_SPEEDS = 101


@runtime_checkable
class Sampler(Robot, Proximity, Counters, WholeSpeeds, Protocol):
    """A robot that can sample itself."""


@dataclass(frozen=True)
class SampleSettings:
    """What to sample.

    Attributes:
        angles: Angles of a full turn in the .sample files.
        distances: Distances from the object.
        first: First distance, from the robot's rim to the object's surface, m.
        step: From distance to distance, m.
        repeats: Repetitions; at least two to estimate sensor noise.
        grid: Drive a grid of so many speeds of each motor, and some settings beside it that show
            what interpolation costs; 0: every whole speed of the robot. Evenly from full speed
            backward to full speed forward.
        held_out: Settings beside a grid that are driven to see what interpolation costs.
        duration: Duration of a motor sample, s.
    """

    angles: int = 180
    distances: int = 20
    first: float = 0.005
    step: float = 0.002
    repeats: int = 1
    grid: int = 0
    held_out: int = 12
    duration: float = 1.0

    def __post_init__(self) -> None:
        if self.angles < 4 or self.distances < 2 or self.repeats < 1 or self.held_out < 0:
            raise UserError("sample at 4 angles or more, 2 distances or more, once or more")
        if not (0 <= self.first <= 1 and 0 < self.step <= 1):
            raise UserError("distances must be above 0 and below 1 m")
        if not 0.1 <= self.duration <= 10:
            raise UserError(f"a motor sample lasts 0.1 to 10 s, not {self.duration:g}")

    def levels(self, full_speed: int) -> NDArray[np.int64]:
        """Return the speeds to drive, in the robot's units.

        Raises:
            UserError: if a grid's speeds are not whole, or there is no grid and the robot has too
                many speeds to drive them all.
        """
        count = self.grid or 2 * full_speed + 1
        if not self.grid and count > MOST_SPEEDS:
            raise UserError(
                f"every pair of the robot's {count:,} speeds would be {count**2:,} settings to "
                "drive: choose a grid of them (--grid)"
            )
        if count < 2 or (2 * full_speed) % (count - 1):
            good = [n + 1 for n in range(1, 2 * full_speed + 1) if 2 * full_speed % n == 0]
            more = " ..." if len(good) > 12 else ""
            raise UserError(
                f"a grid of {count} does not fall on the robot's {2 * full_speed + 1} whole "
                f"speeds; use {', '.join(map(str, good[:12]))}{more}"
            )
        return np.arange(-full_speed, full_speed + 1, 2 * full_speed // (count - 1))
