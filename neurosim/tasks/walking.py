"""Walk fast: the displacement over a trial (Zagal et al. 2004, section 5.2).

The paper's simulated trial lasts 20 s, and its real one until the robot reaches a circle. Here both
end at the circle: a gait that turns, or falls after some seconds, fails in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Step
from neurosim.base.trajectory import Episode
from neurosim.robots.quadruped import FRAME
from neurosim.tasks.base import Interval, Judgement, Task


@dataclass(frozen=True)
class Walking(Task):
    """A trial that ends at a circle or after some seconds; the fitness is displacement over time.

    A robot without a pose has fallen. A fall and a stall are failures, with speed 0.

    Attributes:
        seconds: Longest duration of a trial, s.
        step: Time between two commands of the joints, s.
        stall: Speed below which a robot has not walked, m/s.
        circle: Radius of the circle around the start where a trial ends, m; 0: no circle.
    """

    name: ClassVar[str] = "walking"
    reasons: ClassVar[tuple[str, ...]] = ("fell", "did not walk")
    fitness_unit: ClassVar[str] = "m/s"

    seconds: Annotated[float, Meta(ge=1, le=3600)] = 20.0
    step: Step = FRAME
    stall: Annotated[float, Meta(ge=0, le=100)] = 0.01
    circle: Annotated[float, Meta(ge=0, le=1000)] = 2.0

    @property
    def episode(self) -> Episode:
        """Commands in frames, of 8 ms by default."""
        steps = round(self.seconds / self.step)
        return Episode(step=self.step, steps=steps, circle=self.circle)

    def outline(self) -> list[dict[str, Any]]:
        """Return the circle."""
        return [{"circle": [*self.start[:2], self.circle]}] if self.circle else []

    def first_record(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the records [K, 9]: the usual columns, and the time at the circle (s; 0: none)."""
        return np.concatenate([super().first_record(poses), np.zeros((len(poses), 1))], axis=1)

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval; a robot without a pose has fallen."""
        going = record[:, 0] == 0
        fell = going & np.isnan(interval.poses).any(axis=-1)
        super().advance(record, interval)
        if self.circle:
            arrived = going & ~fell & (_gone(record) >= self.circle)
            record[arrived, 8] = record[arrived, 7]
            going &= ~arrived
        record[:, 0] = ~going | fell

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return speeds; before the circle, progress is as if the trial lasted its whole time."""
        arrived = record[:, 8] > 0
        fell = (record[:, 0] > 0) & ~arrived
        gone = np.where(arrived, self.circle, np.where(fell, 0.0, _gone(record)))
        speed = gone / np.maximum(np.where(arrived, record[:, 8], record[:, 7]), 1e-9)
        walked = speed >= self.stall
        fitness, progress = np.where(walked, speed, 0.0), gone / self.seconds
        why = np.where(fell, 0, 1)
        return Judgement.of(fitness, walked, why, progress=np.where(arrived, fitness, progress))


def _gone(record: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the displacements [K] of records, m."""
    return np.asarray(np.hypot(*(record[:, 4:6] - record[:, 1:3]).T))
