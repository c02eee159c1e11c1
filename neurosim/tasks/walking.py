"""Walk fast: the displacement over a trial (Zagal et al. 2004, section 5.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Step
from neurosim.base.trajectory import Episode
from neurosim.robots.quadruped import FRAME
from neurosim.tasks.base import Interval, Judgement, Task


@dataclass(frozen=True)
class Walking(Task):
    """A trial of some seconds; the fitness is the displacement divided by the time, m/s.

    A robot without a pose has fallen. A fall and a stall are failures, with speed 0.

    Attributes:
        seconds: Duration of a trial, s.
        step: Time between two commands of the joints, s.
        stall: Speed below which a robot has not walked, m/s.
    """

    name: ClassVar[str] = "walking"
    reasons: ClassVar[tuple[str, ...]] = ("fell", "did not walk")
    fitness_unit: ClassVar[str] = "m/s"

    seconds: Annotated[float, Meta(ge=1, le=3600)] = 20.0
    step: Step = FRAME
    stall: Annotated[float, Meta(ge=0, le=100)] = 0.01

    @property
    def episode(self) -> Episode:
        """Commands in frames, of 8 ms by default."""
        return Episode(step=self.step, steps=round(self.seconds / self.step))

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval; a robot without a pose has fallen."""
        record[:, 0] = (record[:, 0] > 0) | np.isnan(interval.poses).any(axis=-1)
        super().advance(record, interval)

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return speeds; progress is the displacement over the time of a whole trial, m/s."""
        fell = record[:, 0] > 0
        gone = np.where(fell, 0.0, np.linalg.norm(record[:, 4:6] - record[:, 1:3], axis=-1))
        speed = gone / np.maximum(record[:, 7], 1e-9)
        walked = speed >= self.stall
        fitness = np.where(walked, speed, 0.0)
        return Judgement.of(fitness, walked, np.where(fell, 0, 1), progress=gone / self.seconds)
