r"""Networks of one hidden layer of product units and summation units (Pretorius et al. 2009, 5.3).

A product unit multiplies powers of its inputs, :math:`\prod_i x_i^{w_i}`, with real exponents
:math:`w_i` (Durbin and Rumelhart, Product units: a computationally powerful and biologically
plausible extension to backpropagation networks, Neural Computation 1, 1989).

**Negative inputs.** A negative number to a real power is complex; as in Durbin and Rumelhart,
and in nearly all later work (Janson and Frenzel 1993, Leerink et al. 1995, Engelbrecht and Ismail
1999), only the real part is kept:

.. math:: \Re \prod_i x_i^{w_i} = \prod_i |x_i|^{w_i} \, \cos\Bigl(\pi \sum_{i: x_i < 0} w_i\Bigr)

**Zero inputs** have no logarithm, and a negative power of zero is infinite. The literature
assumes that there are none, or scales the inputs to an interval away from zero (Martínez-Estudillo
et al. 2006 to [1, 2]). Here that would lose important facts: whether a motor stands, its direction,
and that a displacement is about speed times duration. So inputs are scaled to [-1, 1], and the
magnitude of each is at least ``floor``: a zero input counts as a very small positive one, which a
positive exponent makes almost zero. The sum of ``w_i ln|x_i|``
is kept within :data:`LOG_LIMIT`, so that no exponents overflow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base.declared import Checked, Count
from neurosim.networks.expanded import Expanded

#: The logarithm of a product unit's magnitude is kept between minus and plus this.
LOG_LIMIT = 20.0

#: Units of a kind.
Units = Annotated[int, Meta(ge=0, le=1_000_000)]


class Weights(NamedTuple):
    """The weights in a chromosome by position in the network; leading dimensions are equal."""

    exponents: Tensor  #: of the product units, [..., P, I]
    product_weights: Tensor  #: from product units to the output, [..., P]
    summation: Tensor  #: from inputs to summation units, [..., S, I]
    summation_bias: Tensor  #: [..., S]
    summation_weights: Tensor  #: from summation units to the output, [..., S]
    bias: Tensor  #: of the output, [...]


@dataclass(frozen=True)
class ProductSummationNetwork(Checked):
    """The shape of a network with one output; its weights are one row of genes.

    All activations are linear, as in the paper. Genes are the fields of :class:`Weights` in order,
    each row by row. Product units have no bias, because it would be a factor like their weight to
    the output.

    Attributes:
        inputs: number of inputs I, scaled to about [-1, 1].
        products: number of product units P.
        summations: number of summation units S.
        floor: the smallest magnitude of an input in a product unit.
    """

    inputs: Count
    products: Units = 10
    summations: Units = 10
    floor: Annotated[float, Meta(gt=0, lt=1)] = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.products + self.summations == 0:
            raise ValueError("a network has at least one hidden unit")

    @property
    def genes(self) -> int:
        """Number of genes G of a chromosome."""
        return sum(self._sizes())

    def _sizes(self) -> tuple[int, ...]:
        p, s, i = self.products, self.summations, self.inputs
        return (p * i, p, s * i, s, s, 1)

    def split(self, genes: Tensor) -> Weights:
        """Return views of the weights in ``genes``, [..., G]."""
        parts = genes.split(self._sizes(), dim=-1)
        units = (self.products, self.inputs)
        return Weights(
            exponents=parts[0].unflatten(-1, units),
            product_weights=parts[1],
            summation=parts[2].unflatten(-1, (self.summations, self.inputs)),
            summation_bias=parts[3],
            summation_weights=parts[4],
            bias=parts[5].squeeze(-1),
        )

    def join(self, weights: Weights) -> Tensor:
        """Return the genes [..., G] of these weights."""
        parts = (
            weights.exponents.flatten(-2),
            weights.product_weights,
            weights.summation.flatten(-2),
            weights.summation_bias,
            weights.summation_weights,
            weights.bias.unsqueeze(-1),
        )
        return torch.cat(parts, dim=-1)

    def log_magnitude(self, x: Tensor) -> Tensor:
        """Return ln|x| of scaled inputs, with magnitudes of at least the floor."""
        return x.abs().clamp(min=self.floor).log()

    def product_units(self, exponents: Tensor, x: Tensor) -> Tensor:
        """Return the net values [..., P, N] of product units.

        Args:
            exponents: [..., P, I].
            x: scaled inputs, [N, I].
        """
        magnitude = exponents @ self.log_magnitude(x).T
        turns = exponents @ (x < 0).to(x).T
        return magnitude.clamp(-LOG_LIMIT, LOG_LIMIT).exp() * torch.cos(torch.pi * turns)

    def forward(self, genes: Tensor, x: Tensor) -> Tensor:
        """Return the outputs of networks, directly by the formulas.

        Args:
            genes: one row a network, [P, G].
            x: scaled inputs, [N, I], of the same dtype and device.

        Returns:
            [P, N].
        """
        w = self.split(genes)
        products = self.product_units(w.exponents, x)
        sums = w.summation @ x.T + w.summation_bias.unsqueeze(-1)
        return (
            (w.product_weights.unsqueeze(-1) * products).sum(-2)
            + (w.summation_weights.unsqueeze(-1) * sums).sum(-2)
            + w.bias.unsqueeze(-1)
        )

    def expand(self, genes: Tensor) -> Expanded:
        """Return networks [..., G] as plain sums.

        The summation units and the output's bias amount to one linear map and a constant.
        """
        w = self.split(genes)
        return Expanded(
            w.exponents,
            w.product_weights,
            linear=(w.summation_weights.unsqueeze(-1) * w.summation).sum(-2),
            bias=(w.summation_weights * w.summation_bias).sum(-1) + w.bias,
        )
