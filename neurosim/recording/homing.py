"""The direction to the inside, for a robot that knows only its commands.

The area inside the perimeter line is convex: the straight path from a point on the line to any
former position of the robot is inside. Former positions come from dead reckoning by commands, which
is accurate for about half a minute and needs no sensor.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2


class Homing:
    """Dead reckoning with a memory of the robot's positions.

    Args:
        memory: time for which positions are kept, s.
    """

    def __init__(self, memory: float = 30.0):
        self._memory = memory
        self._pose = np.zeros(3)
        self._trail: deque[tuple[float, float, float]] = deque()  # seconds, x, y
        self._time = 0.0

    def moved(self, twist: NDArray, seconds: float) -> None:
        """Move by a twist [3] (m/s, m/s, rad/s) for some seconds."""
        steps = max(1, math.ceil(seconds / 0.1))
        step = se2.exp(np.asarray(twist, float) * seconds / steps)
        for _ in range(steps):
            self._pose = se2.compose(self._pose, step)
            self._time += seconds / steps
            self._trail.append((self._time, self._pose[0], self._pose[1]))
        while self._trail and self._trail[0][0] < self._time - self._memory:
            self._trail.popleft()

    def turn_inside(self) -> tuple[float, float]:
        """Return the turn (rad, at most a quarter turn) and the sign of the drive.

        The direction is to the mean of the former positions, forwards (+1) or backwards (-1),
        whichever needs the smaller turn.
        """
        places = np.array([place[1:] for place in self._trail])
        return bearing(self._pose, places.mean(axis=0) if len(places) else np.zeros(2))


def bearing(pose: NDArray, goal: NDArray) -> tuple[float, float]:
    """Return the turn (rad, at most a quarter turn) and the sign of the drive to a goal.

    The goal is reached forwards (+1) or backwards (-1), whichever needs the smaller turn.

    Args:
        pose: [3] in metres and radians.
        goal: [2] in metres.
    """
    x, y = goal - pose[:2]
    if math.hypot(x, y) < 1e-6:
        return 0.0, -1.0
    ahead = math.remainder(math.atan2(y, x) - pose[2], 2 * math.pi)
    if abs(ahead) <= math.pi / 2:
        return ahead, 1.0
    return math.remainder(ahead + math.pi, 2 * math.pi), -1.0
