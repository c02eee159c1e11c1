"""The progress of trials that are still under way, step by step.

A trial's progress until now is what the task would say of it if it ended here; at first it is that
of standing still. :class:`Replayed` judges the whole trajectory anew after every step, which is
right for any task. A task whose progress follows from step to step has a score of its own, held
to that one by a test.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim.base.trajectory import Trajectory

#: Rows of a batch: places, or all.
Rows = NDArray[np.int64] | slice


class Interval(NamedTuple):
    """What happens to K trials from one command to the next.

    Attributes:
        poses: [K, 3] after it (m, m, rad).
        commands: [K, C] in it.
        readings: [K, S] at its beginning, or None.
        duration: of it, s.
        active: whether the controller gave the command; not while the motors run down.
    """

    poses: NDArray[np.float64]
    commands: NDArray[np.float64]
    readings: NDArray | None
    duration: float
    active: bool = True


class Score:
    """How far a batch of B trials has come.

    Attributes:
        task: by which.
        progress: [B] the task's progress, if the trials ended here.
        success: [B] bool, whether the task would then be done.
        over: [B] bool, whether nothing that follows counts any more.
    """

    def __init__(self, task: Any, count: int):
        self.task = task
        self.progress = np.zeros(count)
        self.success = np.zeros(count, np.bool_)
        self.over = np.zeros(count, np.bool_)

    def begin(self, rows: Rows, poses: NDArray[np.float64]) -> None:
        """Begin trials anew.

        Args:
            rows: K of the trials.
            poses: [K, 3] where the robots stand (m, m, rad).
        """
        raise NotImplementedError

    def add(self, rows: Rows, interval: Interval) -> None:
        """Go on with K of the trials."""
        raise NotImplementedError


class Replayed(Score):
    """Judges the whole trajectory after every step."""

    def __init__(self, task: Any, count: int, columns: int, sensors: int):
        """Make room; trials have commands of so many columns, and readings of so many sensors."""
        super().__init__(task, count)
        room = task.episode.steps + 1
        self._poses = np.zeros((count, room + 1, 3))
        self._commands = np.zeros((count, room, columns))
        self._readings = np.zeros((count, room, sensors)) if sensors else None
        self._durations = np.full((count, room), task.episode.step)
        self._active = np.zeros((count, room), np.bool_)
        self._length = np.zeros(count, np.int64)
        self._all = np.arange(count)

    def begin(self, rows: Rows, poses: NDArray[np.float64]) -> None:
        """Begin trials anew, with an interval in which the robots stand still."""
        rows = self._all[rows]
        self._poses[rows, :2] = poses[:, None]
        self._commands[rows, 0], self._active[rows, 0] = 0.0, False
        self._durations[rows, 0] = self.task.episode.step
        if self._readings is not None:
            self._readings[rows, 0] = 0.0
        self._judge(rows, 1)
        self._length[rows] = 0

    def add(self, rows: Rows, interval: Interval) -> None:
        """Go on with trials, and judge what they are until now."""
        rows = self._all[rows]
        at = self._length[rows]
        self._poses[rows, at + 1] = interval.poses
        self._commands[rows, at] = interval.commands
        self._durations[rows, at], self._active[rows, at] = interval.duration, interval.active
        if self._readings is not None:
            self._readings[rows, at] = interval.readings
        self._length[rows] += 1
        for length in np.unique(self._length[rows]):
            self._judge(rows[self._length[rows] == length], int(length))

    def _judge(self, rows: NDArray[np.int64], length: int) -> None:
        until = Trajectory(
            self._poses[rows, : length + 1],
            self._commands[rows, :length],
            self._durations[rows, :length],
            None if self._readings is None else self._readings[rows, :length],
            self._active[rows, :length],
        )
        self.progress[rows] = self.task.progress(until)
        self.success[rows] = self.task.judge(until).success
