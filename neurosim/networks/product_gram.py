"""Inner products of product units over rows of data: what least squares on them needs."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neurosim.networks.product_units import LOG_LIMIT, ProductSummationNetwork
from neurosim.networks.sorted_rows import SortedRows


class ProductGram:
    """The Gram matrix of a population's product units together with other, common columns.

    Entry (a, b) is the mean over rows of column a times column b. Columns are the product units,
    each times a factor given for the row, and then the others as they are. Product units
    are computed in single precision and summed in double.
    """

    def __init__(
        self,
        network: ProductSummationNetwork,
        x: Tensor,
        factor: Tensor,
        others: Tensor,
        *,
        kernel: bool | None = None,
    ):
        """Prepare the rows.

        Args:
            network: the shape of the networks.
            x: scaled inputs, [N, I], float64.
            factor: [N].
            others: further columns, [F, N].
            kernel: use the compiled kernel; by default on the CPU.
        """
        kernel = x.device.type == "cpu" if kernel is None else kernel
        self._rows = SortedRows(network, x)
        self._log2 = self._rows.log2() if kernel else None
        self._factor = factor[self._rows.order].double().contiguous()
        self._others = others[:, self._rows.order].double().contiguous()
        self._common = others @ others.T / len(x)

    def __call__(self, exponents: Tensor) -> Tensor:
        """Return the Gram matrices [C, P + F, P + F] (float64) of exponents [C, P, I]."""
        exponents = exponents.float().contiguous()
        signs = self._rows.signs(exponents).contiguous()
        upper = self._tensors if self._log2 is None else self._compiled
        sums = upper(exponents, signs) / len(self._factor)  # [C, P, P + F]
        units = exponents.shape[1]
        common = self._common.expand(len(sums), -1, -1)
        lower = torch.cat([sums[..., units:].transpose(-1, -2), common], dim=-1)
        return torch.cat([sums, lower], dim=-2)

    def _compiled(self, exponents: Tensor, signs: Tensor) -> Tensor:
        from neurosim.networks import _kernels

        sums = _kernels.gram(
            exponents.numpy(),
            signs.numpy(),
            self._log2,
            self._factor.numpy(),
            self._others.numpy(),
            self._rows.spans,
            np.float32(LOG_LIMIT / np.log(2.0)),
        )
        return torch.from_numpy(sums)

    def _tensors(self, exponents: Tensor, signs: Tensor) -> Tensor:
        population, units, _ = exponents.shape
        sums = torch.zeros(
            population,
            units,
            units + len(self._others),
            dtype=torch.float64,
            device=exponents.device,
        )
        for pattern, (start, end) in enumerate(self._rows.spans):
            for a, b in self._rows.blocks(start, end, exponents[..., 0].numel()):
                magnitude = (exponents @ self._rows.log[:, a:b]).clamp_(-LOG_LIMIT, LOG_LIMIT)
                products = (magnitude.exp_() * signs[:, pattern, :, None]).double() * self._factor[
                    a:b
                ]
                others = self._others[:, a:b].expand(population, -1, -1)
                sums += products @ torch.cat([products, others], dim=1).transpose(-1, -2)
        return sums
