"""Camera calibration: the lens from a chessboard, with its uncertainty.

The lens follows Zhang (2000) as OpenCV implements it, on the inner corners of a chessboard in
photographs or in a video. For the pose over the board see :mod:`tracking.camera.board`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import check_file, check_name
from neurosim.base.progress import Progress
from tracking.camera.board import (
    MARKER_HEIGHT,
    camera_over_board,
    click_spread,
    corner_points,
    locate,
    over_the_board,
    read_points,
)
from tracking.camera.camera_model import CameraModel
from tracking.camera.lens import FEWEST_PHOTOGRAPHS, fit, fit_robustly
from tracking.camera.targets import Charuco, Chessboard, Target, View
from tracking.camera.video import Video

PHOTOGRAPHS = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}

#: Smallest number of photographs for calibrating with halves of them.
FEWEST_HALVED = 12
#: Number of halvings; with half as many, the stated uncertainty still varies by a tenth.
SPLITS = 64
HALVES, JACKKNIFE = "halves of the photographs", "jackknife over photographs"
#: Largest number of frames from a video, spread over the poses of the board.
MOST_FRAMES = 40

_GREY = cv2.COLOR_BGR2GRAY


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

    The uncertainty comes from calibrations with halves of the photographs. Errors of corners in one
    photograph are correlated, so the residuals' covariance would give only half of the scatter
    between photographs. The results of halves scatter about the result of all like this does about
    the truth (McCarthy 1969). Fewer than 12 photographs have too small halves; they are left out
    one by one instead (the jackknife, Tukey 1958), which gives about a sixth too little. Three
    photographs are too few.

    Corners that were found in a wrong place, and photographs that do not fit the others, are left
    out: see :func:`tracking.camera.lens.fit_robustly`.

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
        UserError: if fewer than 3 photographs show the whole chessboard and fit together, the
            photographs differ in size, or the points do not fix a pose.
    """
    target: Target = (
        Chessboard(pattern, square)
        if marker is None
        else Charuco(pattern, square, marker, dictionary)
    )
    views, size = _find_all(source, target)
    model, views = fit_robustly(views, size)
    others = _resampled(views, size)
    if points is not None:
        rows = read_points(points)
        model = locate(model, rows)
        return replace(model, uncertainty=_uncertainty(model, *others, rows))
    return replace(model, uncertainty=_uncertainty(model, *others, None))


def _resampled(views: list[View], size: tuple[int, int]) -> tuple[list[CameraModel], str]:
    """Return lenses from parts of the views, and the parts' name; empty if there are too few."""
    if len(views) <= FEWEST_PHOTOGRAPHS:
        return [], ""
    if len(views) < FEWEST_HALVED:
        parts, method = [views[:i] + views[i + 1 :] for i in range(len(views))], JACKKNIFE
    else:
        parts, method = [[views[i] for i in half] for half in _halves(len(views))], HALVES
    try:
        return [fit(part, size) for part in parts], method
    except UserError:
        return [], ""


def _halves(count: int) -> list[NDArray]:
    """Return random halves of ``count`` things as indices, each followed by its other half."""
    rng = np.random.default_rng(0)
    return [half for _ in range(SPLITS) for half in np.array_split(rng.permutation(count), 2)]


def _uncertainty(
    model: CameraModel, others: list[CameraModel], method: str, points: NDArray | None
) -> dict[str, Any] | None:
    """Return :attr:`CameraModel.uncertainty`, or None if it cannot be estimated."""
    if not others:
        return None

    def spread(of: Callable[[CameraModel], NDArray]) -> NDArray:
        values = np.array([of(other) for other in others])
        if method == HALVES:
            return np.sqrt(((values - of(model)) ** 2).mean(0))
        return np.sqrt((len(others) - 1) * ((values - values.mean(0)) ** 2).mean(0))

    fx, fy, cx, cy, *distortion = spread(_lens_numbers).tolist()
    stated: dict[str, Any] = {
        "method": method,
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "distortion": distortion,
    }
    if points is not None:
        pixels = over_the_board(model, points)
        lens = spread(lambda m: locate(m, points).to_board(pixels, MARKER_HEIGHT))
        clicks = click_spread(model, points)
        stated["board_m"] = float(np.sqrt((lens**2 + clicks**2).sum(-1).mean()))
        stated["height_m"] = MARKER_HEIGHT
    return stated


def _lens_numbers(model: CameraModel) -> NDArray:
    matrix = model.camera_matrix
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *model.distortion])


def from_corners(
    picture: str | Path, corners: ArrayLike, board: tuple[float, float]
) -> CameraModel:
    """Return a camera from the four corners of the board alone, without a printed chessboard.

    Args:
        picture: a photograph of the board, or a video, for its size.
        corners, board: as in :func:`tracking.camera.board.corner_points`.

    Raises:
        UserError: if the picture cannot be read, and as ``corner_points`` does.
    """
    image = next(iter(_pictures(picture)))[1]
    size = (image.shape[1], image.shape[0])
    return camera_over_board(size, corner_points(size, corners, board))


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
    views: list[View] = []
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
                views.append(view._replace(name=name))
            progress.advance()
    if len(views) < FEWEST_PHOTOGRAPHS:
        raise UserError(
            f"the {target.name} was found in {len(views)} of {seen} pictures; at least "
            f"{FEWEST_PHOTOGRAPHS} are needed"
        )
    return _spread(views, MOST_FRAMES), size


def _photographs(files: Iterable[Path]) -> Iterator[tuple[str, NDArray]]:
    for file in files:
        check_file(file, "a photograph")
        image = cv2.imread(check_name(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise UserError(f"{file}: is not a photograph that can be read")
        yield str(file), image


def _video_frames(path: Path) -> Iterator[tuple[str, NDArray]]:
    with Video(path) as video:
        # Neighbouring frames are alike; a few hundred are enough to choose from.
        every = max(1, round(video.frames / 300)) if video.frames else 5
        for index, _, frame in video:
            if index % every == 0:
                yield f"{path}, frame {index}", frame


def _spread(photographs: list[View], most: int) -> list[View]:
    """Keep the ``most`` views that differ most, by farthest-point selection on four corners."""
    if len(photographs) <= most:
        return photographs
    corners = [view.pixels for view in photographs]
    views = np.array([[c[0], c[-1], *_other_corners(c)] for c in corners]).reshape(
        len(photographs), -1
    )
    chosen = [0]
    distance = np.linalg.norm(views - views[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(views - views[chosen[-1]], axis=1))
    return [photographs[i] for i in sorted(chosen)]


def _other_corners(corners: NDArray) -> tuple[NDArray, NDArray]:
    axis = corners[-1] - corners[0]
    side = (corners - corners[0]) @ np.array([-axis[1], axis[0]])
    return corners[side.argmin()], corners[side.argmax()]
