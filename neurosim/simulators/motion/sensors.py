"""Sensors of a motion network: what they read follows from where on the board they are.

Each sensor is mounted somewhere on the robot, and reads what a map of the board has there, linear
between the points of a grid. Sensors of the same make share a map. Noise has two parts, whose
variances add up: of the reading itself, and of the place, by the map's slope there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from torch import Tensor


class SensorArrays(NamedTuple):
    """Sensors as compiled code takes them; without any, all are of length 0."""

    mount: np.ndarray  #: [S, 2] m, robot frame
    place: np.ndarray  #: [S] int64, which map each reads
    noise: np.ndarray  #: [S, 2] standard deviations: of readings, and of places (m)
    maps: np.ndarray  #: [K, NY, NX]
    origin: np.ndarray  #: [2] m, of the grid's first point
    cell: float  #: m, between its points


@dataclass(frozen=True)
class Sensors:
    """Learned sensors; all tensors are float64 and on the CPU.

    Attributes:
        names: of the sensors, as readings are named.
        mount: [S, 2] where on the robot they look: ahead of the axle's middle and to the left, m.
        place: [S] int64, which of the maps each reads.
        noise: [S, 2] standard deviations: of its reading (0..1), and of its place (m).
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
            raise ValueError("a sensor reads a map that is not there")
        if (self.noise < 0).any() or not self.cell > 0:
            raise ValueError("sensors' noise must not be negative, and their cells above 0")

    def __len__(self) -> int:
        return len(self.names)

    def read(self, pose: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the readings [B, S], 0..1, of robots at poses [B, 3].

        Args:
            pose: x (m), y (m), heading (rad).
            z: [B, S] standard normal draws of the noise; None: there is none.
        """
        cos, sin = pose[:, 2:].cos(), pose[:, 2:].sin()
        ahead, aside = self.mount.to(pose).unbind(1)
        x = pose[:, :1] + cos * ahead - sin * aside
        y = pose[:, 1:2] + sin * ahead + cos * aside
        maps = self.maps.to(pose)
        _, ny, nx = maps.shape
        across = ((x - float(self.origin[0])) / self.cell).clamp(0.0, nx - 1.0)
        up = ((y - float(self.origin[1])) / self.cell).clamp(0.0, ny - 1.0)
        i, j = across.long().clamp(max=nx - 2), up.long().clamp(max=ny - 2)
        a, b = across - i, up - j
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

    def arrays(self) -> SensorArrays:
        """Return the sensors as compiled code takes them."""
        mount, place, noise, maps, origin = (
            np.ascontiguousarray(getattr(self, name).numpy()) for name in TENSORS
        )
        return SensorArrays(mount, place, noise, maps, origin, float(self.cell))


#: The tensors of sensors, by name.
TENSORS = ("mount", "place", "noise", "maps", "origin")


def no_sensors() -> SensorArrays:
    """Return the arrays of a simulator that has none."""
    return SensorArrays(
        np.empty((0, 2)),
        np.empty(0, np.int64),
        np.empty((0, 2)),
        np.empty((0, 0, 0)),
        np.zeros(2),
        1.0,
    )


@njit(cache=True, error_model="numpy")
def sense(
    s: SensorArrays,
    x: float,
    y: float,
    cos: float,
    sin: float,
    z: NDArray[np.float64],
    first: int,
    out: NDArray[np.float64],
) -> None:
    """Write what sensors read; see :meth:`Sensors.read`.

    Args:
        s: :class:`SensorArrays`.
        x, y: of the robot, m.
        cos, sin: of its heading.
        z: standard normal draws, that of the first sensor at ``first``; empty: there is no noise.
        first: see ``z``.
        out: [S], written.
    """
    ny, nx = s.maps.shape[1], s.maps.shape[2]
    for n in range(len(s.mount)):
        ahead, aside = s.mount[n, 0], s.mount[n, 1]
        across = (x + cos * ahead - sin * aside - s.origin[0]) / s.cell
        up = (y + sin * ahead + cos * aside - s.origin[1]) / s.cell
        across, up = min(max(across, 0.0), nx - 1.0), min(max(up, 0.0), ny - 1.0)
        i, j = min(int(across), nx - 2), min(int(up), ny - 2)
        a, b = across - i, up - j
        board = s.maps[s.place[n]]
        near, right, far, both = board[j, i], board[j, i + 1], board[j + 1, i], board[j + 1, i + 1]
        value = (1.0 - b) * ((1.0 - a) * near + a * right) + b * ((1.0 - a) * far + a * both)
        if len(z) > 0:
            along_x = ((1.0 - b) * (right - near) + b * (both - far)) / s.cell
            along_y = ((1.0 - a) * (far - near) + a * (both - right)) / s.cell
            own, blur = s.noise[n, 0], s.noise[n, 1]
            slope = along_x * along_x + along_y * along_y
            value += np.sqrt(own * own + blur * blur * slope) * z[first + n]
        out[n] = min(max(value, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def sense_all(
    s: SensorArrays,
    poses: NDArray[np.float64],
    z: NDArray[np.float64],
    first: int,
    out: NDArray[np.float64],
) -> None:
    """Write what sensors [B, S] read at poses [B, 3]; ``z`` [B, Z], Z = 0: there is no noise."""
    for b in range(len(poses)):
        cos, sin = np.cos(poses[b, 2]), np.sin(poses[b, 2])
        sense(s, poses[b, 0], poses[b, 1], cos, sin, z[b], first, out[b])


def sensed(
    s: SensorArrays, poses: NDArray[np.float64], z: NDArray | None, first: int
) -> NDArray[np.float64]:
    """Return the readings [B, S] at poses [B, 3]; see :func:`sense`."""
    out = np.empty((len(poses), len(s.mount)))
    draws = np.empty((len(poses), 0)) if z is None else np.ascontiguousarray(z, np.float64)
    sense_all(s, np.ascontiguousarray(poses, np.float64), draws, first, out)
    return out
