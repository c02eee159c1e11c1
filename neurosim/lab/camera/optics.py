"""The roof camera's true optics: a tilted pinhole with Brown-Conrady distortion.

The names and the order of coefficients are OpenCV's (camera calibration and 3D reconstruction).
A pixel's centre has whole-number coordinates.
"""

from __future__ import annotations

import math

import numpy as np

from neurosim.base.compiled import njit
from neurosim.base.perimeter import Board
from neurosim.lab.nxt.params import BOARD, CameraParams
from tracking.camera.camera_model import CameraModel


def _rotation(axis: int, angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cos
    matrix[i, j], matrix[j, i] = -sin, sin
    return matrix


class Optics:
    """Projection from the board's frame to pixels and back to planes above the board.

    Attributes:
        size: width and height (px).
        matrix: intrinsics [3, 3].
        distortion: k1, k2, p1, p2, k3.
        rotation, translation: board frame -> camera frame, [3, 3] and [3] (m).
        centre: the optical centre in the board frame, [3] (m).
    """

    def __init__(self, params: CameraParams, board: Board = BOARD):
        width, height = self.size = params.size
        focal = params.height * min(
            width / (board.length + 2 * params.margin), height / (board.width + 2 * params.margin)
        )
        cx = (width - 1) / 2 + params.principal[0] * width
        cy = (height - 1) / 2 + params.principal[1] * height
        self.matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
        self.distortion = np.array(params.distortion)
        # Looking straight down, the picture's x is the board's x and its y (down) the board's -y.
        down = np.diag([1.0, -1.0, -1.0])
        turns = _rotation(2, params.roll) @ _rotation(0, params.tilt) @ _rotation(1, params.pan)
        self.rotation = turns @ down
        sight = self.rotation[2]
        self.centre = sight * (params.height / sight[2])  # it looks at the board's centre
        self.translation = -self.rotation @ self.centre

    @property
    def calibration(self) -> CameraModel:
        """The result of a calibration without errors."""
        return CameraModel(self.size, self.matrix, self.distortion, self.rotation, self.translation)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points [N, 3] (m, board frame) to pixels [N, 2]."""
        return self.project_camera(np.asarray(points, float) @ self.rotation.T + self.translation)

    def project_camera(self, points: np.ndarray) -> np.ndarray:
        """Project points [N, 3] (m, camera frame) to pixels [N, 2]."""
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        x, y = distort(x, y, self.distortion)
        m = self.matrix
        return np.stack([m[0, 0] * x + m[0, 2], m[1, 1] * y + m[1, 2]], axis=-1)

    def plane_map(self, height: float) -> np.ndarray:
        """Return where every pixel's line of sight meets a plane, [H, W, 2] (m, board frame)."""
        rays = np.ones((self.size[1], self.size[0], 3))
        rays[..., :2] = undistorted_rays(self.matrix, self.distortion, *self.size)
        rays = rays @ self.rotation
        reach = (height - self.centre[2]) / rays[..., 2]
        return self.centre[:2] + rays[..., :2] * reach[..., None]


@njit
def distort(x, y, k):
    """Bend undistorted normalised coordinates as the lens does."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    return (
        x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
        y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y,
    )


@njit
def undistorted_rays(matrix, k, width, height):
    """Return undistorted normalised coordinates of every pixel's centre, [height, width, 2].

    Fixed-point iteration; it contracts by about the distortion itself, here a few percent.
    """
    rays = np.empty((height, width, 2))
    for v in range(height):
        for u in range(width):
            xd = (u - matrix[0, 2]) / matrix[0, 0]
            yd = (v - matrix[1, 2]) / matrix[1, 1]
            x, y = xd, yd
            for _ in range(40):
                bx, by = distort(x, y, k)
                ex, ey = xd - bx, yd - by
                x += ex
                y += ey
                if ex * ex + ey * ey < 1e-20:
                    break
            rays[v, u, 0], rays[v, u, 1] = x, y
    return rays
