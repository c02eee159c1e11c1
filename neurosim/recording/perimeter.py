"""A guard that keeps a tracked robot on the board by its predicted stopping point."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.perimeter import DISTANCE_ERROR, EDGE, ENDS, LINE, STOPPING

#: Time for which commands are kept, s.
MEMORY = 5.0


@dataclass(frozen=True)
class Stop:
    """The reason why the guard stopped the robot.

    Attributes:
        code: of :data:`neurosim.base.perimeter.ENDS`.
        time: time on the robot's clock, s.
        command: the number of the command, from 0; None: a manoeuvre.
        into: time since the start of the command, s.
        sensor: the light sensor that met the line or the edge; None: the position was guarded.
        pose: [3] pose of the robot, if it was known.
        unseen_since: time of the last sighting of a lost robot, s; None: never.
    """

    code: int
    time: float
    command: int | None = None
    into: float = 0.0
    sensor: str | None = None
    pose: tuple[float, ...] | None = None
    unseen_since: float | None = None

    def describe(self) -> dict[str, Any]:
        """Return the reason for recording.json."""
        return asdict(self)

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Stop:
        """Return the reason from the result of :meth:`describe`."""
        pose = content.get("pose")
        return cls(**{**content, "pose": None if pose is None else tuple(pose)})

    def __str__(self) -> str:
        """Return the reason as a sentence without a full stop."""
        words = f"the robot {ENDS[self.code - 1]}"
        if self.sensor is not None:
            words += f" by its light sensor {self.sensor}"
        if self.pose is not None:
            x, y, heading = self.pose
            place = f"x = {x:.2f} m, y = {y:.2f} m, heading {math.degrees(heading):.0f} degrees"
            words += f", {'last seen ' if self.code not in (LINE, EDGE) else ''}at {place}"
        if self.unseen_since is not None:
            words += f" {self.time - self.unseen_since:.1f} s before"
        if self.command is not None:
            words += f", {self.into:.1f} s into command {self.command + 1}"
        return words


class Reckoning:
    """Predicts a robot's pose from its last commands."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, list[float]]] = deque([(-math.inf, [0.0, 0.0, 0.0])])

    def sent(self, time: float, twist: NDArray) -> None:
        """Remember a commanded twist [3] (m/s, m/s, rad/s) and its time (s)."""
        self._sent.append((time, np.asarray(twist, float).tolist()))
        while len(self._sent) > 1 and self._sent[1][0] < time - MEMORY:
            self._sent.popleft()

    def predict(self, pose: NDArray, since: float, until: float) -> tuple[NDArray, float]:
        """Return the pose [3] at ``until`` (s), and the length of the path to it (m).

        Args:
            pose: pose of the robot at ``since``.
            since: s; at most :data:`MEMORY` ago.
            until: s; the last command continues until then.
        """
        x, y, heading = (float(value) for value in pose)
        distance, begins = 0.0, [*(begin for begin, _ in self._sent), math.inf]
        for (begin, (ahead, left, turn)), end in zip(self._sent, begins[1:], strict=True):
            seconds = min(end, until) - max(begin, since)
            if seconds > 0 and (ahead or left or turn):
                # se2.compose of se2.exp, which take ten times as long for one pose.
                half = 0.5 * turn * seconds
                chord = seconds * math.sin(half) / half if half else seconds
                cos, sin = chord * math.cos(heading + half), chord * math.sin(heading + half)
                x, y = x + cos * ahead - sin * left, y + sin * ahead + cos * left
                heading += 2.0 * half
                distance += math.hypot(ahead, left) * seconds
        return np.array([x, y, heading]), distance


class PositionGuard(Reckoning):
    """Keeps the middle of the robot's axle inside the edge of a board, by its position.

    Args:
        board: ``length`` and ``width`` in metres, the frame at its centre.
        margin: smallest distance of the middle of the axle from the board's edge, m.
    """

    def __init__(self, board: Mapping[str, float], margin: float):
        super().__init__()
        self._half = np.array([board["length"], board["width"]], float) / 2
        self._margin = margin

    def leaves(self, pose: NDArray, since: float, now: float) -> bool:
        """Return whether the robot must stop now to stand inside.

        A robot on its way back inside may continue.

        Args:
            pose: as last seen, [3].
            since: its time, s; if it is not known, the earliest.
            now: s.
        """
        here, _ = self.predict(pose, since, now)
        there, distance = self.predict(pose, since, now + STOPPING)
        beyond = self.beyond(there)
        return beyond + DISTANCE_ERROR * distance > 0 and beyond > self.beyond(here) + 1e-4

    def middle(self, clearance: float, rng: np.random.Generator) -> NDArray:
        """Return a random position [2] with ``clearance`` (m) to every edge, if any exists."""
        return rng.uniform(-1, 1, 2) * np.maximum(self._half - clearance, 0.0)

    def beyond(self, pose: NDArray) -> float:
        """Return a pose's distance beyond the margin, m; below 0 inside."""
        return float((np.abs(pose[:2]) - (self._half - self._margin)).max())
