"""Photographs for the calibration of the virtual roof camera, as a person would take them.

They show a chessboard at several positions, distances and tilts, and the empty board with its
reference marks, which are clicked with a small error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from neurosim.base.compiled import njit
from neurosim.base.errors import UserError
from neurosim.base.files import check_name, new_folder, write_csv
from neurosim.lab.camera import scene
from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.camera.optics import Optics, undistorted_rays
from neurosim.lab.nxt.params import CameraParams

#: The chessboard: inner corners along its length and width, and the side of a square (m).
CORNERS = (9, 6)
SQUARE = 0.04
#: Error of a click on a mark (standard deviation, px).
CLICK_ERROR = 0.3

_HALF = np.array([(CORNERS[0] + 1) * SQUARE / 2, (CORNERS[1] + 1) * SQUARE / 2])
_BORDER = 0.03
_WHITE, _BLACK = 225.0, 28.0


@dataclass(frozen=True)
class Photographs:
    """The files of :func:`render_photographs`."""

    chessboards: tuple[Path, ...]
    board: Path
    points: Path


def render_photographs(
    folder: str | Path,
    camera_params: CameraParams,
    seed: int,
    count: int = 20,
    *,
    scale: float = 1.0,
) -> Photographs:
    """Render the pictures for ``neurosim calibrate`` into a new folder.

    ``chessboard-01.jpg`` and on: photographs of a chessboard of 9 x 6 inner corners, 40 mm
    apart. ``board.jpg``: the empty board with its eight crosses. ``points.csv``: the crosses'
    clicked pixels and board coordinates, columns u, v (px), x, y (m).

    Args:
        folder: a new or empty folder.
        camera_params: the camera.
        seed: of the camera's lab.
        count: chessboard photographs, at least 1.
        scale: size of the objects in the pictures, and of the camera's height, relative to the roof
            camera's.

    Raises:
        UserError: if ``folder`` is not empty or ``count`` is not positive.
    """
    if count < 1:
        raise UserError(f"cannot take {count} photographs of a chessboard; ask for at least 1")
    rng = np.random.default_rng([seed, 0xC4E5])
    camera = RoofCamera(camera_params, seed)
    optics = camera.optics
    rays = undistorted_rays(optics.matrix, optics.distortion, *optics.size)
    names = [f"chessboard-{i + 1:02d}.jpg" for i in range(count)]
    with new_folder(folder) as partial:
        for i, name in enumerate(names):
            picture = camera.render(None, noise=False).astype(np.float32)
            rotation, translation = _held_pose(optics, rng, i)
            _paint_chessboard(picture, rays, rotation, translation)
            picture = cv2.GaussianBlur(picture, (0, 0), 0.6)
            picture += camera_params.noise * rng.standard_normal(picture.shape, np.float32)
            _write(partial / name, picture)
        _write(partial / "board.jpg", camera.render(None))
        marks = np.column_stack([scene.MARKS, np.zeros(len(scene.MARKS))])
        clicks = optics.project(marks) + CLICK_ERROR * rng.standard_normal((len(marks), 2))
        x, y = scale * marks[:, 0], scale * marks[:, 1]
        columns = {"u": clicks[:, 0], "v": clicks[:, 1], "x": x, "y": y}
        write_csv(partial / "points.csv", columns)
    folder = Path(folder)
    return Photographs(
        tuple(folder / name for name in names), folder / "board.jpg", folder / "points.csv"
    )


def _write(path: Path, picture: np.ndarray) -> None:
    rounded = (picture + 0.5).clip(0, 255).astype(np.uint8)
    if not cv2.imwrite(check_name(path), rounded, [cv2.IMWRITE_JPEG_QUALITY, 95]):
        raise UserError(f"{path}: this OpenCV could not write a JPEG picture")


def _held_pose(
    optics: Optics, rng: np.random.Generator, turn: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose (chessboard -> camera) that shows all of it; turns go over the picture."""
    width, height = optics.size
    outline = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * (_HALF + _BORDER)
    outline = np.column_stack([outline, np.zeros(4)])
    across, down = (turn % 3 - 1) * 0.3, (turn // 3 % 3 - 1) * 0.3
    while True:
        distance = rng.uniform(0.45, 1.0)
        aim = np.array([across, down]) + rng.uniform(-0.15, 0.15, 2)
        middle = np.array([aim[0] * width, aim[1] * height]) / optics.matrix[0, 0]
        translation = distance * np.array([middle[0], middle[1], 1.0])
        tilt = rng.uniform(math.radians(8), math.radians(35))
        axis = rng.uniform(0.0, 2.0 * math.pi)
        lean, _ = cv2.Rodrigues(tilt * np.array([math.cos(axis), math.sin(axis), 0.0]))
        spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)]))
        rotation = lean @ spin
        pixels = optics.project_camera(outline @ rotation.T + translation)
        if (pixels > 4).all() and (pixels < np.array([width, height]) - 5).all():
            return rotation, translation


@njit
def _paint_chessboard(picture, rays, rotation, translation):
    """Paint a chessboard into a picture, float32 [H, W, 3], 4 x 4 samples a pixel."""
    height, width = rays.shape[:2]
    normal = rotation[:, 2]
    reach = normal[0] * translation[0] + normal[1] * translation[1] + normal[2] * translation[2]
    # It is brightest when it faces the lamps above.
    light = 0.55 + 0.45 * normal[2]
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            inside = 0.0
            value = 0.0
            for i in range(16):
                a, b = (i % 4 - 1.5) / 8.0, (i // 4 - 1.5) / 8.0
                rx = rays[v, u, 0] + a * (rays[v, u + 1, 0] - rays[v, u - 1, 0])
                rx += b * (rays[v + 1, u, 0] - rays[v - 1, u, 0])
                ry = rays[v, u, 1] + a * (rays[v, u + 1, 1] - rays[v, u - 1, 1])
                ry += b * (rays[v + 1, u, 1] - rays[v - 1, u, 1])
                s = reach / (normal[0] * rx + normal[1] * ry + normal[2])
                dx, dy, dz = s * rx - translation[0], s * ry - translation[1], s - translation[2]
                x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz + _HALF[0]
                y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz + _HALF[1]
                over_x = max(-x, x - 2.0 * _HALF[0])
                over_y = max(-y, y - 2.0 * _HALF[1])
                if max(over_x, over_y) < _BORDER:
                    inside += 1.0 / 16.0
                    dark = (int(x / SQUARE) + int(y / SQUARE)) % 2 == 0
                    dark = dark and over_x < 0.0 and over_y < 0.0
                    value += light * (_BLACK if dark else _WHITE) / 16.0
            if inside > 0.0:
                for c in range(3):
                    picture[v, u, c] = (1.0 - inside) * picture[v, u, c] + value
