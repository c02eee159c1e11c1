"""The average of several networks with linear activations is one network with all their units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neurosim.networks import ProductSummationNetwork, Weights
from neurosim.simulators import MotionNetwork


class Expansion(NamedTuple):
    """What a network with linear activations is: product units, inputs and one, each weighed."""

    exponents: Tensor  #: of the product units, [P, I]
    phases: Tensor  #: [P, I]
    weights: Tensor  #: of the product units, [P]
    linear: Tensor  #: weights of the inputs, [I]
    bias: Tensor  #: []
    ceilings: Tensor  #: of the product units, [P]

    @staticmethod
    def of(network: ProductSummationNetwork, genes: Tensor) -> Expansion:
        """Return what a chromosome [G] is, without units that count for nothing."""
        w, (linear, bias) = network.split(genes), network.collapsed(genes)
        counts = w.product_weights != 0
        return Expansion(
            w.exponents[counts],
            w.phases[counts],
            w.product_weights[counts],
            linear,
            bias,
            w.ceilings[counts],
        )

    @staticmethod
    def mean(parts: Sequence[Expansion], scales: Sequence[float] | None = None) -> Expansion:
        """Return the average of functions, each times its scale: the units of all of them."""
        shares = [scale / len(parts) for scale in scales or [1.0] * len(parts)]
        pairs = list(zip(parts, shares, strict=True))
        return Expansion(
            exponents=torch.cat([part.exponents for part in parts]),
            phases=torch.cat([part.phases for part in parts]),
            weights=torch.cat([part.weights * share for part, share in pairs]),
            linear=torch.stack([part.linear * share for part, share in pairs]).sum(0),
            bias=torch.stack([part.bias * share for part, share in pairs]).sum(0),
            ceilings=torch.cat([part.ceilings for part in parts]),
        )

    def genes(self, network: ProductSummationNetwork) -> Tensor:
        """Return the function as a chromosome [G] of a network with units enough for it.

        The linear map goes into the first summation unit; the others have nothing to add, nor
        have product units that the function lacks.
        """
        missing = network.products - len(self.weights)
        summation = self.linear.new_zeros(network.summations, network.inputs)
        summation_weights = self.linear.new_zeros(network.summations)
        summation[0], summation_weights[0] = self.linear, 1.0
        return network.join(
            Weights(
                exponents=pad(self.exponents, (0, 0, 0, missing)),
                product_weights=pad(self.weights, (0, missing)),
                summation=summation,
                summation_bias=self.linear.new_zeros(network.summations),
                summation_weights=summation_weights,
                bias=self.bias,
                phases=pad(self.phases, (0, 0, 0, missing)),
                ceilings=pad(self.ceilings, (0, missing)),
            )
        )


def average(found: Sequence[MotionNetwork]) -> MotionNetwork:
    """Return the network whose outputs are the average of several networks' outputs.

    It has the product units of all of them, as far as they count for something.

    Args:
        found: simulators of one member, of the same rows, with linear activations.
    """
    first = found[0]
    if len(found) == 1:
        return first
    functions = []
    for output, unit in enumerate(first.output_scale[0]):
        parts = [Expansion.of(one.network, one.genes[0, output]) for one in found]
        scales = [(one.output_scale[0, output] / unit).item() for one in found]
        functions.append(Expansion.mean(parts, scales))
    products = max(first.network.products, *(len(one.weights) for one in functions))
    network = replace(first.network, products=products)
    return MotionNetwork(
        first.inputs,
        network,
        torch.stack([function.genes(network) for function in functions]),
        first.input_scale,
        first.output_scale,
        first.coordinates,
        dead_zone=first.dead_zone,
        derived=first.derived,
    )


def widened(network: ProductSummationNetwork, genes: Tensor, products: int) -> Tensor:
    """Return the genes [..., G] of the same networks with units that count for nothing."""
    w, missing = network.split(genes), products - network.products
    return replace(network, products=products).join(
        w._replace(
            exponents=pad(w.exponents, (0, 0, 0, missing)),
            phases=pad(w.phases, (0, 0, 0, missing)),
            product_weights=pad(w.product_weights, (0, missing)),
            ceilings=pad(w.ceilings, (0, missing)),
        )
    )
