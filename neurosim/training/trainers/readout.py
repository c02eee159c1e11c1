"""The linear part of a network, solved for when its product units are known."""

from __future__ import annotations

import torch
from torch import Tensor

from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData, root_mean_square


class Readout:
    """Fits networks with a simulator's product units to rows of one's own choosing.

    Args:
        data: rows, all of which give inputs and outputs their scale.
        simulator: of one member, with linear activations, whose outputs are displacements.
        ridge: added to the diagonal of the equations, the features having a mean square of one.
    """

    def __init__(self, data: TrainingData, simulator: MotionNetwork, ridge: float):
        self._data, self._ridge = data, ridge
        self._network = network = simulator.network
        x = simulator.scaled(data.x)
        self._units = w = network.expand(simulator.genes[0])
        units = network.product_units(w.exponents, x, w.phases, w.ceilings)  # [O, P, N]
        # A unit that says nothing may be one that is not there.
        units = units.transpose(-1, -2) * (w.weights != 0).unsqueeze(1)
        others = [x] if network.summations else []
        others = torch.cat([*others, torch.ones_like(x[:, :1])], dim=1)
        self._features = torch.cat([units, others.expand(len(units), -1, -1)], dim=-1)  # [O, N, F]
        self._scale = root_mean_square(data.y)

    def genes(self, weights: Tensor) -> Tensor:
        """Return the genes [O, G] of the best networks for rows that count ``weights`` [N]."""
        columns = self._features * weights[:, None]
        square = columns.transpose(1, 2) @ self._features
        cross = columns.transpose(1, 2) @ self._data.y.T.unsqueeze(2)  # [O, F, 1]
        size = square.diagonal(dim1=1, dim2=2).sqrt().clamp(min=1e-12)
        square = square / size[:, :, None] / size[:, None, :]
        square.diagonal(dim1=1, dim2=2).add_(self._ridge)
        readout = torch.linalg.solve(square, cross / size.unsqueeze(2)).squeeze(2) / size
        readout, count = readout / self._scale[:, None], self._network.products
        found = self._units._replace(weights=readout[:, :count], bias=readout[:, -1])
        if self._network.summations:
            found = found._replace(linear=readout[:, count:-1])
        return self._network.pack(found)

    def simulator(self, genes: Tensor) -> MotionNetwork:
        """Return the simulator with these genes, [O, G] or [M, O, G]."""
        return MotionNetwork(
            self._data.inputs, self._network, genes, self._data.input_scale, self._scale
        )
