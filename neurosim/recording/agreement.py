"""Whether a robot that is commanded to move is seen to move."""

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

#: What is seen is later than what was commanded, by the delays of radio, motor and camera: up to so
#: much, s, or up to that where light sensors guard the robot, and a slow camera may be used.
SLOWEST, SLOWEST_GUARDED = 0.4, 0.6
#: Sights are remembered for so long, s, one in so many; two say something if so far apart.
MEMORY, BETWEEN, APART = 1.4, 0.05, 0.4
#: Below this fraction of its full speed a robot may stand in its dead band.
DEAD_BAND = 0.15
#: A robot that should have moved by this fraction of its width, and is seen to move by less than
#: this fraction of that, stands.
FAR, STANDS = 0.3, 0.25


class Agreement:
    """Compares commands with sights, in the middle of a drive.

    Distances are the way of the robot's middle, and that of turning: of two wheels their mean way.

    Args:
        full_speed: m/s.
        arm: length at which a turn counts as a way, m; of two wheels half the track.

    Attributes:
        slowest: what is seen is at most so much later than what was commanded, s.
    """

    def __init__(self, full_speed: float, arm: float):
        self.slowest = SLOWEST
        self._arm = arm
        self._commands = Reckoning()
        self._seen: deque[tuple[float, NDArray]] = deque()
        self._full_speed = full_speed
        self._fastest: deque[tuple[float, float]] = deque([(-math.inf, 0.0)])

    def afresh(self) -> Agreement:
        """Return one of the same robot that remembers nothing."""
        other = Agreement(self._full_speed, self._arm)
        other.slowest = self.slowest
        return other

    def sent(self, time: float, twist: NDArray) -> None:
        """Remember that the robot was commanded a twist [3] (m/s, m/s, rad/s) at a time (s)."""
        fastest = math.hypot(twist[0], twist[1]) + self._arm * abs(twist[2])
        if fastest < DEAD_BAND * self._full_speed - 1e-9:
            twist, fastest = np.zeros(3), 0.0
        self._commands.sent(time, twist)
        self._fastest.append((time, fastest))
        while len(self._fastest) > 1 and self._fastest[1][0] < time - 2 * MEMORY:
            self._fastest.popleft()

    def seen(self, time: float, pose: NDArray) -> bool:
        """Remember that the robot was seen at a pose [3] at a time (s); return whether it counts.

        Sights that follow the last one at once say nothing new.
        """
        if self._seen and time < self._seen[-1][0] + BETWEEN:
            return False
        self._seen.append((time, np.asarray(pose, float)))
        while self._seen[0][0] < time - MEMORY:
            self._seen.popleft()
        return True

    def broken(self) -> bool:
        """Return whether, since some sight, the robot should have moved, and stands."""
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
        """The fastest that the robot was commanded to be lately, m/s."""
        return max(speed for _, speed in self._fastest)

    def _commanded(self, times: NDArray) -> NDArray:
        """Return the poses [T, 3] at some times [T] of a robot that does what it is commanded."""
        poses = [np.zeros(3)]
        for begin, end in pairwise(times):
            poses.append(self._commands.predict(poses[-1], begin, end)[0])
        return np.array(poses)

    def _distances(self, poses: NDArray) -> NDArray:
        """Return how far from each of the poses [T, 3] the robot was at most afterwards, [T] m."""
        change = poses[None] - poses[:, None]
        turn = np.abs(np.remainder(change[..., 2] + math.pi, 2 * math.pi) - math.pi)
        distance = np.hypot(change[..., 0], change[..., 1]) + self._arm * turn
        return np.triu(distance).max(axis=1)


class Pictures:
    """Sees that a picture is another one, where nothing is tracked: a place for each.

    ``last``, as a :class:`~neurosim.recording.spotter.Spotter` has it, is when the last picture
    arrived (s), and [3] where its number stands for a place far from the others.

    Args:
        on_seen: is shown every picture, in which nothing was found.
    """

    def __init__(self, on_seen: Callable[[Seen], None] | None = None) -> None:
        self._on_seen, self._taken = on_seen, 0
        self._lock = threading.Lock()
        self._picture: NDArray | None = None
        self._number = 0
        self._last: tuple[float, NDArray] | None = None

    @property
    def last(self) -> tuple[float, NDArray] | None:
        """Return when which picture arrived; see the class."""
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
