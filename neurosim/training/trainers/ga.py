"""The trainer of Pretorius et al. 2009: a genetic algorithm in which every weight is a gene."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base.declared import Count
from neurosim.base.threads import one_thread
from neurosim.evolution import GeneticAlgorithm, GeneticSettings
from neurosim.networks import PopulationError, ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData, Units, root_mean_square


@dataclass(frozen=True)
class GaSettings(GeneticSettings):
    """Table 1, and settings that the paper does not give.

    Attributes:
        generations: Generations of the search.
        hidden: Numbers of product units and of summation units of a network.
        initial: first weights are drawn between minus and plus this.
    """

    generations: Count = 15_000
    hidden: tuple[Units, Units] = (10, 10)
    initial: Annotated[float, Meta(ge=1e-6, le=1000)] = 0.5


class GaTrainer:
    """One independent genetic algorithm for each output; fitness is 1 / MSE (equation 1).

    Inputs are scaled to [-1, 1] by their largest magnitude and outputs to a root mean square of
    one, so that the same first weights and the same mutation suit every output.
    """

    source = "Pretorius, du Plessis, Cilliers 2009, section 5.3 and Table 1"
    settings_type = GaSettings

    def __init__(self, data: TrainingData, settings: GaSettings, seed: int, device: str = "cpu"):
        self.generations = settings.generations
        self._data = data
        self.device = device
        self._network = network = ProductSummationNetwork(len(data.inputs), *settings.hidden)
        self._scale = root_mean_square(data.y)
        self._error = PopulationError(
            network, data.scaled_inputs.to(device), (data.y / self._scale).T.to(device)
        )
        generator = torch.Generator(device).manual_seed(seed)
        shape = (data.y.shape[1], settings.population, network.genes)
        first = torch.rand(shape, generator=generator, device=device) * 2.0 - 1.0
        self._ga = GeneticAlgorithm(settings.initial * first, settings, generator)

    def advance(self) -> Tensor:
        with one_thread(self.device) if self._error.kernel else nullcontext():
            self._ga.tell(1.0 / self._error(self._ga.ask()))
        return self._scale.square() / self._ga.best_fitness.cpu()

    def result(self) -> MotionNetwork:
        """Return the three best networks so far."""
        return MotionNetwork(
            self._data.inputs,
            self._network,
            self._ga.best.cpu(),
            self._data.input_scale,
            self._scale,
        )
