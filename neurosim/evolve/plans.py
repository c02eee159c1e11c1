"""Evolution of a command set in a simulator, Pretorius et al. (2009), section 6.2.

The genetic algorithm is that of Table 1, its operators are those of
:mod:`neurosim.evolution.command_sets`. A plan that is evolved on what the simulator expects drives
along the edge of what the task allows, and fails wherever the robot does a little otherwise: see
:mod:`neurosim.evolve.robust` for evolution over drawn outcomes, which starts from such plans.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.progress import Progress
from neurosim.evolution.command_sets import GENES, PlanPopulation, encode
from neurosim.evolution.genetic import GeneticSettings
from neurosim.evolve.plan_course import Course
from neurosim.evolve.robust import RobustEvolution
from neurosim.evolve.rollouts import PLACING, rollouts
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Task

#: The genetic algorithm of plans: the paper's but for its tournament of 50, which leaves a run
#: with one plan and its likes before the course is found.
DEFAULT_GENETIC = GeneticSettings(tournament=5)
#: Of robust evolution: the way is known, it is to be smoothed without losing variety.
ROBUST_GENETIC = GeneticSettings(tournament=5, mutation=0.1, eta=2.0, mutation_scale=0.03)
#: A generation of fewer commands than this takes a core about a millisecond.
_WORTH_SHARING = 10_000


@dataclass(frozen=True)
class RobustSettings:
    """How plans are made robust.

    Attributes:
        objective: ``probability`` of completing the task, or ``fitness``, the expected fitness.
            The latter often prefers plans that stop halfway and are safe.
        generations: how many, after those without noise.
        draws: outcomes that every plan of a generation meets.
        refresh: new outcomes are drawn every so many generations, lest plans be fitted to them.
        selection_draws: outcomes on which the plan to keep is chosen in the end.
        genetic: the genetic algorithm; its mutation is finer than before.
    """

    objective: str = "probability"
    generations: int = 300
    draws: int = 32
    refresh: int = 10
    selection_draws: int = 1024
    genetic: GeneticSettings = ROBUST_GENETIC

    def __post_init__(self) -> None:
        if self.objective not in ("fitness", "probability"):
            raise UserError(
                f"robust evolution is for fitness or probability, not {self.objective!r}"
            )
        for name in ("generations", "draws", "refresh", "selection_draws"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, not {getattr(self, name)}")


@dataclass(frozen=True)
class PlanSettings:
    """How plans are evolved; commands and generations are those of section 6.2.

    Attributes:
        commands: commands in a chromosome, null ones included.
        generations: how many populations are evaluated.
        runs: independent runs, evaluated together.
        max_speed: fastest motor speed, percent.
        durations: shortest and longest command, s.
        genetic: the genetic algorithm of every run; its ``mutation_scale`` is a share of a
            gene's range. ``GeneticSettings()`` is Table 1 of the paper.
        insertion: whether a null command that mutation brings back comes at any place of the
            plan; False: where it is, as we read the paper.
        robust: how to make the plans robust, or None.
        placing: standard deviation of where the robot is put down, in x and y (m), in heading
            (rad); for drawn outcomes alone.
        final_draws: fresh outcomes from which the probability of success is told.
    """

    commands: int = 10
    generations: int = 1000
    runs: int = 1
    max_speed: float = 50.0
    durations: tuple[float, float] = (0.5, 3.0)
    genetic: GeneticSettings = DEFAULT_GENETIC
    insertion: bool = True
    robust: RobustSettings | None = None
    placing: tuple[float, float] = PLACING
    final_draws: int = 4096

    def __post_init__(self) -> None:
        for name in ("commands", "generations", "runs", "final_draws"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0 < self.max_speed <= 100:
            raise UserError(f"the highest speed must be in 0 to 100 %, not {self.max_speed:g}")
        low, high = self.durations
        if not 0 < low <= high:
            raise UserError(f"durations must be above 0 and in order, not {low:g} to {high:g}")
        if min(self.placing) < 0:
            raise UserError("the scatter of the start pose must not be negative")


@dataclass(frozen=True)
class PlanResult:
    """A command set that was evolved, and what the simulator says will come of it.

    Attributes:
        commands: (left %, right %, duration s) each, None for a null command.
        poses: (G + 1, 3) the start and the expected pose after each of the G given commands,
            at the instant when the next takes over.
        rest: (3,) the expected pose once the motors, stopped after the last command, stand.
        fitness: fitness of the expected path until the robot is at rest.
        completes: whether the expected path completes the task.
        probability: share of drawn outcomes that complete the task; None where the simulator
            has nothing to draw.
        expected_fitness: mean fitness over drawn outcomes, likewise.
        draws: how many outcomes these two are of.
        history: best and mean fitness of every generation, {"best": [...], "mean": [...]}; after
            robust evolution also what it maximised, {"robust_best": ..., "robust_mean": ...}.
        run: which of the runs it came from.
        interrupted: whether evolution was stopped before its last generation.
    """

    commands: list[tuple[float, float, float] | None]
    poses: NDArray[np.float64]
    rest: NDArray[np.float64]
    fitness: float
    completes: bool
    probability: float | None
    expected_fitness: float | None
    draws: int
    history: dict[str, list[float]]
    run: int
    interrupted: bool


def evolve_plan(
    simulator: Simulator,
    task: Task,
    settings: PlanSettings | None = None,
    *,
    seed: int,
    progress: bool = True,
) -> list[PlanResult]:
    """Evolve command sets for a task in a simulator.

    Ctrl-C after the first generation ends evolution and returns what it has found so far.

    Args:
        simulator: takes left, right, duration.
        task: gives the start and the fitness.
        settings: sizes, limits and the genetic algorithm.
        seed: of all that is drawn; the same seed gives the same plans.
        progress: whether to show progress on stderr.

    Returns:
        The best plan of every run, the best first: by what robust evolution maximised, else by
        the fitness of the expected path.

    Raises:
        UserError: if the simulator takes other commands, or robust plans are asked of one that
            has neither noise nor members that disagree.
    """
    settings = settings or PlanSettings()
    course = Course(rollouts(simulator, task.start), task, settings)
    uncertain = is_uncertain(simulator)
    if settings.robust is not None:
        _check_uncertain(uncertain)
    evolution = Evolution(course, seed)
    interrupted = _run(evolution, settings.generations, "evolving", progress)
    if settings.robust is not None and not interrupted:
        population, history = evolution.population, [evolution.history]
        return _robust(course, population, history, seed, progress)
    seed_of_draws = seed if uncertain else None
    best = evolution.population.best
    return _results(course, best, [evolution.history], seed_of_draws, interrupted)


def improve_plans(
    simulator: Simulator,
    task: Task,
    plans: Sequence[PlanResult],
    settings: PlanSettings,
    *,
    seed: int,
    progress: bool = True,
) -> list[PlanResult]:
    """Evolve plans robustly that have been evolved already, each in a run of its own.

    Args:
        simulator, task, seed, progress: as :func:`evolve_plan` takes them.
        plans: as many as ``settings.runs``; at most ``settings.commands`` commands each.
        settings: with ``robust``; ``generations`` are those that the plans have had.

    Returns:
        As :func:`evolve_plan`; the history is that of robust evolution alone.

    Raises:
        UserError: likewise.
    """
    _check_uncertain(is_uncertain(simulator))
    course = Course(rollouts(simulator, task.start), task, settings)
    genes = np.stack([encode(p.commands, settings.max_speed, settings.durations) for p in plans])
    genes = np.repeat(genes[:, None], settings.genetic.population, axis=1)
    population = PlanPopulation(genes, settings.genetic, seed)
    return _robust(course, population, [], seed, progress)


def _robust(
    course: Course, first: PlanPopulation, history: list, seed: int, progress: bool
) -> list[PlanResult]:
    evolution = RobustEvolution(course, first, seed)
    generations = course.settings.robust.generations
    interrupted = _run(evolution, generations, "making it robust", progress)
    history = [*(history or [[]]), evolution.history]
    return _results(course, evolution.finish(), history, seed, interrupted)


def _check_uncertain(uncertain: bool) -> None:
    if not uncertain:
        raise UserError(
            "robust plans need a simulator that knows what it does not know, and this one has "
            "neither noise nor an ensemble; train one with the default trainer"
        )


def is_uncertain(simulator: Simulator) -> bool:
    """Return whether a simulator's outcomes differ; of kinds not known here it is assumed."""
    members = getattr(simulator, "members", 2)
    return members > 1 or getattr(simulator, "noise", None) is not None


class Evolution:
    """Several runs of the genetic algorithm on what the simulator expects.

    Attributes:
        population: chromosomes of all runs.
        history: best and mean fitness of each generation, [runs] each.
    """

    def __init__(self, course: Course, seed: int):
        self._course, settings = course, course.settings
        rng = np.random.default_rng([seed, 0x91A4])
        genes = rng.random((settings.runs, settings.genetic.population, settings.commands * GENES))
        self.population = PlanPopulation(genes, settings.genetic, seed, settings.insertion)
        self.history: list[tuple[NDArray, NDArray]] = []

    def generation(self) -> str:
        """Evaluate a population, make the next, and say how it stands."""
        genes = self.population.genes
        with _threads_for(genes.size // GENES):
            evaluation, poses, _, given = self._course.expected(genes.reshape(-1, genes.shape[-1]))
            keys = self._course.keys(poses, given).reshape(*genes.shape[:2], -1)
            fitness = evaluation.fitness.reshape(genes.shape[:2])
            self.population.tell(fitness, keys)
        self.history.append((self.population.best_fitness.copy(), fitness.mean(axis=1)))
        return f"fitness {self.population.best_fitness.max():.1f}"


@contextmanager
def _threads_for(commands: int) -> Iterator[None]:
    """Keep a generation of so few commands on one core: it is done sooner than it is shared out.

    On a machine that is busy with something else too, every sharing out may cost a time slice of
    the scheduler, more than the whole generation.
    """
    threads = numba.get_num_threads()
    if commands < _WORTH_SHARING:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _run(stage: Any, generations: int, label: str, progress: bool) -> bool:
    """Run a stage of evolution; return whether Ctrl-C ended it early."""
    bar_or_none = Progress(label, generations, "generations") if progress else nullcontext()
    # Where a simulator is stepped in PyTorch there is too little in a step to be shared out.
    with _one_torch_thread(), bar_or_none as bar:
        try:
            for _ in range(generations):
                note = stage.generation()
                if bar is not None:
                    bar.advance(note=note)
        except (KeyboardInterrupt, SystemError) as error:
            # Ctrl-C within a compiled kernel comes out of it wrapped.
            if not isinstance(error.__cause__ or error, KeyboardInterrupt) or not stage.history:
                raise
            return True
    return False


def _results(
    course: Course, best: NDArray, history: list, seed: int | None, interrupted: bool
) -> list[PlanResult]:
    """Return what is to be said of the best plan [N, 4 K] of each run, the best first."""
    evaluation, poses, commands, given = course.expected(best)
    series = {}
    for name, stage in zip(("", "robust_"), history, strict=False):
        for which, values in zip(("best", "mean"), zip(*stage, strict=True), strict=False):
            series[name + which] = np.stack(values, axis=1).tolist()
    fitness = completes = None
    if seed is not None:
        draws = course.draw(course.settings.final_draws, seed + 0xF14A1)
        outcomes = [course.drawn(one[None], draws) for one in best]
        fitness = [float(f.mean()) for f, _, _ in outcomes]
        completes = [float(c.mean()) for _, c, _ in outcomes]
    results = [
        PlanResult(
            commands=[
                tuple(command) if keep else None
                for command, keep in zip(commands[run].tolist(), given[run], strict=True)
            ],
            poses=poses[run][[0, *(np.flatnonzero(given[run]) + 1)]],
            rest=poses[run, -1],
            fitness=float(evaluation.fitness[run]),
            completes=bool(evaluation.completes[run]),
            probability=None if completes is None else completes[run],
            expected_fitness=None if fitness is None else fitness[run],
            draws=0 if seed is None else course.settings.final_draws,
            history={name: values[run] for name, values in series.items()},
            run=run,
            interrupted=interrupted,
        )
        for run in range(len(best))
    ]
    robust = course.settings.robust
    return sorted(results, key=lambda result: _merit(result, robust), reverse=True)


def _merit(result: PlanResult, robust: RobustSettings | None) -> float:
    if robust is None:
        return result.fitness
    return result.expected_fitness if robust.objective == "fitness" else result.probability
