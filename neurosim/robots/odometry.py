"""Where a robot is, by the counters of its wheels: dead reckoning."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.robots.base import Counters


class Odometry:
    """Tells a robot's pose by its counters, which are set to 0 at first.

    Between two readings both wheels are taken to turn at steady speeds.

    Args:
        robot: connected, standing.
        start: where it stands, [3] (m, m, rad).

    Attributes:
        pose: by the last reading, [3] (m, m, rad unwrapped).
        counts: of the left and the right wheel, as last read.
    """

    def __init__(self, robot: Counters, start: ArrayLike):
        robot.set_counts(0, 0)
        self._robot, self.counts = robot, (0, 0)
        self.pose: NDArray[np.float64] = np.array(start, np.float64)

    def read(self) -> NDArray[np.float64]:
        """Read the counters; return the pose that they stand for, [3]."""
        robot, counts = self._robot, self._robot.read_counts()
        left, right = (
            (after - before) / robot.pulses_per_metre
            for before, after in zip(self.counts, counts, strict=True)
        )
        turn = (right - left) / robot.geometry.wheel_base
        self.pose = se2.compose(self.pose, se2.exp([(left + right) / 2, 0.0, turn]))
        self.counts = counts
        return self.pose
