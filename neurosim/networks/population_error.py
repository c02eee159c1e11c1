"""The mean squared error of a whole population of networks, fast.

Three facts make it cheap without a change of the result (:meth:`ProductSummationNetwork.forward` is
the plain form):

- all summation units of a network amount to one linear map;
- ln|x| is the same for all networks;
- the cosine of a product unit depends only on the signs of a row's inputs. There are few such sign
patterns, and with sorted rows a cosine is needed for each pattern, not for each row.

One exponential for each product unit and row remains. On a CPU the loop over rows is a compiled
kernel; elsewhere it is done in tensors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurosim.base.threads import on_cores
from neurosim.networks.product_units import LOG_LIMIT, ProductSummationNetwork
from neurosim.networks.sorted_rows import SortedRows


class PopulationError:
    """The mean squared error of networks against fixed rows of data.

    A call with genes returns the error of each network, summed in single precision.
    """

    def __init__(
        self,
        network: ProductSummationNetwork,
        x: Tensor,
        targets: Tensor,
        *,
        kernel: bool | None = None,
    ):
        """Prepare the rows.

        Args:
            network: the shape of all networks.
            x: scaled inputs, [N, I].
            targets: scaled targets of each group of networks, [O, N].
            kernel: use the compiled kernel; by default on a CPU.

        Raises:
            ValueError: if the kernel is requested on another device.
        """
        self.network = network
        on_cpu = x.device.type == "cpu"
        if kernel and not on_cpu:
            raise ValueError("the kernel needs the CPU")
        self.kernel = on_cpu if kernel is None else kernel
        self._rows = SortedRows(network, x)
        self._log2 = self._rows.log2() if self.kernel else None
        self._targets = targets[:, self._rows.order].float().contiguous()  # [O, N]

    def __call__(self, genes: Tensor) -> Tensor:
        """Return the mean squared error [O, P] (float64) of networks [O, P, G].

        Values beyond single precision are infinite.
        """
        genes = genes.float()
        return self._compiled(genes) if self.kernel else self._tensors(genes)

    def _pieces(self, genes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return exponents [O,P,K,I], signed weights [O,P,M,K], linear map [O,P,I], bias [O,P]."""
        parts = self.network.expand(genes)
        return parts.exponents, parts.signed(self._rows.patterns), parts.linear, parts.bias

    def _compiled(self, genes: Tensor) -> Tensor:
        from neurosim.networks import _kernels

        pieces = [piece.contiguous().numpy() for piece in self._pieces(genes)]
        rows = self._log2, self._rows.x.numpy(), self._targets.numpy(), self._rows.spans
        given = [*pieces, *rows, np.float32(LOG_LIMIT / np.log(2.0))]
        sums = np.empty(genes.shape[:2])
        kernel: Any = _kernels.squared_error

        def part(first: int, last: int) -> None:
            kernel(*given, first, last, sums)

        on_cores(kernel, part, sums.size)
        return torch.from_numpy(sums) / self._targets.shape[1]

    def _tensors(self, genes: Tensor) -> Tensor:
        exponents, signed, weights, bias = self._pieces(genes)
        total = torch.zeros(genes.shape[:2], dtype=torch.float64, device=genes.device)
        for pattern, (start, end) in enumerate(self._rows.spans):
            for a, b in self._rows.blocks(start, end, exponents[..., 0].numel()):
                magnitude = (exponents @ self._rows.log[:, a:b]).clamp_(-LOG_LIMIT, LOG_LIMIT)
                products = (signed[:, :, pattern].unsqueeze(-2) @ magnitude.exp_()).squeeze(-2)
                outputs = products + weights @ self._rows.x[:, a:b] + bias.unsqueeze(-1)
                residual = outputs - self._targets[:, None, a:b]
                total += residual.square().sum(-1)
        return total / self._targets.shape[1]
