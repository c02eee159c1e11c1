"""One search in the simulator, L1 or L3, generation after generation; it can be gone on with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from neurosim.back_to_reality.genetic import BitGenetic, BitSettings
from neurosim.base.errors import UserError
from neurosim.loop.cma import new_search


class AskTell(Protocol):
    """An optimiser of shares 0..1, which maximises."""

    def ask(self) -> NDArray[np.float64]:
        """Return a population [P, G]."""
        ...

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Take its fitness [P]."""
        ...


class BoundedCMA:
    """CMA-ES (pycma) within 0..1."""

    def __init__(self, start: NDArray[np.float64], spread: float, population: int, seed: Any):
        """Begin at shares [G].

        Raises:
            UserError: if the package is not installed, or G is 1.
        """
        if len(start) < 2:
            raise UserError("cma searches two parameters at least: take ga for a single one")
        self._search = new_search(
            np.clip(start, 0.01, 0.99), spread, seed, bounds=(0.0, 1.0), population=population
        )
        self._asked: list[NDArray] = []

    def ask(self) -> NDArray[np.float64]:
        """Return a population [P, G]."""
        self._asked = self._search.ask()
        return np.array(self._asked)

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Take its fitness [P], the higher the better."""
        self._search.tell(self._asked, (-fitness).tolist())


def make_search(
    name: str, start: NDArray[np.float64], genetic: BitSettings, spread: float, seed: Any
) -> AskTell:
    """Return a search by name, ``ga`` (section 5.1.3) or ``cma``.

    Args:
        name: which.
        start: [G] shares where it begins.
        genetic: the genetic algorithm; its population is that of cma, too.
        spread: of cma's first population, a share of the ranges.
        seed: of ``numpy.random.default_rng``.

    Raises:
        UserError: if cma cannot be had here; see :class:`BoundedCMA`.
    """
    if name == "ga":
        return BitGenetic(start, genetic, seed)
    return BoundedCMA(start, spread, genetic.population, seed)


class Climb:
    """A search whose generations are remembered: a :class:`neurosim.base.generations.Stage`.

    Only the fitness values are saved, not the optimiser. To resume, the search is repeated with
    these values, without any simulation.

    Attributes:
        done: generations so far.
        asked: [P, G] of every generation.
        fitness: [P] of every generation.
    """

    def __init__(
        self,
        search: AskTell,
        evaluate: Callable[[NDArray[np.float64]], NDArray[np.float64]],
        before: NDArray[np.float64] | None = None,
    ):
        """Begin, or go on.

        Args:
            search: the optimiser, new.
            evaluate: returns the fitness [P] of a population [P, G].
            before: [n, P] fitness of generations that were evaluated before.

        Raises:
            ValueError: if the generations before are not of this search.
        """
        self._search, self._evaluate = search, evaluate
        self.done = 0
        self.asked: list[NDArray[np.float64]] = []
        self.fitness: list[NDArray[np.float64]] = []
        for known in () if before is None else before:
            self._advance(known)

    def _advance(self, known: NDArray[np.float64] | None) -> None:
        asked = self._search.ask()
        fitness = self._evaluate(asked) if known is None else known
        if fitness.shape != (len(asked),):
            raise ValueError("these generations are of another search")
        self._search.tell(fitness)
        self.asked.append(asked)
        self.fitness.append(fitness)
        self.done += 1

    def generation(self) -> str:
        """Evaluate a generation; return its best."""
        self._advance(None)
        return f"best {self.fitness[-1].max():.3g}"

    def state(self) -> Mapping[str, Any]:
        """Return the fitness of all generations."""
        return {"fitness": np.stack(self.fitness)} if self.fitness else {}

    @property
    def individuals(self) -> int:
        """How many were evaluated so far, before an interruption or since."""
        return sum(map(len, self.asked))

    @property
    def best(self) -> NDArray[np.float64]:
        """Return the best of each generation, [n, G]."""
        pairs = zip(self.asked, self.fitness, strict=True)
        return np.stack([asked[fitness.argmax()] for asked, fitness in pairs])

    def history(self) -> dict[str, list[float]]:
        """Return best and mean fitness of every generation."""
        return {
            "best": [float(fitness.max()) for fitness in self.fitness],
            "mean": [float(fitness.mean()) for fitness in self.fitness],
        }
