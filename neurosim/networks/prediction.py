"""Outputs of a few networks for many rows, fast, as simulators need them."""

from __future__ import annotations

import torch
from torch import Tensor

from neurosim.networks.expanded import sign_patterns
from neurosim.networks.product_units import LOG_LIMIT, ProductSummationNetwork

#: With more inputs than this, a table by sign pattern would cost more than it saves.
_MOST_INPUTS = 8


class Prediction:
    """The outputs of given networks; called with scaled inputs [N, I], it returns [N, O].

    The summation units are one linear map, and the cosines of the product units are in a table by
    sign pattern. :meth:`ProductSummationNetwork.forward` is the plain form, which is used for many
    inputs.
    """

    def __init__(self, network: ProductSummationNetwork, genes: Tensor):
        """Prepare networks with ``genes`` [O, G]."""
        self._network = network
        self._genes = genes
        self._fast = network.inputs <= _MOST_INPUTS or network.products == 0
        if not self._fast:
            return
        self._log_magnitude = network.log_magnitude
        parts = network.expand(genes)
        self._linear, self._bias = parts.linear.T.contiguous(), parts.bias
        self._groups = (len(genes), network.products)
        if network.products == 0:
            return
        self._exponents = parts.exponents.flatten(0, 1).T.contiguous()  # [I, O * P]
        signed = parts.signed(sign_patterns(network.inputs).to(genes))
        self._signed = signed.transpose(0, 1).flatten(1)  # [2^I, O * P]
        self._bits = 2 ** torch.arange(network.inputs, device=genes.device)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the outputs [N, O] for scaled inputs [N, I]."""
        if not self._fast:
            return self._network.forward(self._genes, x).T
        if self._network.products == 0:
            return torch.addmm(self._bias, x, self._linear)
        units = (self._log_magnitude(x) @ self._exponents).clamp(-LOG_LIMIT, LOG_LIMIT).exp()
        units = units * self._signed[((x < 0) * self._bits).sum(-1)]
        products = units.unflatten(-1, self._groups).sum(-1)
        return torch.addmm(self._bias, x, self._linear) + products
