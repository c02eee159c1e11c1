"""The optimisers by name: ask and tell, knowing only fitness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.registry import Registry
from neurosim.controllers.base import Controller
from neurosim.evolution import GeneticAlgorithm
from neurosim.evolution.command_sets import PlanPopulation
from neurosim.loop.settings import EvolveSettings


@runtime_checkable
class Optimiser(Protocol):
    """Asked for a population, told its fitness; N independent runs of it at once, or one.

    An optimiser of your own needs ``ask`` and ``tell``. Two attributes may be there beside them:
    ``hints``, names of what else ``tell`` takes as keywords (``keys``, by which crossover of plans
    pairs commands), and ``state()`` with ``load(state)``, without which it cannot be resumed.
    """

    def ask(self) -> Any:
        """Return the population to evaluate: [P, G], or [N, P, G] of N runs."""
        ...

    def tell(self, fitness: NDArray[np.float64], *args: Any, **hints: Any) -> None:
        """Take the fitness [P] or [N, P] of the population asked for, the higher the better."""
        ...


#: By name: (controller, settings, seed, first population or None) -> optimiser.
OPTIMISERS = Registry(
    "optimiser",
    "neurosim.optimisers",
    {"ga": "neurosim.loop.optimisers:paper_ga", "cma": "neurosim.loop.cma:CMA"},
)


def make_optimiser(
    name: str,
    controller: Controller,
    settings: EvolveSettings,
    seed: int,
    first: NDArray[np.float64] | None = None,
) -> Optimiser:
    """Return an optimiser of a controller's genes.

    Args:
        name: in :data:`OPTIMISERS`.
        controller: whose genes.
        settings: population, rates and runs.
        seed: random seed.
        first: a first population [N, P, G], or None: one is drawn.

    Raises:
        UserError: if there is none of this name, or what has it is no optimiser.
    """
    made = OPTIMISERS.get(name)(controller, settings, seed, first)
    if not isinstance(made, Optimiser):
        raise UserError(f"the optimiser {name!r} has no ask() and tell()")
    return made


def paper_ga(
    controller: Controller, settings: EvolveSettings, seed: int, first: NDArray | None
) -> Optimiser:
    """Return the genetic algorithm of the paper that a controller is from."""
    genetic = settings.genetic
    shape = (settings.runs, genetic.population, controller.genes)
    if controller.kind == "plan":
        if first is None:
            first = np.random.default_rng([seed, 0x91A4]).random(shape)
        return PlanPopulation(first, genetic, seed, settings.insertion)
    generator = torch.Generator().manual_seed(seed)
    if first is None:
        drawn = controller.first(shape[0] * shape[1], generator)
        first_ = drawn.unflatten(0, shape[:2])
    else:
        first_ = torch.from_numpy(np.ascontiguousarray(first))
    return RealCoded(first_, genetic, generator)


class RealCoded(GeneticAlgorithm):
    """The real-coded genetic algorithm of networks, in NumPy's arrays."""

    def ask(self) -> NDArray[np.float64]:  # type: ignore[override]
        """Return the population [N, P, G] to evaluate; treat it as read-only."""
        return super().ask().numpy()

    def tell(self, fitness: NDArray[np.float64]) -> None:  # type: ignore[override]
        """Take its fitness [N, P] and make the next."""
        super().tell(torch.as_tensor(fitness))

    def state(self) -> dict[str, NDArray]:  # type: ignore[override]
        """Return all that the next generations depend on."""
        return {name: value.numpy() for name, value in super().state().items()}

    def load(self, state: Mapping[str, NDArray]) -> None:  # type: ignore[override]
        """Go on from what :meth:`state` returned."""
        super().load({name: torch.from_numpy(value) for name, value in state.items()})
