"""Search spaces, and the protocol of optimisers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from neurosim.evolution.bits import BitSettings
from neurosim.evolution.command_sets import PlanSettings
from neurosim.evolution.genetic import GeneticSettings


@dataclass(frozen=True, eq=False)
class SearchSpace:
    """The space that an optimiser searches, and its start; N independent runs of it.

    Attributes:
        start: [N, G] where each run begins.
        seed: of ``numpy.random.default_rng``; all random numbers come from it.
        settings: of the genetic algorithm. Other optimisers need not know them.
        spread: standard deviation of the first population around the start, in every gene.
        bounds: lowest and highest of every gene, or None.
        population: number of individuals; None: the optimiser chooses.
        given: [N, P, G] first populations, or None; see :meth:`first`.
    """

    start: NDArray[np.float64]
    seed: tuple[int, ...]
    settings: GeneticSettings | PlanSettings | BitSettings
    spread: float
    bounds: tuple[float, float] | None = None
    population: int | None = None
    given: NDArray[np.float64] | None = None

    @property
    def runs(self) -> int:
        """Number of independent runs."""
        return len(self.start)

    @property
    def genes(self) -> int:
        """Number of genes of an individual."""
        return self.start.shape[1]

    def first(self) -> NDArray[np.float64]:
        """Return first populations [N, P, G]: the given ones, else random ones around the start."""
        if self.given is not None:
            return self.given
        shape = self.runs, self.settings.population, self.genes
        normal = np.random.default_rng([*self.seed, 0xF125]).standard_normal(shape)
        population = self.start[:, None] + self.spread * normal
        population[:, 0] = self.start
        return population if self.bounds is None else np.clip(population, *self.bounds)


@runtime_checkable
class Optimiser(Protocol):
    """An optimiser, which asks for populations and gets their fitness; one run or N at once.

    An optimiser of your own needs ``ask`` and ``tell``, and all its random numbers from the seed.
    Two parts are optional: ``hints``, names of further keywords of ``tell`` (``keys``, by which
    crossover of plans pairs commands), and ``state()`` with ``load(state)``, arrays by name, if
    these are smaller than all its answers.
    """

    def ask(self) -> Any:
        """Return the population to evaluate: [P, G], or [N, P, G] for N runs."""
        ...

    def tell(self, fitness: NDArray[np.float64], *args: Any, **hints: Any) -> None:
        """Take the fitness [P] or [N, P] of the last population, the higher the better."""
        ...
