"""To walk fast: the displacement over a trial (Zagal et al. 2004, section 5.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Episode, Trajectory
from neurosim.robots.quadruped import FRAME
from neurosim.tasks.base import Judgement, Task

#: Who is slower has not walked, m/s.
STALL = 0.01


@dataclass(frozen=True)
class Walking(Task):
    """A trial of some seconds; the fitness is the displacement divided by the time, m/s.

    Where there is no pose the robot has fallen. A fall and a stall are failures: no speed at all.

    Attributes:
        seconds: How long a trial is, s.
    """

    name: ClassVar[str] = "walking"
    reasons: ClassVar[tuple[str, ...]] = ("fell", "did not walk")

    seconds: float = 20.0

    def __post_init__(self) -> None:
        if not self.seconds >= 1.0:
            raise UserError(f"a trial of walking takes a second at least, not {self.seconds:g}")

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
            raise UserError("the task walking needs the robot's poses: watch it with a camera")
        poses = trajectory.poses
        fell = np.isnan(poses).any(axis=(-1, -2))
        way = np.linalg.norm(poses[..., -1, :2] - poses[..., 0, :2], axis=-1)
        speed = np.where(fell, 0.0, way / trajectory.times[..., -1])
        walked = speed >= STALL
        last = np.isnan(poses[..., 1:, 0]).argmax(axis=-1)
        segment = np.where(fell, last, poses.shape[-2] - 2)
        return Judgement.of(np.where(walked, speed, 0.0), walked, np.where(fell, 0, 1), segment)
