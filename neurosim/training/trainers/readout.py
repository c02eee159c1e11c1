"""The linear part of a network, solved for when its product units are known."""

from __future__ import annotations

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData, root_mean_square
from neurosim.training.trainers.exponents import translation_factors
from neurosim.training.trainers.pursuit import row_weights

#: Networks, targets, and the factors [N] of each network's output in each target.
_System = tuple[tuple[int, ...], tuple[int, ...], list[list[Tensor]]]


class Readout:
    """Fits networks with a simulator's product units to rows of one's own choosing.

    Args:
        data: rows, all of which give inputs and outputs their scale.
        simulator: of one member, with linear activations.
        ridge: added to the diagonal of the equations, the features having a mean square of one.
        weigh: rows count by how large their errors are expected to be, as in
            :func:`neurosim.training.trainers.pursuit.row_weights`.
    """

    def __init__(self, data: TrainingData, simulator: MotionNetwork, ridge: float, weigh: bool):
        self._data = data
        self._network = network = simulator.network
        self._coordinates = simulator.coordinates
        self._ridge = ridge
        self._dead_zone, self._derived = simulator.dead_zone, simulator.derived
        x = simulator.network_inputs(data.x)
        self._units = w = network.expand(simulator.genes[0])
        units = network.product_units(w.exponents, x, w.phases, w.ceilings)  # [O, P, N]
        # A unit that says nothing may be one that is not there.
        units = units.transpose(-1, -2) * (w.weights != 0).unsqueeze(1)
        others = [x] if network.summations else []
        others = torch.cat([*others, torch.ones_like(x[:, :1])], dim=1)
        features = torch.cat([units, others.expand(len(units), -1, -1)], dim=-1)  # [O, N, F]
        self._count = features.shape[-1]
        targets, parts = _equations(data.y, self._coordinates)
        #: Per system: networks, columns [E, N, len(networks) * F], targets [E, N].
        self._systems = []
        for networks, components, factors in parts:
            own = features[list(networks)]  # [n, N, F]
            columns = [
                (own * torch.stack(row).unsqueeze(-1)).transpose(0, 1).flatten(1) for row in factors
            ]
            self._systems.append((networks, torch.stack(columns), targets[list(components)]))
        #: Of the outputs; an offset is measured as the distance is.
        scale = root_mean_square(targets.T)
        self._scale = torch.cat([scale, scale[:2]])[: len(units)]

        if weigh:
            self._weigh_rows(x)

    def _weigh_rows(self, x: Tensor) -> None:
        alike = torch.ones(len(x), dtype=torch.float64)
        for number, (networks, columns, targets) in enumerate(self._systems):
            error = targets - columns @ self._solve(columns, targets, alike)
            if not error.any():
                continue  # nothing to tell rows apart by
            weights = row_weights(x, error)
            self._systems[number] = (
                networks,
                columns * weights.unsqueeze(-1),
                targets * weights,
            )

    def genes(self, weights: Tensor) -> Tensor:
        """Return the genes [O, G] of the best networks for rows that count ``weights`` [N]."""
        readout = self._scale.new_empty(len(self._scale), self._count)
        for networks, columns, targets in self._systems:
            solved = self._solve(columns, targets, weights)
            readout[list(networks)] = solved.view(len(networks), -1)
        readout, count = readout / self._scale[:, None], self._network.products
        found = self._units._replace(weights=readout[:, :count], bias=readout[:, -1])
        if self._network.summations:
            found = found._replace(linear=readout[:, count:-1])
        return self._network.pack(found)

    def _solve(self, columns: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
        weighted = (columns * weights[:, None]).flatten(0, 1).T
        square = weighted @ columns.flatten(0, 1)
        cross = weighted @ targets.flatten()
        size = square.diagonal().sqrt().clamp(min=1e-12)
        square = square / (size[:, None] * size)
        square.diagonal().add_(self._ridge)
        return torch.linalg.solve(square, cross / size) / size

    def simulator(self, genes: Tensor) -> MotionNetwork:
        """Return the simulator with these genes, [O, G] or [M, O, G]."""
        return MotionNetwork(
            self._data.inputs,
            self._network,
            genes,
            self._data.input_scale,
            self._scale,
            self._coordinates,
            dead_zone=self._dead_zone,
            derived=self._derived,
        )


def _equations(y: Tensor, coordinates: str) -> tuple[Tensor, list[_System]]:
    """Return what the networks' outputs have to do with displacements [N, 3].

    Returns:
        Targets [3, N], and systems of equations: the networks that share it, its targets, and for
        each of these the factor [N] of each network's output in it.
    """
    one = torch.ones_like(y[:, 0])
    if coordinates == "displacement":
        return y.T, [((o,), (o,), [[one]]) for o in range(3)]
    turn = ((2,), (2,), [[one]])
    position = translation_factors(y[:, 2]).unbind(0)
    return se2.mid_turn(y).T, [((0, 1, 3, 4), (0, 1), [list(p) for p in position]), turn]
