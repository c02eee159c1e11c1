"""Networks as plain sums, the basis of all fast forms."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Expanded(NamedTuple):
    r"""Networks as sums of product units, a linear map and a constant.

    .. math:: \sum_p w_p \prod_i |x_i|^{e_{pi}}
              \cos\Bigl(\pi \sum_{i: x_i < 0} e_{pi}\Bigr) + \sum_i a_i x_i + b

    Leading dimensions are several networks.
    """

    exponents: Tensor  #: of the product units, [..., P, I]
    weights: Tensor  #: of the product units, [..., P]
    linear: Tensor  #: weights of the inputs, [..., I]
    bias: Tensor  #: [...]

    def signed(self, patterns: Tensor) -> Tensor:
        """Return the product units' weights for patterns of negative inputs, [..., S, P].

        Args:
            patterns: 1 where an input is negative, else 0, [S, I].
        """
        signs = torch.cos(torch.pi * (self.exponents @ patterns.T)).transpose(-1, -2)
        return self.weights.unsqueeze(-2) * signs

    def times(self, factor: Tensor | float) -> Expanded:
        """Return networks whose outputs are ``factor`` ([...] or one number) times these."""
        each = factor.unsqueeze(-1) if isinstance(factor, Tensor) else factor
        return self._replace(
            weights=self.weights * each, linear=self.linear * each, bias=self.bias * factor
        )


def sign_patterns(inputs: int) -> Tensor:
    """Return all patterns of negative inputs, [2^I, I]: bit i of a row's index is its column i."""
    return (torch.arange(2**inputs).unsqueeze(-1) // 2 ** torch.arange(inputs) % 2).double()
