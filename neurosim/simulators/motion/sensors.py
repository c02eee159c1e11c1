"""Sensors of a motion network, whose readings depend on their position on the board.

Each sensor has a position on the robot, and reads a map of the board there, linear between the
points of a grid. Sensors of the same type share a map. Noise has two parts, whose variances add up:
of the reading itself, and of the position, by the map's slope there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from neurosim.base.kernels import kernel
from neurosim.simulators.motion.maps import cell_of, cells_of


@dataclass(frozen=True)
class Sensors:
    """Learned sensors; all tensors are float64 and on the CPU.

    Attributes:
        names: names of the sensors and of their readings.
        mount: [S, 2] positions on the robot: ahead of the axle's middle and to the left, m.
        place: [S] int64, index of each sensor's map.
        noise: [S, 2] standard deviations: of its reading (0..1), and of its position (m).
        maps: [K, NY, NX] readings, 0..1, over the board: rows along y, columns along x.
        origin: [2] x and y of the maps' first point, m, board frame.
        cell: distance between their points, m.
    """

    names: tuple[str, ...]
    mount: Tensor
    place: Tensor
    noise: Tensor
    maps: Tensor
    origin: Tensor
    cell: float

    def __post_init__(self) -> None:
        for name in TENSORS:
            value = getattr(self, name).detach().cpu()
            object.__setattr__(self, name, value.long() if name == "place" else value.double())
        count = len(self.names)
        shapes = {"mount": (count, 2), "place": (count,), "noise": (count, 2), "origin": (2,)}
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"sensors' {name} must be of shape {shape}")
        if count == 0 or len(set(self.names)) != count:
            raise ValueError("sensors must have names that differ")
        if self.maps.ndim != 3 or min(self.maps.shape) < 1 or min(self.maps.shape[1:]) < 2:
            raise ValueError("sensors' maps must be at least 2 by 2 points")
        if (self.place < 0).any() or (self.place >= len(self.maps)).any():
            raise ValueError("a sensor reads a map that does not exist")
        if (self.noise < 0).any() or not self.cell > 0:
            raise ValueError("sensors' noise must not be negative, and their cells above 0")

    def __len__(self) -> int:
        return len(self.names)

    def read(self, pose: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the readings [B, S], 0..1, of robots at poses [B, 3].

        Args:
            pose: x (m), y (m), heading (rad).
            z: [B, S] standard normal draws of the noise; None: without noise.
        """
        cos, sin = pose[:, 2:].cos(), pose[:, 2:].sin()
        ahead, aside = self.mount.to(pose).unbind(1)
        x = pose[:, :1] + cos * ahead - sin * aside
        y = pose[:, 1:2] + sin * ahead + cos * aside
        maps = self.maps.to(pose)
        i, j, a, b = cells_of(x, y, self.origin, self.cell, (maps.shape[1], maps.shape[2]))
        k = self.place.to(pose.device).expand_as(i)
        near, right = maps[k, j, i], maps[k, j, i + 1]
        far, both = maps[k, j + 1, i], maps[k, j + 1, i + 1]
        value = (1 - b) * ((1 - a) * near + a * right) + b * ((1 - a) * far + a * both)
        if z is not None:
            along_x = ((1 - b) * (right - near) + b * (both - far)) / self.cell
            along_y = ((1 - a) * (far - near) + a * (both - right)) / self.cell
            own, blur = self.noise.to(pose).unbind(1)
            variance = own**2 + blur**2 * (along_x**2 + along_y**2)
            value = value + variance.sqrt() * z.to(pose)
        return value.clamp(0.0, 1.0)

    def arrays(self) -> dict[str, Any]:
        """Return the sensors' arrays for :class:`MotionModel`."""
        tensors = {f"sensor_{name}": getattr(self, name).numpy() for name in TENSORS}
        arrays = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
        return {**arrays, "sensor_cell": float(self.cell)}


#: The tensors of sensors, by name.
TENSORS = ("mount", "place", "noise", "maps", "origin")


def no_sensors() -> dict[str, Any]:
    """Return the arrays of a simulator without sensors."""
    return {
        "sensor_mount": np.empty((0, 2)),
        "sensor_place": np.empty(0, np.int64),
        "sensor_noise": np.empty((0, 2)),
        "sensor_maps": np.empty((0, 0, 0)),
        "sensor_origin": np.zeros(2),
        "sensor_cell": 1.0,
    }


@kernel(forceinline=True)
def read(a, x, y, theta, z, first, out):
    """Write the readings; see :meth:`Sensors.read`.

    Args:
        a: :class:`MotionModel`.
        x, y, theta: pose of the robot (m, m, rad).
        z: standard normal numbers, the first sensor's at ``first``; empty: no noise.
        first: see ``z``.
        out: [S], written.
    """
    cos, sin = np.cos(theta), np.sin(theta)
    ny, nx = a.sensor_maps.shape[1], a.sensor_maps.shape[2]
    for n in range(len(a.sensor_mount)):
        ahead, aside = a.sensor_mount[n, 0], a.sensor_mount[n, 1]
        at_x, at_y = x + cos * ahead - sin * aside, y + sin * ahead + cos * aside
        i, j, u, v = cell_of(at_x, at_y, a.sensor_origin, a.sensor_cell, ny, nx)
        board = a.sensor_maps[a.sensor_place[n]]
        near, right, far, both = board[j, i], board[j, i + 1], board[j + 1, i], board[j + 1, i + 1]
        value = (1.0 - v) * ((1.0 - u) * near + u * right) + v * ((1.0 - u) * far + u * both)
        if len(z) > 0:
            along_x = ((1.0 - v) * (right - near) + v * (both - far)) / a.sensor_cell
            along_y = ((1.0 - u) * (far - near) + u * (both - right)) / a.sensor_cell
            own, blur = a.sensor_noise[n, 0], a.sensor_noise[n, 1]
            slope = along_x * along_x + along_y * along_y
            value += np.sqrt(own * own + blur * blur * slope) * z[first + n]
        out[n] = min(max(value, 0.0), 1.0)
