"""Settings of evolution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from neurosim.base.declared import Checked, Count, CountOrNone, Fraction, Placing
from neurosim.base.errors import UserError, check_names
from neurosim.controllers.base import Controller
from neurosim.evolution.genetic import GeneticSettings
from neurosim.loop.objectives import objective_named
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.base import Task

#: Plans: Table 1 of Pretorius et al. 2009 except its tournament of 50, after which all plans of a
#: run are alike before one completes the course.
PLAN_GENETIC = GeneticSettings(tournament=5)
#: Robust evolution: it improves known plans without losing variety. 60 individuals reach the same
#: fitness as 250, in a third of the time, because each is judged by many samples.
ROBUST_GENETIC = GeneticSettings(
    population=60, tournament=5, mutation=0.1, eta=2.0, mutation_scale=0.03
)
#: Networks: Lund and Miglino 1996 give population and parents (and so 5 children of each); the rest
#: is neurosim's own.
NETWORK_GENETIC = GeneticSettings(
    population=100, crossover=0.5, mutation=0.15, eta=2.0, mutation_scale=1.0, elites=0, parents=20
)


@dataclass(frozen=True)
class RobustSettings(Checked):
    """How controllers are made robust, after generations without noise.

    Attributes:
        objective: ``probability`` of completing the task, or ``fitness``, the expected fitness.
            The latter often prefers safe plans that stop halfway.
        generations: Generations of --robust, after those without noise.
        draws: Random samples for every individual of a generation of --robust.
        refresh: number of generations that share the same samples; new samples prevent overfitting.
        settling: number of generations without noise that a run goes on once it completes the task.
        halving: number of generations after which the worse half of the runs ends, repeated.
        selection_draws: number of samples for the final choice of an individual.
        genetic: the genetic algorithm; its mutation is finer than before.
    """

    objective: Literal["probability", "fitness"] = "probability"
    generations: Count = 300
    draws: Count = 32
    refresh: Count = 10
    settling: Count = 100
    halving: Count = 100
    selection_draws: Count = 1024
    genetic: GeneticSettings = ROBUST_GENETIC


@dataclass(frozen=True)
class EvolveSettings(Checked):
    """How controllers are evolved; see :func:`default_settings`.

    Attributes:
        optimiser: its name; ``ga`` is the genetic algorithm of the controller's paper.
        generations: Number of generations.
        runs: Independent runs, evaluated together; the best of all is kept.
        genetic: the genetic algorithm of every run; for plans its ``mutation_scale`` is a fraction
            of a gene's range.
        insertion: plans: whether mutation brings a null command back at any position in the plan;
            False: at its own position, as the paper probably does.
        samples: Random samples that each individual of a generation is tried in; 0: only the
            simulator's expected motion.
        objective: The number that evolution maximises: fitness; probability, of completing the
            task; progress, towards its end; or steady, fitness minus a loss for paths that differ
            from sample to sample. See :mod:`neurosim.loop.objectives`.
        robust: how to make the result robust, or None.
        placing: Error in placing the robot, for random samples: standard deviations of its position
            (x and y) and of its heading, m and rad.
        arenas: Arenas, drawn at random, in which individuals are tried in place of the
            simulator's own, a start in any of them; 0: in its own.
        selection: Start poses from which the best of the last population is chosen, where samples
            are drawn.
        final_draws: Random samples for estimating the probability of success.
        unsupported: Largest fraction of the time in commands unlike any in the simulator's data;
            controllers above it rank last.
        extrapolate: Commands may leave the range of the simulator's data; this is only reported.
    """

    optimiser: str = "ga"
    generations: Count = 1000
    runs: Count = 1
    genetic: GeneticSettings = PLAN_GENETIC
    insertion: bool = True
    samples: CountOrNone = 0
    objective: str = "fitness"
    robust: RobustSettings | None = None
    placing: Placing = field(default=PLACING)
    arenas: CountOrNone = 0
    selection: Count = 50
    final_draws: Count = 4096
    unsupported: Fraction = 0.1
    extrapolate: bool = False

    @property
    def most_unsupported(self) -> float | None:
        """The fraction of the time above which a controller ranks last; None: no limit."""
        return None if self.extrapolate else self.unsupported

    def __post_init__(self) -> None:
        super().__post_init__()
        objective_named(self.objective)
        if not isinstance(self.robust, RobustSettings | None):
            raise UserError(
                f"robust: expected RobustSettings, such as RobustSettings(generations=100), "
                f"found {self.robust!r}"
            )

    def changed(self, changes: Mapping[str, Any]) -> EvolveSettings:
        """Return these settings with some replaced.

        Raises:
            UserError: if a setting is unknown, or a value is out of range.
        """
        check_names("evolution", changes, [each.name for each in fields(self)])
        return replace(self, **changes)


def default_settings(controller: Controller, task: Task, **changes: Any) -> EvolveSettings:
    """Return the settings of a controller's paper, with changes.

    Plans are evolved as in section 6.2 of Pretorius et al. 2009, on the expected motion.
    Closed-loop controllers are evolved as by Lund and Miglino 1996, in new random trials for every
    generation, from random starts if the task has them; otherwise for graded progress.
    """
    if controller.open_loop:
        return EvolveSettings(runs=10).changed(changes)
    steady = task.trial_starts > 1
    settings = EvolveSettings(
        generations=200,
        genetic=NETWORK_GENETIC,
        samples=1 if steady else 4,
        objective="steady" if steady else "progress",
        final_draws=256,
    )
    return settings.changed(changes)
