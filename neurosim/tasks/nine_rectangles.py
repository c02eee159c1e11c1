"""Once around nine rectangles, Pretorius et al. (2009), section 6.2, or a course like it.

The board's middle is divided into nine rectangles of 80 x 50 cm::

    +---+---+---+
    | 1 | 2 | 3 |      y
    +---+---+---+      ^
    |0,8| X | 4 |      |
    +---+---+---+      +--> x
    | 7 | 6 | 5 |
    +---+---+---+

The robot starts in the centre of the centre-left rectangle, facing rectangle 1. It must pass
through 1 to 7 in order and stop in its first rectangle, which counts as 8.
It must not enter the centre (X), leave the grid, or skip a rectangle. Size and order of the
rectangles are settings, for other boards.

Fitness is equation 2, F = N_max^2 - C_nogain / 10. N_max is the furthest rectangle reached; a robot
reaches 8 only if it ends there, so one that drives through it has 7. C_nogain counts the given
commands without progress along the course. The paper's commands last half a second at least
(:data:`COMMAND`); a shorter one counts as that part of a command. Counted whole, 600 commands of a
closed-loop controller would cost 60, and a robot that drives over the line would gain by ending its
trial. The paper reduces the fitness of a robot that breaks a rule "immediately" and "heavily", but
gives no number: here nothing after the breach counts (N_max stays, later commands gain nothing),
and ``penalty`` is subtracted. It is a constant, so that plans with more progress before a breach
still win; nearly all plans of the first generation have a breach.

Between two poses the robot is assumed to move on the arc of constant twist, whose centre is checked
every 2 cm or closer. If the heading changes by nearly a whole turn (or several) while the position
changes a little, this arc is very long, although the robot moved little. An arc longer than
``longest_arc``, farther than a robot drives in one command, is replaced by the straight line to the
end pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.base.declared import Metres, Seconds, Step
from neurosim.base.errors import UserError
from neurosim.base.perimeter import LONGEST_ARC
from neurosim.base.se2 import compiled as se2
from neurosim.base.trajectory import RUN_DOWN, Episode
from neurosim.tasks.base import Interval, Judgement, Task

#: The centre is checked at least this often, m.
SPACING = 0.02

#: The shortest command of the paper, s.
COMMAND = 0.5

#: Faults of a robot; 0: none.
FAULTS = {1: "entered a forbidden rectangle", 2: "left the grid", 3: "skipped a rectangle"}
_FORBIDDEN, _OUTSIDE, _SKIPPED = FAULTS
#: Columns of a record before the squares of the nearest distances to the goals (m^2): breach; pose
#: (3); progress; N_max below the last goal; C_nogain; fault; progress at the command's beginning;
#: present square of the distance from the last goal (m^2); time since the command's beginning (s).
_COLUMNS = 11
_NOT_THERE = "did not end in the last rectangle"


#: The number of a rectangle in the course.
_Number = Annotated[int, Meta(ge=-1, le=1000)]


@dataclass(frozen=True)
class NineRectangles(Task):
    """The course around nine rectangles; other grids by other settings.

    Attributes:
        penalty: Fitness that is subtracted if the rules are broken.
        longest_arc: A distance longer than any robot drives in one command, m.
        length: Length of a rectangle along x, m.
        width: Width of a rectangle along y, m.
        course: Number of each rectangle, rows from the top (largest y) down; -1 is forbidden.
            The numbers from 0 are passed in turn, and the last goal is 0 again.
        step: Time between two commands of a closed-loop controller, s.
        seconds: Time of a closed-loop controller, s.
    """

    penalty: Annotated[float, Meta(ge=0, le=1000000)] = 32.0
    longest_arc: Metres = LONGEST_ARC
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

    @cached_property
    def last(self) -> int:
        """The number of the last goal: the start, reached again."""
        return int(self._grid[0].max()) + 1

    @cached_property
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
        """Equation 2 for the last goal, with commands that all make progress."""
        return float(self.last**2)

    @property
    def stop_penalty(self) -> float:  # type: ignore[override]
        """A stop by the guard counts as a breach, too."""
        return self.penalty

    @property
    def episode(self) -> Episode:
        """Steps for ``seconds``, then a stop; goals are the rectangles' centres."""
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

    def first_record(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return records [K, 11 + goals]; see :data:`_COLUMNS`."""
        record = np.zeros((len(poses), _COLUMNS + self.last + 1))
        record[:, 1:4], record[:, _COLUMNS:] = poses, np.inf
        self._add(record, poses, 0.0, False, False, True)
        return record

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval; nothing counts after a breach, and commands then gain nothing."""
        given = interval.duration, interval.active, interval.ends
        self._add(record, interval.poses, *given, False)

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return equation 2; ``detail`` has ``furthest``, ``no_gain`` and ``fault`` of FAULTS.

        ``furthest`` is N_max, ``no_gain`` C_nogain. Progress adds the nearness to the next
        rectangle, up to most of the value of reaching it; the last one counts only at the robot's
        last pose.
        """
        fault, no_gain = record[:, 7].astype(np.int64), record[:, 6]
        success = (fault == 0) & (record[:, 4] == self.last)
        fitness, progress = np.empty(len(record)), np.empty(len(record))
        furthest = np.empty(len(record), np.int64)
        diagonal = math.hypot(self.length, self.width)
        _worth(record, self.last, diagonal, float(self.penalty), fitness, progress, furthest)
        why = np.where(fault > 0, fault, len(self.reasons)) - 1
        return Judgement.of(
            fitness,
            success,
            why,
            progress=progress,
            furthest=furthest,
            no_gain=no_gain,
            fault=fault,
        )

    def _add(
        self,
        record: NDArray[np.float64],
        poses: NDArray[np.float64],
        duration: NDArray[np.float64] | float,
        active: NDArray[np.bool_] | bool,
        ends: bool,
        begins: bool,
    ) -> None:
        seconds, given = np.full(len(record), duration), np.full(len(record), active, np.bool_)
        course = self._grid, self._goals, float(self.longest_arc)
        _add(record, np.ascontiguousarray(poses), seconds, given, ends, begins, *course)

    @cached_property
    def _goals(self) -> NDArray[np.float64]:
        """The centres [last + 1, 2] (m) of the rectangles that follow 0, 1, 2, ..."""
        return np.array([self.centre(number + 1) for number in range(self.last + 1)])

    def region(self, poses: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the rectangle of each pose [..., 3]: its number, -1 forbidden, -2 outside."""
        poses = np.asarray(poses, np.float64)
        regions = _places(poses[..., 0].ravel(), poses[..., 1].ravel(), self._grid)
        return regions.reshape(poses.shape[:-1])

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


@njit(nogil=True)
def _places(x: NDArray, y: NDArray, grid: tuple) -> NDArray:
    places = np.empty(len(x), np.int64)
    for i in range(len(x)):
        places[i] = _place(x[i], y[i], grid)
    return places


@njit(nogil=True)
def _room(x: float, y: float, grid: tuple) -> float:
    """Return the distance (m) of a point in the grid from the borders of its rectangle."""
    course, length, width = grid
    column, row = x / length + 0.5 * course.shape[1], 0.5 * course.shape[0] - y / width
    column, row = column - math.floor(column), row - math.floor(row)
    return min(length * min(column, 1.0 - column), width * min(row, 1.0 - row))


@njit(nogil=True)
def _place(x: float, y: float, grid: tuple) -> int:
    """Return the rectangle at a point: its number, -1 forbidden, -2 outside."""
    course, length, width = grid
    rows, columns = course.shape
    column, row = x / length + 0.5 * columns, 0.5 * rows - y / width
    # Compared before they are rounded, so that NaN is outside, too.
    if not (0.0 <= column < columns and 0.0 <= row < rows):
        return -2
    return course[int(row), int(column)]


@njit(nogil=True)
def _advance(progress: int, place: int, last: int) -> tuple[int, int]:
    """Return progress along the course after a step to ``place``, and the fault or 0.

    Progress counts rectangles from the start: it continues beyond the last in a second round, and
    falls when the robot drives back.
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


@njit(nogil=True)
def _segment(
    start_x: float,
    start_y: float,
    start_heading: float,
    end_x: float,
    end_y: float,
    end_heading: float,
    progress: int,
    longest: float,
    grid: tuple,
    last: int,
) -> tuple[int, int, int]:
    """Follow the arc between two poses; return progress, its highest, and the fault or 0."""
    x, y = end_x - start_x, end_y - start_y
    chord = math.sqrt(x * x + y * y)
    turn = end_heading - start_heading
    # Also true for NaN.
    if not (chord < 10.0 and abs(turn) < 1e6):
        return progress, progress, _OUTSIDE
    length = se2.arc_length(x, y, turn)
    if not length < longest:
        turn, length = 0.0, chord
    samples = math.ceil(length / SPACING)
    highest = progress
    # Samples nearer than the rectangle's border cannot be beyond it.
    sample = max(1, int(_room(start_x, start_y, grid) / length * samples)) if samples > 1 else 1
    while sample < samples:
        at_x, at_y = se2.arc(x, y, turn, sample / samples)
        at_x, at_y = start_x + at_x, start_y + at_y
        progress, fault = _advance(progress, _place(at_x, at_y, grid), last)
        highest = max(highest, progress)
        if fault:
            return progress, highest, fault
        sample += max(1, int(_room(at_x, at_y, grid) / length * samples))
    progress, fault = _advance(progress, _place(end_x, end_y, grid), last)
    return progress, max(highest, progress), fault


@njit(nogil=True)
def _begin(x: float, y: float, grid: tuple, last: int) -> tuple[int, int]:
    """Return progress at a start, and the fault or 0."""
    progress, fault = _advance(0, _place(x, y, grid), last)
    return (progress, fault) if progress == 0 else (0, _SKIPPED)


@njit(nogil=True)
def _add(
    record: NDArray,
    poses: NDArray,
    seconds: NDArray,
    active: NDArray,
    ends: bool,
    begins: bool,
    grid: tuple,
    goals: NDArray,
    longest: float,
) -> None:
    """Move robots with records [K, W] to poses [K, 3], or begin at these; see :data:`_COLUMNS`."""
    _, length, width = grid
    last = len(goals) - 1
    for k in range(len(record)):
        x, y, heading = poses[k, 0], poses[k, 1], poses[k, 2]
        record[k, 10] += seconds[k]
        moves = x != record[k, 1] or y != record[k, 2] or heading != record[k, 3]
        if not (begins or active[k] or moves):
            record[k, 10] = 0.0
            continue
        progress, fault = int(record[k, 4]), int(record[k, 7])
        if begins:
            progress, fault = _begin(x, y, grid, last)
        elif fault == 0:
            progress, highest, fault = _segment(
                record[k, 1],
                record[k, 2],
                record[k, 3],
                x,
                y,
                heading,
                progress,
                longest,
                grid,
                last,
            )
            record[k, 5] = max(record[k, 5], min(highest, last - 1))
        if ends:
            if active[k] and min(progress, last) <= record[k, 8]:
                # One in which nothing was seen has no duration, and counts whole.
                record[k, 6] += min(record[k, 10] / COMMAND, 1.0) if record[k, 10] > 0.0 else 1.0
            record[k, 10] = 0.0
            record[k, 8] = min(progress, last)
        record[k, 9] = np.inf
        # After a breach nothing counts.
        if fault == 0 and math.isfinite(x) and math.isfinite(y):
            for goal in range(len(goals)):
                off_x = max(abs(x - goals[goal, 0]) - 0.5 * length, 0.0)
                off_y = max(abs(y - goals[goal, 1]) - 0.5 * width, 0.0)
                square = off_x * off_x + off_y * off_y
                record[k, _COLUMNS + goal] = min(record[k, _COLUMNS + goal], square)
                if goal == last - 1:
                    record[k, 9] = square
        record[k, 0] = 1.0 if fault != 0 else 0.0
        record[k, 4], record[k, 7] = progress, fault
        record[k, 1], record[k, 2], record[k, 3] = x, y, heading


@njit(nogil=True)
def _worth(
    record: NDArray,
    last: int,
    diagonal: float,
    penalty: float,
    fitness: NDArray,
    progress: NDArray,
    furthest: NDArray,
) -> None:
    """Write the values [K] of records [K, W]; see :meth:`NineRectangles.worth`."""
    for k in range(len(record)):
        breach, most = record[k, 7] != 0.0, int(record[k, 5])
        success = not breach and record[k, 4] == last
        if success:
            most = last
        furthest[k] = most
        fitness[k] = most * most - record[k, 6] / 10.0 - (penalty if breach else 0.0)
        away = record[k, _COLUMNS + most]
        if most == last - 1 and not breach:
            away = record[k, 9]
        near = min(max(1.0 - math.sqrt(away) / diagonal, 0.0), 1.0)
        progress[k] = fitness[k] + (0.0 if success else 0.9 * (2 * most + 1) * near)
