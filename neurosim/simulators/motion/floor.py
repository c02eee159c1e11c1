r"""The floor under a robot: a smooth map of the fraction of motion that is lost.

Slip differs between positions, and different slip on the left and on the right turns the robot.
With the lost fraction :math:`s` at a position, a displacement :math:`d` and a turn :math:`\phi`
become

.. math:: d' = (1 - a s)\, d, \qquad \phi' = (1 - s)\, \phi + d \times \nabla s

because of the two wheels the one that slips more falls behind. A displacement is computed in three
pieces of its arc. The number :math:`a` is the part of the fraction that the distance ahead loses,
too. The map is a sum of Gaussian bells on a grid; each member of an ensemble has its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurosim.base.kernels import kernel
from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.maps import cell_of, cells_of

#: Number of pieces of a displacement's arc.
PIECES = 3
#: Distance of the bells' centres, and of the points of the map, in lengths of a bell.
SPACING, CELL = 0.8, 0.25


@dataclass(frozen=True)
class Floor:
    """A learned floor; all tensors are float64 and on the CPU.

    Attributes:
        weights: [1 + M, NY, NX] weights of the bells, of the mean and of each member.
        origin: [2] x and y of the first bell, m, board frame.
        length: standard deviation of a bell, m; the distance of centres is :data:`SPACING` times
            it.
        ahead: part of the lost fraction that the distance loses, too, 0..1.
        map: of each network, [1 + M, NY, NX, 3]: lost fraction, and its gradient (1/m).
    """

    weights: Tensor
    origin: Tensor
    length: float
    ahead: float
    map: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in TENSORS:
            object.__setattr__(self, name, getattr(self, name).detach().cpu().double())
        if tuple(self.origin.shape) != (2,):
            raise ValueError("floor's origin must be of shape (2,)")
        if self.weights.ndim != 3 or min(self.weights.shape) < 1:
            raise ValueError("floor's weights must be of networks, rows and columns")
        if not self.length > 0 or not 0 <= self.ahead <= 1:
            raise ValueError("floor's length must be above 0, and the way's part between 0 and 1")
        (x, along_x), (y, along_y) = self._along(0), self._along(1)
        parts = [y @ self.weights @ x.T, y @ self.weights @ along_x.T, along_y @ self.weights @ x.T]
        object.__setattr__(self, "map", torch.stack(parts, dim=-1))

    def _along(self, axis: int) -> tuple[Tensor, Tensor]:
        """Return bells and their slopes along an axis of the map, [points, bells]."""
        count = self.weights.shape[2 - axis]
        points = 1 + math.ceil((SPACING * (count - 1) + 4.0) / CELL)
        bells, at = (torch.arange(n, dtype=torch.float64) for n in (count, points))
        off = SPACING * bells + 2.0 - CELL * at.unsqueeze(1)
        value = (-0.5 * off.square()).exp()
        return value, value * off / self.length

    @property
    def centres(self) -> Tensor:
        """Positions of the bells, [K, 2] m, in the order of their weights."""
        rows, columns = (
            torch.arange(count, dtype=torch.float64) for count in self.weights.shape[1:]
        )
        return self.origin + SPACING * self.length * torch.cartesian_prod(rows, columns).flip(1)

    def bells(self, points: Tensor) -> Tensor:
        """Return bells and their gradients [3, P, K] at points [P, 2]: value, along x, along y."""
        off = (self.centres.to(points) - points.unsqueeze(1)) / self.length
        value = (-0.5 * off.square().sum(2)).exp()
        return torch.stack(
            [value, value * off[..., 0] / self.length, value * off[..., 1] / self.length]
        )

    @property
    def cell(self) -> float:
        """Distance between the points of the map, m."""
        return CELL * self.length

    @property
    def corner(self) -> Tensor:
        """Position of the map's first point, [2] m: two lengths beyond the first bell."""
        return self.origin - 2.0 * self.length

    def moved(self, pose: Tensor, moved: Tensor, member: Tensor | int = -1) -> Tensor:
        """Return displacements on this floor [B, 3] for those on an even floor.

        Args:
            pose: poses of the robots, [B, 3] m, m, rad.
            moved: displacements [B, 3] in their frames.
            member: of the ensemble, of all or of each [B]; -1: the mean.
        """
        points, chords = pieces(pose, moved)
        network = torch.as_tensor(member, device=pose.device) + 1
        lost, along_x, along_y = self._at(points, network).unbind(-1)
        turn = (chords[..., 0] * along_y - chords[..., 1] * along_x).sum(1)
        turn = turn - moved[:, 2] * lost.mean(1)
        chord = (chords * (1.0 - self.ahead * lost).unsqueeze(-1)).sum(1)
        ahead = se2.rotate(turn / 2.0 - pose[:, 2], chord)
        return torch.cat([ahead, (moved[:, 2] + turn).unsqueeze(1)], dim=1)

    def _at(self, points: Tensor, network: Tensor) -> Tensor:
        """Return the map [B, P, 3] at points [B, P, 2], linear between those of the grid."""
        table = self.map.to(points)
        shape = table.shape[1], table.shape[2]
        i, j, a, b = cells_of(points[..., 0], points[..., 1], self.corner, self.cell, shape)
        a, b = a.unsqueeze(-1), b.unsqueeze(-1)
        m = network.reshape(-1, 1).expand_as(i)
        near, far = ((1 - a) * table[m, row, i] + a * table[m, row, i + 1] for row in (j, j + 1))
        return (1 - b) * near + b * far

    def arrays(self) -> dict[str, Any]:
        """Return the floor's arrays for :class:`MotionModel`."""
        return {
            "floor_map": np.ascontiguousarray(self.map.numpy()),
            "floor_corner": np.ascontiguousarray(self.corner.numpy()),
            "floor_cell": self.cell,
            "floor_ahead": float(self.ahead),
        }


#: The tensors of a floor, by name.
TENSORS = ("weights", "origin")


def even() -> dict[str, Any]:
    """Return the arrays of a simulator without a floor."""
    return {
        "floor_map": np.empty((0, 0, 0, 3)),
        "floor_corner": np.zeros(2),
        "floor_cell": 1.0,
        "floor_ahead": 0.0,
    }


def pieces(pose: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Return the middles of the pieces of arcs [B, PIECES, 2], and their chords, board frame.

    Args:
        pose: beginnings of the arcs, [B, 3] m, m, rad.
        moved: displacements [B, 3] in the frames there.
    """
    third = moved[:, 2].clamp(-math.pi, math.pi) / 3.0
    chord = se2.rotate(pose[:, 2], moved[:, :2]) / (1.0 + 2.0 * third.cos()).unsqueeze(1)
    first, last = se2.rotate(-third, chord), se2.rotate(third, chord)
    chords = torch.stack([first, chord, last], dim=1)
    return pose[:, None, :2] + chords.cumsum(1) - chords / 2.0, chords


@kernel(forceinline=True)
def on_floor(a, network, x, y, theta, dx, dy, turn):
    """Return a displacement on the floor; see :meth:`Floor.moved`.

    Args:
        a: :class:`MotionModel` of a simulator with a floor.
        network: 0 for the mean, 1 + m for a member.
        x, y, theta: pose (m, m, rad).
        dx, dy, turn: displacement on an even floor (m, m, rad).
    """
    table = a.floor_map[network]
    rows, columns = table.shape[0], table.shape[1]
    third = min(max(turn, -math.pi), math.pi) / 3.0
    cos, sin, c, s = math.cos(theta), math.sin(theta), math.cos(third), math.sin(third)
    part = 1.0 / (1.0 + 2.0 * c)
    mx, my = part * (cos * dx - sin * dy), part * (sin * dx + cos * dy)
    turned, lost_x, lost_y, mean = 0.0, 0.0, 0.0, 0.0
    for n in range(PIECES):
        own = (n - 1) * s  # the first piece is turned back by a third, the last ahead
        rest = c if n != 1 else 1.0
        cx, cy = rest * mx - own * my, own * mx + rest * my
        at_x, at_y = x + 0.5 * cx, y + 0.5 * cy
        x, y = x + cx, y + cy
        i, j, u, v = cell_of(at_x, at_y, a.floor_corner, a.floor_cell, rows, columns)
        p, q, r, t = (1.0 - v) * (1.0 - u), (1.0 - v) * u, v * (1.0 - u), v * u
        near, right, far, both = table[j, i], table[j, i + 1], table[j + 1, i], table[j + 1, i + 1]
        lost = p * near[0] + q * right[0] + r * far[0] + t * both[0]
        along_x = p * near[1] + q * right[1] + r * far[1] + t * both[1]
        along_y = p * near[2] + q * right[2] + r * far[2] + t * both[2]
        turned += cx * along_y - cy * along_x
        lost_x, lost_y, mean = lost_x + lost * cx, lost_y + lost * cy, mean + lost / PIECES
    turned -= turn * mean
    mx, my = mx / part - a.floor_ahead * lost_x, my / part - a.floor_ahead * lost_y
    c, s = math.cos(0.5 * turned), math.sin(0.5 * turned)
    mx, my = c * mx - s * my, s * mx + c * my
    return cos * mx + sin * my, cos * my - sin * mx, turn + turned
