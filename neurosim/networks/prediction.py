"""Outputs of a few networks for many rows, fast: what a simulator in use computes."""

from __future__ import annotations

import torch
from torch import Tensor

from neurosim.networks.product_units import LOG_LIMIT, ProductSummationNetwork

#: With more inputs than this a table by sign pattern would be larger than what it saves.
_MOST_INPUTS = 8


class Prediction:
    """The outputs of given networks; called with scaled inputs [N, I], it returns [N, O].

    With linear activations the summation units are one linear map, and the cosines of the product
    units stand in a table by sign pattern. :meth:`ProductSummationNetwork.forward` is the plain
    form, and what is used for other activations.
    """

    def __init__(self, network: ProductSummationNetwork, genes: Tensor):
        """Prepare networks with ``genes`` [O, G]."""
        self._network = network
        self._genes = genes
        self._fast = network.linear and network.inputs <= _MOST_INPUTS
        if not self._fast:
            return
        w = network.split(genes)
        outputs, inputs = len(genes), network.inputs
        self._exponents = w.exponents.flatten(0, 1).T.contiguous()  # [I, O * P]
        self._ceilings = w.ceilings.flatten()
        self._bits = 2 ** torch.arange(inputs, device=genes.device)
        patterns = torch.arange(2**inputs, device=genes.device)
        negative = (patterns.unsqueeze(-1) // self._bits % 2).to(genes)  # [2^I, I]
        phases = w.phases.flatten(0, 1).T
        signs = torch.cos(torch.pi * (negative @ phases))
        self._signed = signs * w.product_weights.flatten()  # [2^I, O * P]
        weights, self._bias = network.collapsed(genes)
        self._linear = weights.T.contiguous()
        self._groups = (outputs, network.products)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the outputs [N, O] for scaled inputs [N, I]."""
        if not self._fast:
            return self._network.forward(self._genes, x).T
        magnitude = self._network.log_magnitude(x) @ self._exponents
        torch.minimum(magnitude, self._ceilings, out=magnitude)
        magnitude.clamp_(min=-LOG_LIMIT).exp_()
        magnitude *= self._signed[((x < 0) * self._bits).sum(-1)]
        products = magnitude.unflatten(-1, self._groups).sum(-1)
        return torch.addmm(self._bias, x, self._linear).add_(products)
