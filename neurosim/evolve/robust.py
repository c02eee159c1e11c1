"""Plans that still complete the task when the robot does not do quite what is expected.

Evolution goes on from plans that were evolved without noise. Every plan of a generation meets the
same drawn outcomes (common random numbers: where the robot was put down, which member of the
ensemble it moves as, the noise of every command), so that two plans differ by what they are and
not by their luck. Its fitness is the mean over the outcomes. New ones are drawn every few
generations, lest plans be fitted to them; the plan that is kept of each run is chosen on other
outcomes again, and its probability of success told from still others.

Sources: Jin and Branke, Evolutionary optimization in uncertain environments, IEEE Trans.
Evolutionary Computation 9, 2005; Jakobi, Husbands and Harvey, Noise and the reality gap, ECAL 1995.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurosim.evolution.command_sets import PlanPopulation
from neurosim.evolve.plan_course import Course

#: Of the last population and of those before so many plans of each run are looked at again.
FINALISTS = 24
#: Outcomes drawn at once for one batch of plans hold at most this many poses.
_POSES = 500_000
#: Weight of the fitness where the probability counts: among plans that never complete the task
#: it says which is on its way.
_TIE = 1e-4


class RobustEvolution:
    """Several runs of the genetic algorithm over drawn outcomes.

    Attributes:
        population: chromosomes of all runs.
        history: best and mean of what is maximised, of each generation, [runs] each.
    """

    def __init__(self, course: Course, first: PlanPopulation, seed: int):
        """Go on from runs without noise.

        Runs that have found no plan that completes the task get the plans of those that have.
        """
        self._course, self._settings = course, course.settings.robust
        self._rng = np.random.default_rng([seed, 0x20B5])
        completes = course.expected(first.best)[0].completes
        source = np.arange(len(completes))
        if completes.any():
            source[~completes] = np.resize(np.flatnonzero(completes), (~completes).sum())
        size = self._settings.genetic.population
        genes = np.take(first.genes[source], np.arange(size), axis=1, mode="wrap")
        genes[:, 0] = first.best[source]
        self.population = PlanPopulation(genes, self._settings.genetic, seed + 1)
        self.history: list[tuple[NDArray, NDArray]] = []
        self._draws = None
        #: The best of each set of outcomes, chromosomes [N, 4 K].
        self._kept: list[NDArray] = [genes[:, 0]]
        self._last = genes[:, :1]

    def generation(self) -> str:
        """Evaluate a population, make the next, and say how it stands."""
        number, genes = len(self.history), self.population.genes
        if number % self._settings.refresh == 0:
            self._draws = self._course.draw(self._settings.draws, self._seed())
        merit, success, keys = zip(*(self._judge(run, self._draws) for run in genes), strict=True)
        merit, success = np.stack(merit), np.stack(success)
        self.population.tell(merit, np.stack(keys))
        order = np.argsort(-merit, axis=1, kind="stable")[:, :FINALISTS]
        self._last = np.take_along_axis(genes, order[..., None], axis=1)
        if (number + 1) % self._settings.refresh == 0:
            self._kept.append(self._last[:, 0])
        self.history.append((merit.max(axis=1), merit.mean(axis=1)))
        return f"completes in {100 * success.max():.0f} % of {self._settings.draws} outcomes"

    def finish(self) -> NDArray[np.float64]:
        """Return the best plan of each run, [N, 4 K], chosen on outcomes of their own."""
        draws = self._course.draw(self._settings.selection_draws, self._seed())
        late = np.stack(self._kept[-FINALISTS:], axis=1)
        candidates = np.concatenate([late, self._last], axis=1)
        merit = np.stack([self._judge(run, draws)[0] for run in candidates])
        return candidates[np.arange(len(candidates)), merit.argmax(axis=1)]

    def _judge(self, genes: NDArray, draws) -> tuple[NDArray, NDArray, NDArray]:
        """Return merit and share of successes [P] of one run's plans, and their keys [P, K]."""
        batch = max(_POSES // (len(draws) * (self._course.settings.commands + 2)), 1)
        parts = []
        for first in range(0, len(genes), batch):
            fitness, completes, keys = self._course.drawn(genes[first : first + batch], draws)
            parts.append((fitness.mean(axis=1), completes.mean(axis=1), keys))
        fitness, success, keys = (np.concatenate(part) for part in zip(*parts, strict=True))
        if self._settings.objective == "probability":
            return success + _TIE * fitness, success, keys
        return fitness, success, keys

    def _seed(self) -> int:
        return int(self._rng.integers(2**62))
