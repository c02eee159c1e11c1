"""The baseline that a reader would ask for: multilayer perceptrons trained by gradient descent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base.declared import Checked, Count
from neurosim.networks import Perceptron, ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData, root_mean_square


@dataclass(frozen=True)
class GradientSettings(Checked):
    """Settings of Adam and of early stopping.

    Attributes:
        rate: highest learning rate; it falls to zero along half a cosine.
        batch: rows in a step.
        epochs: passes over the rows for which the learning rate is planned.
        validation: share of the training rows, drawn at random, that decides which epoch is kept.
    """

    rate: Annotated[float, Meta(ge=1e-9, le=10)] = 3e-3
    batch: Count = 64
    epochs: Count = 400
    validation: Annotated[float, Meta(ge=0.001, le=0.999)] = 0.1


class GradientTrainer:
    """A tanh network of two hidden layers an output, trained on the displacement itself.

    Nothing here knows of twists, dead zones or products: inputs are scaled to [-1, 1], outputs to
    a root mean square of one, and the mean squared error is minimised by Adam.
    """

    source = (
        "Multilayer perceptron; Adam: Kingma and Ba 2015; cosine learning rate: Loshchilov and "
        "Hutter 2017; early stopping: Prechelt 1998"
    )
    settings_type = GradientSettings
    default_generations = 400
    default_hidden = (64, 64)

    def __init__(
        self,
        data: TrainingData,
        network: ProductSummationNetwork | Perceptron,
        settings: GradientSettings,
        seed: int,
        device: str = "cpu",
    ):
        """Take the sizes of the two hidden layers from ``network``, whatever its kind."""
        if isinstance(network, ProductSummationNetwork):
            network = Perceptron(network.inputs, network.products, network.summations)
        self._data, self._network, self._settings = data, network, settings
        self._generator = torch.Generator().manual_seed(seed)
        self._scale = root_mean_square(data.y)
        order = torch.randperm(len(data.x), generator=self._generator)
        held_out = max(1, round(settings.validation * len(order)))
        x, y = data.scaled_inputs.to(device), (data.y / self._scale).to(device)
        self._x, self._y = x[order[held_out:]], y[order[held_out:]]
        self._unseen = (x[order[:held_out]], y[order[:held_out]])
        self._genes = network.initial(3, self._generator).to(x).requires_grad_()
        self._optimiser = torch.optim.Adam([self._genes], lr=settings.rate)
        self._best = self._genes.detach().clone()
        self._best_error = torch.full((3,), torch.inf, dtype=x.dtype, device=device)
        self._training_error = self._best_error.clone()
        self._epoch = 0

    @staticmethod
    def make_network(
        inputs: int, hidden: tuple[int, int], activations: tuple[str, str]
    ) -> Perceptron:
        """Return the shape of the networks that it trains; its activations are its own."""
        return Perceptron(inputs, *hidden)

    def advance(self) -> Tensor:
        """Work one epoch; return the training error of the epoch that is kept, [3], in SI units."""
        settings = self._settings
        done = min(self._epoch / settings.epochs, 1.0)
        rate = 0.5 * settings.rate * (1.0 + torch.cos(torch.tensor(torch.pi * done)).item())
        self._optimiser.param_groups[0]["lr"] = rate
        order = torch.randperm(len(self._x), generator=self._generator)
        for rows in order.split(settings.batch):
            error = self._error(self._genes, self._x[rows], self._y[rows]).sum()
            self._optimiser.zero_grad()
            error.backward()
            self._optimiser.step()
        self._epoch += 1
        with torch.no_grad():
            unseen = self._error(self._genes, *self._unseen)
            better = unseen < self._best_error
            self._best_error = torch.where(better, unseen, self._best_error)
            self._best = torch.where(better[:, None], self._genes, self._best)
            seen = self._error(self._genes, self._x, self._y)
            self._training_error = torch.where(better, seen, self._training_error)
        return self._scale.square() * self._training_error.cpu()

    def _error(self, genes: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return the mean squared error of each output's network, [3]."""
        return (self._network.forward(genes, x) - y.T).square().mean(1)

    def result(self) -> MotionNetwork:
        """Return, for each output, the network of the epoch that predicted unseen rows best."""
        return MotionNetwork(
            self._data.inputs,
            self._network,
            self._best.cpu(),
            self._data.input_scale,
            self._scale,
        )

    def state(self) -> dict[str, Tensor]:
        """Return networks, the optimiser's moments and what early stopping remembers."""
        moments = self._optimiser.state.get(self._genes, {})
        state = {
            "genes": self._genes.detach(),
            "best": self._best,
            "best_error": self._best_error,
            "training_error": self._training_error,
            "epoch": torch.tensor([self._epoch]),
            "generator": self._generator.get_state(),
            **{f"adam.{name}": torch.as_tensor(value) for name, value in moments.items()},
        }
        return {name: value.cpu().clone() for name, value in state.items()}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state, bit for bit."""
        with torch.no_grad():
            self._genes.copy_(state["genes"])
        self._best = state["best"].to(self._genes)
        self._best_error = state["best_error"].to(self._genes)
        self._training_error = state["training_error"].to(self._genes)
        self._epoch = int(state["epoch"])
        self._generator.set_state(state["generator"])
        moments = {k.removeprefix("adam."): v for k, v in state.items() if k.startswith("adam.")}
        if moments:
            moments = {k: v.to(self._genes) if v.ndim else v for k, v in moments.items()}
            moments["step"] = state["adam.step"].reshape(()).float()
            self._optimiser.state[self._genes] = moments
