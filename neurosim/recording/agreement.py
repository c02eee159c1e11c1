"""A check that a robot moves when it is commanded to move."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurosim.recording.perimeter import Reckoning
from tracking.live import Seen
from tracking.markers.pair import LOST

#: Largest delay of a sight after its command, by radio, motor and camera, s; and the largest if
#: light sensors guard the robot, so that a slow camera may be used.
SLOWEST, SLOWEST_GUARDED = 0.4, 0.6
#: Time for which sights are kept, s; time between two kept ones; and time between two that are
#: compared.
MEMORY, BETWEEN, APART = 1.4, 0.05, 0.4
#: Below this fraction of its full speed a robot may stand in its dead band.
DEAD_BAND = 0.15
#: A robot stands if it should have moved by this fraction of its width, and moved by less than this
#: fraction of that distance.
FAR, STANDS = 0.3, 0.25


class Agreement:
    """Compares commands with sights, in the middle of a drive.

    Distances are those of the robot's middle and of turning: for two wheels, their mean distance.

    Args:
        full_speed: m/s.
        arm: length that converts a turn into a distance, m; for two wheels half the track.

    Attributes:
        slowest: largest delay of a sight after its command, s.
    """

    def __init__(self, full_speed: float, arm: float):
        self.slowest = SLOWEST
        self._arm = arm
        self._commands = Reckoning()
        self._seen: deque[tuple[float, NDArray]] = deque()
        self._full_speed = full_speed
        self._fastest: deque[tuple[float, float]] = deque([(-math.inf, 0.0)])

    def afresh(self) -> Agreement:
        """Return a copy for the same robot without memory."""
        other = Agreement(self._full_speed, self._arm)
        other.slowest = self.slowest
        return other

    def sent(self, time: float, twist: NDArray) -> None:
        """Remember a commanded twist [3] (m/s, m/s, rad/s) and its time (s)."""
        fastest = math.hypot(twist[0], twist[1]) + self._arm * abs(twist[2])
        if fastest < DEAD_BAND * self._full_speed - 1e-9:
            twist, fastest = np.zeros(3), 0.0
        self._commands.sent(time, twist)
        self._fastest.append((time, fastest))
        while len(self._fastest) > 1 and self._fastest[1][0] < time - 2 * MEMORY:
            self._fastest.popleft()

    def seen(self, time: float, pose: NDArray) -> bool:
        """Remember a seen pose [3] and its time (s); return whether it counts.

        A sight too soon after the last one does not count.
        """
        if self._seen and time < self._seen[-1][0] + BETWEEN:
            return False
        self._seen.append((time, np.asarray(pose, float)))
        while self._seen[0][0] < time - MEMORY:
            self._seen.popleft()
        return True

    def broken(self) -> bool:
        """Return whether the robot stands, although it should have moved since some sight."""
        if not self._seen:
            return False
        times = np.array([time for time, _ in self._seen])
        apart = times[-1] - times >= APART
        moved = self._distances(np.array([pose for _, pose in self._seen]))
        if not apart.any() or (moved >= STANDS * self._speed * (times[-1] - times))[apart].all():
            return False
        delays = np.linspace(0.0, self.slowest, 1 + round(self.slowest / 0.1))
        should = np.min([self._distances(self._commanded(times - late)) for late in delays], axis=0)
        return bool((apart & (should > 2 * FAR * self._arm) & (moved < STANDS * should)).any())

    @property
    def _speed(self) -> float:
        """The largest speed of the last commands, m/s."""
        return max(speed for _, speed in self._fastest)

    def _commanded(self, times: NDArray) -> NDArray:
        """Return the poses [T, 3] at times [T] of a robot that follows its commands ideally."""
        poses = [np.zeros(3)]
        for begin, end in pairwise(times):
            poses.append(self._commands.predict(poses[-1], begin, end)[0])
        return np.array(poses)

    def _distances(self, poses: NDArray) -> NDArray:
        """Return the largest later distance of the robot from each of the poses [T, 3], [T] m."""
        change = poses[None] - poses[:, None]
        turn = np.abs(np.remainder(change[..., 2] + math.pi, 2 * math.pi) - math.pi)
        distance = np.hypot(change[..., 0], change[..., 1]) + self._arm * turn
        return np.triu(distance).max(axis=1)


class Pictures:
    """Notices new pictures if nothing is tracked, and gives each a different position.

    Like that of a :class:`~neurosim.recording.spotter.Spotter`, ``last`` is the time of the last
    picture (s) and a pose [3]; its position comes from the picture's number, far from the others.

    Args:
        on_seen: called with every picture, without markers.
    """

    def __init__(self, on_seen: Callable[[Seen], None] | None = None) -> None:
        self._on_seen, self._taken = on_seen, 0
        self._lock = threading.Lock()
        self._picture: NDArray | None = None
        self._number = 0
        self._last: tuple[float, NDArray] | None = None

    @property
    def last(self) -> tuple[float, NDArray] | None:
        """Return the time and the position of the last picture; see the class."""
        with self._lock:
            return self._last

    def take(self, time: float, picture: NDArray) -> None:
        """Take a picture that arrived at a time (s)."""
        if self._picture is None or not np.array_equal(self._picture, picture):
            self._number += 1
            self._picture = picture.copy()
        with self._lock:
            self._last = time, np.array([float(self._number), 0.0, 0.0])
        if self._on_seen is not None:
            self._on_seen(Seen(self._taken, time, time, picture, LOST))
        self._taken += 1
