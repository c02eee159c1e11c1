"""A video with the tracked robot drawn over it."""

from __future__ import annotations

import itertools
from collections import deque
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import check_name
from tracking.markers.pair import Sighting

#: Length of the trail, frames.
TRAIL = 150

_FOURCC = {".mp4": "mp4v", ".m4v": "mp4v", ".mkv": "MJPG", ".avi": "MJPG"}
# OpenCV draws at fractions of a pixel when coordinates carry this many extra bits.
_BITS = 4


def check_overlay(overlay: str | Path, video: Path) -> None:
    """Refuse an overlay that cannot be written, or would replace a film.

    Raises:
        UserError: if the file exists, or its ending is not .mp4, .mkv or .avi.
    """
    overlay = Path(overlay)
    if overlay.suffix.lower() not in _FOURCC:
        raise UserError(f"{overlay}: name the overlay video .mp4, .mkv or .avi")
    if overlay.exists() and overlay.samefile(video):
        raise UserError(f"{overlay} is the video itself; name another file for the overlay")
    if overlay.exists():
        raise UserError(f"{overlay} exists already; name another file, or remove it yourself")


class Overlay:
    """Writes the overlay frame by frame; use it as a context manager.

    Markers are circled, an arrow points from the rear to the front one,
    a trail follows the middle between them, and a line of text gives time and quality.
    """

    def __init__(
        self,
        path: str | Path,
        size: tuple[int, int],
        fps: float,
        colours: tuple[tuple[int, int, int], tuple[int, int, int]],
    ):
        """Open the file.

        Args:
            path: of the file.
            size: width and height in pixels.
            fps: frames a second.
            colours: of the circles around front and rear, BGR.

        Raises:
            UserError: if it cannot be written.
        """
        self.path = Path(path)
        fourcc = _FOURCC[self.path.suffix.lower()]
        self._writer = cv2.VideoWriter(check_name(path), cv2.VideoWriter.fourcc(*fourcc), fps, size)
        if not self._writer.isOpened():
            raise UserError(f"{self.path}: OpenCV cannot write this video here")
        self._colours = colours
        self._trail: deque[NDArray | None] = deque(maxlen=TRAIL)

    def write(self, frame: NDArray, time: float, sighting: Sighting) -> None:
        """Draw one sighting over its frame and write it."""
        self._writer.write(self.draw(frame, time, sighting))

    def draw(self, frame: NDArray, time: float, sighting: Sighting) -> NDArray:
        """Return a copy of the frame with the sighting drawn over it."""
        picture = frame.copy()
        middle = (sighting.front + sighting.rear) / 2 if sighting.in_view else None
        self._trail.append(middle)
        trail = list(self._trail)
        for before, after in itertools.pairwise(trail):
            if before is not None and after is not None:
                _line(picture, before, after, (0, 220, 255), 1)
        if sighting.in_view:
            axis = sighting.front - sighting.rear
            radius = max(4.0, 0.28 * float(np.hypot(*axis)))
            for centre, colour in zip((sighting.front, sighting.rear), self._colours, strict=True):
                cv2.circle(
                    picture, _fixed(centre), round(radius * 2**_BITS), colour, 1,
                    cv2.LINE_AA, _BITS,
                )  # fmt: skip
                for step in 2.0 * np.eye(2):
                    _line(picture, centre - step, centre + step, (0, 0, 0), 1)
            tip = sighting.front + 0.8 * axis
            cv2.arrowedLine(
                picture, _whole(sighting.front + 0.3 * axis), _whole(tip), (255, 255, 255), 1,
                cv2.LINE_AA, 0, 0.4,
            )  # fmt: skip
        caption = f"{time:.2f} s  " + (
            f"quality {sighting.quality:.2f}" if sighting.in_view else "lost"
        )
        # A plain dark strip: outlined letters differ from one OpenCV to the next.
        cv2.rectangle(picture, (0, 0), (210, 24), (0, 0, 0), cv2.FILLED)
        cv2.putText(
            picture,
            caption,
            (8, 17),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.5,
            (255, 255, 255),
            1,
            cv2.LINE_AA,
        )
        return picture

    def close(self) -> None:
        """Finish the file."""
        self._writer.release()

    def __enter__(self) -> Overlay:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _fixed(point: NDArray) -> tuple[int, int]:
    u, v = np.round(np.asarray(point) * 2**_BITS).astype(int)
    return int(u), int(v)


def _whole(point: NDArray) -> tuple[int, int]:
    u, v = np.round(np.asarray(point)).astype(int)
    return int(u), int(v)


def _line(picture: NDArray, a: NDArray, b: NDArray, shade: tuple[int, int, int], width: int):
    cv2.line(picture, _fixed(a), _fixed(b), shade, width, cv2.LINE_AA, _BITS)
