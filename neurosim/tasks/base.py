"""The protocol of tasks: start, duration and score of a trial.

A task scores a trial in one way, step by step: :meth:`Task.first_record` makes a record of each
trial, :meth:`Task.advance` adds an interval to it, and :meth:`Task.worth` gives the fitness if the
trial ends there. :class:`Records` of environments advance while trials run; :meth:`Task.judge`
advances them over whole trajectories. If the place has a perimeter, they also end a trial where the
guard of a real drive ends it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurosim.base.declared import Checked, SettingError
from neurosim.base.errors import UserError, unwritten
from neurosim.base.perimeter import ENDS, LONGEST_ARC, Perimeter
from neurosim.base.place import Place
from neurosim.base.trajectory import Episode, Trajectory
from neurosim.simulators.base import InPlace, Sensing, Simulator

#: Rows of a batch: places, or all.
Rows = NDArray[np.int64] | slice
EVERY = slice(None)


class Interval(NamedTuple):
    """The time from one command to the next, or between two camera frames, of K trials.

    Attributes:
        poses: [K, 3] at its end (m, m, rad); NaN if the robot was not seen.
        duration: [K] or one for all, s.
        active: [K] or one for all: whether it belongs to a command of the controller, not to a null
            command or to the stop at the end.
        ends: whether it is the last interval of its command.
        commands: [K, C] during it; None unless the task scores by commands.
        readings: [K, S] at its beginning; None unless the task scores by readings.
        touching: [K] whether the robot touches something at its end; None: unknown.
    """

    poses: NDArray[np.float64]
    duration: NDArray[np.float64] | float
    active: NDArray[np.bool_] | bool = True
    ends: bool = True
    commands: NDArray | None = None
    readings: NDArray | None = None
    touching: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class Judgement:
    """The score of a batch of trials; ``...`` are its axes.

    Attributes:
        fitness: [...] float64, finite; the higher the better.
        success: [...] bool, whether the task is done.
        reason: [...] index of the failure in the task's ``reasons``; -1 if the task is done.
        progress: [...] the robot's progress: a fitness without steps, for optimisers that need a
            slope and for rewards.
        over: [...] bool, whether the result is decided.
        segment: [...] the command during which the result was settled; the last by default.
        detail: name -> [...]: the components of the fitness, different in each task.

    Example:
        >>> judged = ns.Judgement.of([0.2, 0.7], np.array([0.2, 0.7]) > 0.5)
        >>> judged.success
        array([False,  True])
    """

    fitness: NDArray[np.float64]
    success: NDArray[np.bool_]
    reason: NDArray[np.int64]
    progress: NDArray[np.float64]
    over: NDArray[np.bool_]
    segment: NDArray[np.int64]
    detail: dict[str, NDArray] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        fitness: NDArray,
        success: NDArray,
        reason: NDArray | int = 0,
        *,
        progress: NDArray | None = None,
        **detail: NDArray,
    ) -> Judgement:
        """Return a judgement of arrays [...]; the default progress is the fitness.

        ``reason`` counts only if the task is not done. Arrays are copied, so columns of a
        record may be given: records change while trials run.
        """
        fitness, success = np.array(fitness, np.float64), np.array(success, np.bool_)
        why = np.where(success, -1, reason)
        graded = fitness if progress is None else np.array(progress, np.float64)
        over, segment = np.zeros(success.shape, np.bool_), np.zeros(success.shape, np.int64)
        own = {name: np.array(one) for name, one in detail.items()}
        return cls(fitness, success, why, graded, over, segment, own)

    def mapped(self, change: Callable[[NDArray], NDArray]) -> Judgement:
        """Return the judgement with every array changed, as by a selection or a reshape."""
        names = ("fitness", "success", "reason", "progress", "over", "segment")
        arrays = {name: change(getattr(self, name)) for name in names}
        return Judgement(**arrays, detail={name: change(one) for name, one in self.detail.items()})


class Task(Checked):
    """A task, scored step by step; subclass it.

    A task of your own is a frozen dataclass with a ``name``, its settings as fields
    with their ranges (:mod:`neurosim.base.declared`), and :meth:`worth`;
    also :meth:`first_record` and :meth:`advance` if the score needs more than the end of a trial.
    Trials may be simulated or driven.

    Attributes:
        name: the name for ``--task``.
        reasons: the ways in which a trial can fail, in words that follow "the robot".
        start: x (m), y (m), heading (rad) of a trial's start, in the board's frame.
        trial_starts: number of starts of a trial.
        highest_fitness: the highest possible fitness; None: unknown.
        stop_penalty: subtracted from the fitness of a trial that the guard ends.
        perimeter: limits at which the guard ends trials, or None. See :meth:`within_perimeter`.
        place: the place of the trials; None: the simulator's. As a field of a task it may be a
            :class:`neurosim.base.place.Place`, or any argument of
            :meth:`neurosim.base.place.Place.of`.
        senses: the senses that are read, "proximity" or "light"; None: the simulator's.
        longest_arc: a distance longer than any robot drives in one command, m, for pictures of
            plans.
        fitness_unit: unit of the fitness, if any.
        replanned: whether a plan is replanned after every command by default, because open-loop
            plans fail.
        scored_by: parts of a trajectory that the score needs: ``poses``, ``commands``,
            ``readings``.

    Example:
        >>> @dataclass(frozen=True)
        ... class Far(ns.Task):
        ...     name = "far"
        ...     metres: float = 0.5
        ...
        ...     def worth(self, record):
        ...         distance = np.hypot(record[:, 4], record[:, 5])  # where the robot is
        ...         return ns.Judgement.of(distance, distance > self.metres)
        >>> float(Far().judge(ns.rollout("simulator", [[40, 40, 1.0]])).fitness) > 0
        True
    """

    name: ClassVar[str]
    scored_by: tuple[str, ...] = ("poses",)
    reasons: ClassVar[tuple[str, ...]] = ("did not complete the task",)
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    trial_starts: int = 1
    highest_fitness: float | None = None
    stop_penalty: float = 0.0
    perimeter: Perimeter | None = None
    place: Place | None = None
    senses: tuple[str, ...] | None = None
    longest_arc: float = LONGEST_ARC
    fitness_unit: ClassVar[str] = ""
    replanned: ClassVar[bool] = False

    def __post_init__(self) -> None:
        place = getattr(self, "place", None)
        if place is not None:
            try:
                object.__setattr__(self, "place", Place.of(place))
            except SettingError as error:
                raise SettingError(f"place.{error.field}", error.what) from None
        super().__post_init__()

    @property
    def episode(self) -> Episode:
        """The episode of a trial; by default 30 s of steps of 0.1 s, then a stop."""
        return Episode(rest=0.5)

    @property
    def usual_controller(self) -> str:
        """The default kind of controller: a network if readings are needed."""
        return "network" if self.episode.readings else "plan"

    def first_record(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the records [K, W] of trials that begin at poses [K, 3] (m, m, rad).

        Column 0 is 1 if the result is decided, else 0; the others are the task's own. By default
        these are 8 columns, enough for a task that is scored by the robot's last pose: 0; the start
        pose (3); the last pose that was seen (3); the time since the start (s).
        """
        zero = np.zeros((len(poses), 1))
        return np.concatenate([zero, poses, poses, zero], axis=1)

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval of K trials to their records [K, W], in place.

        Several threads call it, for different trials.
        """
        seen = np.isfinite(interval.poses).all(axis=1)
        record[seen, 4:7] = interval.poses[seen]
        record[:, 7] += interval.duration

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return the fitness of trials with records [K, W] if they end now.

        ``over`` and ``segment`` need not be given: :meth:`score` and :meth:`judge` fill them in.
        """
        raise unwritten(self, "worth")

    def placed(self, simulator: Simulator) -> Simulator:
        """Return a simulator in the task's place and with its senses, if it has any."""
        changes: dict[str, Any] = {}
        if self.place is not None and isinstance(simulator, InPlace):
            changes["place"] = self.place
        if self.senses is not None and isinstance(simulator, Sensing):
            changes["senses"] = self.senses
        return simulator.changed(**changes) if changes else simulator  # type: ignore[attr-defined]

    def in_place(self, place: Place) -> Self:
        """Return the task in a place; the task itself if it has no place."""
        if not is_dataclass(self) or "place" not in self.__dataclass_fields__:
            return self
        return replace(self, place=place)

    def within_perimeter(self, perimeter: Perimeter | None) -> Self:
        """Return the task with a guard that ends drives at a perimeter, or without one.

        The board is that of the task's place, if any.
        """
        if perimeter is not None and self.place is not None and self.place.board is not None:
            perimeter = replace(perimeter, board=self.place.board)
        task = copy(self)
        object.__setattr__(task, "perimeter", perimeter)  # tasks are frozen dataclasses
        return task

    def why(self, reason: int) -> str:
        """Return the words for a failure, by its index in a judgement; they follow "the robot"."""
        return (*self.reasons, *ENDS)[reason]

    def ended(self, judged: Judgement, code: NDArray | int) -> Judgement:
        """Return the judgement of trials that the guard ended, if ``code`` is above 0, as failures.

        Args:
            judged: judgement of the robot's progress, [...].
            code: [...] or one for all, of :data:`neurosim.base.perimeter.ENDS`.
        """
        stopped = np.asarray(code) > 0
        if not stopped.any():
            return judged
        penalty = np.where(stopped, self.stop_penalty, 0.0)
        why = len(self.reasons) - 1 + np.asarray(code, np.int64)
        return replace(
            judged,
            success=judged.success & ~stopped,
            reason=np.where(stopped, why, judged.reason),
            fitness=judged.fitness - penalty,
            progress=judged.progress - penalty,
            over=judged.over | stopped,
        )

    def judge(self, trajectory: Trajectory, earlier: Records | None = None) -> Judgement:
        """Judge trajectories [...]; see :class:`Judgement`.

        Args:
            trajectory: simulated or driven.
            earlier: of the one trial that all trajectories continue; by default trials begin at
                their first poses.

        Raises:
            UserError: if the task is scored by poses or readings that the trajectory lacks.
        """
        self.check_scored(trajectory.poses is not None, trajectory.readings is not None)
        shape, steps = trajectory.shape, trajectory.commands.shape[-2]
        count = math.prod(shape)
        if trajectory.poses is None:
            poses = np.full((count, steps + 1, 3), np.nan)
        else:
            poses = np.asarray(trajectory.poses, np.float64).reshape(count, steps + 1, 3)
        records = Records(self, poses[:, 0]) if earlier is None else earlier.tiled(count)
        before = records.over()
        settled = np.where(before, 0, max(steps - 1, 0))
        for step, interval in enumerate(_intervals(trajectory, poses, self.scored_by)):
            records.add(interval, over=before)
            over = records.over()
            settled[over & ~before], before = step, over
        if trajectory.segment is not None:
            settled = trajectory.segment[settled]
        judged = replace(records.score(), segment=settled)
        return judged.mapped(lambda one: np.asarray(one).reshape(shape))

    def check_scored(self, poses: bool, readings: bool) -> None:
        """Raise an error for trials that lack poses or readings that the task needs.

        Raises:
            UserError: naming the missing part.
        """
        if "poses" in self.scored_by and not poses:
            raise UserError(f"{self.name} needs the robot's poses: use a camera")
        if "readings" in self.scored_by and not readings:
            raise UserError(f"{self.name} needs the sensors' readings")

    def whole(self, fitness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fitness of whole trials [...] of those from each start [..., trial_starts]."""
        return fitness.mean(axis=-1)

    def draw_starts(
        self, simulator: Simulator, count: int, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """Return start poses [count, 3] drawn at random; None: every trial starts at ``start``.

        Args:
            simulator: has the place.
            count: poses.
            rng: source of the draws.
        """
        return None

    def region(self, poses: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the number of the part of the course in which each pose [..., 3] is.

        Crossover pairs commands of two plans in the same part; by default in the same square of
        half a metre.
        """
        squares = np.floor(np.nan_to_num(np.asarray(poses)[..., :2], nan=1e3) / 0.5)
        x, y = np.clip(squares, -1000, 1000).astype(np.int64).T
        return (x * 2001 + y).T

    def outline(self) -> list[dict[str, Any]]:
        """Return the shapes of the task for a picture, in m: a list of shapes.

        Each is ``{"polygon": [[x, y], ...]}`` (of two points, a line; with a ``width``, a printed
        one), ``{"circle": [x, y, radius]}`` or ``{"text": str, "at": [x, y]}``; a shape that the
        robot must not touch or enter has ``"forbidden": True``.
        """
        return []

    def describe(self) -> dict[str, Any]:
        """Return name and settings, from which the same task can be made."""
        settings: dict[str, Any] = asdict(self) if is_dataclass(self) else {}
        if settings.get("place") is not None:
            settings["place"] = self.place.to_json()  # type: ignore[union-attr]
        return {"name": self.name, "settings": settings}


class Records:
    """The records of B trials under way, and of the guard that may end them.

    Attributes:
        task: scores the trials.
        own: [B, W] of :meth:`Task.first_record`.
        guard: [B, 4] of :meth:`neurosim.base.perimeter.Perimeter.ends`: the last known pose
            (m, m, rad), and the reason of the trial's end, a code of
            :data:`neurosim.base.perimeter.ENDS` or 0; None without a perimeter.
    """

    def __init__(self, task: Task, poses: NDArray[np.float64]):
        """Begin trials at poses [B, 3] (m, m, rad)."""
        self.task, self.own = task, task.first_record(poses)
        self.guard = None if task.perimeter is None else _guard(poses)

    def begin(self, rows: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
        """Begin new trials in rows [K] at poses [K, 3]."""
        self.own[rows] = self.task.first_record(poses)
        if self.guard is not None:
            self.guard[rows] = _guard(poses)

    def tiled(self, count: int) -> Records:
        """Return ``count`` copies of a single trial's records."""
        copies = copy(self)
        copies.own = np.tile(self.own, (count, 1))
        copies.guard = None if self.guard is None else np.tile(self.guard, (count, 1))
        return copies

    def over(self) -> NDArray[np.bool_]:
        """Return whether each trial's result is decided, or the guard has ended it, [B]."""
        decided = self.own[:, 0] > 0
        return decided if self.guard is None else decided | (self.guard[:, 3] > 0)

    def add(
        self,
        interval: Interval,
        rows: Rows = EVERY,
        over: NDArray[np.bool_] | None = None,
    ) -> None:
        """Add an interval of trials in rows [K], up to the guard's stop; nothing counts after that.

        Args:
            interval: of K trials.
            rows: of the batch; all by default.
            over: [B] of :meth:`over` if known.
        """
        own = self.own[rows]
        if self.guard is None:
            self.task.advance(own, interval)
        else:
            guard = self.guard[rows]
            stopped = np.flatnonzero(guard[:, 3] > 0)
            kept = own[stopped]
            running = ~(self.over() if over is None else over)[rows]
            assert self.task.perimeter is not None
            poses = self.task.perimeter.ends(guard, interval.poses, interval.duration, running)
            self.task.advance(own, interval._replace(poses=poses))
            own[stopped] = kept
            if not isinstance(rows, slice):
                self.guard[rows] = guard
        if not isinstance(rows, slice):
            self.own[rows] = own

    def score(self, rows: Rows = EVERY) -> Judgement:
        """Return :meth:`Task.worth` of trials in rows [K], with ``over``."""
        own = self.own[rows]
        judged = replace(self.task.worth(own), over=own[:, 0] > 0)
        if self.guard is None:
            return judged
        return self.task.ended(judged, self.guard[rows, 3])


def _guard(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([poses, np.zeros((len(poses), 1))], axis=1)


def _intervals(
    trajectory: Trajectory, poses: NDArray[np.float64], wanted: tuple[str, ...]
) -> Iterator[Interval]:
    """Give the intervals of trajectories [...] with poses [B, T + 1, 3], flattened to B trials."""
    shape, steps = trajectory.shape, trajectory.commands.shape[-2]
    count, ends = len(poses), np.ones(steps, np.bool_)
    if trajectory.segment is not None:
        ends = np.append(np.diff(trajectory.segment) > 0, True)

    def by_step(values: Any) -> Any:
        """Return values [..., T, ...] as [T, B, ...]; those for all trials remain [T], or one.

        They are views: a copy takes as long as a rollout.
        """
        if values is None or not np.ndim(values):
            return itertools.repeat(values)
        if np.ndim(values) == 1:
            return values.tolist()
        after = np.shape(values)[len(shape) + 1 :]
        return np.moveaxis(values, len(shape), 0).reshape(steps, count, *after)

    rows = zip(
        np.moveaxis(poses[:, 1:], 1, 0),
        by_step(trajectory.durations),
        itertools.repeat(True) if trajectory.active is None else by_step(trajectory.active),
        ends.tolist(),
        by_step(trajectory.commands if "commands" in wanted else None),
        by_step(trajectory.readings if "readings" in wanted else None),
        by_step(trajectory.touching),
        strict=False,
    )
    for row in rows:
        yield Interval(*row)
