"""What every trainer offers, and the data that it is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from neurosim.networks import Perceptron, ProductSummationNetwork
from neurosim.simulators import MotionNetwork


@dataclass(frozen=True)
class TrainingData:
    """The rows to learn from, and how they are scaled for a network.

    Attributes:
        inputs: names and units of the inputs, [{name, unit}].
        x: inputs, [N, I], float64, in the dataset's units.
        y: displacements, [N, 3], in m, m and rad.
    """

    inputs: list[dict[str, str]]
    x: Tensor
    y: Tensor

    @property
    def input_scale(self) -> Tensor:
        """The largest magnitude of each input, [I]: scaled inputs lie in [-1, 1]."""
        return _not_zero(self.x.abs().amax(0))

    @property
    def scaled_inputs(self) -> Tensor:
        """Inputs divided by their scale, [N, I]."""
        return self.x / self.input_scale


def root_mean_square(values: Tensor) -> Tensor:
    """Return the root mean square of each column, 1 where it is zero."""
    return _not_zero(values.square().mean(0).sqrt())


def _not_zero(scale: Tensor) -> Tensor:
    return torch.where(scale > 0, scale, 1.0)


@dataclass(frozen=True)
class PursuitSettings:
    """How product units are searched for, one at a time.

    Attributes:
        candidates: units drawn for each function that may get one.
        parents: best of them, from which others are made.
        children: made by changing parents.
        mutation_scales: standard deviations of the change of exponents, one a round.
        limits: lowest and highest exponent.
        ridge: added to the diagonal of the equations, scaled to ones.
        refine_every: units from one refinement of all exponents to the next.
        refine_steps: steps of a refinement.
        reweigh_at: numbers of units at which the rows are weighed anew by their expected error.
        unit_cost: degrees of freedom that a unit counts as in generalised cross-validation.
        least_gain: relative gain of the score that counts as one.
        patience: units without a gain after which the search ends.
    """

    candidates: int = 600
    parents: int = 12
    children: int = 150
    mutation_scales: tuple[float, ...] = (0.4, 0.15)
    limits: tuple[float, float] = (-3.0, 4.0)
    ridge: float = 1e-7
    refine_every: int = 2
    refine_steps: int = 2
    reweigh_at: tuple[int, ...] = (4, 8)
    unit_cost: float = 12.0
    least_gain: float = 1e-3
    patience: int = 8

    def __post_init__(self) -> None:
        if min(self.candidates, self.parents, self.children, self.refine_every) < 1:
            raise ValueError("candidates, parents, children and refine_every are at least 1")
        if not self.limits[0] < self.limits[1]:
            raise ValueError("the lowest exponent must be below the highest")


class Trainer(Protocol):
    """Learns a motion network, a generation (or an epoch) at a time.

    Made with (data, network, settings, seed, device); the settings are a frozen dataclass, the
    trainer's ``settings_type``. All that the next generation depends on is in its state.

    Attributes:
        source: where the method was published.
        settings_type: class of its settings.
        default_generations: generations that it needs.
        default_hidden: units of both kinds that its networks have if nobody says otherwise.
    """

    source: str
    settings_type: type
    default_generations: int
    default_hidden: tuple[int, int]

    def __init__(
        self,
        data: TrainingData,
        network: ProductSummationNetwork | Perceptron,
        settings: object,
        seed: int,
        device: str,
    ) -> None: ...

    @staticmethod
    def make_network(
        inputs: int, hidden: tuple[int, int], activations: tuple[str, str]
    ) -> ProductSummationNetwork | Perceptron:
        """Return the shape of the networks that it trains.

        Args:
            inputs: of a network.
            hidden: units of both kinds, or of both layers.
            activations: of the hidden units and of the output.

        Raises:
            ValueError: if there is no such network.
        """
        ...

    def advance(self) -> Tensor:
        """Work one generation; return the least mean squared error so far, [3], in SI units."""
        ...

    def result(self) -> MotionNetwork:
        """Return the best simulator so far."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Return the state as tensors on the CPU."""
        ...

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state, bit for bit."""
        ...
