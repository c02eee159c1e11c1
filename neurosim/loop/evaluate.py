"""The one loop: a simulator, a task and a controller; genes in, fitness out.

Every evolution, robust evolution, check and trial goes through :class:`Evaluator`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.cluster import Name
from neurosim.base.compiled import njit
from neurosim.base.errors import UserError
from neurosim.base.generations import compiling_notice
from neurosim.base.interrupts import uninterrupted
from neurosim.base.threads import on_cores, one_core, one_thread
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.controllers.base import Controller, check_inputs
from neurosim.controllers.plan import FixedPlan, Plan
from neurosim.controllers.registry import make_controller, units_of
from neurosim.evolution.command_sets import pairing_keys
from neurosim.loop.objectives import Merit, objective_named, put_behind, repeats_of
from neurosim.loop.stepped import SteppedRollouts
from neurosim.loop.workers import workers_named
from neurosim.simulators.base import Rollouts, Simulator
from neurosim.simulators.engine import ThreadSafe
from neurosim.simulators.registry import simulator_of
from neurosim.simulators.sampling import PLACING, trial_steps
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.registry import make_task

#: Largest number of poses of trajectories that are computed at once: tens of megabytes. With many
#: more, new memory takes time; with many fewer, the calls of a task at each step do.
POSES_AT_ONCE = 400_000
#: Fewer steps than this take a core about a millisecond, less than their distribution may cost.
_WORTH_SHARING = 10_000


class Evaluator:
    """Judges individuals of a controller, in a simulator, at a task.

    Attributes:
        simulator, task, controller: the three; the task ends trials at the simulator's perimeter.
        placing: error in placing the robot where a trial starts at a mark: standard
            deviations in x and y (m) and in heading (rad); for random samples alone.
        rollouts: the simulator's own compiled rollouts, or stepped ones.
        workers: those that judge the parts of a population; None: this process.
    """

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        controller: Controller,
        *,
        placing: tuple[float, float] = PLACING,
        stepped: bool = False,
        workers: Name = "local",
    ):
        """Join the three.

        Args:
            simulator, task, controller, placing: see the class.
            stepped: whether to use stepped rollouts even if compiled ones exist.
            workers: see :func:`neurosim.loop.workers.workers_named`.

        Raises:
            UserError: if one needs commands, sensors or goals that another lacks; or if the workers
                do not exist.
        """
        simulator = task.placed(simulator)
        task = task.within_perimeter(simulator.perimeter)
        self.simulator, self.task, self.controller = simulator, task, controller
        self.placing, self.episode = placing, task.episode
        _check_columns(simulator, controller)
        has_goals = self.episode.goals is not None
        check_inputs(controller, simulator.reading_names, has_goals, "the simulator")
        check_readings(simulator, task)
        self.rollouts = rollouts_of(simulator, controller, self.episode, stepped=stepped)
        self.workers = workers_named(workers)

    def starts(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], bool]:
        """Return start poses [count, 3], and whether the task drew them."""
        return draw_starts(self.simulator, self.task, count, rng)

    def draw(self, trials: int, rng: np.random.Generator | int, repeats: int = 1) -> Draws:
        """Draw the samples of some trials, each from the task's number of starts.

        Args:
            trials: their number; ``trial_starts`` of the task times as many samples are drawn.
            rng: source of all random numbers, or a seed.
            repeats: number of samples of every start, each with other noise.
        """
        own = np.random.default_rng(rng) if isinstance(rng, int) else rng
        starts, by_task = self.starts(trials * self.task.trial_starts, own)
        starts = np.tile(starts, (repeats, 1))
        return self.rollouts.draw(
            starts, own if by_task else rng, None if by_task else self.placing
        )

    def expectation(self, seed: int = 0) -> Draws:
        """Return samples without noise: the mean, from the task's start or starts."""
        starts, _ = self.starts(self.task.trial_starts, np.random.default_rng(seed))
        member = np.full(len(starts), -1) if self.simulator.members > 1 else None
        return Draws(starts, member)

    @uninterrupted()
    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...] of individuals [P, G] through samples [R]."""
        trajectory = self.rollouts.run(genes, draws, reuse=reuse)
        return with_contacts(self.simulator, trajectory) if self.episode.contacts else trajectory

    @uninterrupted()
    def judge(self, genes: NDArray[np.float64], draws: Draws) -> tuple[Judgement, Trajectory]:
        """Return judgements [P, R] of individuals [P, G], and their trajectories."""
        trajectory = self.run(genes, draws)
        return self._finite(self.scored(trajectory)), trajectory

    def scored(self, trajectory: Trajectory) -> Judgement:
        """Return the task's judgement [P, R] of trajectories."""
        return self.task.judge(trajectory)

    def _finite(self, judged: Judgement) -> Judgement:
        """Return a judgement whose fitness is finite.

        Raises:
            UserError: naming the task whose fitness is not.
        """
        if not np.isfinite(judged.fitness).all():
            raise UserError(
                f"the task {self.task.name} gives a trial a fitness that is not finite (nan or "
                "inf): return a finite number, the lower the worse"
            )
        return judged

    def merit(
        self,
        genes: NDArray[np.float64],
        draws: Draws,
        objective: str = "fitness",
        hints: Sequence[str] = (),
        unsupported: float | None = None,
    ) -> tuple[Merit, dict[str, NDArray]]:
        """Return the merit of individuals [P, G] over samples; in parts, to bound memory.

        Args:
            genes: a row for each individual.
            draws: the samples.
            objective: one of :data:`neurosim.loop.objectives.OBJECTIVES`.
            hints: further values that the optimiser needs of each individual: ``keys`` [P, K], by
                which crossover of plans pairs commands.
            unsupported: individuals with a larger fraction of the time in commands unlike any in
                the simulator's data rank last, if the simulator knows its gaps; None: no such
                limit.
        """
        how = objective, tuple(hints), unsupported
        if self.workers is None:
            judged: Iterable[Any] = self._judged_here(genes, draws, how)
        else:
            cut = (genes[part] for part in self._parts(len(genes), len(draws)))
            judged = self.workers(self, cut, draws, how)
        parts, numbers = zip(*judged, strict=True)
        merit = Merit(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        columns = [np.concatenate(part) for part in zip(*numbers, strict=True)]
        return merit, dict(zip(hints, columns, strict=True))

    @uninterrupted()
    def _judged_here(
        self, genes: NDArray[np.float64], draws: Draws, how: tuple[Any, ...]
    ) -> list[Any]:
        """Return the results of :meth:`merit_of` for parts of a population, in order.

        Each core judges whole individuals, because that needs it to wait for others only once.
        """
        parts: dict[int, list[Any]] = {}

        def part(first: int, last: int) -> None:
            with one_core(last - first < len(genes)):
                cut = self._parts(last - first, len(draws))
                parts[first] = [self.merit_of(genes[first:last][p], draws, *how) for p in cut]

        if isinstance(self.rollouts, ThreadSafe):
            on_cores(None, part, len(genes))
        else:
            part(0, len(genes))
        return list(itertools.chain.from_iterable(parts[first] for first in sorted(parts)))

    @uninterrupted()
    def merit_of(
        self,
        genes: NDArray[np.float64],
        draws: Draws,
        objective: str,
        hints: Sequence[str],
        unsupported: float | None,
    ) -> tuple[Merit, list[NDArray]]:
        """Return the merit of one part of a population, and its hints; see :meth:`merit`."""
        trajectory = self.run(genes, draws, reuse=True)
        merit = objective_named(objective)(
            self.task, trajectory, self._finite(self.scored(trajectory))
        )
        if unsupported is not None and self.simulator.knows_gaps:
            merit = put_behind(merit, self.unsupported(trajectory), unsupported)
        return merit, [_HINTS[name](self, trajectory) for name in hints]

    @uninterrupted()
    def unsupported(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return the fraction [P] of the individuals' time in unsupported commands.

        They are unlike any in the simulator's data (:meth:`Simulator.supported`); the stop at the
        end of a trial does not count.
        """
        commands, active = trajectory.commands, trajectory.active
        durations, shape = trajectory.durations, commands.shape[:-1]
        if np.shape(durations) != shape:
            durations = np.broadcast_to(durations, shape)
        assert isinstance(durations, np.ndarray)
        if active is None:
            active = np.ones(shape, np.bool_)
        if self.controller.open_loop:  # the same in all samples
            commands, durations, active = commands[:, 0], durations[:, 0], active[:, 0]
        if commands.shape[-1] < len(self.simulator.command_names):
            commands = np.concatenate([commands, durations[..., None]], axis=-1)
        supported = self.simulator.supported(commands)
        rows = (len(commands), -1)
        return _fraction(*(part.reshape(rows) for part in (supported, durations, active)))

    def _parts(self, individuals: int, samples: int) -> Iterator[slice]:
        """Cut individuals into parts whose trajectories are computed at once."""
        batch = max(POSES_AT_ONCE // (samples * (self.steps + 1)), 1)
        return (slice(first, first + batch) for first in range(0, individuals, batch))

    @cached_property
    def steps(self) -> int:
        """Number of steps of a trial, including the stop at its end."""
        return trial_steps(self.controller, self.episode)

    @contextmanager
    def threads_for(self, individuals: int) -> Iterator[None]:
        """Keep little work on one core.

        Steps of a simulator in PyTorch are too small to be distributed.
        """
        work = individuals * (self.steps - (self.episode.rest > 0))
        with one_core(work < _WORTH_SHARING), one_thread():
            yield

    def _keys(self, trajectory: Trajectory) -> NDArray[np.int64]:
        """Return the keys [P, K] by which crossover pairs commands, by the first sample."""
        slots = trajectory.commands.shape[-2] - (self.episode.rest > 0)
        poses, active = trajectory.poses, trajectory.active
        assert poses is not None
        assert active is not None
        return pairing_keys(self.task.region(poses[:, 0, :slots]), active[:, 0, :slots])


#: Further values of individuals that an optimiser may need, by name.
_HINTS = {"keys": Evaluator._keys}


@njit(nogil=True)
def _fraction(supported: NDArray, durations: NDArray, active: NDArray) -> NDArray:
    """Return the fraction [P] of the time in active intervals [P, N] that are not supported."""
    fractions = np.zeros(len(durations))
    for p in range(len(durations)):
        off = spent = 0.0
        for n in range(durations.shape[1]):
            time = durations[p, n] if active[p, n] else 0.0
            spent += time
            off += 0.0 if supported[p, n] else time
        if spent > 0.0:
            fractions[p] = off / spent
    return fractions


def with_contacts(simulator: Simulator, trajectory: Trajectory) -> Trajectory:
    """Return a simulated trajectory with the robot's contacts."""
    assert trajectory.poses is not None
    return replace(trajectory, touching=simulator.touching(trajectory.poses[..., 1:, :]))


def rollouts_of(
    simulator: Simulator, controller: Controller, episode: Episode, *, stepped: bool = False
) -> Rollouts:
    """Return the simulator's own compiled rollouts, or else stepped ones."""
    compiled = None if stepped else simulator.rollouts(controller, episode)
    return compiled or SteppedRollouts(simulator, controller, episode)


def draw_starts(
    simulator: Simulator, task: Task, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], bool]:
    """Return start poses [count, 3] of a task, and whether the task drew them."""
    starts = task.draw_starts(simulator, count, rng)
    if starts is None:
        return np.tile(np.asarray(task.start, np.float64), (count, 1)), False
    return starts, True


def check_readings(simulator: Simulator, task: Task) -> None:
    """Raise an error for a simulator without the sensors that a task needs.

    Raises:
        UserError: if it has none.
    """
    if task.episode.readings and not simulator.reading_names:
        raise UserError(
            f"the task {task.name} needs the readings of sensors, and this simulator "
            f'({simulator.kind}) has none; make one from samples with "neurosim build-tables"'
        )


def _check_columns(simulator: Simulator, controller: Controller) -> None:
    """Raise an error for a controller whose outputs are not the simulator's commands."""
    wanted, given = tuple(simulator.command_names), tuple(controller.outputs)
    if not controller.open_loop:
        wanted = tuple(name for name in wanted if name != "duration")
    if wanted != given:
        raise UserError(
            f"the controller ({controller.kind}) gives {', '.join(given)}, but this simulator "
            f"takes {', '.join(wanted)}; use one that was made from such commands"
        )
    known = units_of(simulator)
    units = controller.units if isinstance(controller, FixedPlan | Plan) else ()
    for name, unit in zip(given, units, strict=False):
        if known.get(name) and unit not in ("1", known[name]):  # 1: the file names none
            raise UserError(
                f"the controller ({controller.kind}) gives {name} in {unit}, but this simulator "
                f"takes it in {known[name]}; make it for the simulator, as by "
                f'make_controller("{controller.kind}", simulator)'
            )


class Fitness:
    """Fitness of genes, as :func:`evaluate` returns it: call it like a function."""

    def __init__(self, evaluator: Evaluator, draws: Draws, objective: str):
        self.evaluator, self.draws, self._objective = evaluator, draws, objective
        self._called = False

    @property
    def genes(self) -> int:
        """Number of genes of an individual."""
        return self.evaluator.controller.genes

    def __call__(self, genes: Any) -> Any:
        """Return the fitness [P] of individuals [P, G], or of one [G]; the higher the better.

        NumPy arrays (or lists) give NumPy, tensors give tensors.

        Raises:
            UserError: if the number of genes is wrong, or one is not finite.
        """
        rows, single = self._rows(genes)
        slow = None if self._called else compiling_notice("the first evaluation")
        try:
            with self.evaluator.threads_for(len(rows) * len(self.draws)):
                merit, _ = self.evaluator.merit(rows, self.draws, self._objective)
        finally:
            if slow is not None:
                slow.cancel()
        self._called = True
        fitness = merit.merit[0] if single else merit.merit
        return torch.as_tensor(fitness) if isinstance(genes, Tensor) else fitness

    def unsupported(self, genes: Any) -> Any:
        """Return the fraction [P] of the time in commands unlike any that were recorded.

        A fitness from many such commands is a guess. The fraction is of the time of the
        controller's commands in these samples. For a simulator that does not know its gaps,
        commands outside of its ranges count.

        Raises:
            UserError: as for the fitness.
        """
        rows, single = self._rows(genes)
        with self.evaluator.threads_for(len(rows) * len(self.draws)):
            fraction = self.evaluator.unsupported(self.evaluator.run(rows, self.draws))
        unsupported = fraction[0] if single else fraction
        return torch.as_tensor(unsupported) if isinstance(genes, Tensor) else unsupported

    def _rows(self, genes: Any) -> tuple[NDArray[np.float64], bool]:
        """Return genes as rows, and whether there was a single one."""
        given = genes.detach().cpu() if isinstance(genes, Tensor) else genes
        try:
            rows = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            raise UserError(f"genes must be numbers [P, {self.genes}], not {genes!r:.60}") from None
        single, rows = rows.ndim == 1, np.atleast_2d(rows)
        if rows.ndim != 2 or rows.shape[1] != self.genes or not len(rows):
            raise UserError(f"expected genes [P, {self.genes}] or [{self.genes}], got {rows.shape}")
        if not np.isfinite(rows).all():
            row = int(np.argwhere(~np.isfinite(rows))[0, 0])
            raise UserError(f"genes[{row}]: expected finite numbers, found {rows[row]!s:.60}")
        return rows, single


def joined(
    simulator: str | Path | Simulator, task: str | Task, controller: str | Controller | None
) -> tuple[Simulator, Task, Controller]:
    """Return simulator, task and controller, each given as an object or by name.

    Args:
        simulator: a simulator or its folder.
        task: the task or its name.
        controller: the family or its kind; None: the task's usual one.

    Raises:
        UserError: if one of them is missing or of a wrong type.
    """
    simulator, task = simulator_of(simulator), make_task(task)
    if controller is None:
        controller = task.usual_controller
    if isinstance(controller, str):
        controller = make_controller(controller, simulator, task)
    if not isinstance(controller, Controller):
        raise UserError(
            f"expected a controller or its kind, such as plan, not {type(controller).__name__}"
        )
    return simulator, task, controller


def evaluate(
    simulator: str | Path | Simulator,
    task: str | Task,
    controller: str | Controller | None = None,
    *,
    samples: int = 0,
    objective: str = "fitness",
    placing: tuple[float, float] = PLACING,
    seed: int = 0,
    workers: Name = "local",
) -> Fitness:
    """Return the function that gives the fitness of genes, for any optimiser.

    Args:
        simulator: a simulator or its folder.
        task: the task or its name.
        controller: the family whose genes are judged, or its kind; by default the task's usual one.
        samples: number of random trials of each individual, drawn once and the same for all; 0: the
            expected motion, without noise.
        objective: ``fitness``, ``probability`` of success, or ``progress``, a fitness without
            steps.
        placing: error in placing the robot: standard deviations, m and rad.
        seed: of the draws.
        workers: local, this process; or ray, the workers of a Ray cluster. The fitness is the same.

    Raises:
        UserError: if one of the three needs something that another lacks, or samples are drawn in a
            simulator without uncertainty.

    Example:
        >>> fitness = ns.evaluate("tables", "obstacle-avoidance", "network")
        >>> fitness(np.zeros((5, fitness.genes))).shape
        (5,)
    """
    three = joined(simulator, task, controller)
    evaluator = Evaluator(*three, placing=placing, workers=workers)
    if samples < 0:
        raise UserError(f"samples must not be negative, not {samples}")
    repeats = repeats_of(objective)
    draws = evaluator.draw(samples, seed, repeats) if samples else evaluator.expectation(seed)
    return Fitness(evaluator, draws, objective)
