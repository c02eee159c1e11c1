"""Go to a pose, or to several in turn, without touching a wall or an obstacle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import Metres, MetresOrNone, Pose, Seconds, Step, Turn
from neurosim.base.errors import UserError
from neurosim.base.perimeter import LONGEST_ARC
from neurosim.base.place import Place, to_segment
from neurosim.base.trajectory import RUN_DOWN, Episode
from neurosim.tasks.base import Interval, Judgement, Task

if TYPE_CHECKING:
    from neurosim.simulators.base import Simulator

#: Distance of a robot whose pose is unknown, m.
_FAR = 1e3
#: Distance of a piece of an arc from its chord that does not count, m; longest piece, on which only
#: one goal is passed, m; largest number of pieces.
_STRAIGHT, _LONG, _PIECES = 0.005, 0.2, 24


@dataclass(frozen=True)
class GoTo(Task):
    """Drive to poses in turn and stop at the last.

    Fitness is the number of passed goals, plus the covered fraction of the distance to the next
    one; at the last goal also its accuracy. After a contact nothing counts.

    Attributes:
        goals: List of poses to pass: x (m), y (m), heading (rad) of each; the heading counts at the
            last one only.
        begin: Start pose: x (m), y (m), heading (rad); by default that of the place, or the origin.
        place: Place of the trials, a JSON file or a name; by default without walls and obstacles.
        radius: Radius of the robot, m: its centre keeps this distance from walls and obstacles.
        within: Distance within which a goal is passed, m.
        tolerance: Distance from the last goal within which the robot must stop, m.
        heading_tolerance: Difference from the last goal's heading within which the robot must stop,
            rad; by default its heading does not matter.
        step: Time between two commands of a closed-loop controller, s.
        seconds: Time of a closed-loop controller, s.
        area: Length and width of a board, m: trials start anywhere on it, and end at a last goal
            that is anywhere on it, too. Both are moved together until the goal is at the task's
            goal, so a controller that gets only the goal's relative position learns to go anywhere.
            By default all trials start at begin.
    """

    name: ClassVar[str] = "go-to"
    replanned: ClassVar[bool] = True
    reasons: ClassVar[tuple[str, ...]] = (
        "touched a wall or an obstacle",
        "did not pass all goals",
        "did not stop at the last goal",
        "stopped at the last goal, turned wrongly",
    )

    goals: tuple[Pose, ...] = ((0.6, 0.3, 0.0),)
    begin: Pose | None = None
    place: Place | None = None
    radius: MetresOrNone = 0.09
    within: Metres = 0.08
    tolerance: Metres = 0.05
    heading_tolerance: Turn | None = None
    step: Step = 0.1
    seconds: Seconds = 15.0
    area: tuple[Metres, Metres] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "goals", tuple(tuple(map(float, goal)) for goal in self.goals))
        if self.begin is not None:
            object.__setattr__(self, "begin", tuple(map(float, self.begin)))
        if not self.goals:
            raise UserError("go-to needs at least one goal: x (m), y (m), heading (rad)")
        if self.area is not None:
            object.__setattr__(self, "area", tuple(map(float, self.area)))
            if len(self.goals) > 1 or self._solids is not None:
                raise UserError(
                    "area (random starts) needs a single goal and a place without walls: leave "
                    "out area"
                )
        if self._solids is not None:
            self._solids.check_start(self.start, self.radius)
            for goal in self.goals:
                if self._solids.clearance(goal[:2]) < self.radius - self.within:
                    raise UserError(
                        f"the robot cannot reach the goal at x {100 * goal[0]:.1f} cm, y "
                        f"{100 * goal[1]:.1f} cm: a wall or an obstacle is there"
                    )

    @property
    def start(self) -> Pose:  # type: ignore[override]
        """Start pose of a trial."""
        if self.begin is not None:
            return self.begin
        own = None if self.place is None else self.place.start
        return (0.0, 0.0, 0.0) if own is None else own

    @property
    def highest_fitness(self) -> float:  # type: ignore[override]
        """Fitness with all goals passed and the last one reached exactly, with its heading."""
        return float(len(self.goals) + 1 + (self.heading_tolerance is not None))

    #: A robot that the guard stops at the last goal gets no more than one that just reaches it.
    stop_penalty: ClassVar[float] = 0.5  # type: ignore[misc]

    @property
    def episode(self) -> Episode:
        """Steps for ``seconds``, then a stop."""
        steps = max(round(self.seconds / self.step), 1)
        return Episode(self.step, steps, RUN_DOWN, np.array(self.goals), self.within)

    def draw_starts(
        self, simulator: Simulator, count: int, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """Return start poses [count, 3] in ``area``, or None."""
        if self.area is None:
            return None
        start, goal = (anywhere(self.area, count, rng) for _ in range(2))
        return se2.compose(np.array(self.goals[-1]), se2.between(goal, start))

    def first_record(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return records [K, 5 + goals].

        Their columns: touched a wall; pose (3); goals passed; nearest distance to each goal (m).
        """
        record = np.full((len(poses), 5 + len(self.goals)), _FAR)
        record[:, 0], record[:, 1:4], record[:, 4] = 0.0, _finite(poses), 0.0
        self._add(record, record[:, 1:4])
        return record

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval, in which the robot drives an arc; nothing counts after a wall.

        An arc longer than any robot drives in one command is replaced by a straight line.
        """
        poses = _finite(interval.poses)
        # Of short steps nothing more needs to be computed.
        change = np.abs(poses - record[:, 1:4])
        x, y, turns = (float(change[:, column].max(initial=0.0)) for column in range(3))
        if turns <= 1.0 and 1.1 * (x + y) * max(turns / 8.0 / _STRAIGHT, 1.0 / _LONG) <= 1.0:
            self._add(record, poses)
            return
        before = record[:, 1:4].copy()
        moved = se2.between(before, poses)
        length = se2.arc_length(moved)
        curved, pieces = length <= LONGEST_ARC, np.ones(len(poses))
        length, turn = length[curved], np.abs(moved[curved, 2])
        most = np.maximum(np.sqrt(length * turn / 8.0 / _STRAIGHT), length / _LONG)
        pieces[curved] = np.clip(np.ceil(most), 1.0, _PIECES)
        for piece in range(1, int(pieces.max(initial=1.0))):
            rows = np.flatnonzero(pieces > piece)
            own = record[rows]
            self._add(own, se2.compose(before[rows], se2.arc(moved[rows], piece / pieces[rows])))
            record[rows] = own
        self._add(record, poses)

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return passed goals and the accuracy at the last; ``distance`` (m), ``turn`` (rad)."""
        goals, last = self._goals, len(self.goals) - 1
        passed, nearest = record[:, 4].astype(np.int64), record[:, 5:]
        touched, end = record[:, 0] > 0, record[:, 1:4]
        away = np.linalg.norm(end[:, :2] - goals[last, :2], axis=-1)
        turned = np.abs(se2.wrapped(end[:, 2] - goals[last, 2]))
        legs = np.linalg.norm(np.diff([self.start[:2], *goals[:, :2]], axis=0), axis=1)
        if self.area is not None:
            legs[0] = math.hypot(*self.area)
        rows, goal = np.arange(len(end)), np.minimum(passed, last)
        fitness = passed + np.clip(1.0 - nearest[rows, goal] / np.maximum(legs[goal], 1e-6), 0, 1)
        there = (passed >= len(goals)) & ~touched
        good = away <= self.tolerance
        fine = np.ones_like(good)
        if self.heading_tolerance is not None:
            fine = turned <= self.heading_tolerance
        # All passed goals give len(goals); accuracy at the last one up to 1 more, or 2 with a
        # heading.
        hit = 1.0 / (1.0 + away / self.tolerance)
        if self.heading_tolerance is not None:
            hit = hit + 1.0 / (1.0 + turned / self.heading_tolerance)
        fitness = np.where(passed >= len(goals), len(goals) + np.where(touched, 0.0, hit), fitness)
        success = there & good & fine
        reason = np.select([touched, ~there, ~good], [0, 1, 2], 3)
        return Judgement.of(fitness, success, reason, passed=passed, distance=away, turn=turned)

    def outline(self) -> list[dict[str, Any]]:
        """Return the place, and goals as circles."""
        shapes = [] if self.place is None else self.place.shapes()
        for number, (x, y, _) in enumerate(self.goals, start=1):
            shapes.append({"circle": [x, y, self.within]})
            shapes.append({"text": str(number), "at": [x, y]})
        return shapes

    @cached_property
    def _goals(self) -> NDArray[np.float64]:
        """The poses [N, 3] to pass."""
        return np.array(self.goals)

    @property
    def _solids(self) -> Place | None:
        """The place, if it has solid parts."""
        return self.place if self.place is not None and self.place.solid else None

    def _touches(self, before: NDArray, after: NDArray) -> NDArray[np.bool_]:
        """Return whether a robot touches a wall or an obstacle [...] between points [..., 2]."""
        near = np.zeros(before.shape[:-1], np.bool_)
        if self._solids is None:
            return near
        for x1, y1, x2, y2 in self._solids.surfaces:
            ends = np.array([x1, y1]), np.array([x2, y2])
            near |= _between_segments(before, after, *ends) < self.radius
        for x, y, radius in self._solids.cylinders:
            near |= to_segment(np.array([x, y]), before, after) < radius + self.radius
        return near

    def _add(self, record: NDArray[np.float64], poses: NDArray[np.float64]) -> None:
        """Move robots with records [K, W] straight to poses [K, 3]."""
        before, after, counts = record[:, 1:3].copy(), poses[:, :2], record[:, 0] == 0
        goals = self._goals[:, :2]
        rows = np.arange(len(record))
        goal = np.minimum(record[:, 4].astype(np.int64), len(goals) - 1)
        distance = to_segment(goals[goal], before, after)
        least = np.minimum(record[rows, 5 + goal], distance)
        record[rows, 5 + goal] = np.where(counts, least, record[rows, 5 + goal])
        record[:, 4] += counts & (distance <= self.within) & (record[:, 4] < len(goals))
        record[:, 0] = ~counts | self._touches(before, after)
        record[:, 1:4] = poses


def anywhere(
    area: tuple[float, float], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return poses [count, 3] (m, m, rad) anywhere on a board of this length and width, m."""
    half = np.array([*area, 2.0 * math.pi]) / 2.0
    return rng.uniform(-half, half, (count, 3))


def _finite(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses, with unknown ones far away."""
    return np.nan_to_num(poses, nan=_FAR, posinf=_FAR, neginf=-_FAR)


def _between_segments(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> NDArray:
    """Return the distances [...] of the segments a to b [..., 2] to the segment c to d [2]."""

    def side(p: NDArray, q: NDArray, r: NDArray) -> NDArray:
        u, v = q - p, r - p
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    crosses = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    ends = [to_segment(c, a, b), to_segment(d, a, b), to_segment(a, c, d), to_segment(b, c, d)]
    return np.where(crosses, 0.0, np.minimum.reduce(ends))
