"""Multilayer perceptrons of two tanh layers, their weights a row of genes as in other networks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neurosim.base.declared import Checked, Count


@dataclass(frozen=True)
class Perceptron(Checked):
    """The shape of a perceptron with one output and two hidden layers of tanh units.

    Genes are the weights of each layer, row by row, and then its biases, layer after layer.

    Attributes:
        inputs: number of inputs I, scaled to about [-1, 1].
        first: units of the first hidden layer.
        second: units of the second.
    """

    inputs: Count
    first: Count = 64
    second: Count = 64

    #: Its output is no linear function of anything that a faster form could make use of.
    linear = False

    @property
    def genes(self) -> int:
        """Number of genes G."""
        return sum((rows + 1) * columns for rows, columns in self._layers())

    def _layers(self) -> tuple[tuple[int, int], ...]:
        return (self.inputs, self.first), (self.first, self.second), (self.second, 1)

    def initial(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw genes [count, G] as Glorot and Bengio 2010 do; biases are zero."""
        parts = []
        for rows, columns in self._layers():
            reach = math.sqrt(6.0 / (rows + columns))
            weights = torch.rand(count, rows * columns, generator=generator, dtype=torch.float64)
            parts += [reach * (2.0 * weights - 1.0), weights.new_zeros(count, columns)]
        return torch.cat(parts, dim=1)

    def forward(self, genes: Tensor, x: Tensor) -> Tensor:
        """Return the outputs [P, N] of networks [P, G] for scaled inputs [N, I]."""
        values = x.expand(len(genes), -1, -1)
        start = 0
        for number, (rows, columns) in enumerate(self._layers()):
            middle, end = start + rows * columns, start + (rows + 1) * columns
            weights = genes[:, start:middle].view(-1, columns, rows).transpose(1, 2)
            values = torch.baddbmm(genes[:, middle:end].unsqueeze(1), values, weights)
            if number < 2:
                values = torch.tanh(values)
            start = end
        return values.squeeze(-1)
