"""How controllers are evolved."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from neurosim.base.errors import UserError
from neurosim.controllers.base import Controller
from neurosim.evolution.genetic import GeneticSettings
from neurosim.loop.objectives import objective_named
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.base import Task

#: Plans: Table 1 of Pretorius et al. 2009 but for its tournament of 50, which leaves a run with
#: one plan and its likes before the course is found.
PLAN_GENETIC = GeneticSettings(tournament=5)
#: Robust evolution: the way is known, it is to be smoothed without losing variety.
ROBUST_GENETIC = GeneticSettings(tournament=5, mutation=0.1, eta=2.0, mutation_scale=0.03)
#: Networks: Lund and Miglino 1996 give population and parents (and so 5 children of each); the
#: rest is ours.
NETWORK_GENETIC = GeneticSettings(
    population=100, crossover=0.5, mutation=0.15, eta=2.0, mutation_scale=1.0, elites=0, parents=20
)


@dataclass(frozen=True)
class RobustSettings:
    """How controllers are made robust, after generations without noise.

    Attributes:
        objective: ``probability`` of completing the task, or ``fitness``, the expected fitness.
            The latter often prefers plans that stop halfway and are safe.
        generations: Generations of --robust, after those without noise.
        draws: Outcomes that every individual of a generation of --robust meets.
        refresh: new outcomes are drawn every so many generations, lest individuals be fitted to
            them.
        selection_draws: outcomes on which the individual to keep is chosen in the end.
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
        _at_least_one(self, "generations", "draws", "refresh", "selection_draws")


@dataclass(frozen=True)
class EvolveSettings:
    """How controllers are evolved; see :func:`default_settings`.

    Attributes:
        optimiser: its name; ``ga`` is the genetic algorithm of the controller's paper.
        generations: How many populations are evaluated.
        runs: Independent runs, evaluated together; the best of all is kept.
        genetic: the genetic algorithm of every run; for plans its ``mutation_scale`` is a share
            of a gene's range.
        insertion: plans: whether a null command that mutation brings back comes at any position
            in the plan; False: where it is, as we read the paper.
        outcomes: Trials, drawn anew, that every individual of a generation is tried in; 0: it is
            judged by what the simulator expects.
        objective: What is maximised: fitness, probability, progress or steady. See
            :mod:`neurosim.loop.objectives`.
        robust: how to make the result robust, or None.
        placing: How exactly the robot is put down, for drawn outcomes: standard deviations of its
            position (x and y) and of its heading, m and rad.
        arenas: Arenas, drawn at random, in which individuals are tried in place of the
            simulator's own, a start in any of them; 0: in its own.
        selection: Start poses from which the best of the last population is chosen, where outcomes
            are drawn.
        final_draws: Fresh outcomes from which the probability of success is estimated.
        unsupported: Controllers rank behind all others that spend a larger share of the time than
            this in commands unlike any that the simulator learned from.
        extrapolate: Commands may leave what the simulator learned from, which is only reported.
    """

    optimiser: str = "ga"
    generations: int = 1000
    runs: int = 1
    genetic: GeneticSettings = PLAN_GENETIC
    insertion: bool = True
    outcomes: int = 0
    objective: str = "fitness"
    robust: RobustSettings | None = None
    placing: tuple[float, float] = field(default=PLACING)
    arenas: int = 0
    selection: int = 50
    final_draws: int = 4096
    unsupported: float = 0.1
    extrapolate: bool = False

    @property
    def most_unsupported(self) -> float | None:
        """The share of the time above which a controller ranks behind; None: none does."""
        return None if self.extrapolate else self.unsupported

    def __post_init__(self) -> None:
        _at_least_one(self, "generations", "runs", "selection", "final_draws")
        objective_named(self.objective)
        for name in ("outcomes", "arenas"):
            if getattr(self, name) < 0:
                raise UserError(f"{name} must not be negative, not {getattr(self, name)}")
        if not 0 <= self.unsupported <= 1:
            raise UserError(f"unsupported is a share of the time, 0 to 1, not {self.unsupported}")
        if min(self.placing) < 0:
            raise UserError("the scatter of the start pose must not be negative")


def default_settings(controller: Controller, task: Task, **changes: Any) -> EvolveSettings:
    """Return the settings of the paper that a controller is from, and some changed.

    Plans are evolved as in section 6.2 of Pretorius et al. 2009, on what the simulator expects.
    Controllers that see are evolved as by Lund and Miglino 1996, in trials drawn anew for every
    generation, from random starts where the task has them; else for graded progress.
    """
    if controller.blind:
        return replace(EvolveSettings(runs=10), **changes)
    steady = task.trial_starts > 1
    settings = EvolveSettings(
        generations=200,
        genetic=NETWORK_GENETIC,
        outcomes=1 if steady else 4,
        objective="steady" if steady else "progress",
        final_draws=256,
    )
    return replace(settings, **changes)


def _at_least_one(settings: object, *names: str) -> None:
    for name in names:
        if getattr(settings, name) < 1:
            raise UserError(f"{name} must be at least 1, not {getattr(settings, name)}")
