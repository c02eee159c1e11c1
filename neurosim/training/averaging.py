"""The average of several networks with linear activations is one network with all their units."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from neurosim.networks import ProductSummationNetwork, Weights
from neurosim.simulators import MotionNetwork


def average(found: list[MotionNetwork]) -> MotionNetwork:
    """Return the network whose outputs are the average of several networks' outputs.

    It has the product units of all of them, as far as they count for something.

    Args:
        found: simulators of one member, of the same rows, with linear activations.
    """
    first = found[0]
    if len(found) == 1:
        return first
    parts = [network.network.split(network.genes[0]) for network in found]
    # In units of the first one's outputs.
    shares = [n.output_scale[0] / first.output_scale[0] / len(found) for n in found]

    def mean(outputs: list[Tensor]) -> Tensor:
        return sum(
            (s.view(-1, *[1] * (o.ndim - 1)) * o for s, o in zip(shares, outputs, strict=True)),
            start=torch.zeros_like(outputs[0]),
        )

    weights = torch.cat(
        [w.product_weights * s.unsqueeze(-1) for w, s in zip(parts, shares, strict=True)], dim=-1
    )
    # Units that count come first; as many are kept as the output has that needs most.
    order = (weights == 0).to(torch.int8).argsort(dim=-1, stable=True)
    order = order[:, : max(int((weights != 0).sum(-1).max()), first.network.products)]
    of_units = order.unsqueeze(-1).expand(-1, -1, first.network.inputs)
    network = replace(first.network, products=order.shape[-1])
    linear = [torch.einsum("os,osi->oi", w.summation_weights, w.summation) for w in parts]
    bias = [w.bias + (w.summation_weights * w.summation_bias).sum(-1) for w in parts]
    # The linear map goes into the first summation unit; the others have nothing to add.
    summation = torch.zeros_like(parts[0].summation)
    summation_weights = torch.zeros_like(parts[0].summation_weights)
    summation[:, 0], summation_weights[:, 0] = mean(linear), 1.0
    genes = network.join(
        Weights(
            exponents=torch.cat([w.exponents for w in parts], dim=-2).gather(-2, of_units),
            phases=torch.cat([w.phases for w in parts], dim=-2).gather(-2, of_units),
            product_weights=weights.gather(-1, order),
            summation=summation,
            summation_bias=torch.zeros_like(parts[0].summation_bias),
            summation_weights=summation_weights,
            bias=mean(bias),
        )
    )
    return MotionNetwork(
        first.inputs,
        network,
        genes,
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
        )
    )
