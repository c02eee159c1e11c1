"""Calibration targets: a chessboard, or a ChArUco board, in a picture."""

from __future__ import annotations

from typing import Annotated, NamedTuple, Protocol

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Metres, checks
from neurosim.base.errors import UserError

_REFINE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)

#: Smallest number of visible corners of a ChArUco board, not all on one line.
FEWEST_CORNERS = 8

#: Inner corners along the two sides of a chessboard.
Corners = Annotated[int, Meta(ge=2, le=100)]
Pattern = tuple[Corners, Corners]


class View(NamedTuple):
    """Corners of a target in one picture."""

    board: NDArray  # [N, 2] m
    pixels: NDArray  # [N, 2]
    name: str = ""  # of the picture


class Target(Protocol):
    """A flat target whose corners are found in pictures."""

    #: How a message names it.
    name: str

    def find(self, grey: NDArray) -> View | None:
        """Return its corners in a picture [H, W], or None."""
        ...


class Chessboard:
    """A chessboard; all of its inner corners must be seen.

    Args:
        pattern: inner corners along its two sides.
        square: side of a square, m.
    """

    @checks
    def __init__(self, pattern: Pattern, square: Metres):
        self.pattern = pattern
        self.name = f"whole chessboard of {pattern[0]} x {pattern[1]} inner corners"
        self._board = np.mgrid[: pattern[0], : pattern[1]].T.reshape(-1, 2) * square

    def find(self, grey: NDArray) -> View | None:
        """Return its corners, row by row."""
        corners = find_corners(grey, self.pattern)
        return None if corners is None else View(self._board, corners)


class Charuco:
    """A ChArUco board: a chessboard with ArUco markers in its white squares; a part is enough.

    Args:
        pattern: inner corners along its two sides; one less than the squares.
        square: side of a square, m.
        marker: side of a marker, m.
        dictionary: of the markers, as OpenCV names it without ``DICT_``, such as ``4X4_50``.
    """

    @checks
    def __init__(
        self, pattern: Pattern, square: Metres, marker: Metres, dictionary: str = "4X4_50"
    ):
        if not 0 < marker < square:
            raise UserError(
                f"a marker of {1000 * marker:g} mm does not fit a square of {1000 * square:g} mm"
            )
        number = getattr(cv2.aruco, f"DICT_{dictionary.upper()}", None)
        if number is None:
            raise UserError(f"there is no ArUco dictionary {dictionary!r}; use one such as 4X4_50")
        self.name = f"ChArUco board of {pattern[0]} x {pattern[1]} inner corners ({dictionary})"
        squares = (pattern[0] + 1, pattern[1] + 1)
        own = cv2.aruco.getPredefinedDictionary(number)
        if squares[0] * squares[1] // 2 > len(own.bytesList):
            raise UserError(
                f"the dictionary {dictionary} has {len(own.bytesList)} markers, too few for a "
                f"board of {squares[0]} x {squares[1]} squares"
            )
        self.board = cv2.aruco.CharucoBoard(squares, square, marker, own)
        self._detector = cv2.aruco.CharucoDetector(self.board)
        self._corners = np.asarray(self.board.getChessboardCorners(), float)[:, :2]

    def find(self, grey: NDArray) -> View | None:
        """Return its visible corners."""
        corners, names, _, _ = self._detector.detectBoard(grey)
        if names is None or len(names) < FEWEST_CORNERS:
            return None
        board = self._corners[np.ravel(names)]
        if np.linalg.matrix_rank(board - board[0]) < 2:
            return None
        return View(board, np.asarray(corners, float).reshape(-1, 2))


def find_corners(image: NDArray, pattern: tuple[int, int]) -> NDArray | None:
    """Return the inner corners [N, 2] of a chessboard in pixels, row by row, or None."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    visible, corners = cv2.findChessboardCorners(grey, pattern)
    if not visible:
        return None
    reach = _reach(corners.reshape(pattern[1], pattern[0], 2))
    corners = cv2.cornerSubPix(grey, corners, (reach, reach), (-1, -1), _REFINE)
    return corners.reshape(-1, 2)


def _reach(corners: NDArray) -> int:
    """Return how far the refinement window reaches: 11 x 11 pixels, less on small squares."""
    nearest = min(np.linalg.norm(np.diff(corners, axis=axis), axis=-1).min() for axis in (0, 1))
    return int(np.clip(nearest / 2, 2, 5))
