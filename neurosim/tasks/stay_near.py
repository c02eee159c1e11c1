"""Reach a target and stay near it: a light, or obstacles of one size among others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from neurosim.base.declared import Count, Metres, Pose, Seconds, Step
from neurosim.base.errors import UserError
from neurosim.base.place import Place, cylinder_arena, lit_arena
from neurosim.base.trajectory import Episode
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Interval, Judgement, Task

#: Difference of radii below which obstacles have the same size, m.
_SAME_SIZE = 0.0005
#: Distance of the default start from walls, m.
_ROOM = 0.05
#: Number of times that starts are drawn until there are enough.
_TRIES = 200


@dataclass(frozen=True)
class StayNear(Task):
    """Reach a target and stay near it; subclasses name the targets.

    Fitness is the fraction of the time near a target, less the fraction near an object to keep away
    from. ``progress`` also grows during the approach.

    Attributes:
        place: Place of the trials, a JSON file or a name.
        within: Distance from the robot's middle to the target that counts as near, m.
        stay: Time near the target at the end of a trial that counts as success, s.
        starts: Number of random poses from which a trial starts, none of them near a target.
        step: Time between two commands, s.
        seconds: Time of a trial from each start, s.
        contacts: The effect of a contact: free, none; or end: nothing counts after the first one.
            On a robot contacts are unknown.
    """

    reasons: ClassVar[tuple[str, ...]] = (
        "never came near the target",
        "did not stay near it",
        "touched something",
    )
    highest_fitness: ClassVar[float] = 1.0  # type: ignore[misc]

    place: Place | None = None
    within: Metres = 0.1
    stay: Seconds = 5.0
    starts: Count = 5
    step: Step = 0.1
    seconds: Seconds = 30.0
    contacts: Literal["free", "end"] = "free"

    @cached_property
    def targets(self) -> NDArray[np.float64]:
        """The targets, [N, 3]: x, y, radius (m).

        Raises:
            UserError: if the place has none.
        """
        raise NotImplementedError

    @cached_property
    def others(self) -> NDArray[np.float64]:
        """Round objects to keep away from, [N, 3]: x, y, radius (m)."""
        return np.empty((0, 3))

    @property
    def trial_starts(self) -> int:  # type: ignore[override]
        """Number of starts of a trial."""
        return self.starts

    @property
    def start(self) -> Pose:  # type: ignore[override]
        """The place's start, or a pose that is free and not near a target."""
        place = self.place
        assert place is not None
        if place.start is not None:
            return place.start
        rng = np.random.default_rng(0)
        return tuple(self._far(lambda: place.free_poses(1, _ROOM, rng), 1)[0].tolist())

    @property
    def episode(self) -> Episode:
        """Steps for ``seconds``; a trial ends moving."""
        steps = max(round(self.seconds / self.step), 1)
        return Episode(self.step, steps, contacts=self.contacts == "end")

    @property
    def usual_controller(self) -> str:
        """A network: the target is found by the sensors."""
        return "network"

    def draw_starts(
        self, simulator: Simulator, count: int, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """Return random poses [count, 3] without a contact and not near a target."""
        if simulator.free_poses(1, np.random.default_rng(0)) is None:
            return None
        return self._far(lambda: simulator.free_poses(count, rng), count)

    def first_record(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return records [K, 8].

        Their columns: touched something; last known position (m, m); time, time near a target, near
        another object, near a target without a break so far, and time weighted by nearness, s.
        """
        record = np.zeros((len(poses), 8))
        record[:, 1:3] = poses[:, :2]
        return record

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval, with the robot's pose at its end."""
        seen = np.isfinite(interval.poses).all(axis=1)
        record[seen, 1:3] = interval.poses[seen, :2]
        away = _distance(record[:, 1:3], self.targets)
        if interval.touching is not None and self.contacts == "end":
            record[:, 0] = (record[:, 0] > 0) | interval.touching
        free = record[:, 0] == 0
        near = free & (away <= self.within)
        wrong = free & ~near & (_distance(record[:, 1:3], self.others) <= self.within)
        record[:, 3] += interval.duration
        record[:, 4] += near * interval.duration
        record[:, 5] += wrong * interval.duration
        record[:, 6] = near * (record[:, 6] + interval.duration)
        record[:, 7] += free * self.within / np.maximum(away, self.within) * interval.duration

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return the fractions of the time; ``near`` and ``wrong`` are those of the two parts."""
        touched, _, _, time, near, wrong, lasting, close = record.T
        whole = np.maximum(time, 1e-9)
        # The sum of durations differs from the product by rounding.
        success = lasting >= self.stay - 1e-6
        return Judgement.of(
            (near - wrong) / whole,
            success,
            np.select([touched > 0, near > 0], [2, 1], 0),
            progress=(close - wrong) / whole,
            near=near / whole,
            wrong=wrong / whole,
        )

    def outline(self) -> list[dict[str, Any]]:
        """Return the place, and circles around the targets."""
        assert self.place is not None
        near = [[x, y, radius + self.within] for x, y, radius in self.targets.tolist()]
        return [*self.place.shapes(), *({"circle": circle} for circle in near)]

    def _far(self, draw: Callable[[], NDArray | None], count: int) -> NDArray[np.float64]:
        """Return ``count`` of the poses of ``draw``, those near no target."""
        assert self.place is not None
        starts = np.empty((0, 3))
        for _ in range(_TRIES):
            poses = draw()
            assert poses is not None
            if not self.place.inside(poses[:, :2]).all():
                raise UserError(f"{self.name} needs its own place: leave out --arenas")
            far = _distance(poses[:, :2], self.targets) > self.within
            starts = np.concatenate([starts, poses[far]])
            if len(starts) >= count:
                return starts[:count]
        raise UserError(
            "everywhere in this place is near a target: choose a smaller distance (within)"
        )


@dataclass(frozen=True)
class Phototaxis(StayNear):
    """Reach a light and stay near it.

    Fitness is the fraction of the time that the robot is near a light.

    Attributes:
        place: Place of the trials, with a light, a JSON file or a name; by default a room of 80 x
            60 cm with a light behind a wall.
        sees: Sensors that the robot has: of ambient light, or also of proximity.
    """

    name: ClassVar[str] = "phototaxis"

    sees: Literal["light", "both"] = "light"

    def __post_init__(self) -> None:
        if self.place is None:
            object.__setattr__(self, "place", lit_arena())
        super().__post_init__()

    @property
    def senses(self) -> tuple[str, ...]:  # type: ignore[override]
        """Ambient light, and proximity if it is wanted."""
        return ("light",) if self.sees == "light" else ("proximity", "light")

    @cached_property
    def targets(self) -> NDArray[np.float64]:
        """The place's lights."""
        assert self.place is not None
        return _some([(*light, 0.0) for light in self.place.lights], "light")


@dataclass(frozen=True)
class Discrimination(StayNear):
    """Stay near obstacles of one size, and away from walls and other obstacles.

    After Nolfi 1996, and the environment ErDiscrim of evorobotpy2, whose arena and distance are the
    defaults here. Fitness is the fraction of the time that the robot is near a target, less the
    fraction that it is near another obstacle.

    Attributes:
        place: Place of the trials, with a target, a JSON file or a name; by default a room of 40 x
            40 cm with a small cylinder.
        within: Distance from the robot's middle to the target's surface that counts as near, m.
        target: Radius of the obstacles to stay near, m.
        seconds: Time of a trial from each start, s.
    """

    name: ClassVar[str] = "discrimination"
    senses: ClassVar[tuple[str, ...]] = ("proximity",)  # type: ignore[misc]

    within: Metres = 0.0875
    target: Metres = 0.0125
    seconds: Seconds = 50.0

    def __post_init__(self) -> None:
        if self.place is None:
            object.__setattr__(self, "place", cylinder_arena())
        super().__post_init__()

    @cached_property
    def targets(self) -> NDArray[np.float64]:
        """The obstacles of the target's size."""
        named = f"obstacle of {1000 * self.target:g} mm radius"
        return _some(self._cylinders[self._are_targets], named)

    @cached_property
    def others(self) -> NDArray[np.float64]:
        """The other obstacles."""
        return self._cylinders[~self._are_targets]

    @property
    def _cylinders(self) -> NDArray[np.float64]:
        assert self.place is not None
        return self.place.cylinders

    @property
    def _are_targets(self) -> NDArray[np.bool_]:
        same: NDArray[np.bool_] = np.abs(self._cylinders[:, 2] - self.target) <= _SAME_SIZE
        return same


def _some(circles: Sequence[Any] | NDArray, what: str) -> NDArray[np.float64]:
    """Return circles [N, 3], at least one."""
    if not len(circles):
        raise UserError(f"this place has no {what}: add one to it")
    return np.array(circles, np.float64)


def _distance(points: NDArray[np.float64], circles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of points [K, 2] from the nearest of circles [N, 3], m; 0 inside."""
    away = np.linalg.norm(points[:, None] - circles[:, :2], axis=-1) - circles[:, 2]
    return np.maximum(away.min(axis=1, initial=np.inf), 0.0)
