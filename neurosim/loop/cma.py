"""CMA-ES by the package pycma (extra ``cma``), as an optimiser by name.

Hansen and Ostermeier, Completely derandomized self-adaptation in evolution strategies,
Evolutionary Computation 9, 2001.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.controllers.base import Controller
from neurosim.loop.settings import EvolveSettings


def new_search(
    start: NDArray[np.float64],
    spread: float,
    seed: Any,
    *,
    bounds: tuple[float, float] | None = None,
    population: int | None = None,
) -> Any:
    """Return a search of pycma, which minimises.

    Args:
        start: [G] where it begins.
        spread: standard deviation of its first population.
        seed: of ``numpy.random.default_rng``.
        bounds: lowest and highest of every gene, or None.
        population: its size; None: pycma's own, by the number of genes.

    Raises:
        UserError: if pycma is not installed.
    """
    try:
        import cma
    except ImportError:
        raise UserError(
            "the optimiser cma needs the package pycma: pip install 'neurosim[cma]'"
        ) from None
    # Numbers of its own: pycma would draw from, and seed, those of the whole program.
    numbers = np.random.default_rng(seed)
    options: dict[str, Any] = {"seed": math.nan, "verbose": -9}
    options["randn"] = lambda *shape: numbers.standard_normal(shape)
    if bounds is not None:
        options["bounds"] = list(bounds)
    if population is not None:
        options["popsize"] = population
    return cma.CMAEvolutionStrategy(start, spread, options)


class CMA:
    """CMA-ES, one search for each run; it cannot be resumed."""

    def __init__(
        self,
        controller: Controller,
        settings: EvolveSettings,
        seed: int,
        first: NDArray[np.float64] | None = None,
    ):
        """Start from the first population's mean and spread, [N, P, G] or as the controller draws.

        Raises:
            UserError: if pycma is not installed.
        """
        generator = torch.Generator().manual_seed(seed)
        self._searches = []
        for run in range(settings.runs):
            genes = controller.first(64, generator).numpy() if first is None else first[run]
            start, spread = genes.mean(axis=0), float(max(genes.std(), 0.05))
            bounds = (0.0, 1.0) if controller.blind else None
            self._searches.append(new_search(start, spread, [seed, run], bounds=bounds))
        self._asked: list[list[NDArray]] = []

    def ask(self) -> NDArray[np.float64]:
        """Return the populations [N, P, G]."""
        self._asked = [search.ask() for search in self._searches]
        return np.array(self._asked)

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Take their fitness [N, P]."""
        for search, asked, values in zip(self._searches, self._asked, fitness, strict=True):
            search.tell(asked, (-np.nan_to_num(values, nan=-1e12)).tolist())
