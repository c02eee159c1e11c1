"""The lens from pictures of a chessboard: the fit, and the search for outliers.

Zhang (2000) as OpenCV implements it. A corner at a wrong position (a reflection, a finger, a smear)
disturbs the whole lens, because least squares weigh it by the square of its error; it is detected
by its difference from all others.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from tracking.camera.camera_model import CameraModel
from tracking.camera.targets import View

#: Fewer photographs cannot tell focal length, principal point and distortion apart.
FEWEST_PHOTOGRAPHS = 3
#: A corner is wrong if it is off by so many times the median of all corners; a photograph if its
#: corners' root mean square is so many times the median of all photographs'.
WRONG_CORNER, WRONG_PHOTOGRAPH = 8.0, 4.0
#: Smallest error of an outlier, px.
LEAST_WRONG = 0.5
#: A photograph with more wrong corners than this fraction is wrong itself.
MOST_WRONG = 0.25


def fit(views: list[View], size: tuple[int, int]) -> CameraModel:
    """Return the lens that fits all corners of all views best, by least squares.

    Args:
        views: of one target, at least 3.
        size: of the pictures, width and height in pixels.

    Raises:
        UserError: if the views do not fix a lens.
    """
    return _fit(views, size)[0]


def fit_robustly(views: list[View], size: tuple[int, int]) -> tuple[CameraModel, list[View]]:
    """Return the lens that fits the views without outliers, and the kept views.

    In each round the photograph that fits worst is left out, or in every photograph the corner
    that fits worst, if it is wrong; then the lens is fitted again. They are left out one at a time,
    because an outlier makes its neighbours look wrong, too.

    Args:
        views: of one target, with names.
        size: of the pictures, width and height in pixels.

    Returns:
        The lens, with the outliers under ``left_out``, and the views that it uses.

    Raises:
        UserError: as :func:`fit` does, or if fewer than 3 photographs fit together.
    """
    whole = {view.name: len(view.pixels) for view in views}
    left_out: list[dict[str, Any]] = []
    while True:
        model, misses = _fit(views, size)
        rms = np.array([np.sqrt((each**2).mean()) for each in misses])
        worst = int(rms.argmax())
        if rms[worst] > max(LEAST_WRONG, WRONG_PHOTOGRAPH * float(np.median(rms))) and (
            _is_wrong_throughout(misses[worst], misses)
        ):
            views, left_out = _without(views, worst, float(rms[worst]), left_out)
            continue
        limit = max(LEAST_WRONG, WRONG_CORNER * float(np.median(np.concatenate(misses))))
        wrong = [(i, int(each.argmax())) for i, each in enumerate(misses) if each.max() > limit]
        if not wrong:
            return replace(model, left_out=tuple(left_out)), views
        for i, corner in sorted(wrong, reverse=True):
            view, off = views[i], float(misses[i][corner])
            if len(view.pixels) - 1 < (1 - MOST_WRONG) * whole[view.name]:
                views, left_out = _without(views, i, float(rms[i]), left_out)
                continue
            u, v = (round(float(place), 1) for place in view.pixels[corner])
            left_out.append({"photograph": view.name, "off_px": round(off, 2), "u": u, "v": v})
            kept = np.arange(len(view.pixels)) != corner
            views = [*views[:i], _part(view, kept), *views[i + 1 :]]


def describe_left_out(left_out: dict[str, Any]) -> str:
    """Describe a corner or a photograph that was left out."""
    if "u" in left_out:
        return (
            f"{left_out['photograph']}: the corner at {left_out['u']:.0f},{left_out['v']:.0f} is "
            f"{left_out['off_px']:.1f} px off and left out; is something over it?"
        )
    return (
        f"{left_out['photograph']}: its corners are {left_out['off_px']:.1f} px off and it is left "
        "out; did the chessboard move, or bend?"
    )


def _is_wrong_throughout(own: NDArray, misses: list[NDArray]) -> bool:
    """Return whether a whole photograph, not only some corners, does not fit."""
    return bool(np.median(own) > WRONG_PHOTOGRAPH / 2 * np.median(np.concatenate(misses)))


def _without(
    views: list[View], which: int, rms: float, left_out: list[dict[str, Any]]
) -> tuple[list[View], list[dict[str, Any]]]:
    """Return the views without one, and the outliers, in which it replaces its corners."""
    name = views[which].name
    if len(views) <= FEWEST_PHOTOGRAPHS:
        raise UserError(
            f"fewer than {FEWEST_PHOTOGRAPHS} photographs fit together ({name} is {rms:.1f} px "
            "off); take others, with a flat chessboard and a still hand"
        )
    rest = [each for each in left_out if each["photograph"] != name]
    rest.append({"photograph": name, "off_px": round(rms, 2)})
    return [*views[:which], *views[which + 1 :]], rest


def _part(view: View, kept: NDArray) -> View:
    return view._replace(board=view.board[kept], pixels=view.pixels[kept])


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit OpenCV to one thread, because sums of several threads vary in their last digits."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _fit(views: list[View], size: tuple[int, int]) -> tuple[CameraModel, list[NDArray]]:
    """Return the lens, and its errors [N] in pixels at the corners of each view."""
    boards = [
        np.column_stack([view.board, np.zeros(len(view.board))]).astype(np.float32)
        for view in views
    ]
    images = [view.pixels.reshape(-1, 1, 2).astype(np.float32) for view in views]
    turns: Any = ()
    places: Any = ()
    try:
        with _one_thread():
            rms, matrix, distortion, turns, places = cv2.calibrateCamera(
                boards, images, size, None, None
            )
    except cv2.error:
        rms = np.inf
    if not np.isfinite(rms) or matrix[0, 0] > 100 * max(size):
        raise UserError(
            "these photographs do not fix the lens: take them with the chessboard tilted in "
            "several directions and over the whole image"
        )
    misses = []
    for board, image, turn, place in zip(boards, images, turns, places, strict=True):
        seen = cv2.projectPoints(board, turn, place, matrix, distortion)[0]
        misses.append(np.hypot(*(seen - image).reshape(-1, 2).T))
    model = CameraModel(
        size,
        matrix,
        np.ravel(distortion)[:5],
        rms_px=float(rms),
        photographs=len(images),
    )
    return model, misses
