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
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import number, read_csv
from neurosim.base.progress import Progress
from tracking.camera_model import CameraModel
from tracking.targets import Charuco, Chessboard, Target, View
from tracking.video import Video

PHOTOGRAPHS = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}

#: Fewer photographs cannot tell focal length, principal point and distortion apart.
FEWEST_PHOTOGRAPHS = 3
#: From a video at most this many frames are taken, spread over the places the board was held.
MOST_FRAMES = 40

_GREY = cv2.COLOR_BGR2GRAY

#: The height over the board at which a calibration says how sure a position is, m: that of the
#: paper's markers.
MARKER_HEIGHT = 0.10
#: A marked point is off by at least this (standard deviation, px), however well four points fit.
LEAST_CLICK = 0.3


def calibrate(
    source: str | Path | Sequence[str | Path],
    pattern: tuple[int, int] = (9, 6),
    square: float = 0.025,
    points: str | Path | ArrayLike | None = None,
    *,
    marker: float | None = None,
    dictionary: str = "4X4_50",
) -> CameraModel:
    """Calibrate a camera.

    How uncertain it is comes from leaving out one photograph after the other (the jackknife,
    Tukey 1958): corners of one photograph err together, so that the residuals' covariance states
    half of the scatter that other photographs bring.

    Args:
        source: photographs of a chessboard: a folder, a list of files, or one video.
        pattern: the number of inner corners along the chessboard's two sides.
        square: the side of one of its squares in metres.
        points: at least 4 marked points, as a CSV file with the columns u, v (pixels) and x, y
            (metres on the board), or as an array [N, 4] of the same; without them the model
            has no pose over the board.
        marker: side of the markers of a ChArUco board in metres; without, a plain chessboard.
        dictionary: of the ChArUco board's markers.

    Raises:
        UserError: if fewer than 3 photographs show the whole chessboard, the photographs differ
            in size, or the points do not fix a pose.
    """
    target: Target = (
        Chessboard(pattern, square)
        if marker is None
        else Charuco(pattern, square, marker, dictionary)
    )
    views, size = _find_all(source, target)
    model = _lens(views, size)
    others = _without_one(views, size)
    if points is not None:
        rows = _read_points(points)
        model = locate(model, rows)
        return replace(model, uncertainty=_uncertainty(model, others, rows))
    return replace(model, uncertainty=_uncertainty(model, others, None))


def _without_one(views: list[View], size: tuple[int, int]) -> list[CameraModel]:
    """Return the lens without each of the views in turn; none where three are all there are."""
    if len(views) <= FEWEST_PHOTOGRAPHS:
        return []
    try:
        return [_lens(views[:i] + views[i + 1 :], size) for i in range(len(views))]
    except UserError:
        return []


def _uncertainty(
    model: CameraModel, others: list[CameraModel], points: NDArray | None
) -> dict[str, Any] | None:
    """Return what :attr:`CameraModel.uncertainty` holds, or None where it cannot be known."""
    if not others:
        return None
    count = len(others)

    def spread(values: NDArray) -> NDArray:
        return np.sqrt((count - 1) / count * ((values - values.mean(0)) ** 2).sum(0))

    fx, fy, cx, cy, *distortion = spread(np.array([_lens_numbers(m) for m in others])).tolist()
    stated: dict[str, Any] = {
        "method": "jackknife over photographs",
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "distortion": distortion,
    }
    if points is not None:
        pixels = _over_the_board(model, points)
        lens = spread(np.array([locate(m, points).to_board(pixels, MARKER_HEIGHT) for m in others]))
        clicks = click_spread(model, points)
        stated["board_m"] = float(np.sqrt((lens**2 + clicks**2).sum(-1).mean()))
        stated["height_m"] = MARKER_HEIGHT
    return stated


def click_spread(model: CameraModel, points: NDArray) -> NDArray:
    """Return the standard deviation [N, 2] (m) of positions over the board that clicks leave.

    The clicks' own error is what the points miss by, with the degrees of freedom that the pose
    takes, and at least 0.3 px; each coordinate of each point is moved by it in turn.

    Args:
        model: located by ``points``.
        points: [N, 4] u, v, x, y.
    """
    flat = np.column_stack([points[:, 2:], np.zeros(len(points))])
    misses = model.to_pixels(flat) - points[:, :2]
    error = max(LEAST_CLICK, float(np.sqrt((misses**2).sum() / (2 * len(points) - 6))))
    pixels = _over_the_board(model, points)
    here = model.to_board(pixels, MARKER_HEIGHT)
    square = np.zeros_like(here)
    for row in range(len(points)):
        for column in range(2):
            moved = points.copy()
            moved[row, column] += error
            square += (locate(model, moved).to_board(pixels, MARKER_HEIGHT) - here) ** 2
    return np.sqrt(square)


def _over_the_board(model: CameraModel, points: NDArray) -> NDArray:
    """Return the pixels [25, 2] of a grid, at the markers' height, between the marked points."""
    x, y = (np.linspace(points[:, i].min(), points[:, i].max(), 5) for i in (2, 3))
    grid = np.stack([*np.meshgrid(x, y), np.full((5, 5), MARKER_HEIGHT)], axis=-1)
    return model.to_pixels(grid.reshape(-1, 3))


def _lens_numbers(model: CameraModel) -> NDArray:
    matrix = model.camera_matrix
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *model.distortion])


def from_corners(
    picture: str | Path | tuple[int, int], corners: ArrayLike, board: tuple[float, float]
) -> CameraModel:
    """Return a camera from the four corners of the board alone, for those who print nothing.

    The lens is taken for a usual one: a pinhole with its axis through the picture's middle and a
    focal length of 0.9 of the picture's width. What is stated as uncertain is what lenses on the
    market differ by: 15 % of the focal length (standard deviation) and 0.1 of k1, which bends a
    picture by a few per cent at its corners.

    Args:
        picture: a photograph of the board, or a video, for its size; or the size in pixels.
        corners: [4, 2] pixels, from the top left one clockwise as seen.
        board: its length and width, m; the length runs from left to right.

    Raises:
        UserError: if the picture cannot be read, or the corners are crossed, in one line, outside
            of the picture or in another order.
    """
    if isinstance(picture, tuple):
        size = picture
    else:
        image = next(iter(_pictures(picture)))[1]
        size = (image.shape[1], image.shape[0])
    pixels = np.asarray(corners, float)
    if (pixels < -0.5).any() or (pixels > np.array(size) - 0.5).any():
        raise UserError(f"a corner is outside of the picture of {size[0]} x {size[1]} pixels")
    sides = np.roll(pixels, -1, axis=0) - pixels
    turns = sides[:, 0] * np.roll(sides[:, 1], -1) - sides[:, 1] * np.roll(sides[:, 0], -1)
    if not (turns > 0).all():
        raise UserError(
            "the four corners do not go round the board: name them clockwise as seen, from the "
            "top left one"
        )
    x, y = board[0] / 2, board[1] / 2
    rows = np.column_stack([pixels, [(-x, y), (x, y), (x, -y), (-x, -y)]])
    focal = 0.9 * size[0]
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)

    def camera(focal: float, k1: float) -> CameraModel:
        matrix = [[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]]
        return locate(CameraModel(size, matrix, [k1, 0, 0, 0, 0]), rows)

    model = camera(focal, 0.0)
    seen = _over_the_board(model, rows)
    here = model.to_board(seen, MARKER_HEIGHT)
    square = click_spread(model, rows) ** 2
    for other in (camera(1.15 * focal, 0.0), camera(focal, -0.1)):
        square += (other.to_board(seen, MARKER_HEIGHT) - here) ** 2
    stated = {
        "method": "spread of usual lenses",
        "fx": 0.15 * focal,
        "fy": 0.15 * focal,
        "cx": 0.02 * size[0],
        "cy": 0.02 * size[1],
        "distortion": [0.1, 0.0, 0.0, 0.0, 0.0],
        "board_m": float(np.sqrt(square.sum(-1).mean())),
        "height_m": MARKER_HEIGHT,
    }
    return replace(model, uncertainty=stated)


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


def _pictures(source: str | Path | Sequence[str | Path]) -> Iterator[tuple[str, NDArray]]:
    if not isinstance(source, str | Path):
        return _photographs([Path(p) for p in source])
    if Path(source).is_dir():
        files = sorted(p for p in Path(source).iterdir() if p.suffix.lower() in PHOTOGRAPHS)
        if not files:
            raise UserError(f"{source}: no photographs in this folder")
        return _photographs(files)
    if not Path(source).exists():
        raise UserError(f"{source}: no such photographs; name files, a folder of them, or a video")
    if Path(source).suffix.lower() in PHOTOGRAPHS:
        return _photographs([Path(source)])
    return _video_frames(Path(source))


def _find_all(
    source: str | Path | Sequence[str | Path], target: Target
) -> tuple[list[View], tuple[int, int]]:
    images = _pictures(source)
    found: list[View] = []
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
            view = target.find(image if image.ndim == 2 else cv2.cvtColor(image, _GREY))
            if view is not None:
                found.append(view)
            progress.advance()
    if len(found) < FEWEST_PHOTOGRAPHS:
        raise UserError(
            f"the {target.name} was found in {len(found)} of {seen} pictures; at least "
            f"{FEWEST_PHOTOGRAPHS} are needed"
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


def _spread(found: list[View], most: int) -> list[View]:
    """Keep the ``most`` views that differ most, by farthest-point selection on four corners."""
    if len(found) <= most:
        return found
    corners = [view.pixels for view in found]
    views = np.array([[c[0], c[-1], *_other_corners(c)] for c in corners]).reshape(len(found), -1)
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


def _lens(views: list[View], size: tuple[int, int]) -> CameraModel:
    boards = [
        np.column_stack([view.board, np.zeros(len(view.board))]).astype(np.float32)
        for view in views
    ]
    images = [view.pixels.reshape(-1, 1, 2).astype(np.float32) for view in views]
    try:
        rms, matrix, distortion, _, _ = cv2.calibrateCamera(boards, images, size, None, None)
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
