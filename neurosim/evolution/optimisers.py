"""The optimisers by name: ask and tell, knowing only fitness.

Each is made from a :class:`~neurosim.evolution.space.SearchSpace`, and works in evolution and in
back to reality. It is resumed by giving a new one the same answers, see
:class:`neurosim.evolution.climb.Replay`.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.registry import Registry
from neurosim.evolution.bits import BitGenetic, BitSettings
from neurosim.evolution.command_sets import PlanPopulation, PlanSettings
from neurosim.evolution.genetic import GeneticAlgorithm, GeneticSettings
from neurosim.evolution.space import Optimiser, SearchSpace

#: Functions by name that take a :class:`SearchSpace` and return an :class:`Optimiser`. One that
#: does not use all settings of the genetic algorithm names those it does: its attribute ``uses``.
OPTIMISERS = Registry(
    "optimiser",
    "neurosim.optimisers",
    {"ga": "neurosim.evolution.optimisers:paper_ga", "cma": "neurosim.evolution.cma:CMA"},
)


def make_optimiser(name: str, space: SearchSpace) -> Optimiser:
    """Return an optimiser.

    Raises:
        UserError: if the name is unknown, the object is not an optimiser, or it cannot search this
            space.
    """
    made = OPTIMISERS.get(name)(space)
    if not isinstance(made, Optimiser):
        raise UserError(f"the optimiser {name!r} has no ask() and tell()")
    return made


def paper_ga(space: SearchSpace) -> Optimiser:
    """Return the genetic algorithm of the paper from which the space's settings are."""
    if isinstance(space.settings, BitSettings):
        return BitGenetic(space.start[0], space.settings, space.seed)
    if isinstance(space.settings, PlanSettings):
        return PlanPopulation(space.first(), space.settings, space.seed)
    return RealCoded(space)


class RealCoded:
    """The real-coded genetic algorithm of networks, in NumPy's arrays."""

    def __init__(self, space: SearchSpace):
        assert isinstance(space.settings, GeneticSettings)
        seed = int(np.random.default_rng([*space.seed, 0x6A]).integers(2**63))
        first = torch.from_numpy(np.ascontiguousarray(space.first()))
        generator = torch.Generator().manual_seed(seed)
        self._algorithm = GeneticAlgorithm(first, space.settings, generator)

    def ask(self) -> NDArray[np.float64]:
        """Return the population [N, P, G] to evaluate; treat it as read-only."""
        return self._algorithm.ask().numpy()

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Take the population's fitness [N, P] and make the next population."""
        self._algorithm.tell(torch.as_tensor(fitness))
