"""A stage of evolution: generations of an optimiser's population, judged by the one loop.

A controller that is evolved on the expected motion does it along the edge of what the task
allows, and fails wherever the robot does a little otherwise. Where samples are drawn, every
individual of a generation meets the same (common random numbers: where the robot was placed,
which member of the ensemble it moves as, the noise of every step), so that two individuals differ
by what they are and not by their luck. New ones are drawn every few generations, so that
individuals do not overfit them; the one that is kept of each run is chosen on other samples again,
and its probability of success estimated from still others.

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

from neurosim.base.trajectory import Draws
from neurosim.controllers.base import Controller
from neurosim.evolution.climb import resumable
from neurosim.evolution.command_sets import PlanSettings
from neurosim.evolution.optimisers import make_optimiser
from neurosim.evolution.space import Optimiser, SearchSpace
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.objectives import Merit, is_behind, repeats_of
from neurosim.loop.settings import EvolveSettings

#: Of a stage with random samples so many candidates of each run are looked at again: the best of
#: the last population, and the best of each set of samples before.
FINALISTS = 24
#: State of a stage, in addition to the optimiser's own.
_STATE = ("best", "mean", "population", "merit", "top", "top_merit")


class Search:
    """One stage: what an optimiser asks for is judged, generation after generation.

    Attributes:
        optimiser: the optimiser, or its :class:`~neurosim.evolution.climb.Replay`.
        best, mean: of what is shown, in every generation, [N] each.
        shown: [N, P] of the population judged last: its fitness, or what stands for it.
        population, merit: [N, P, G] and [N, P] of it.
        top: [N, G] the best individual of each run so far; with random samples it may have been
            lucky, see :meth:`choose`.
        top_merit: [N] its merit.
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
    ):
        """Begin a stage.

        Args:
            evaluator: judges.
            optimiser: has ask() and tell().
            seed: of the samples.
            objective: what is maximised.
            samples: trials that every individual is tried in; 0: what the simulator expects.
            refresh: new samples are drawn every so many generations.
            kept: [N, G] a candidate from before for each run; the best of each set of samples
                is then remembered too, to be looked at again.
            unsupported: see :meth:`Evaluator.merit`.
        """
        self._evaluator, self.optimiser = evaluator, resumable(optimiser)
        self._seed, self._refresh = list(seed), refresh
        self._objective, self._samples = objective, samples
        self._unsupported = unsupported
        self._draws = None if samples else evaluator.expectation()
        self._hints = tuple(getattr(optimiser, "hints", ()))
        self.best: list[NDArray[np.float64]] = []
        self.mean: list[NDArray[np.float64]] = []
        self.shown = self.merit = self.top = np.empty((0, 0))
        self.population, self.top_merit = np.empty((0, 0, 0)), np.empty(0)
        self._keeps = kept is not None
        self._kept = [] if kept is None else [kept]

    @property
    def done(self) -> int:
        """How many generations there were so far."""
        return len(self.best)

    def generation(self) -> str:
        """Judge a population, let the optimiser make the next, and say how it stands."""
        asked = np.asarray(self.optimiser.ask(), np.float64)
        genes = asked.reshape(-1, *asked.shape[-2:])
        if self._samples and (self._draws is None or self.done % self._refresh == 0):
            self._draws = self._draw()
        assert self._draws is not None
        with self._evaluator.threads_for(genes.shape[0] * genes.shape[1] * len(self._draws)):
            merit, hints = self._judge(genes, self._draws)
            self.optimiser.tell(merit.merit.reshape(asked.shape[:-1]), **hints)
        self._remember(genes, merit)
        if self._samples and self._objective == "probability":
            return f"completes in {100 * merit.success.max():.0f} % of {len(self._draws)} samples"
        return f"best {np.max(self.best[-1]):z.1f}"

    def _draw(self) -> Draws:
        """Draw the samples of this generation and those that share them."""
        repeats = repeats_of(self._objective) if self._evaluator.simulator.uncertain else 1
        rng = np.random.default_rng([*self._seed, self.done // self._refresh])
        return self._evaluator.draw(self._samples, rng, repeats)

    def _judge(self, genes: NDArray, draws: Draws) -> tuple[Merit, dict[str, NDArray]]:
        """Return the merit [N, P] of populations [N, P, G], and the hints."""
        runs, size, _ = genes.shape
        merit, hints = self._evaluator.merit(
            genes.reshape(runs * size, -1), draws, self._objective, self._hints, self._unsupported
        )
        shaped = {name: value.reshape(runs, size, -1) for name, value in hints.items()}
        return Merit(*(part.reshape(runs, size) for part in merit)), shaped

    def _remember(self, genes: NDArray, merit: Merit) -> None:
        self.population, self.merit, self.shown = genes, merit.merit, merit.shown
        runs, index = np.arange(len(genes)), merit.merit.argmax(axis=1)
        candidates, value = genes[runs, index], merit.merit[runs, index]
        if not self.done:
            self.top, self.top_merit = candidates.copy(), value.copy()
        better = value > self.top_merit
        self.top[better], self.top_merit[better] = candidates[better], value[better]
        if self._keeps and (self.done + 1) % self._refresh == 0:
            self._kept.append(candidates)
        # Who ranks behind the others is not the best of them, however high the fitness.
        shown = np.where(is_behind(merit.merit), -np.inf, merit.shown)
        best = shown.max(axis=1)
        self.best.append(np.where(np.isfinite(best), best, merit.shown.max(axis=1)))
        self.mean.append(merit.shown.mean(axis=1))

    def candidates(self) -> NDArray[np.float64]:
        """Return the individuals [N, C, G] among which the best of each run is to be found."""
        if not self._keeps:
            return self.population
        order = np.argsort(-self.merit, axis=1, kind="stable")[:, :FINALISTS]
        last = np.take_along_axis(self.population, order[..., None], axis=1)
        return np.concatenate([np.stack(self._kept[-FINALISTS:], axis=1), last], axis=1)

    def choose(self, draws: Draws) -> NDArray[np.float64]:
        """Return the candidate of each run that is best over other samples, [N, G]."""
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
        """Return all that the next generations depend on, as arrays."""
        state = {f"optimiser.{name}": value for name, value in self.optimiser.state().items()}
        state |= {name: np.array(getattr(self, name)) for name in _STATE}
        return state | ({"kept": np.stack(self._kept)} if self._kept else {})

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state` returned.

        Raises:
            KeyError, ValueError: if it is the state of something else.
            UserError: if the optimiser asks for others than it did before.
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
        controller: whose genes.
        settings: which optimiser, population, rates and runs.
        seed: random seed.
        first: a first population [N, P, G], or None: the controller draws one.

    Raises:
        UserError: if there is no such optimiser.
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
