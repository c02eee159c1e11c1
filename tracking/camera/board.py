"""The camera's pose over the board, from points marked in a picture of it.

Points with known positions in the image and on the board first give a homography, which least
squares of the reprojection error refine. Four of them, the corners of the board, suffice without
any calibration: a usual lens is then assumed, and the uncertainty includes the differences of such
lenses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import number, read_csv
from tracking.camera.camera_model import CameraModel

#: Height over the board at which a calibration states the uncertainty of positions, m: that of the
#: paper's markers.
MARKER_HEIGHT = 0.10
#: Smallest error of a marked point (standard deviation, px), even if four points fit exactly.
LEAST_CLICK = 0.3

#: A usual lens: the focal length as a fraction of the picture's width (58 degrees), the axis
#: through the picture's middle, no distortion. Standard deviations over cameras on the market: of
#: the focal length (a fraction), of the axis (a fraction of the width), of k1 (at 0.2 a picture's
#: corner is off by about a tenth); and of a height measured with a tape (a fraction).
USUAL_FOCAL_LENGTH = 0.9
FOCAL_SPREAD, AXIS_SPREAD, BEND_SPREAD, HEIGHT_SPREAD = 0.15, 0.02, 0.2, 0.02


def locate(model: CameraModel, points: str | Path | ArrayLike) -> CameraModel:
    """Return ``model`` with its pose over the board, from at least 4 marked points.

    Args:
        model: a camera whose lens is known.
        points: as in :func:`tracking.camera.calibrate.calibrate`.

    Raises:
        UserError: if there are fewer than 4 points, they lie on a line, or they are mirrored.
    """
    rows = read_points(points)
    pixels, board = rows[:, :2], rows[:, 2:]
    _check_spread(pixels, "in the image")
    _check_spread(board, "on the board")
    rays = model.undistort(pixels)
    homography, _ = cv2.findHomography(board, rays)
    if homography is None:
        raise UserError("the marked points do not fix the position of the board; mark other points")
    rotation, translation = _pose_of(homography)
    above = np.column_stack([board, np.zeros(len(board))])
    turn, translation = cv2.solvePnPRefineLM(
        above,
        pixels,
        model.camera_matrix,
        model.distortion,
        cv2.Rodrigues(rotation)[0],
        translation.reshape(3, 1),
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12),
    )
    model = replace(model, rotation=cv2.Rodrigues(turn)[0], translation=translation.ravel())
    if model.position[2] <= 0:
        raise UserError(
            "the marked points have one axis mirrored; with x to the right in the image, y on "
            "the board goes up"
        )
    misses = model.to_board(pixels) - board
    return replace(model, board_rms_m=float(np.sqrt((misses**2).sum(1).mean())))


def corner_points(
    image_size: tuple[int, int], corners: ArrayLike, board: tuple[float, float]
) -> NDArray:
    """Return the board's four corners as marked points, [4, 4] u, v (px) and x, y (m).

    Args:
        image_size: width and height in pixels.
        corners: [4, 2] pixels, from the top left one clockwise as seen.
        board: its length and width, m; the length runs from left to right.

    Raises:
        UserError: if the corners are crossed, in one line, outside of the picture or in another
            order.
    """
    pixels = np.asarray(corners, float)
    if (pixels < -0.5).any() or (pixels > np.array(image_size) - 0.5).any():
        raise UserError(
            f"a corner is outside of the picture of {image_size[0]} x {image_size[1]} pixels"
        )
    sides = np.roll(pixels, -1, axis=0) - pixels
    turns = sides[:, 0] * np.roll(sides[:, 1], -1) - sides[:, 1] * np.roll(sides[:, 0], -1)
    if not (turns > 0).all():
        raise UserError(
            "the four corners are in a wrong order: give them clockwise, from the top left one"
        )
    x, y = board[0] / 2, board[1] / 2
    return np.column_stack([pixels, [(-x, y), (x, y), (x, -y), (-x, -y)]])


def camera_over_board(
    image_size: tuple[int, int],
    points: ArrayLike,
    lens: CameraModel | None = None,
    height: float | None = None,
) -> CameraModel:
    """Return the camera that sees points of the board at the marked pixels.

    Without a lens, a usual one is assumed. Points on a plane seen from straight above do not
    determine the focal length, but the camera's height does. The stated uncertainty is the change
    of positions if focal length (or height), axis and distortion are off by a standard deviation of
    usual lenses, to either side, plus the spread of the clicks. Most of it comes from the
    distortion, which four corners do not determine.

    Args:
        image_size: width and height in pixels.
        points: [N, 4], u and v in pixels, x and y in metres on the board; at least 4.
        lens: a calibration of the lens; its uncertainty is taken over, without a ``board_m``.
        height: of the camera above the board, in metres.

    Raises:
        UserError: as :func:`locate` does, or if the lens is of another size of picture, or no
            usual camera at that height sees the points there.
    """
    if lens is not None:
        if tuple(lens.image_size) != tuple(image_size):
            raise UserError(
                f"the calibration is of pictures of {lens.image_size[0]}x{lens.image_size[1]}, but "
                f"the camera's are {image_size[0]}x{image_size[1]}"
            )
        return locate(lens, points)
    rows = read_points(points)
    axis = AXIS_SPREAD * image_size[0]

    usual = USUAL_FOCAL_LENGTH * image_size[0]

    def camera(focal: float, cx: float = 0.0, cy: float = 0.0, k1: float = 0.0) -> CameraModel:
        return locate(_usual(image_size, focal, cx, cy, k1), rows)

    if height is None:
        model = camera(usual)
    else:
        if not camera(0.2 * usual).position[2] <= height <= camera(5 * usual).position[2]:
            raise UserError(
                f"no usual lens fits these corners at a height of {height:g} m; check the height "
                "of the camera and the size of the board"
            )
        model = _at_height(camera, 0.2 * usual, 5 * usual, height)

    def other(size: float, *lens: float) -> CameraModel:
        """Return the camera with focal length or height off by a fraction, and another lens."""
        focal = model.camera_matrix[0, 0]
        if height is None:
            return camera(focal * (1 + size), *lens)
        return _at_height(lambda f: camera(f, *lens), focal / 1.5, focal * 1.5, height * (1 + size))

    steps = np.diag([FOCAL_SPREAD if height is None else HEIGHT_SPREAD, axis, axis, BEND_SPREAD])
    seen = over_the_board(model, rows)
    here = model.to_board(seen, MARKER_HEIGHT)
    others = [other(*step) for step in (*steps, *-steps)]
    square = click_spread(model, rows) ** 2
    square += sum((m.to_board(seen, MARKER_HEIGHT) - here) ** 2 for m in others) / 2
    focal = np.array([m.camera_matrix[0, 0] for m in others]) - model.camera_matrix[0, 0]
    stated = {
        "method": "spread of usual lenses",
        "fx": float(np.sqrt((focal**2).sum() / 2)),
        "fy": float(np.sqrt((focal**2).sum() / 2)),
        "cx": axis,
        "cy": axis,
        "distortion": [BEND_SPREAD, 0.0, 0.0, 0.0, 0.0],
        "board_m": float(np.sqrt(square.sum(-1).mean())),
        "height_m": MARKER_HEIGHT,
    }
    return replace(model, uncertainty=stated)


def _usual(
    size: tuple[int, int], focal_length: float, cx: float, cy: float, k1: float
) -> CameraModel:
    middle = (size[0] - 1) / 2 + cx, (size[1] - 1) / 2 + cy
    matrix = [[focal_length, 0, middle[0]], [0, focal_length, middle[1]], [0, 0, 1]]
    return CameraModel(size, matrix, [k1, 0, 0, 0, 0])


def _at_height(
    camera: Callable[[float], CameraModel], low: float, high: float, height: float
) -> CameraModel:
    """Return the camera, of those with focal lengths between two (px), that is nearest a height."""
    # The height that the points ask for grows with the focal length.
    for _ in range(30):
        middle = (low + high) / 2
        if camera(middle).position[2] < height:
            low = middle
        else:
            high = middle
    return camera((low + high) / 2)


def click_spread(model: CameraModel, points: NDArray) -> NDArray:
    """Return the standard deviation [N, 2] (m) of positions over the board from errors of clicks.

    The clicks' error is the points' residual, corrected for the pose's degrees of freedom, and at
    least 0.3 px; each coordinate of each point is moved by it in turn.

    Args:
        model: located by ``points``.
        points: [N, 4] u, v, x, y.
    """
    flat = np.column_stack([points[:, 2:], np.zeros(len(points))])
    misses = model.to_pixels(flat) - points[:, :2]
    error = max(LEAST_CLICK, float(np.sqrt((misses**2).sum() / (2 * len(points) - 6))))
    pixels = over_the_board(model, points)
    here = model.to_board(pixels, MARKER_HEIGHT)
    square = np.zeros_like(here)
    for row in range(len(points)):
        for column in range(2):
            moved = points.copy()
            moved[row, column] += error
            square += (locate(model, moved).to_board(pixels, MARKER_HEIGHT) - here) ** 2
    return np.sqrt(square)


def over_the_board(model: CameraModel, points: NDArray) -> NDArray:
    """Return the pixels [25, 2] of a grid, at the markers' height, between the marked points."""
    x, y = (np.linspace(points[:, i].min(), points[:, i].max(), 5) for i in (2, 3))
    grid = np.stack([*np.meshgrid(x, y), np.full((5, 5), MARKER_HEIGHT)], axis=-1)
    return model.to_pixels(grid.reshape(-1, 3))


def read_points(points: str | Path | ArrayLike) -> NDArray:
    """Return marked points [N, 4] from a file or an array; see :func:`locate`.

    Raises:
        UserError: if there are fewer than 4, or they are not four finite numbers each.
    """
    if isinstance(points, str | Path):
        table = read_csv(points, dict.fromkeys(("u", "v", "x", "y"), number))
        rows, where = table.to_numpy(), f"{points}: "
    else:
        rows, where = np.asarray(points, float), ""
        if rows.ndim != 2 or rows.shape[1] != 4 or not np.isfinite(rows).all():
            raise UserError("each marked point needs four numbers: u, v in pixels, x, y in metres")
    if len(rows) < 4:
        raise UserError(f"{where}{len(rows)} points are marked; at least 4 are needed")
    return rows


def _check_spread(points: NDArray, where: str) -> None:
    centred = points - points.mean(0)
    spread = np.linalg.svd(centred, compute_uv=False)
    # Four points with three on one line do not determine a homography either.
    doubtful = spread[1] < 0.01 * spread[0] or (
        len(points) == 4 and _flattest_triangle(points) < 0.005 * spread[0] ** 2
    )
    if doubtful:
        raise UserError(
            f"the marked points lie on one line {where}; mark some away from it, "
            "best the board's four corners"
        )


def _flattest_triangle(points: NDArray) -> float:
    areas = []
    for left_out in range(len(points)):
        a, b, c = np.delete(points, left_out, axis=0)
        (p, q), (r, s) = b - a, c - a
        areas.append(abs(p * s - q * r) / 2)
    return min(areas)


def _pose_of(homography: NDArray) -> tuple[NDArray, NDArray]:
    """Split a homography (board metres to normalised image) into rotation and translation."""
    scale = 2.0 / (np.linalg.norm(homography[:, 0]) + np.linalg.norm(homography[:, 1]))
    columns = homography * scale
    if columns[2, 2] < 0:  # the board is in front of the camera
        columns = -columns
    rotation = np.column_stack([columns[:, 0], columns[:, 1], np.cross(*columns[:, :2].T)])
    u, _, vt = np.linalg.svd(rotation)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, columns[:, 2]
