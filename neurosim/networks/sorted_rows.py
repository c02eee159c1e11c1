"""Rows of data sorted by the signs of their inputs."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neurosim.networks.product_units import ProductSummationNetwork

#: Numbers in one block of a population's values, so that it fits a cache or a GPU's memory.
_BLOCK = {"cpu": 1 << 20, "cuda": 1 << 27}


class SortedRows:
    """The inputs that the product units of all networks share.

    Attributes:
        order: the rows' indices in the data, [N].
        x: sorted inputs, [I, N], single precision.
        log: ln of their magnitudes, [I, N].
        patterns: 1 where an input is negative, [M, I].
        spans: first row and end of each pattern.
    """

    def __init__(self, network: ProductSummationNetwork, x: Tensor):
        negative = x < 0
        patterns, which = torch.unique(negative, dim=0, return_inverse=True)
        self.order = torch.argsort(which, stable=True)
        self.x = x[self.order].float().T.contiguous()
        self.log = network.log_magnitude(x[self.order]).float().T.contiguous()
        self.patterns = patterns.float()
        counts = torch.bincount(which, minlength=len(patterns)).cpu().numpy()
        ends = np.cumsum(counts)
        self.spans = np.stack([ends - counts, ends], axis=1)

    def log2(self) -> np.ndarray:
        """Return the logarithms to base 2, for the kernels."""
        return self.log.numpy() * np.float32(1.0 / np.log(2.0))

    def blocks(self, start: int, end: int, width: int) -> list[tuple[int, int]]:
        """Cut rows into blocks, with ``width`` numbers in each row."""
        rows = max(1, _BLOCK.get(self.x.device.type, 1 << 20) // max(1, width))
        return [(a, min(a + rows, end)) for a in range(start, end, rows)]
