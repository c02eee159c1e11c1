"""The average of several networks with linear activations is one network with all their units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from neurosim.networks import Expanded, ProductSummationNetwork
from neurosim.simulators import MotionNetwork


def mean(parts: Sequence[Expanded], scales: Sequence[float] | None = None) -> Expanded:
    """Return the average of functions, each times its scale: the units of all of them."""
    scales = scales or [1.0] * len(parts)
    parts = [part.times(s / len(parts)) for part, s in zip(parts, scales, strict=True)]
    return Expanded(
        exponents=torch.cat([part.exponents for part in parts]),
        phases=torch.cat([part.phases for part in parts]),
        ceilings=torch.cat([part.ceilings for part in parts]),
        weights=torch.cat([part.weights for part in parts]),
        linear=torch.stack([part.linear for part in parts]).sum(0),
        bias=torch.stack([part.bias for part in parts]).sum(0),
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
        parts = [_used(one.network.expand(one.genes[0, output])) for one in found]
        scales = [(one.output_scale[0, output] / unit).item() for one in found]
        functions.append(mean(parts, scales))
    products = max(first.network.products, *(len(one.weights) for one in functions))
    network = replace(first.network, products=products)
    return MotionNetwork(
        first.inputs,
        network,
        torch.stack([network.pack(function) for function in functions]),
        first.input_scale,
        first.output_scale,
        first.coordinates,
        dead_zone=first.dead_zone,
        derived=first.derived,
    )


def _used(function: Expanded) -> Expanded:
    """Return a function without the product units that count for nothing."""
    used = function.weights != 0
    parts = function._asdict()
    return function._replace(
        **{name: parts[name][used] for name in ("exponents", "phases", "ceilings", "weights")}
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
