"""A stage of evolution: generations of an optimiser's population, judged by the one loop.

A controller that evolves on the expected motion uses the task's limits fully, and fails if the
robot moves a little differently. With random samples, every individual of a generation gets the
same ones (common random numbers: the start, the member of the ensemble, the noise of every step).
So a difference between two individuals is not due to luck. New samples are drawn every few
generations, so that individuals do not overfit them. The best of each run is chosen on other
samples, and its probability of success is estimated on still others.

Sources: Jin and Branke, Evolutionary optimization in uncertain environments, IEEE Trans.
Evolutionary Computation 9, 2005; Jakobi, Husbands and Harvey, Noise and the reality gap, ECAL 1995.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Draws
from neurosim.controllers.base import Controller
from neurosim.evolution.climb import resumable
from neurosim.evolution.command_sets import PlanSettings
from neurosim.evolution.optimisers import make_optimiser
from neurosim.evolution.space import Optimiser, SearchSpace
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.objectives import Merit, is_behind, repeats_of
from neurosim.loop.settings import EvolveSettings

#: Number of candidates of each run that are judged again after a stage with random samples: the
#: best of the last population, and the best of each earlier set of samples.
FINALISTS = 24
#: State of a stage, in addition to the optimiser's own.
_STATE = ("best", "mean", "population", "merit", "shown", "top", "top_merit", "running", "settled")


class Search:
    """One stage: the populations of an optimiser are judged, generation after generation.

    Attributes:
        optimiser: the optimiser, or its :class:`~neurosim.evolution.climb.Replay`.
        best, mean: of the shown value in every generation, [N] each.
        shown: [N, P] the shown value of the last population, usually its fitness.
        population, merit: [N, P, G] and [N, P] of it.
        top: [N, G] the best individual of each run so far; with random samples it may be due to
            luck, see :meth:`choose`.
        top_merit: [N] its merit.
        running: [N] bool; runs that have ended keep what they had then.
        settled: [N] number of generations since a run completed the task.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        optimiser: Optimiser,
        *,
        seed: Sequence[int],
        objective: str = "fitness",
        samples: int = 0,
        refresh: int = 1,
        kept: NDArray[np.float64] | None = None,
        unsupported: float | None = None,
        settling: int | None = None,
        halving: int = 0,
    ):
        """Begin a stage.

        Args:
            evaluator: judges.
            optimiser: has ask() and tell().
            seed: of the samples.
            objective: the objective that is maximised.
            samples: number of trials of every individual; 0: the expected motion.
            refresh: number of generations that share the same samples.
            kept: [N, G] an earlier candidate of each run; then the best of each set of samples is
                also kept, to be judged again.
            unsupported: see :meth:`Evaluator.merit`.
            settling: number of generations after which a run ends once an individual completes the
                task, so that others do, too; None: it does not end.
            halving: number of generations after which the worse half of the runs ends, repeated; 0:
                none does.
        """
        self._evaluator, self.optimiser = evaluator, resumable(optimiser)
        self._seed, self._refresh = list(seed), refresh
        self._objective, self._samples = objective, samples
        self._unsupported = unsupported
        self._settling, self._halving = settling, halving
        self._draws = None if samples else evaluator.expectation()
        self._hints = tuple(getattr(optimiser, "hints", ()))
        self.best: list[NDArray[np.float64]] = []
        self.mean: list[NDArray[np.float64]] = []
        self.shown = self.merit = self.top = np.empty((0, 0))
        self.population, self.top_merit = np.empty((0, 0, 0)), np.empty(0)
        self.running, self.settled = np.empty(0, np.bool_), np.empty(0, np.int64)
        self._keeps = kept is not None
        self._kept = [] if kept is None else [kept]

    @property
    def done(self) -> int:
        """Number of generations so far."""
        return len(self.best)

    @property
    def ended(self) -> bool:
        """Whether all runs have ended."""
        return self.done > 0 and not self.running.any()

    def generation(self) -> str:
        """Judge a population, let the optimiser make the next; return a short figure."""
        asked = np.asarray(self.optimiser.ask(), np.float64)
        wanted = self._evaluator.controller.genes
        if asked.ndim < 2 or asked.shape[-1] != wanted or not np.isfinite(asked).all():
            raise UserError(
                f"the optimiser must ask for finite genes [..., {wanted}]; it asked for "
                f"{list(asked.shape)}"
                + ("" if np.isfinite(asked).all() else ", some of them nan or inf")
            )
        genes = asked.reshape(-1, *asked.shape[-2:])
        if self._samples and (self._draws is None or self.done % self._refresh == 0):
            self._draws = self._draw()
        assert self._draws is not None
        if not self.done:
            self.running = np.ones(len(genes), np.bool_)
            self.settled = np.zeros(len(genes), np.int64)
        individuals = self.running.sum() * genes.shape[1]
        with self._evaluator.threads_for(individuals * len(self._draws)):
            merit, hints = self._judge(genes, self._draws)
            self.optimiser.tell(merit.merit.reshape(asked.shape[:-1]), **hints)
        self._remember(genes, merit)
        if self._samples and self._objective == "probability":
            return f"completes in {100 * merit.success.max():.0f} % of {len(self._draws)} samples"
        return f"best {np.max(self.best[-1]):z.1f}"

    def _draw(self) -> Draws:
        """Draw the samples of this generation and of the next ones that share them."""
        repeats = repeats_of(self._objective) if self._evaluator.simulator.uncertain else 1
        rng = np.random.default_rng([*self._seed, self.done // self._refresh])
        return self._evaluator.draw(self._samples, rng, repeats)

    def _judge(self, genes: NDArray, draws: Draws) -> tuple[Merit, dict[str, NDArray]]:
        """Return the merit [N, P] of populations [N, P, G], and the hints; 0 of ended runs."""
        runs, size, _ = genes.shape
        judged, hints = self._evaluator.merit(
            genes[self.running].reshape(-1, genes.shape[2]),
            draws,
            self._objective,
            self._hints,
            self._unsupported,
        )

        def of_all(values: NDArray) -> NDArray:
            shaped = np.zeros((runs, size, *values.shape[1:]), values.dtype)
            shaped[self.running] = values.reshape(-1, *shaped.shape[1:])
            return shaped

        return Merit(*map(of_all, judged)), {name: of_all(one) for name, one in hints.items()}

    def _remember(self, genes: NDArray, merit: Merit) -> None:
        if not self.done:
            self.population, self.merit, self.shown = genes, merit.merit, merit.shown
            self.top, self.top_merit = genes[:, 0].copy(), np.full(len(genes), -np.inf)
        run = self.running
        self.population = np.where(run[:, None, None], genes, self.population)
        self.merit = np.where(run[:, None], merit.merit, self.merit)
        self.shown = np.where(run[:, None], merit.shown, self.shown)
        runs, index = np.arange(len(genes)), self.merit.argmax(axis=1)
        candidates, value = self.population[runs, index], self.merit[runs, index]
        better = value > self.top_merit
        self.top[better], self.top_merit[better] = candidates[better], value[better]
        if self._keeps and (self.done + 1) % self._refresh == 0:
            self._kept.append(candidates)
        # An individual that ranks last is never the best, at any fitness.
        shown = np.where(is_behind(self.merit), -np.inf, self.shown)
        best = shown.max(axis=1)
        self.best.append(np.where(np.isfinite(best), best, self.shown.max(axis=1)))
        self.mean.append(self.shown.mean(axis=1))
        if self._settling is not None:
            self.settled += (self.settled > 0) | (merit.success.max(axis=1) >= 1.0)
            self.running = run & (self.settled <= self._settling)
        if self._halving and self.done % self._halving == 0:
            self._halve()

    def _halve(self) -> None:
        """End the worse half of the runs, by their best individuals over the last samples."""
        lately = np.mean(self.best[-3 * self._refresh :], axis=0)
        order = np.argsort(np.where(self.running, -lately, np.inf), kind="stable")
        self.running[order[-(-self.running.sum() // 2) :]] = False

    def candidates(self) -> NDArray[np.float64]:
        """Return the individuals [N, C, G] among which the best of each run is chosen."""
        if not self._keeps:
            return self.population
        order = np.argsort(-self.merit, axis=1, kind="stable")[:, :FINALISTS]
        last = np.take_along_axis(self.population, order[..., None], axis=1)
        return np.concatenate([np.stack(self._kept[-FINALISTS:], axis=1), last], axis=1)

    def choose(self, draws: Draws) -> NDArray[np.float64]:
        """Return the best candidate of each run over new samples, [N, G]."""
        candidates = self.candidates()
        merit, _ = zip(
            *(
                self._evaluator.merit(run, draws, self._objective, unsupported=self._unsupported)
                for run in candidates
            ),
            strict=True,
        )
        best = np.stack([one.merit for one in merit]).argmax(axis=1)
        return candidates[np.arange(len(candidates)), best]

    def state(self) -> dict[str, NDArray]:
        """Return as arrays all values on which the next generations depend."""
        state = {f"optimiser.{name}": value for name, value in self.optimiser.state().items()}
        state |= {name: np.array(getattr(self, name)) for name in _STATE}
        return state | ({"kept": np.stack(self._kept)} if self._kept else {})

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a result of :meth:`state`.

        Raises:
            KeyError, ValueError: if it is the state of another search.
            UserError: if the optimiser asks for other individuals than before.
        """
        self.optimiser.load(part_of(state, "optimiser."))
        for name in _STATE:
            setattr(self, name, state[name].copy())
        self.best, self.mean = list(self.best), list(self.mean)
        self._kept = list(state.get("kept", ()))


def part_of(state: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return the items of a state whose names have this prefix, without the prefix."""
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}


def new_optimiser(
    controller: Controller,
    settings: EvolveSettings,
    seed: int,
    first: NDArray[np.float64] | None = None,
) -> Optimiser:
    """Return an optimiser of a controller's genes.

    Args:
        controller: the family of the genes.
        settings: of the optimiser, its population, rates and runs.
        seed: random seed.
        first: a first population [N, P, G], or None: the controller draws one.

    Raises:
        UserError: if the optimiser is unknown.
    """
    genetic, open_loop = settings.genetic, controller.open_loop
    shape = settings.runs, genetic.population, controller.genes
    if first is None and controller.kind == "plan":
        first = np.random.default_rng([seed, 0x91A4]).random(shape)
    elif first is None:
        generator = torch.Generator().manual_seed(seed)
        first = controller.first(shape[0] * shape[1], generator).numpy().reshape(shape)
    if controller.kind == "plan":
        genetic = PlanSettings(**asdict(genetic), insertion=settings.insertion)
    space = SearchSpace(
        first.mean(axis=1),
        (seed,),
        genetic,
        float(max(first.std(axis=1).mean(), 0.05)),
        controller.gene_range if open_loop else None,
        given=first,
    )
    return make_optimiser(settings.optimiser, space)
