"""To walk fast: the displacement over a trial (Zagal et al. 2004, section 5.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Episode, Trajectory
from neurosim.robots.quadruped import FRAME
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.score import Interval, Rows, Score

#: Who is slower has not walked, m/s.
STALL = 0.01

_NO_POSES = "the task walking needs the robot's poses: watch it with a camera"


@dataclass(frozen=True)
class Walking(Task):
    """A trial of some seconds; the fitness is the displacement divided by the time, m/s.

    Where there is no pose the robot has fallen. A fall and a stall are failures: no speed at all.

    Attributes:
        seconds: How long a trial is, s.
    """

    name: ClassVar[str] = "walking"
    reasons: ClassVar[tuple[str, ...]] = ("fell", "did not walk")
    fitness_unit: ClassVar[str] = "m/s"

    seconds: Annotated[float, Meta(ge=1, le=3600)] = 20.0

    @property
    def episode(self) -> Episode:
        """Commands in frames of 8 ms."""
        return Episode(step=FRAME, steps=round(self.seconds / FRAME))

    def judge(self, trajectory: Trajectory) -> Judgement:
        """Judge trajectories [...].

        Raises:
            UserError: if they have no poses.
        """
        if trajectory.poses is None:
            raise UserError(_NO_POSES)
        poses = trajectory.poses
        fell = np.asarray(np.isnan(poses).any(axis=(-1, -2)))
        gone = self._gone(poses[..., 0, :], poses[..., -1, :], fell)
        speed = gone / trajectory.times[..., -1]
        walked = speed >= STALL
        last = np.isnan(poses[..., 1:, 0]).argmax(axis=-1)
        segment = np.where(fell, last, poses.shape[-2] - 2)
        return Judgement.of(np.where(walked, speed, 0.0), walked, np.where(fell, 0, 1), segment)

    def progress(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return the displacement over the time of a whole trial, m/s; 0 of who fell.

        Of a whole trial that is the fitness of who walked.
        """
        if trajectory.poses is None:
            raise UserError(_NO_POSES)
        poses = trajectory.poses
        fell = np.asarray(np.isnan(poses).any(axis=(-1, -2)))
        return self._gone(poses[..., 0, :], poses[..., -1, :], fell) / self.seconds

    def score(self, count: int, columns: int, sensors: int) -> Score:
        """Return what follows the displacement step by step; a fall ends a trial."""
        return _Walk(self, count)

    @staticmethod
    def _gone(
        begin: NDArray[np.float64], end: NDArray[np.float64], fell: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return displacements [...] (m) between poses [..., 3]; 0 of who fell [...]."""
        return np.where(fell, 0.0, np.linalg.norm(end[..., :2] - begin[..., :2], axis=-1))


class _Walk(Score):
    """The displacement of trials under way."""

    def __init__(self, task: Walking, count: int):
        super().__init__(task, count)
        self._start, self._time = np.zeros((count, 3)), np.zeros(count)

    def begin(self, rows: Rows, poses: NDArray[np.float64]) -> None:
        self._start[rows], self._time[rows] = poses, 0.0
        self.progress[rows] = 0.0
        self.success[rows] = self.over[rows] = False

    def add(self, rows: Rows, interval: Interval) -> None:
        self.over[rows] |= np.isnan(interval.poses).any(axis=-1)
        self._time[rows] += interval.duration
        gone = self.task._gone(self._start[rows], interval.poses, self.over[rows])
        self.progress[rows] = gone / self.task.seconds
        self.success[rows] = gone >= STALL * self._time[rows]
