"""Back to reality: controller and simulator are adapted to each other, in turn.

Zagal, Ruiz-del-Solar and Vallejos 2004, section 4: L1 learns the controller in the simulator, L2 in
reality, L3 adapts the simulator until it gives the results of reality; then this repeats. This
module works with any robot and any controller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.back_to_reality.adapt import (
    SPREAD,
    Compared,
    agreement,
    best_set,
    similar,
)
from neurosim.back_to_reality.evaluations import Evaluation, Evaluations
from neurosim.back_to_reality.settings import BackToRealitySettings
from neurosim.back_to_reality.simulated import Simulated
from neurosim.base.generations import run_generations
from neurosim.base.scalars import Scalars
from neurosim.evolution.bits import BitSettings
from neurosim.evolution.climb import Climb
from neurosim.evolution.optimisers import make_optimiser
from neurosim.evolution.policy_gradient import PolicyGradient
from neurosim.evolution.space import Optimiser, SearchSpace
from neurosim.loop.journal import Journal
from neurosim.loop.search import part_of

#: Parameter sets over which a prediction is the mean, where L1 takes several.
FORESEEN = 16


@dataclass
class Adaptation:
    """The result of a run.

    Attributes:
        genes: [G] the best individual, as fractions of the controller's range of genes.
        fitness: its mean fitness in reality.
        start: mean fitness in reality of the first controller.
        parameters: [K] of the simulator, fractions of their ranges; adapted by L3 if that ran.
        evaluations: used in reality.
        trials: used in reality.
        record: every evaluation in reality, in their order.
        cycles: its course, for JSON.
    """

    genes: NDArray[np.float64]
    fitness: float
    start: float
    parameters: NDArray[np.float64]
    evaluations: float
    trials: int
    record: Evaluations
    cycles: list[dict[str, Any]] = field(default_factory=list)


class Alternation:
    """A running alternation.

    Attributes:
        cycles: its course so far, for JSON.
    """

    def __init__(
        self,
        simulated: Simulated,
        journal: Journal,
        start: NDArray[np.float64],
        settings: BackToRealitySettings,
        *,
        seed: int = 0,
        state: Mapping[str, NDArray] | None = None,
        save: Callable[[Mapping[str, Any]], None] | None = None,
        progress: bool = True,
        scalars: Scalars | None = None,
    ):
        """Prepare.

        Args:
            simulated: the simulator, task and controller.
            journal: of the trials in reality.
            start: [G] the controller to start from, such as one that was tuned by hand; fractions.
            settings: of the alternation.
            seed: random seed.
            state: the last state that ``save`` got before an interruption.
            save: keeps the state.
            progress: whether to show progress on stderr.
            scalars: for curves of the fitness in reality and of each search.

        Raises:
            UserError: if a search needs a package that is not installed, or more parameters.
            FileError: if there are trials that were tracked for another number of steps.
        """
        journal.expect(simulated.steps)
        self._simulated, self._journal, self._start = simulated, journal, start
        self._settings, self._seed = settings, seed
        # Checked now, before any trial is made.
        Climb(self._controllers(0, start), lambda genes: genes[:, 0])
        if settings.adapt != "none":
            Climb(self._parameters(0, simulated.as_is), lambda sets: sets[:, 0])
        self._state = dict(state or {})
        self._save, self._progress = save, progress
        self._scalars = scalars or Scalars(None)
        self._record = Evaluations()
        self._now = simulated.as_is  # [K] the simulator's parameters
        self.cycles: list[dict[str, Any]] = []
        #: Parameter sets [S, K] that predict, before and after L3 of a cycle.
        self._adapted: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}

    def run(self) -> Adaptation:
        """Run all cycles and return their results.

        Raises:
            KeyboardInterrupt: at Ctrl-C; the state was saved.
            UserError, RobotError: of reality; what was tried before is written down.
        """
        settings, best = self._settings, self._start
        self._try(self._start[None], "start")
        for cycle in range(settings.cycles + 1):
            last = cycle == settings.cycles
            if self._room() <= settings.spared:
                break
            self.cycles.append({"parameters": self._named(self._now)})
            candidates = self._search(cycle, best)
            genes, real = self._candidates(cycle, candidates)
            self._confirm()
            if last or not len(genes):
                break
            if settings.adapt != "none":
                self._adapt(cycle, genes, real)
            best = self._believed().genes
            if settings.policy_steps:
                self._policies(cycle, best)
                self._confirm()
                best = self._believed().genes
        start, believed = self._record.latest()[0], self._believed()
        return Adaptation(
            believed.genes, believed.fitness, start.fitness, self._now, self._journal.evaluations,
            self._journal.used, self._record, self.cycles,
        )  # fmt: skip

    # Trials in reality

    def _room(self) -> int:
        """Return how many evaluations are left."""
        if not self._settings.budget:
            return 1_000_000
        return self._settings.budget - round(self._journal.evaluations)

    def _try(self, genes: NDArray[np.float64], why: str) -> NDArray[np.float64]:
        """Return the fitness [P] of individuals in their first evaluation in reality."""
        fitness = self._journal.evaluate(self._simulated.real_genes(genes), why)
        before = len(self._record)
        self._record.add(genes, fitness)
        self._show(before)
        return fitness

    def _show(self, before: int) -> None:
        """Add the newest evaluations, after the first ``before``, to their curve."""
        for number, one in enumerate(self._record.all[before:], start=before + 1):
            self._scalars.add("reality/fitness", one.fitness, number)

    def _confirm(self) -> None:
        """Evaluate the best again, then the new best, until one has enough evaluations.

        The best of many single results is usually partly luck.
        """
        for _ in range(self._settings.finalists):
            leader = self._record.leader()
            if leader.count >= self._settings.confirm or self._room() < 1:
                break
            genes = self._simulated.real_genes(leader.genes[None])
            fitness = self._journal.evaluate(genes, "confirm", leader.count + 1)
            self._record.all.append(Evaluation(leader.genes, float(fitness[0]), leader.count + 1))
            self._show(len(self._record) - 1)

    def _believed(self) -> Evaluation:
        return self._record.believed(self._settings.confirm)

    # L1

    def _search(self, cycle: int, start: NDArray[np.float64]) -> Climb:
        """Evolve controllers in the simulator, from mutations of one."""
        settings = self._settings

        def evaluate(genes: NDArray[np.float64]) -> NDArray[np.float64]:
            # The simulator never agrees fully with reality: controllers that are evolved in the
            # best set alone, or in the same few sets, depend on these.
            sets = self._around(settings.sets, cycle, climb.done)
            each = self._simulated.over(genes, sets)
            return each.mean(axis=0) - settings.caution * each.std(axis=0)

        total = settings.generations
        if cycle and settings.later_generations:
            total = settings.later_generations
        climb = Climb(self._controllers(cycle, start), evaluate)
        label = f"cycle {cycle + 1}: controllers in the simulator (L1)"
        self._climb(climb, f"{cycle}.L1", total, label, settings.sets)
        self.cycles[cycle]["L1"] = climb.history()
        return climb

    def _controllers(self, cycle: int, start: NDArray[np.float64]) -> Optimiser:
        how = self._settings
        return self._optimiser(how.search, start, how.genetic, how.spread, cycle, 1)

    def _parameters(self, cycle: int, start: NDArray[np.float64]) -> Optimiser:
        how = self._settings
        return self._optimiser(how.adapt, start, how.adapt_genetic, SPREAD, cycle, 3)

    def _optimiser(
        self,
        name: str,
        start: NDArray[np.float64],
        genetic: BitSettings,
        spread: float,
        cycle: int,
        level: int,
    ) -> Optimiser:
        """Return an optimiser of fractions 0..1."""
        space = SearchSpace(
            start[None],
            (self._seed, cycle, level),
            genetic,
            spread,
            (0.0, 1.0),
            genetic.population,
        )
        return make_optimiser(name, space)

    def _climb(self, climb: Climb, name: str, total: int, label: str, each: int) -> None:
        """Run a search, or the rest of it; each of its individuals takes ``each`` trials."""

        def save(state: Mapping[str, Any]) -> None:
            self._state |= {f"{name}.{key}": value for key, value in state.items()}
            if self._save is not None:
                self._save(self._state)

        climb.load(part_of(self._state, f"{name}."))
        before = climb.done
        self._simulated.tried += climb.individuals * each

        def after() -> None:
            fitness, (cycle, level) = climb.fitness[-1], name.split(".")
            search = f"cycle-{int(cycle) + 1}/{level}"
            self._scalars.add(f"{search}/best", float(fitness.max()), climb.done)
            self._scalars.add(f"{search}/mean", float(fitness.mean()), climb.done)

        if run_generations(climb, total, label, save=save, progress=self._progress, after=after):
            raise KeyboardInterrupt
        if climb.done > before:
            save(climb.state())

    def _candidates(
        self, cycle: int, climb: Climb
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Try the best of generations spread over the search; return genes and fitness.

        The paper's individuals are some of the best of the evolved populations; the last ones
        exploit the simulator's peculiarities.
        """
        count = min(self._settings.candidates, self._room() - self._settings.spared)
        known = self._record.known
        chosen: list[NDArray[np.float64]] = []
        places = np.linspace(climb.done - 1, 0, count).round().astype(int)
        # Instead of duplicates: other individuals of the last generations.
        others = [
            asked[np.argsort(-fitness)]
            for asked, fitness in zip(climb.asked, climb.fitness, strict=True)
        ]
        for genes in [*climb.best[places], *np.concatenate(others[::-1])]:
            if len(chosen) < count and genes.tobytes() not in known:
                known.add(genes.tobytes())
                chosen.append(genes)
        if not chosen:
            return np.empty((0, self._simulated.genes)), np.empty(0)
        genes = np.stack(chosen)
        real = self._try(genes, f"cycle {cycle + 1}, L1")
        adapted = self.cycles[cycle - 1].get("L3") if cycle else None
        if adapted is None:
            simulated = self._simulated.expected(genes, self._foreseen())
        else:
            adapted["held_out"] = held_out = self._agreement(cycle - 1, genes, real)
            simulated = np.array(held_out["simulated_after"])
        works = np.abs(simulated - real) <= 0.25 * np.maximum(real, simulated)
        self.cycles[cycle]["transfer"] = {
            "simulated": simulated.tolist(),
            "real": real.tolist(),
            "works": float(np.mean(works & (real > 0.0))),
        }
        return genes, real

    # L3

    def _adapt(self, cycle: int, genes: NDArray[np.float64], real: NDArray[np.float64]) -> None:
        """Search the parameters with which the simulator gives the results of reality.

        It does nothing if poses are to be compared and reality tracked none.
        """
        settings, left_out = self._settings, None
        if settings.compare == "similar":
            fitness = self._simulated.fitness(genes, self._now)
            chosen = similar(fitness, real, settings.compared)
            left_out = np.delete(genes, chosen, axis=0), np.delete(real, chosen)
            genes, real = genes[chosen], real[chosen]
        else:
            best = self._believed()
            others = [one for one in self._record.latest() if (one.genes != best.genes).any()]
            recent = [*others[max(len(others) + 1 - settings.compared, 0) :], best]
            genes = np.stack([one.genes for one in recent])
            real = np.array([one.fitness for one in recent])
        ten = self._compared(genes, real)
        if settings.compare == "tracked" and ten.poses is None:
            return
        climb = Climb(self._parameters(cycle, self._now), lambda sets: -ten.discrepancy(sets))
        label = f"cycle {cycle + 1}: the simulator's parameters (L3)"
        self._climb(climb, f"{cycle}.L3", settings.adapt_generations, label, len(ten.genes))
        before = self._foreseen()
        self._now = best_set(ten, climb, self._now)
        self._adapted[cycle] = before, self._foreseen()
        self.cycles[cycle]["L3"] = {
            "history": {name: [-v for v in values] for name, values in climb.history().items()},
            "parameters": [self._named(self._now)],
            "compared": self._agreement(cycle, ten.genes, ten.fitness),
        }
        if left_out is not None and len(left_out[0]):
            self.cycles[cycle]["L3"]["left_out"] = self._agreement(cycle, *left_out)

    def _around(self, count: int, *seed: int) -> NDArray[np.float64]:
        """Return the simulator's parameters and random ones around them, [count, K]."""
        rng = np.random.default_rng([self._seed, 0x5E75, *seed])
        normal = rng.standard_normal((count - 1, len(self._now)))
        others = np.clip(self._now + self._settings.prior * normal, 0.0, 1.0)
        return np.concatenate([self._now[None], others])

    def _foreseen(self) -> NDArray[np.float64]:
        """Return the parameter sets [S, K] over which a prediction is the mean."""
        return self._around(FORESEEN if self._settings.sets > 1 else 1)

    def _agreement(
        self, cycle: int, genes: NDArray[np.float64], real: NDArray[np.float64]
    ) -> dict[str, Any]:
        return agreement(self._compared(genes, real), *self._adapted[cycle])

    def _compared(self, genes: NDArray[np.float64], real: NDArray[np.float64]) -> Compared:
        return Compared(self._simulated, genes, real, self._poses(genes))

    def _poses(self, genes: NDArray[np.float64]) -> list[NDArray[np.float64]] | None:
        return self._journal.poses(self._simulated.real_genes(genes))

    def _named(self, fractions: NDArray[np.float64]) -> dict[str, float]:
        values = self._simulated.values(fractions).tolist()
        return {one.name: v for one, v in zip(self._simulated.parameters, values, strict=True)}

    # L2

    def _policies(self, cycle: int, start: NDArray[np.float64]) -> None:
        """Learn in reality, from the best so far; every policy that is tried can be the best."""
        settings = self._settings
        learner = PolicyGradient(start, settings.policy, [self._seed, cycle, 2])
        climb = Climb(
            learner,
            lambda asked: self._try(asked, f"cycle {cycle + 1}, L2, step {climb.done + 1}"),
        )
        while (
            climb.done < settings.policy_steps
            and self._room() - settings.spared >= settings.policy.policies
        ):
            climb.generation()
        self.cycles[cycle]["L2"] = history = climb.history()
        if not climb.done:
            return
        if self._room() > settings.spared:
            end = self._try(learner.point[None], f"cycle {cycle + 1}, L2, its end")
            for values in history.values():
                values.append(float(end[0]))
        genes, real = np.concatenate(climb.asked), np.concatenate(climb.fitness)
        if "L3" in self.cycles[cycle]:
            self.cycles[cycle]["L3"]["neighbours"] = self._agreement(cycle, genes, real)
