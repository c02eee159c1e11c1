"""Once around nine rectangles, Pretorius et al. (2009), section 6.2, or a course like it.

The board's middle is divided into nine rectangles of 80 x 50 cm::

    +---+---+---+
    | 1 | 2 | 3 |      y
    +---+---+---+      ^
    |0,8| X | 4 |      |
    +---+---+---+      +--> x
    | 7 | 6 | 5 |
    +---+---+---+

The robot starts in the centre of the centre-left rectangle, facing rectangle 1, is to pass
through 1 to 7 in order and to end, stopped, in the rectangle it started in, which counts as 8.
It must not enter the centre (X), leave the grid, or skip a rectangle. Another board has other
rectangles: their size and order are settings.

Fitness is equation 2, F = N_max^2 - C_nogain / 10. N_max is the furthest rectangle reached; 8
is reached only by a robot that ends there, so one that drives through it has 7. C_nogain counts
the given commands that end no further along the course than they began. The paper reduces the
fitness of a robot that breaks a rule "immediately" and "heavily" without saying by how much:
here nothing after the breach counts any more (N_max stays, later commands gain nothing), and
``penalty`` is taken off. It is a constant, so that among plans with a breach, as nearly all of
the first generation are, those that come further before it still win.

Between two poses the robot is taken to move on the arc of constant twist, checked at its centre
every 2 cm or closer. Where the heading changes by nearly a whole turn (or several) while the
place changes, that arc grows without bound, however little the robot really moved: an arc longer
than ``longest_arc``, farther than a robot drives in one command, is replaced by the straight
line to the end pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numba import njit, prange
from numpy.typing import NDArray

from neurosim.base.declared import Metres, Seconds, Step
from neurosim.base.errors import UserError
from neurosim.base.se2 import compiled as se2
from neurosim.base.trajectory import RUN_DOWN, Episode, Trajectory
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.score import Interval, Rows, Score

#: The centre is checked at least this often, m.
SPACING = 0.02

#: What a robot can do wrong; 0 is nothing.
FAULTS = {1: "entered a forbidden rectangle", 2: "left the grid", 3: "skipped a rectangle"}
_FORBIDDEN, _OUTSIDE, _SKIPPED = FAULTS
_NOT_THERE = "did not end in the last rectangle"


#: The number of a rectangle in the course.
_Number = Annotated[int, Meta(ge=-1, le=1000)]


@dataclass(frozen=True)
class NineRectangles(Task):
    """The course around nine rectangles; other grids by other settings.

    Attributes:
        penalty: What a breach of the rules takes off the fitness.
        longest_arc: Farther than a robot drives in one command, m.
        length: Length of a rectangle along x, m.
        width: Width of a rectangle along y, m.
        course: Number of each rectangle, rows from the top (largest y) down; -1 is forbidden.
            The numbers from 0 are passed in turn, and the last goal is 0 again.
        step: Time between two commands of a controller that sees, s.
        seconds: Time that a controller that sees has, s.
    """

    penalty: Annotated[float, Meta(ge=0, le=1000000)] = 32.0
    longest_arc: Metres = 1.5
    length: Metres = 0.80
    width: Metres = 0.50
    course: tuple[tuple[_Number, ...], ...] = ((1, 2, 3), (0, -1, 4), (7, 6, 5))
    step: Step = 0.1
    seconds: Seconds = 60.0

    name: ClassVar[str] = "nine-rectangles"
    reasons: ClassVar[tuple[str, ...]] = (*FAULTS.values(), _NOT_THERE)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "course", tuple(map(tuple, self.course)))
        if self.seconds < self.step:
            raise UserError(f"a trial of {self.seconds:g} s is shorter than one step")
        numbers = sorted(n for row in self.course for n in row if n != -1)
        if len({len(row) for row in self.course}) != 1 or numbers != list(range(len(numbers))):
            raise UserError(
                "course must be rows of equal length with the numbers 0, 1, 2, ... once each, and "
                f"-1 for forbidden rectangles, not {self.course}"
            )
        if len(numbers) < 3:
            raise UserError("a course has at least 3 rectangles to pass")

    @property
    def last(self) -> int:
        """The number of the last goal: the start, reached again."""
        return int(self._grid[0].max()) + 1

    @property
    def _grid(self) -> tuple[NDArray[np.int64], float, float]:
        return np.array(self.course, np.int64), float(self.length), float(self.width)

    def centre(self, number: int) -> tuple[float, float]:
        """Return the centre (m) of a rectangle; the last goal is 0."""
        course, length, width = self._grid
        row, column = np.argwhere(course == number % self.last)[0]
        rows, columns = course.shape
        return (column + 0.5 - columns / 2) * length, (rows / 2 - row - 0.5) * width

    @property
    def start(self) -> tuple[float, float, float]:  # type: ignore[override]
        """The centre of rectangle 0, facing rectangle 1."""
        (x, y), (to_x, to_y) = self.centre(0), self.centre(1)
        return float(x), float(y), math.atan2(to_y - y, to_x - x)

    @property
    def highest_fitness(self) -> float:  # type: ignore[override]
        """Equation 2 of the last goal, reached by commands that all gain something."""
        return float(self.last**2)

    @property
    def episode(self) -> Episode:
        """Steps for ``seconds``, then the motors run down; goals are the rectangles' centres."""
        places = [self.centre(number) for number in range(1, self.last + 1)]
        ahead = np.diff(np.array([*places, self.centre(self.last + 1)]), axis=0)
        headings = np.arctan2(ahead[:, 1], ahead[:, 0])
        return Episode(
            step=self.step,
            steps=round(self.seconds / self.step),
            rest=RUN_DOWN,
            goals=np.column_stack([places, headings]),
            reach=0.3 * min(self.length, self.width),
        )

    def judge(self, trajectory: Trajectory) -> Judgement:
        """Judge trajectories by their poses: at the boundaries of commands, or all that were seen.

        A pose that is not finite is outside the grid.

        Returns:
            Fitness and success (ended in the last rectangle without a breach); in ``detail``
            ``furthest`` (N_max), ``no_gain`` (C_nogain) and ``fault`` (a key of FAULTS or 0).

        Raises:
            UserError: if there are no poses.
        """
        poses, active = _flat(trajectory)
        ends = np.ones(active.shape[1], np.bool_)
        if trajectory.segment is not None:
            ends = np.append(np.diff(trajectory.segment) > 0, True)
        furthest, no_gain, fault, where = _drive(
            poses, active, ends, float(self.longest_arc), self._grid
        )
        fitness = furthest**2 - no_gain / 10.0 - self.penalty * (fault != 0)
        success = furthest == self.last
        reason = np.where(success, -1, np.where(fault > 0, fault, len(self.reasons)) - 1)
        if trajectory.segment is not None:
            where = trajectory.segment[where]
        detail = {"furthest": furthest, "no_gain": no_gain, "fault": fault}
        shape = trajectory.shape
        return Judgement(
            fitness.reshape(shape),
            success.reshape(shape),
            reason.reshape(shape),
            where.reshape(shape),
            {name: value.reshape(shape) for name, value in detail.items()},
        )

    def progress(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return the fitness [...] and how near the robot came to the next rectangle.

        Near a rectangle most of what reaching it would add is given already; the last one only
        for where the robot ends. Nothing counts after a breach.
        """
        judged, (poses, _) = self.judge(trajectory), _flat(trajectory)
        furthest = judged.detail["furthest"].ravel()
        off = np.abs(poses[..., :2] - self._goals[furthest][:, None])
        away = np.linalg.norm(np.maximum(off - (self.length / 2, self.width / 2), 0.0), axis=-1)
        away = np.where(np.isfinite(away), away, np.inf)
        steps = np.arange(away.shape[1])
        segment = judged.segment.ravel()
        if trajectory.segment is not None:
            segment = np.searchsorted(trajectory.segment, segment, side="left")
        fault = judged.detail["fault"].ravel() != 0
        over = fault[:, None] & (steps > segment[:, None])
        early = (furthest == self.last - 1)[:, None] & ~fault[:, None] & (steps < steps[-1])
        nearest = np.where(over | early, np.inf, away).min(axis=1)
        reach = math.hypot(self.length, self.width)
        share = np.clip(1.0 - nearest / reach, 0.0, 1.0)
        gain = np.where(judged.success.ravel(), 0.0, 0.9 * (2 * furthest + 1) * share)
        return judged.fitness + gain.reshape(judged.fitness.shape)

    @property
    def _goals(self) -> NDArray[np.float64]:
        """The centres [last + 1, 2] (m) of the rectangles that follow 0, 1, 2, ..."""
        return np.array([self.centre(number + 1) for number in range(self.last + 1)])

    def score(self, count: int, columns: int, sensors: int) -> Score:
        """Return what follows the course step by step; a breach of the rules ends a trial."""
        return _Course(self, count)

    def region(self, poses: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the rectangle of each pose [..., 3]: its number, -1 forbidden, -2 outside."""
        poses = np.asarray(poses, np.float64)
        found = _places(poses[..., 0].ravel(), poses[..., 1].ravel(), self._grid)
        return found.reshape(poses.shape[:-1])

    def outline(self) -> list[dict[str, Any]]:
        """Return the rectangles with their numbers."""
        course, length, width = self._grid
        rows, columns = course.shape
        shapes: list[dict[str, Any]] = []
        for (row, column), number in np.ndenumerate(course):
            x, y = (column - columns / 2) * length, (rows / 2 - row - 1) * width
            corners = [[x, y], [x + length, y], [x + length, y + width], [x, y + width]]
            label = "forbidden" if number < 0 else str(number or self.last)
            where = {"at": [x + length / 2, y + width / 2], "forbidden": bool(number < 0)}
            shapes.append({"polygon": corners, "forbidden": bool(number < 0)})
            shapes.append({"text": label, **where})
        return shapes


def _flat(trajectory: Trajectory) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return poses [B, T + 1, 3] and active [B, T] of trajectories."""
    if trajectory.poses is None:
        raise UserError("the course can only be judged where the robot's poses are known")
    poses = np.ascontiguousarray(trajectory.poses, np.float64)
    poses = poses.reshape(-1, *poses.shape[-2:])
    active = trajectory.active
    if active is None:
        active = np.ones(trajectory.commands.shape[:-1], np.bool_)
    return poses, np.ascontiguousarray(active, np.bool_).reshape(len(poses), -1)


@njit(cache=True, nogil=True)
def _places(x: NDArray, y: NDArray, grid: tuple) -> NDArray:
    places = np.empty(len(x), np.int64)
    for i in range(len(x)):
        places[i] = _place(x[i], y[i], grid)
    return places


@njit(cache=True, nogil=True)
def _room(x: float, y: float, grid: tuple) -> float:
    """Return how far (m) a point in the grid is from the borders of its rectangle."""
    course, length, width = grid
    column, row = x / length + 0.5 * course.shape[1], 0.5 * course.shape[0] - y / width
    column, row = column - math.floor(column), row - math.floor(row)
    return min(length * min(column, 1.0 - column), width * min(row, 1.0 - row))


@njit(cache=True, nogil=True)
def _place(x: float, y: float, grid: tuple) -> int:
    """Return the rectangle at a point: its number, -1 forbidden, -2 outside."""
    course, length, width = grid
    rows, columns = course.shape
    column, row = x / length + 0.5 * columns, 0.5 * rows - y / width
    # Compared before they are rounded: what is not a number is outside too.
    if not (0.0 <= column < columns and 0.0 <= row < rows):
        return -2
    return course[int(row), int(column)]


@njit(cache=True, nogil=True)
def _advance(progress: int, place: int, last: int) -> tuple[int, int]:
    """Return progress along the course after a step to ``place``, and the fault or 0.

    Progress counts rectangles from the start: it goes on beyond the last on a second round, and
    falls when the robot goes back.
    """
    if place == -2:
        return progress, _OUTSIDE
    if place == -1:
        return progress, _FORBIDDEN
    step = (place - progress) % last
    if step == 0:
        return progress, 0
    if step == 1:
        return progress + 1, 0
    if step == last - 1 and progress > 0:
        return progress - 1, 0
    return progress, _SKIPPED


@njit(cache=True, nogil=True)
def _segment(
    start: NDArray,
    end: NDArray,
    progress: int,
    longest: float,
    grid: tuple,
    last: int,
) -> tuple[int, int, int]:
    """Follow the arc between two poses; return progress, its highest, and the fault or 0."""
    x, y = end[0] - start[0], end[1] - start[1]
    chord = math.sqrt(x * x + y * y)
    turn = end[2] - start[2]
    # Also true where anything is not a number.
    if not (chord < 10.0 and abs(turn) < 1e6):
        return progress, progress, _OUTSIDE
    length = se2.arc_length(x, y, turn)
    if not length < longest:
        turn, length = 0.0, chord
    samples = math.ceil(length / SPACING)
    highest = progress
    # Samples that are nearer than the rectangle's border cannot lie beyond it.
    sample = max(1, int(_room(start[0], start[1], grid) / length * samples)) if samples > 1 else 1
    while sample < samples:
        at_x, at_y = se2.arc(x, y, turn, sample / samples)
        at_x, at_y = start[0] + at_x, start[1] + at_y
        progress, fault = _advance(progress, _place(at_x, at_y, grid), last)
        highest = max(highest, progress)
        if fault:
            return progress, highest, fault
        sample += max(1, int(_room(at_x, at_y, grid) / length * samples))
    progress, fault = _advance(progress, _place(end[0], end[1], grid), last)
    return progress, max(highest, progress), fault


@njit(cache=True, nogil=True)
def _begin(pose: NDArray, grid: tuple, last: int) -> tuple[int, int]:
    """Return progress at a start, and the fault or 0."""
    progress, fault = _advance(0, _place(pose[0], pose[1], grid), last)
    return (progress, fault) if progress == 0 else (0, _SKIPPED)


@njit(cache=True, nogil=True, parallel=True)
def _drive(
    poses: NDArray,
    given: NDArray,
    ends: NDArray,
    longest: float,
    grid: tuple,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return N_max, C_nogain, the fault and the segment it happened in (B,) of trajectories.

    Args:
        poses: (B, S + 1, 3).
        given: (B, S) whether each segment is part of a given command.
        ends: (S,) whether each segment is the last of its command.
        longest: arcs longer than this are replaced by their chords, m.
        grid: course, length and width (m) of a rectangle.
    """
    batch, segments = given.shape
    last = grid[0].max() + 1
    furthest = np.zeros(batch, np.int64)
    no_gain = np.zeros(batch, np.int64)
    faults = np.zeros(batch, np.int64)
    where = np.full(batch, max(segments - 1, 0))
    for b in prange(batch):
        progress, fault = _begin(poses[b, 0], grid, last)
        if fault != 0:
            where[b] = 0
        began = 0
        for s in range(segments):
            if fault == 0:
                progress, highest, fault = _segment(
                    poses[b, s], poses[b, s + 1], progress, longest, grid, last
                )
                furthest[b] = max(furthest[b], min(highest, last - 1))
                if fault != 0:
                    where[b] = s
            if ends[s]:
                if given[b, s] and min(progress, last) <= began:
                    no_gain[b] += 1
                began = min(progress, last)
        if fault == 0 and progress == last:
            furthest[b] = last
        faults[b] = fault
    return furthest, no_gain, faults, where


class _Course(Score):
    """Rectangles passed by trials under way; every interval is a command."""

    def __init__(self, task: NineRectangles, count: int):
        super().__init__(task, count)
        self._course = task._grid, task._goals, float(task.longest_arc), task.penalty
        self._pose = np.zeros((count, 3))
        #: Progress, N_max below the last goal, C_nogain and the fault of each.
        self._at = np.zeros((count, 4), np.int64)
        #: How near each came to the rectangle that follows each, m.
        self._nearest = np.zeros((count, task.last + 1))
        self._every = np.arange(count)

    def begin(self, rows: Rows, poses: NDArray[np.float64]) -> None:
        self._at[rows], self._nearest[rows], self._pose[rows] = 0, np.inf, poses
        self._go_on(rows, poses, False, True)

    def add(self, rows: Rows, interval: Interval) -> None:
        self._go_on(rows, interval.poses, interval.active, False)

    def _go_on(self, rows: Rows, poses: NDArray[np.float64], active: bool, begins: bool) -> None:
        state = self._pose, self._at, self._nearest
        found = self.progress, self.success, self.over
        poses = np.ascontiguousarray(poses)
        _go_on(self._every[rows], poses, active, begins, *self._course, *state, *found)


@njit(cache=True, parallel=True)
def _go_on(
    rows: NDArray,
    poses: NDArray,
    active: bool,
    begins: bool,
    grid: tuple,
    goals: NDArray,
    longest: float,
    penalty: float,
    before: NDArray,
    at: NDArray,
    nearest: NDArray,
    value: NDArray,
    success: NDArray,
    over: NDArray,
) -> None:
    """Go on by a command to poses [K, 3]; as :func:`_drive` and :meth:`NineRectangles.progress`."""
    _, length, width = grid
    last, reach = len(goals) - 1, math.sqrt(length * length + width * width)
    for k in prange(len(rows)):
        b = rows[k]
        x, y = poses[k, 0], poses[k, 1]
        progress, fault = at[b, 0], at[b, 3]
        if begins:
            progress, fault = _begin(poses[k], grid, last)
        began = min(progress, last)
        if fault == 0:
            progress, highest, fault = _segment(before[b], poses[k], progress, longest, grid, last)
            at[b, 1] = max(at[b, 1], min(highest, last - 1))
        if active and min(progress, last) <= began:
            at[b, 2] += 1
        done = fault == 0 and progress == last
        furthest = last if done else at[b, 1]
        away = np.inf
        if math.isfinite(x) and math.isfinite(y):
            for goal in range(len(goals)):
                off_x = max(abs(x - goals[goal, 0]) - 0.5 * length, 0.0)
                off_y = max(abs(y - goals[goal, 1]) - 0.5 * width, 0.0)
                here = math.sqrt(off_x * off_x + off_y * off_y)
                if fault == 0:  # after a breach nothing counts
                    nearest[b, goal] = min(nearest[b, goal], here)
                if goal == furthest:
                    away = here
        if furthest != last - 1 or fault != 0:  # the last goal counts only where the robot ends
            away = nearest[b, furthest]
        value[b] = furthest * furthest - at[b, 2] / 10.0 - penalty * (fault != 0)
        if not done:
            share = min(max(1.0 - away / reach, 0.0), 1.0)
            value[b] += 0.9 * (2 * furthest + 1) * share
        success[b], over[b] = done, fault != 0
        at[b, 0], at[b, 3] = progress, fault
        before[b] = poses[k]
