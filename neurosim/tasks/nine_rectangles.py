"""Once around nine rectangles, Pretorius et al. (2009), section 6.2.

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
It must not enter the centre (X), leave the grid, or skip a rectangle.

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
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.se2 import compiled as se2
from neurosim.tasks.base import Evaluation

#: Rectangles, m: along x, along y.
LENGTH, WIDTH = 0.80, 0.50
#: Number of each rectangle, top row first; the centre has none.
COURSE = np.array([[1, 2, 3], [0, -1, 4], [7, 6, 5]])
LAST = 8
#: The centre is checked at least this often, m.
SPACING = 0.02

#: What a robot can do wrong; 0 is nothing.
FAULTS = {1: "entered the centre rectangle", 2: "left the grid", 3: "skipped a rectangle"}
_CENTRE, _OUTSIDE, _SKIPPED = FAULTS
_NOT_THERE = "did not end in rectangle 8"


@dataclass(frozen=True)
class NineRectangles:
    """The course around nine rectangles.

    Attributes:
        penalty: what a breach of the rules takes off the fitness.
        longest_arc: no robot drives farther than this in one command, m.
    """

    penalty: float = 32.0
    longest_arc: float = 1.5

    name: ClassVar[str] = "nine-rectangles"
    reasons: ClassVar[tuple[str, ...]] = (*FAULTS.values(), _NOT_THERE)
    start: ClassVar[tuple[float, float, float]] = (-LENGTH, 0.0, math.pi / 2)

    def __post_init__(self) -> None:
        if not (self.penalty >= 0 and self.longest_arc > 0):
            raise UserError("penalty must not be negative, and longest_arc must be above 0")

    def evaluate(self, poses: ArrayLike, given: ArrayLike) -> Evaluation:
        """Judge trajectories by their poses at the boundaries of commands.

        Args:
            poses: (B, K + 1, 3) x, y (m), heading (rad, unwrapped) before the first of K
                segments and after each. A pose that is not finite is outside the grid.
            given: (B, K) bool; False for null commands and for what follows the last command.

        Returns:
            Fitness and ``completes`` (ended in rectangle 8 without a breach); in ``detail``
            ``furthest`` (N_max), ``no_gain`` (C_nogain) and ``fault`` (a key of FAULTS or 0).

        Raises:
            ValueError: if the shapes do not fit.
        """
        poses = np.ascontiguousarray(poses, np.float64)
        given = np.ascontiguousarray(given, np.bool_)
        batch, segments = given.shape
        if poses.shape != (batch, segments + 1, 3):
            raise ValueError(f"expected poses ({batch}, {segments + 1}, 3), got {poses.shape}")
        return self._judge(poses, given, np.ones(segments, np.bool_))

    def evaluate_track(self, track: ArrayLike, segment: ArrayLike, given: ArrayLike) -> Evaluation:
        """Judge one trajectory by every pose that was seen; a batch of one is returned.

        Args:
            track: (M, 3) finite poses in order of time.
            segment: (M,) never decreasing: the segment during which each was seen.
            given: (K,) bool, as in :meth:`evaluate`.

        Raises:
            ValueError: if there is no pose.
        """
        track, segment = np.asarray(track, np.float64), np.asarray(segment)
        given = np.asarray(given, np.bool_)
        if len(track) == 0 or len(track) != len(segment):
            raise ValueError("expected at least one pose, and one segment for each")
        # A segment without poses still is a command that gained nothing: it gets a step on
        # the spot. A step belongs to the segment in which it arrives.
        silent = np.setdiff1d(np.arange(len(given)), segment[1:])
        order = np.argsort(np.concatenate([segment[1:], silent]), kind="stable")
        steps = np.concatenate([segment[1:], silent])[order]
        seen = np.concatenate([np.arange(1, len(track)), np.full(len(silent), -1)])[order]
        arrivals = np.maximum.accumulate(np.concatenate([[0], seen]))
        ends = np.append(np.diff(steps) > 0, True)
        result = self._judge(track[arrivals][None], given[steps][None], ends)
        return replace(result, segment=steps[result.segment])

    def fitness(self, poses: ArrayLike, given: ArrayLike) -> NDArray[np.float64]:
        """Return the fitness (B,) of trajectories; see :meth:`evaluate`."""
        return self.evaluate(poses, given).fitness

    def completes(self, poses: ArrayLike, given: ArrayLike) -> NDArray[np.bool_]:
        """Return which trajectories (B,) complete the course; see :meth:`evaluate`."""
        return self.evaluate(poses, given).completes

    def region(self, poses: ArrayLike) -> NDArray[np.int64]:
        """Return the rectangle of each pose (..., 3): 0 to 7, -1 the centre, -2 outside."""
        poses = np.asarray(poses, np.float64)
        return _places(poses[..., 0].ravel(), poses[..., 1].ravel()).reshape(poses.shape[:-1])

    def describe(self) -> dict[str, Any]:
        """Return name and settings."""
        return {"name": self.name, "settings": asdict(self)}

    def _judge(self, poses: NDArray, given: NDArray, ends: NDArray) -> Evaluation:
        furthest, no_gain, fault, segment = _drive(poses, given, ends, self.longest_arc)
        fitness = furthest**2 - no_gain / 10.0 - self.penalty * (fault != 0)
        completes = furthest == LAST
        reason = np.where(completes, -1, np.where(fault > 0, fault, len(self.reasons)) - 1)
        detail = {"furthest": furthest, "no_gain": no_gain, "fault": fault}
        return Evaluation(fitness, completes, reason, segment, detail)


@njit(cache=True, nogil=True)
def _places(x: NDArray, y: NDArray) -> NDArray:
    places = np.empty(len(x), np.int64)
    for i in range(len(x)):
        places[i] = _place(x[i], y[i])
    return places


@njit(cache=True, nogil=True)
def _room(x: float, y: float) -> float:
    """Return how far (m) a point in the grid is from the borders of its rectangle."""
    column, row = x / LENGTH + 1.5, 1.5 - y / WIDTH
    column, row = column - math.floor(column), row - math.floor(row)
    return min(LENGTH * min(column, 1.0 - column), WIDTH * min(row, 1.0 - row))


@njit(cache=True, nogil=True)
def _place(x: float, y: float) -> int:
    """Return the rectangle at a point: 0 to 7, -1 the centre, -2 outside."""
    column, row = x / LENGTH + 1.5, 1.5 - y / WIDTH
    # Compared before they are rounded: what is not a number is outside too.
    if not (0.0 <= column < 3.0 and 0.0 <= row < 3.0):
        return -2
    return COURSE[int(row), int(column)]


@njit(cache=True, nogil=True)
def _advance(progress: int, place: int) -> tuple[int, int]:
    """Return progress along the course after a step to ``place``, and the fault or 0.

    Progress counts rectangles from the start: it goes on beyond 8 on a second round, and
    falls when the robot goes back.
    """
    if place == -2:
        return progress, _OUTSIDE
    if place == -1:
        return progress, _CENTRE
    step = (place - progress) % 8
    if step == 0:
        return progress, 0
    if step == 1:
        return progress + 1, 0
    if step == 7 and progress > 0:
        return progress - 1, 0
    return progress, _SKIPPED


@njit(cache=True, nogil=True)
def _segment(start: NDArray, end: NDArray, progress: int, longest: float) -> tuple[int, int, int]:
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
    sample = max(1, int(_room(start[0], start[1]) / length * samples)) if samples > 1 else 1
    while sample < samples:
        at_x, at_y = se2.arc(x, y, turn, sample / samples)
        at_x, at_y = start[0] + at_x, start[1] + at_y
        progress, fault = _advance(progress, _place(at_x, at_y))
        highest = max(highest, progress)
        if fault:
            return progress, highest, fault
        sample += max(1, int(_room(at_x, at_y) / length * samples))
    progress, fault = _advance(progress, _place(end[0], end[1]))
    return progress, max(highest, progress), fault


@njit(cache=True, nogil=True, parallel=True)
def _drive(
    poses: NDArray, given: NDArray, ends: NDArray, longest: float
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return N_max, C_nogain, the fault and the segment it happened in (B,) of trajectories.

    Args:
        poses: (B, S + 1, 3).
        given: (B, S) whether each segment is part of a given command.
        ends: (S,) whether each segment is the last of its command.
        longest: arcs longer than this are replaced by their chords, m.
    """
    batch, segments = given.shape
    furthest = np.zeros(batch, np.int64)
    no_gain = np.zeros(batch, np.int64)
    faults = np.zeros(batch, np.int64)
    where = np.full(batch, max(segments - 1, 0))
    for b in prange(batch):
        progress, fault = _advance(0, _place(poses[b, 0, 0], poses[b, 0, 1]))
        if progress != 0:
            progress, fault = 0, _SKIPPED
        if fault != 0:
            where[b] = 0
        began = 0
        for s in range(segments):
            if fault == 0:
                progress, highest, fault = _segment(poses[b, s], poses[b, s + 1], progress, longest)
                furthest[b] = max(furthest[b], min(highest, LAST - 1))
                if fault != 0:
                    where[b] = s
            if ends[s]:
                if given[b, s] and min(progress, LAST) <= began:
                    no_gain[b] += 1
                began = min(progress, LAST)
        if fault == 0 and progress == LAST:
            furthest[b] = LAST
        faults[b] = fault
    return furthest, no_gain, faults, where
