"""A stage of evolution: generations of an optimiser's population, judged by the one loop.

A controller that is evolved on what the simulator expects does it along the edge of what the task
allows, and fails wherever the robot does a little otherwise. Where outcomes are drawn, every
individual of a generation meets the same (common random numbers: where the robot was put down,
which member of the ensemble it moves as, the noise of every step), so that two individuals differ
by what they are and not by their luck. New ones are drawn every few generations, lest individuals
be fitted to them; the one that is kept of each run is chosen on other outcomes again, and its
probability of success estimated from still others.

Sources: Jin and Branke, Evolutionary optimization in uncertain environments, IEEE Trans.
Evolutionary Computation 9, 2005; Jakobi, Husbands and Harvey, Noise and the reality gap, ECAL 1995.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.checkpoint import random_state, set_random_state
from neurosim.base.errors import UserError
from neurosim.base.trajectory import Draws
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.objectives import Merit, is_behind, repeats_of
from neurosim.loop.optimisers import Optimiser

#: Of a stage with drawn outcomes so many candidates of each run are looked at again: the best of
#: the last population, and the best of each set of outcomes before.
FINALISTS = 24


class Search:
    """One stage: what an optimiser asks for is judged, generation after generation.

    Attributes:
        done: generations so far.
        rng: source of the outcomes.
        best, mean: of what is shown, in every generation, [N] each.
        shown: [N, P] of the population judged last: its fitness, or what stands for it.
        top: [N, G] the best individual of each run so far; with drawn outcomes it may have been
            lucky, see :meth:`choose`.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        optimiser: Optimiser,
        *,
        objective: str = "fitness",
        outcomes: int = 0,
        refresh: int = 1,
        rng: np.random.Generator,
        kept: NDArray[np.float64] | None = None,
        unsupported: float | None = None,
    ):
        """Begin a stage.

        Args:
            evaluator: judges.
            optimiser: asks and is told.
            objective: what is maximised.
            outcomes: trials that every individual is tried in; 0: what the simulator expects.
            refresh: the outcomes are drawn anew every so many generations.
            rng: source of the outcomes.
            kept: [N, G] a candidate from before for each run; the best of each set of outcomes
                is then remembered too, to be looked at again.
            unsupported: see :meth:`Evaluator.merit`.
        """
        self._evaluator, self.optimiser = evaluator, optimiser
        self._objective, self._outcomes, self._refresh = objective, outcomes, refresh
        self._unsupported = unsupported
        self.rng, self._draws = rng, None if outcomes else evaluator.expectation()
        self._hints = tuple(getattr(optimiser, "hints", ()))
        self.done = 0
        self.best: list[NDArray[np.float64]] = []
        self.mean: list[NDArray[np.float64]] = []
        self.shown = np.empty((0, 0))
        self.top = np.empty((0, 0))
        self._top_merit = np.empty(0)
        self._population = np.empty((0, 0, 0))
        self._merit = np.empty((0, 0))
        self._keeps = kept is not None
        self._kept = [] if kept is None else [kept]
        self._drawn_from = random_state(rng)

    def generation(self) -> str:
        """Judge a population, let the optimiser make the next, and say how it stands."""
        asked = np.asarray(self.optimiser.ask(), np.float64)
        genes = asked.reshape(-1, *asked.shape[-2:])
        if self._outcomes and self.done % self._refresh == 0:
            self._drawn_from = random_state(self.rng)
            self._draws = self._draw()
        assert self._draws is not None
        with self._evaluator.threads_for(genes.shape[0] * genes.shape[1] * len(self._draws)):
            merit, hints = self._judge(genes, self._draws)
            self.optimiser.tell(merit.merit.reshape(asked.shape[:-1]), **hints)
        self._remember(genes, merit)
        self.done += 1
        if self._outcomes and self._objective == "probability":
            return f"completes in {100 * merit.success.max():.0f} % of {len(self._draws)} outcomes"
        return f"best {np.max(self.best[-1]):z.1f}"

    def _draw(self) -> Draws:
        repeats = repeats_of(self._objective) if self._evaluator.simulator.uncertain else 1
        return self._evaluator.draw(self._outcomes, self.rng, repeats)

    def _judge(self, genes: NDArray, draws: Draws) -> tuple[Merit, dict[str, NDArray]]:
        """Return what populations [N, P, G] are worth, [N, P] each, and what else is to be told."""
        runs, size, _ = genes.shape
        merit, hints = self._evaluator.merit(
            genes.reshape(runs * size, -1), draws, self._objective, self._hints, self._unsupported
        )
        shaped = {name: value.reshape(runs, size, -1) for name, value in hints.items()}
        return Merit(*(part.reshape(runs, size) for part in merit)), shaped

    def _remember(self, genes: NDArray, merit: Merit) -> None:
        # Who ranks behind the others is not the best of them, however high the fitness.
        shown = np.where(is_behind(merit.merit), -np.inf, merit.shown)
        best = shown.max(axis=1)
        self.best.append(np.where(np.isfinite(best), best, merit.shown.max(axis=1)))
        self.mean.append(merit.shown.mean(axis=1))
        self._population, self._merit, self.shown = genes, merit.merit, merit.shown
        runs, index = np.arange(len(genes)), merit.merit.argmax(axis=1)
        found, value = genes[runs, index], merit.merit[runs, index]
        if not self.done:
            self.top, self._top_merit = found.copy(), value.copy()
        better = value > self._top_merit
        self.top[better], self._top_merit[better] = found[better], value[better]
        if self._keeps and (self.done + 1) % self._refresh == 0:
            self._kept.append(found)

    def candidates(self) -> NDArray[np.float64]:
        """Return the individuals [N, C, G] among which the best of each run is to be found."""
        if not self._keeps:
            return self._population
        order = np.argsort(-self._merit, axis=1, kind="stable")[:, :FINALISTS]
        last = np.take_along_axis(self._population, order[..., None], axis=1)
        return np.concatenate([np.stack(self._kept[-FINALISTS:], axis=1), last], axis=1)

    def choose(self, draws: Draws) -> NDArray[np.float64]:
        """Return the candidate of each run that is best over other outcomes, [N, G]."""
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
        """Return all that the next generations depend on, as arrays.

        Raises:
            UserError: if the optimiser has no state to be kept.
        """
        if not hasattr(self.optimiser, "state"):
            raise UserError("this optimiser cannot be interrupted and resumed: it has no state()")
        found = {f"optimiser.{name}": value for name, value in self.optimiser.state().items()}
        found |= {
            "done": np.array([self.done]),
            "best": np.array(self.best, float),
            "mean": np.array(self.mean, float),
            "random": random_state(self.rng),
            "drawn_from": self._drawn_from,
        }
        if self.done:
            found |= {"population": self._population, "merit": self._merit}
            found |= {"top": self.top, "top_merit": self._top_merit}
        if self._kept:
            found["kept"] = np.stack(self._kept)
        return found

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state` returned.

        Raises:
            KeyError, ValueError: if it is the state of something else.
        """
        prefix = "optimiser."
        self.optimiser.load(  # type: ignore[attr-defined]
            {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        )
        self.done = int(state["done"][0])
        self.best, self.mean = list(state["best"]), list(state["mean"])
        if self.done:
            self._population, self._merit = state["population"], state["merit"]
            self.top, self._top_merit = state["top"].copy(), state["top_merit"].copy()
        self._kept = list(state["kept"]) if "kept" in state else []
        self._drawn_from = state["drawn_from"]
        if self._outcomes and self.done % self._refresh:
            # The outcomes of the generations before are those of the next ones too.
            set_random_state(self.rng, self._drawn_from)
            self._draws = self._draw()
        set_random_state(self.rng, state["random"])
