"""What every trainer offers, and the data that it is given."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from neurosim.networks import ProductSummationNetwork
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


@contextmanager
def one_thread(device: str) -> Iterator[None]:
    """Let PyTorch work in one thread where compiled kernels do the heavy part in several.

    A genetic algorithm's tensors are small; and PyTorch's second thread, between two of its
    tasks, keeps busy on the core that the kernels want.
    """
    threads = torch.get_num_threads()
    if torch.device(device).type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class Trainer(Protocol):
    """Learns a motion network, a generation (or an epoch) at a time.

    Made with (data, network, settings, seed, device); the settings are a frozen dataclass, the
    trainer's ``settings_type``. All that the next generation depends on is in its state.

    Attributes:
        source: where the method was published.
        settings_type: class of its settings.
        default_generations: generations that it needs.
    """

    source: str
    settings_type: type
    default_generations: int

    def __init__(
        self,
        data: TrainingData,
        network: ProductSummationNetwork,
        settings: object,
        seed: int,
        device: str,
    ) -> None: ...

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
