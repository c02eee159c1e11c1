"""Settings of a sampling, and the abilities of a robot that it needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Checked, CountOrNone
from neurosim.base.errors import UserError
from neurosim.robots.base import Counters, Proximity, Robot, WholeSpeeds
from neurosim.simulators.tables.sensor_table import LIGHT, OBSTACLE, WALL, cylinder

#: Number of speeds of a motor above which a robot drives a grid of them.
MOST_SPEEDS = 101
#: Range of a robot's sensors if it has no ``reach``, m.
REACH = 0.043


@runtime_checkable
class Sampler(Robot, Proximity, Counters, WholeSpeeds, Protocol):
    """A robot that can sample itself."""


@dataclass(frozen=True)
class SampleSettings(Checked):
    """Settings of a sampling.

    Attributes:
        angles: Number of angles of a full turn in the .sample files.
        distances: Number of distances from the object.
        first: First distance, from the robot's rim to the object's surface, m.
        step: From distance to distance, m; by default so that the last is as far as the sensors
            see, for a Khepera 2 mm.
        cylinders: Radii of the round obstacles, m.
        light: Also sample a light, with the sensors of ambient light.
        light_step: From distance to distance at the light, m.
        repeats: Repetitions; at least two to estimate sensor noise.
        grid: Drive a grid with this number of speeds of each motor, and some other settings to
            measure the interpolation error; 0: every whole speed of the robot. Evenly from full
            speed backward to full speed forward.
        held_out: Settings in addition to a grid, driven to measure the interpolation error.
        duration: Duration of a motor sample, s.
    """

    angles: Annotated[int, Meta(ge=4, le=3600)] = 180
    distances: Annotated[int, Meta(ge=2, le=1000)] = 20
    first: Annotated[float, Meta(ge=0, le=1)] = 0.005
    step: Annotated[float, Meta(ge=0.0001, le=1)] | None = None
    cylinders: tuple[Annotated[float, Meta(ge=0.001, le=1)], ...] = (OBSTACLE,)
    light: bool = False
    light_step: Annotated[float, Meta(ge=0.0001, le=1)] = 0.02
    repeats: Annotated[int, Meta(ge=1, le=1000)] = 1
    grid: CountOrNone = 0
    held_out: CountOrNone = 12
    duration: Annotated[float, Meta(ge=0.1, le=10)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "cylinders", tuple(self.cylinders))
        if not self.cylinders or len(set(self.kinds)) < len(self.kinds):
            raise UserError("give the radii of one or more round obstacles, each of another size")

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of objects to sample, in order."""
        return (WALL, *map(cylinder, self.cylinders), *(LIGHT,) * self.light)

    def of(self, robot: Sampler) -> SampleSettings:
        """Return the settings for a robot: with a step, in whole tenths of a millimetre."""
        reach = getattr(robot, "reach", REACH) - self.first
        step = max(round(reach / (self.distances - 1), 4), 0.0001)
        return self if self.step is not None else replace(self, step=step)

    def step_at(self, kind: str) -> float:
        """Return the difference of two distances from an object of a kind, m."""
        assert self.step is not None  # see of()
        return self.light_step if kind == LIGHT else self.step

    def away(self, kind: str) -> NDArray[np.float64]:
        """Return the distances from an object of a kind, [distances] m."""
        return self.first + self.step_at(kind) * np.arange(self.distances)

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
