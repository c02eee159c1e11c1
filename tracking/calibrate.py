"""Camera calibration: lens from a chessboard, pose over the board from marked points.

The lens follows Zhang (2000) as OpenCV implements it, on the inner corners of a chessboard in
photographs or in a video. The pose over the board comes from points whose place in the image
and on the board are both known: a homography first, refined by least squares of the
reprojection error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import number, read_csv
from neurosim.base.progress import Progress
from tracking.camera_model import CameraModel
from tracking.video import Video

PHOTOGRAPHS = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}

#: Fewer photographs cannot tell focal length, principal point and distortion apart.
FEWEST_PHOTOGRAPHS = 3
#: From a video at most this many frames are taken, spread over the places the board was held.
MOST_FRAMES = 40

_REFINE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)


def calibrate(
    source: str | Path | Sequence[str | Path],
    pattern: tuple[int, int] = (9, 6),
    square: float = 0.025,
    points: str | Path | ArrayLike | None = None,
) -> CameraModel:
    """Calibrate a camera.

    Args:
        source: photographs of a chessboard: a folder, a list of files, or one video.
        pattern: the number of inner corners along the chessboard's two sides.
        square: the side of one of its squares in metres.
        points: at least 4 marked points, as a CSV file with the columns u, v (pixels) and x, y
            (metres on the board), or as an array [N, 4] of the same; without them the model
            has no pose over the board.

    Raises:
        UserError: if fewer than 3 photographs show the whole chessboard, the photographs differ
            in size, or the points do not fix a pose.
    """
    if min(pattern) < 2 or square <= 0:
        raise UserError(
            f"a chessboard of {pattern[0]} x {pattern[1]} inner corners with squares of "
            f"{square:g} m cannot be: at least 2 x 2 corners and squares above 0 m are needed"
        )
    corners, size = _find_all(source, pattern)
    model = _lens(corners, size, pattern, square)
    if points is None:
        return model
    return locate(model, points)


def find_corners(image: NDArray, pattern: tuple[int, int]) -> NDArray | None:
    """Return the inner corners [N, 2] of a chessboard in pixels, row by row, or None."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    found, corners = cv2.findChessboardCorners(grey, pattern)
    if not found:
        return None
    reach = _reach(corners.reshape(pattern[1], pattern[0], 2))
    corners = cv2.cornerSubPix(grey, corners, (reach, reach), (-1, -1), _REFINE)
    return corners.reshape(-1, 2)


def _reach(corners: NDArray) -> int:
    """Return how far the refinement window reaches: 11 x 11 pixels, less on small squares."""
    nearest = min(np.linalg.norm(np.diff(corners, axis=axis), axis=-1).min() for axis in (0, 1))
    return int(np.clip(nearest / 2, 2, 5))


def locate(model: CameraModel, points: str | Path | ArrayLike) -> CameraModel:
    """Return ``model`` with its pose over the board, from at least 4 marked points.

    Args:
        model: a camera whose lens is known.
        points: as in :func:`calibrate`.

    Raises:
        UserError: if there are fewer than 4 points, they lie on a line, or they are mirrored.
    """
    rows = _read_points(points)
    pixels, board = rows[:, :2], rows[:, 2:]
    _check_spread(pixels, "in the image")
    _check_spread(board, "on the board")
    rays = model.undistort(pixels)
    homography, _ = cv2.findHomography(board, rays)
    if homography is None:
        raise UserError("the marked points do not fix the board's place; mark others")
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
            "by the marked points the camera would look at the board from below: one axis is "
            "mirrored; with x to the right in the image, y on the board goes up"
        )
    misses = model.to_board(pixels) - board
    return replace(model, board_rms_m=float(np.sqrt((misses**2).sum(1).mean())))


def _find_all(
    source: str | Path | Sequence[str | Path], pattern: tuple[int, int]
) -> tuple[list[NDArray], tuple[int, int]]:
    if not isinstance(source, str | Path):
        images = _photographs([Path(p) for p in source])
    elif Path(source).is_dir():
        files = sorted(p for p in Path(source).iterdir() if p.suffix.lower() in PHOTOGRAPHS)
        if not files:
            raise UserError(f"{source}: no photographs in this folder")
        images = _photographs(files)
    elif Path(source).suffix.lower() in PHOTOGRAPHS:
        images = _photographs([Path(source)])
    else:
        images = _video_frames(Path(source))
    found: list[NDArray] = []
    size: tuple[int, int] | None = None
    first, seen = "", 0
    with Progress("looking for the chessboard", unit="pictures") as progress:
        for name, image in images:
            here = (image.shape[1], image.shape[0])
            if size is None:
                size, first = here, name
            elif here != size:
                raise UserError(
                    f"{name} has {here[0]} x {here[1]} pixels and {first} {size[0]} x {size[1]}; "
                    "all photographs must come from one camera at one setting"
                )
            seen += 1
            corners = find_corners(image, pattern)
            if corners is not None:
                found.append(corners)
            progress.advance()
    if len(found) < FEWEST_PHOTOGRAPHS:
        raise UserError(
            f"the whole chessboard of {pattern[0]} x {pattern[1]} inner corners was found in "
            f"{len(found)} of {seen} pictures; at least {FEWEST_PHOTOGRAPHS} are needed"
        )
    return _spread(found, MOST_FRAMES), size


def _photographs(files: Iterable[Path]) -> Iterator[tuple[str, NDArray]]:
    for file in files:
        if not file.exists():
            raise UserError(f"{file}: no such photograph")
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise UserError(f"{file}: is not a photograph that can be read")
        yield str(file), image


def _video_frames(path: Path) -> Iterator[tuple[str, NDArray]]:
    with Video(path) as video:
        # Neighbouring frames say the same; a few hundred looks are enough to choose from.
        every = max(1, round(video.frames / 300)) if video.frames else 5
        for index, _, frame in video:
            if index % every == 0:
                yield f"{path}, frame {index}", frame


def _spread(found: list[NDArray], most: int) -> list[NDArray]:
    """Keep the ``most`` views that differ most, by farthest-point selection on four corners."""
    if len(found) <= most:
        return found
    views = np.array([[c[0], c[-1], *_other_corners(c)] for c in found]).reshape(len(found), -1)
    chosen = [0]
    distance = np.linalg.norm(views - views[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(views - views[chosen[-1]], axis=1))
    return [found[i] for i in sorted(chosen)]


def _other_corners(corners: NDArray) -> tuple[NDArray, NDArray]:
    axis = corners[-1] - corners[0]
    side = (corners - corners[0]) @ np.array([-axis[1], axis[0]])
    return corners[side.argmin()], corners[side.argmax()]


def _lens(
    corners: list[NDArray], size: tuple[int, int], pattern: tuple[int, int], square: float
) -> CameraModel:
    board = np.zeros((pattern[0] * pattern[1], 3), np.float32)
    board[:, :2] = np.mgrid[: pattern[0], : pattern[1]].T.reshape(-1, 2) * square
    images = [c.reshape(-1, 1, 2).astype(np.float32) for c in corners]
    try:
        rms, matrix, distortion, _, _ = cv2.calibrateCamera(
            [board] * len(images), images, size, None, None
        )
    except cv2.error:
        rms = np.inf
    if not np.isfinite(rms) or matrix[0, 0] > 100 * max(size):
        raise UserError(
            "these photographs do not fix the lens: take them with the chessboard tilted in "
            "several directions and over the whole image"
        )
    return CameraModel(
        size,
        matrix,
        np.ravel(distortion)[:5],
        rms_px=float(rms),
        photographs=len(images),
    )


def _read_points(points: str | Path | ArrayLike) -> NDArray:
    if isinstance(points, str | Path):
        table = read_csv(points, dict.fromkeys(("u", "v", "x", "y"), number))
        rows, where = np.column_stack([table[name] for name in ("u", "v", "x", "y")]), f"{points}: "
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
    # Four points of which three stand on one line leave a homography open as well.
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
    if columns[2, 2] < 0:  # the board is before the camera
        columns = -columns
    rotation = np.column_stack([columns[:, 0], columns[:, 1], np.cross(*columns[:, :2].T)])
    u, _, vt = np.linalg.svd(rotation)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, columns[:, 2]
