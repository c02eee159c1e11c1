"""A genetic algorithm over the product units' exponents, everything linear solved exactly.

Given its product units, a network with linear activations is linear in all its other weights, and
the best of these follow from one small system of equations; only the exponents need searching.
The networks learn the body twist whose exponential is the displacement, so that what the robot
does (drive at a speed, turn at a rate) is not hidden behind the sine and cosine of where that led.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from neurosim.evolution import GeneticAlgorithm, GeneticSettings
from neurosim.networks import ProductGram, ProductSummationNetwork, Weights
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData, one_thread, root_mean_square


@dataclass(frozen=True)
class ExponentsSettings(GeneticSettings):
    """Settings of the search: Table 1 of the paper, and what it does not say.

    Attributes:
        initial: first exponents are drawn between minus and plus this.
        sparsity: share of the first exponents that are zero: most products are of few inputs.
        limit: exponents stay between minus and plus this.
        ridge: added to the diagonal of the equations, features having a mean square of one.
    """

    mutation_scale: float = 0.3
    initial: float = 2.0
    sparsity: float = 0.6
    limit: float = 4.0
    ridge: float = 1e-6


class ExponentsTrainer:
    """One genetic algorithm an output over [products x inputs] exponents.

    The displacement of a constant body twist (vx, vy, omega) over unit time is, seen from
    half way round, (vx, vy) times the chord factor sinc(omega / 2). Fitting that factor times the
    networks' outputs to the displacement rotated back by half its turn minimises the error of the
    displacement itself, and needs no logarithm, which has none near whole turns.
    """

    source = (
        "Ridge regression on evolved product units, after Martínez-Estudillo et al. 2006; "
        "twist coordinates: Lynch and Park 2017, section 3.3"
    )
    settings_type = ExponentsSettings
    default_generations = 100

    def __init__(
        self,
        data: TrainingData,
        network: ProductSummationNetwork,
        settings: ExponentsSettings,
        seed: int,
        device: str = "cpu",
    ):
        if not network.linear or network.summations < 1 or network.products < 1:
            raise ValueError("exponents are trained for linear activations and units of both kinds")
        self._data = data
        self._device = device
        self._network = network
        self._settings = settings
        x = data.scaled_inputs.to(device)
        targets, factors = half_way(data.y.to(device))  # [N, 3], [N, 3]
        self._scale = root_mean_square(targets)
        linear = torch.cat([x, torch.ones_like(x[:, :1])], dim=1).T
        self._grams = []
        for factor, target in zip(factors.T, (targets / self._scale).T, strict=True):
            others = torch.cat([linear * factor, target.unsqueeze(0)])
            self._grams.append(ProductGram(network, x, factor, others))
        generator = torch.Generator(device).manual_seed(seed)
        genes = network.products * network.inputs
        shape = (targets.shape[1], settings.population, genes)
        draws = {"generator": generator, "device": device, "dtype": x.dtype}
        first = settings.initial * (2.0 * torch.rand(shape, **draws) - 1.0)
        first *= torch.rand(shape, **draws) >= settings.sparsity
        self._ga = GeneticAlgorithm(
            first,
            settings,
            generator,
            bounds=(-settings.limit, settings.limit),
        )

    def advance(self) -> Tensor:
        """Work one generation; return the least mean squared error so far, [3], in SI units.

        Those of dx and dy are of the displacement seen from half way round, the turn taken as
        measured.
        """
        with one_thread(self._device):
            error, _ = self._solve(self._ga.ask())
            self._ga.tell(1.0 / error)
        return (self._scale.square() / self._ga.best_fitness).cpu()

    def result(self) -> MotionNetwork:
        """Return the three best networks so far."""
        network = self._network
        best = self._ga.best.unsqueeze(1)
        _, readout = self._solve(best)  # [3, 1, P + I + 1]
        readout = readout.squeeze(1)
        p, i, s = network.products, network.inputs, network.summations
        outputs = len(readout)
        # The linear map goes into the first summation unit; the others have nothing to add.
        summation = readout.new_zeros(outputs, s, i)
        summation[:, 0] = readout[:, p : p + i]
        summation_weights = readout.new_zeros(outputs, s)
        summation_weights[:, 0] = 1.0
        weights = Weights(
            exponents=best.view(outputs, p, i),
            product_weights=readout[:, :p],
            summation=summation,
            summation_bias=readout.new_zeros(outputs, s),
            summation_weights=summation_weights,
            bias=readout[:, -1],
        )
        return MotionNetwork(
            self._data.inputs,
            network,
            network.join(weights).cpu(),
            self._data.input_scale,
            self._scale.cpu(),
            coordinates="twist",
        )

    def state(self) -> dict[str, Tensor]:
        """Return the genetic algorithm's state."""
        return self._ga.state()

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state, bit for bit."""
        self._ga.load(state)

    def _solve(self, exponents: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean squared errors [O, C] and read-outs [O, C, F] of exponents [O, C, P*I].

        The equations are scaled to a unit diagonal: a product unit's size says nothing.
        """
        errors, readouts = zip(
            *(self._solve_output(o, e) for o, e in enumerate(exponents)), strict=True
        )
        return torch.stack(errors), torch.stack(readouts)

    def _solve_output(self, output: int, exponents: Tensor) -> tuple[Tensor, Tensor]:
        units = exponents.view(-1, self._network.products, self._network.inputs)
        gram = self._grams[output](units)  # the last column is the target
        square, cross, power = gram[:, :-1, :-1], gram[:, :-1, -1], gram[:, -1, -1]
        size = square.diagonal(dim1=-2, dim2=-1).sqrt().clamp(min=1e-12)
        square = square / (size.unsqueeze(-1) * size.unsqueeze(-2))
        square.diagonal(dim1=-2, dim2=-1).add_(self._settings.ridge)
        cross = cross / size
        triangle, failed = torch.linalg.cholesky_ex(square)
        readout = torch.cholesky_solve(cross.unsqueeze(-1), triangle).squeeze(-1)
        # |y - Fw|^2 for the ridge solution w: y'y - 2 w'c + w'Sw, S without the ridge.
        error = power - (readout * cross).sum(-1) - self._settings.ridge * readout.square().sum(-1)
        return torch.where(failed == 0, error.clamp(min=1e-12), torch.inf), readout / size


def half_way(displacement: Tensor) -> tuple[Tensor, Tensor]:
    """Return displacements seen from half way round, and each output's factor on its twist.

    Args:
        displacement: [N, 3].

    Returns:
        Targets [N, 3] and factors [N, 3], such that twist * factor = target.
    """
    dx, dy, dtheta = displacement.unbind(-1)
    cos, sin = (dtheta / 2.0).cos(), (dtheta / 2.0).sin()
    targets = torch.stack([cos * dx + sin * dy, cos * dy - sin * dx, dtheta], dim=-1)
    chord = torch.sinc(dtheta / (2.0 * torch.pi))
    return targets, torch.stack([chord, chord, torch.ones_like(chord)], dim=-1)
