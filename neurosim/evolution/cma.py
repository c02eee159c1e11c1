"""CMA-ES by the package pycma (extra ``cma``), as an optimiser by name.

Hansen and Ostermeier, Completely derandomized self-adaptation in evolution strategies,
Evolutionary Computation 9, 2001.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.evolution.space import SearchSpace


class CMA:
    """CMA-ES, one search for each run.

    Attributes:
        uses: settings of the genetic algorithm that count here, too: none.
    """

    uses: ClassVar[tuple[str, ...]] = ()

    def __init__(self, space: SearchSpace):
        """Begin at the space's start, within its bounds.

        Raises:
            UserError: if pycma is not installed, or there is only one gene.
        """
        try:
            import cma
        except ImportError:
            raise UserError(
                "the optimiser cma needs the package pycma: pip install 'neurosim[cma]'"
            ) from None
        if space.genes < 2:
            raise UserError("cma needs at least two parameters: use ga for one")
        options: dict[str, Any] = {"seed": math.nan, "verbose": -9}
        if space.population is not None:
            options["popsize"] = space.population
        starts = space.start
        if space.bounds is not None:
            options["bounds"] = list(space.bounds)
            low, high = space.bounds
            inside = 0.01 * (high - low)
            starts = np.clip(starts, low + inside, high - inside)
        self._searches = []
        for run, start in enumerate(starts):
            # Separate random numbers: pycma would use, and seed, those of the whole program.
            numbers = np.random.default_rng([*space.seed, run])
            options["randn"] = lambda *shape, numbers=numbers: numbers.standard_normal(shape)
            self._searches.append(cma.CMAEvolutionStrategy(start, space.spread, dict(options)))
        self._asked: list[list[NDArray]] = []

    def ask(self) -> NDArray[np.float64]:
        """Return the populations [N, P, G]."""
        self._asked = [search.ask() for search in self._searches]
        return np.array(self._asked)

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Take their fitness [N, P], the higher the better; NaN is worse than anything."""
        for search, asked, values in zip(self._searches, self._asked, fitness, strict=True):
            search.tell(asked, (-np.nan_to_num(values, nan=-1e12)).tolist())
