"""Dead reckoning: a robot's pose from the counters of its wheels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.base.errors import RobotError
from neurosim.robots.base import Counters, WholeSpeeds

#: Largest factor of a wheel's speed over full speed, and largest error of a reading, in pulses.
FASTER, OFF = 1.5, 25
#: Number of times that a wrong reading is repeated.
TRIES = 3


class Odometry:
    """Computes a robot's pose from its counters, which are set to 0 at first.

    Between two readings both wheels are assumed to turn at steady speeds. Counters of an impossible
    distance are read again, because a line may change a digit.

    Args:
        robot: connected, standing.
        start: its pose, [3] (m, m, rad).

    Attributes:
        pose: by the last reading, [3] (m, m, rad unwrapped).
        counts: of the left and the right wheel, as last read.
    """

    def __init__(self, robot: Counters, start: ArrayLike):
        whole: Any = robot  # which has a clock, too
        whole.set_counts(0, 0)
        self._robot = whole
        self.counts: tuple[int, int] = (0, 0)
        self._asked: float = whole.clock.now()
        self.pose: NDArray[np.float64] = np.array(start, np.float64)

    def read(self) -> NDArray[np.float64]:
        """Read the counters; return the pose, [3].

        Raises:
            RobotError: if the distance is impossible each time.
        """
        robot, counts = self._robot, self._plausible_counts()
        left, right = (
            (after - before) / robot.pulses_per_metre
            for before, after in zip(self.counts, counts, strict=True)
        )
        twist = se2.of_wheels(left, right, robot.geometry.wheel_base)
        self.pose = se2.compose(self.pose, se2.exp(twist))
        self.counts = counts
        return self.pose

    def _plausible_counts(self) -> tuple[int, int]:
        clock, since, pulses = self._robot.clock, self._asked, 0
        fastest = self._fastest()
        for _ in range(TRIES):
            asked = clock.now()
            counts: tuple[int, int] = self._robot.read_counts()
            if math.isinf(fastest):
                return counts
            pulses = max(abs(now - before) for now, before in zip(counts, self.counts, strict=True))
            if pulses <= OFF + FASTER * fastest * (clock.now() - since):
                self._asked = asked
                return counts
        raise RobotError(
            f"the robot reports {pulses} pulses of a wheel, more than it can drive: check the "
            "cable, and whether the robot was switched off and on, and try again"
        )

    def _fastest(self) -> float:
        """Return a counter's rate at full speed, pulses/s; infinite if unknown."""
        robot: Any = self._robot
        if not isinstance(robot, WholeSpeeds):
            return math.inf
        return robot.full_speed * robot.speed_unit * self._robot.pulses_per_metre
