"""The camera model: pixels to metres on the board and back, without parallax.

A pinhole camera with the five-term lens distortion of Brown (1966) as OpenCV orders it
(k1, k2, p1, p2, k3), and its pose over the board. Pixel (0, 0) is the middle of the top left
pixel, u to the right and v down. The board frame has its origin at the board's centre, x along
the long side, y along the short side, z up.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import formats
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import read_json, write_json

FORMAT, VERSION = "neurosim-calibration", 1

# Undistortion is a fixed-point iteration; OpenCV's default of five rounds leaves 0.01 px.
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A calibrated camera.

    Attributes:
        image_size: width and height in pixels.
        camera_matrix: [3, 3], focal lengths and principal point in pixels.
        distortion: [5], k1, k2, p1, p2, k3.
        rotation: [3, 3] from the board frame to the camera frame (x right, y down, z ahead),
            or None if no points on the board were marked.
        translation: [3] in metres, the board's origin in the camera frame; None likewise.
        rms_px: reprojection error of the chessboard corners.
        photographs: number of photographs of the calibration.
        board_rms_m: root mean square distance on the board between the marked points and their
            positions by this model, in metres.
        uncertainty: standard deviations, or None if unknown: ``fx``, ``fy``, ``cx``, ``cy`` (px),
            ``distortion`` (five), and with a pose over the board ``board_m``, of a position at the
            height ``height_m`` over it, in metres.
        left_out: photographs and corners that did not fit: ``photograph`` (its name), ``off_px``,
            its error, and for a single corner ``u`` and ``v`` (px).
    """

    image_size: tuple[int, int]
    camera_matrix: NDArray
    distortion: NDArray
    rotation: NDArray | None = None
    translation: NDArray | None = None
    rms_px: float = 0.0
    photographs: int = 0
    board_rms_m: float | None = field(default=None)
    uncertainty: dict[str, Any] | None = None
    left_out: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for name, shape in (
            ("camera_matrix", (3, 3)),
            ("distortion", (5,)),
            ("rotation", (3, 3)),
            ("translation", (3,)),
        ):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, np.asarray(value, float).reshape(shape))

    @property
    def has_board(self) -> bool:
        """Whether the camera's pose over the board is known."""
        return self.rotation is not None and self.translation is not None

    @cached_property
    def homography(self) -> NDArray | None:
        """[3, 3] from undistorted normalised image coordinates to metres on the plane z = 0."""
        if not self.has_board:
            return None
        plane = np.column_stack([self.rotation[:, 0], self.rotation[:, 1], self.translation])
        inverse = np.linalg.inv(plane)
        return inverse / inverse[2, 2]

    @cached_property
    def position(self) -> NDArray:
        """[3] position of the camera in the board frame, in metres."""
        self._need_board()
        return -self.rotation.T @ self.translation

    def undistort(self, pixels: ArrayLike) -> NDArray:
        """Return undistorted normalised image coordinates [N, 2] of pixels [N, 2]."""
        pixels = np.asarray(pixels, float).reshape(-1, 1, 2)
        if len(pixels) == 0:
            return np.empty((0, 2))
        points = cv2.undistortPoints(
            pixels, self.camera_matrix, self.distortion, criteria=_UNDISTORT
        )
        return points.reshape(-1, 2)

    def straighten(self, pixels: ArrayLike) -> NDArray:
        """Return pixels [N, 2] of a lens with the same focal length and without distortion."""
        return self.undistort(pixels) @ self.camera_matrix[:2, :2].T + self.camera_matrix[:2, 2]

    def to_board(self, pixels: ArrayLike, height: float = 0.0) -> NDArray:
        """Return board coordinates [N, 2] in metres of points seen at pixels [N, 2].

        The ray of each pixel is cut with the plane ``height`` metres above the board, so that
        a marker on top of a robot is not displaced by parallax. NaN stays NaN.

        Raises:
            UserError: if the calibration has no points on the board.
        """
        self._need_board()
        points = self.undistort(pixels)
        rays = points @ self.rotation[:2] + self.rotation[2]
        reach = (height - self.position[2]) / rays[:, 2]
        return self.position[:2] + reach[:, None] * rays[:, :2]

    def to_pixels(self, points: ArrayLike) -> NDArray:
        """Return the pixels [N, 2] at which points [N, 3] of the board frame are seen."""
        self._need_board()
        points = np.asarray(points, float).reshape(-1, 3)
        if len(points) == 0:
            return np.empty((0, 2))
        # Turned here: a camera that looks straight down is turned by half a turn, where OpenCV's
        # rotation vectors lose half of their digits.
        seen = points @ self.rotation.T + self.translation
        pixels, _ = cv2.projectPoints(
            seen, np.zeros(3), np.zeros(3), self.camera_matrix, self.distortion
        )
        return pixels.reshape(-1, 2)

    def write(self, path: str | Path) -> None:
        """Write calibration.json, whole or not at all."""
        content = {
            "units": {"image": "pixel", "board": "m"},
            "image_size": list(self.image_size),
            "camera_matrix": self.camera_matrix,
            "distortion": self.distortion,
            "rms_px": self.rms_px,
            "photographs": self.photographs,
            "homography": self.homography,
            "rotation": self.rotation,
            "translation": self.translation,
            "board_rms_m": self.board_rms_m,
            "uncertainty": self.uncertainty,
            "left_out": list(self.left_out),
        }
        write_json(path, FORMAT, VERSION, content)

    @classmethod
    def read(cls, path: str | Path) -> CameraModel:
        """Read calibration.json.

        Raises:
            FileError: naming the field that is missing or is wrong.
        """
        path = Path(path)
        document = read_json(path, FORMAT, VERSION, formats.Calibration)
        matrix = np.array(document["camera_matrix"], float)
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or not np.allclose(matrix[2], (0, 0, 1)):
            raise FileError(
                path, "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", field="camera_matrix"
            )
        rotation, translation = document.get("rotation"), document.get("translation")
        if (rotation is None) != (translation is None):
            field = "rotation" if rotation is None else "translation"
            raise FileError(path, "is missing", field=field)
        if rotation is not None:
            rotation = np.array(rotation, float)
            if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or (
                np.linalg.det(rotation) < 0
            ):
                raise FileError(path, "is not a rotation matrix", field="rotation")
        return cls(
            tuple(document["image_size"]),
            matrix,
            document["distortion"],
            rotation,
            translation,
            document.get("rms_px", 0.0),
            document.get("photographs", 0),
            document.get("board_rms_m"),
            document.get("uncertainty"),
        )

    def _need_board(self) -> None:
        if not self.has_board:
            raise UserError(
                "this calibration has no points marked on the board, so pixels cannot become "
                "metres; run neurosim calibrate again with at least 4 marked points"
            )
