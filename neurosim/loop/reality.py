"""Generations on the robot itself: Lund and Miglino 1996, after the transfer.

The optimiser goes on where it was in the simulator; the robot tries one individual after the
other, in its own time. Every trial is kept as soon as it is over, and is never made again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from neurosim.base.checkpoint import random_state, set_random_state
from neurosim.loop.search import Search

#: So many of the last population's best are tried again, and so often each: what was best in its
#: own trial may have been lucky.
AGAIN, TRIALS_AGAIN = 5, 4


class RealRobot(Protocol):
    """A robot that tries controllers."""

    def fitness(self, genes: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the fitness [P] of individuals [P, G], each in a trial of its own."""
        ...

    def compare(self, genes: NDArray[np.float64], seed: int) -> list[dict[str, list]]:
        """Return paths of an individual [G] in the simulator and on the robot, for the report."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return what is said of the robot: which one it is, not where it is plugged in."""
        ...


class RealSearch:
    """The generations on the robot of one run.

    Attributes:
        done, best, mean: as of :class:`Search`.
        chosen: [G] the individual that was best in trials anew; None before these.
        again: mean and standard deviation of its fitness in them, [2].
    """

    def __init__(self, first: Search, reality: RealRobot, keep: Callable[[], None]):
        """Go on after a stage in the simulator.

        Args:
            first: the stage; its optimiser and random numbers are gone on with.
            reality: tries individuals.
            keep: called after each trial.
        """
        self.first, self._reality, self._keep = first, reality, keep
        self.done = 0
        self.best: list[NDArray[np.float64]] = []
        self.mean: list[NDArray[np.float64]] = []
        self.chosen: NDArray[np.float64] | None = None
        self.again: NDArray[np.float64] | None = None
        self._population = np.empty((0, 0))
        self._fitness = np.full(len(self._asked()), np.nan)

    def _asked(self) -> NDArray[np.float64]:
        asked = np.asarray(self.first.optimiser.ask(), np.float64)
        return asked.reshape(-1, asked.shape[-1])

    def generation(self) -> str:
        """Try every individual that was not tried yet, and let the optimiser make the next."""
        asked = self._asked()
        for index in np.flatnonzero(np.isnan(self._fitness)):
            self._fitness[index] = self._reality.fitness(asked[[index]], self.first.rng)[0]
            self._keep()
        fitness = self._fitness
        shape = np.asarray(self.first.optimiser.ask()).shape[:-1]
        self.best.append(fitness.max(keepdims=True))
        self.mean.append(fitness.mean(keepdims=True))
        self._population = asked[np.argsort(-fitness)[:AGAIN]].copy()
        self.first.optimiser.tell(fitness.reshape(shape))
        self._fitness = np.full(len(fitness), np.nan)
        self.done += 1
        self._keep()
        return f"best {self.best[-1][0]:z.1f}"

    def candidates(self) -> NDArray[np.float64]:
        """Return the best of the last generation [C, G], or the one chosen of them."""
        return self._population if self.chosen is None else self.chosen[None]

    def choose(self, seed: int) -> None:
        """Try the best of the last generation again, and keep the one that is best."""
        if self.chosen is None:
            rng = np.random.default_rng([seed, 3])
            trials = [self._reality.fitness(self._population, rng) for _ in range(TRIALS_AGAIN)]
            each = np.stack(trials, axis=1)
            best = int(each.mean(axis=1).argmax())
            self.chosen = self._population[best]
            self.again = np.array([each[best].mean(), each[best].std(ddof=1)])
            self._keep()

    def state(self) -> dict[str, NDArray]:
        """Return all that the next generations depend on beside the stage before."""
        found = {
            "done": np.array([self.done]),
            "best": np.array(self.best, float).reshape(-1, 1),
            "mean": np.array(self.mean, float).reshape(-1, 1),
            "fitness": self._fitness.copy(),
            "population": self._population,
            "random": random_state(self.first.rng),
        }
        if self.chosen is not None and self.again is not None:
            found |= {"chosen": self.chosen, "again": self.again}
        return found

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state` returned.

        Raises:
            KeyError, ValueError: if it is the state of something else.
        """
        if state["fitness"].shape != self._fitness.shape:
            raise ValueError("the state is of another population")
        self.done = int(state["done"][0])
        self.best, self.mean = list(state["best"]), list(state["mean"])
        self._fitness, self._population = state["fitness"].copy(), state["population"]
        self.chosen, self.again = state.get("chosen"), state.get("again")
        set_random_state(self.first.rng, state["random"])
