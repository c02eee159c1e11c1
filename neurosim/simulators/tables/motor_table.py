"""A motor table: a robot's motion at every setting of its two motors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import files, se2
from neurosim.base.errors import FileError, UserError

#: Largest speed in a table, m/s and rad/s.
FASTEST = 1000.0

_COLUMNS = ("left", "right", "duration", "dx", "dy", "dtheta")


@dataclass(frozen=True, eq=False)
class MotorTable:
    """Body twists by the speeds of the left and the right motor.

    A sampled displacement is stored as its constant twist, which also gives other durations; its
    spread grows with the square root of the duration, like independent errors.

    Attributes:
        levels: (L,) speeds in percent, the same for both motors, evenly spaced and ascending.
        twist: (L, L, 3) forward m/s, to the left m/s, counter-clockwise rad/s; left x right.
        spread: (L, L, 3) standard deviations of the twist's integral over one second, or None if no
            setting was driven twice.
        resolution: difference of two possible speeds, %, to which commands are rounded; 0 if any
            speed is possible.
    """

    levels: NDArray[np.float64]
    twist: NDArray[np.float64]
    spread: NDArray[np.float64] | None = None
    resolution: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.levels)
        if count < 2 or self.twist.shape != (count, count, 3):
            raise ValueError("expected two levels or more and twists (levels, levels, 3)")
        gaps = np.diff(self.levels)
        if gaps[0] <= 0 or not np.allclose(gaps, gaps[0], rtol=1e-6):
            uneven = int(np.argmin(np.isclose(gaps, gaps[0], rtol=1e-6)))
            raise UserError(
                f"motors must be sampled at evenly spaced speeds: {self.levels[0]:g} and "
                f"{self.levels[1]:g} % are {gaps[0]:g} apart, {self.levels[uneven]:g} and "
                f"{self.levels[uneven + 1]:g} % are {gaps[uneven]:g}"
            )
        holes = np.argwhere(~np.isfinite(self.twist).all(-1))
        if len(holes):
            left, right = self.levels[holes[0]]
            raise UserError(
                f"the motor table has {len(holes)} holes, the first at left {left:g} %, "
                f"right {right:g} %; drive these settings too"
            )
        fastest = np.abs(self.twist).max()
        if fastest > FASTEST:
            raise UserError(
                f"the motor table has a speed of {fastest:g} m/s or rad/s; the limit is {FASTEST:g}"
            )

    @property
    def full_speed(self) -> float:
        """Return the speed straight on at the highest setting of both motors, m/s."""
        return float(self.twist[-1, -1, 0])

    @property
    def wheel_base(self) -> float:
        """Return the distance between the wheels by the turns on the spot, m."""
        turn = self.twist[0, -1, 2] - self.twist[-1, 0, 2]
        forward = self.twist[-1, -1, 0] - self.twist[0, 0, 0]
        return math.inf if turn == 0 else abs(float(2 * forward / turn))

    @classmethod
    def ideal(
        cls, wheel_base: float = 0.053, full_speed: float = 0.1, *, units: int = 10
    ) -> MotorTable:
        """Return the table of an ideal differential drive, for a robot without samples.

        Args:
            wheel_base: distance between the wheels, m; the Khepera's by default.
            full_speed: of a wheel at 100 %, m/s.
            units: number of the robot's forward speeds, the largest of which is full speed.
        """
        levels = np.linspace(-100.0, 100.0, 2 * units + 1)
        left, right = np.meshgrid(
            levels / 100 * full_speed, levels / 100 * full_speed, indexing="ij"
        )
        twist = se2.of_wheels(left, right, wheel_base)
        return cls(levels, twist, None, 100.0 / units)

    @classmethod
    @np.errstate(over="ignore", invalid="ignore")
    def from_samples(
        cls,
        left: ArrayLike,
        right: ArrayLike,
        duration: ArrayLike,
        displacement: ArrayLike,
        *,
        resolution: float = 0.0,
    ) -> MotorTable:
        """Make a table from displacements; every pair of speeds was driven at least once.

        Args:
            left, right: (N,) percent.
            duration: (N,) s.
            displacement: (N, 3) m, m, rad, in the robot's frame at the start.
            resolution: of the robot's speeds, %.

        Raises:
            UserError: if a pair is missing, or speeds are not evenly spaced.
        """
        left, right, duration = (np.asarray(v, float) for v in (left, right, duration))
        integral = se2.log(displacement)
        levels = np.unique(np.concatenate([left, right]))
        if len(levels) < 2:
            raise UserError("motors must be sampled at two speeds or more")
        twist = np.full((len(levels), len(levels), 3), np.nan)
        spread = np.full_like(twist, np.nan)
        for i, at_left in enumerate(levels):
            for j, at_right in enumerate(levels):
                here = (left == at_left) & (right == at_right)
                if not here.any():
                    continue
                twist[i, j] = integral[here].sum(axis=0) / duration[here].sum()
                if not np.isfinite(twist[i, j]).all():
                    raise UserError(
                        f"the samples at left {at_left:g} %, right {at_right:g} % give no speed: "
                        "their displacement is too large for a number"
                    )
                if here.sum() > 1:
                    off = integral[here] - twist[i, j] * duration[here, None]
                    variance = (off**2 / duration[here, None]).sum(axis=0) / (here.sum() - 1)
                    spread[i, j] = np.sqrt(variance)
        return cls(levels, twist, spread if np.isfinite(spread).all() else None, resolution)

    @classmethod
    def read_csv(cls, path: str | Path, *, resolution: float = 0.0) -> MotorTable:
        """Make a table from a CSV file or a dataset with left, right, duration, dx, dy, dtheta.

        Raises:
            FileError: if the file is wrong, has a duration that is not above
                zero, or does not sample every pair of evenly spaced speeds.
        """
        path = Path(path) / "dataset.csv" if Path(path).is_dir() else Path(path)
        table = files.read_csv(path, dict.fromkeys(_COLUMNS, files.number))
        if table.empty:
            raise FileError(path, "has no rows; expected a command in each")
        wrong = table["duration"] <= 0
        files.refuse_lines(path, table, wrong, "expected a duration above 0 s", "duration")
        displacement = table[["dx", "dy", "dtheta"]].to_numpy()
        try:
            return cls.from_samples(
                table["left"],
                table["right"],
                table["duration"],
                displacement,
                resolution=resolution,
            )
        except FileError:
            raise
        except UserError as error:
            raise FileError(path, str(error)) from None
