"""A camera's colour cast and the level of the light: guessed from one picture, and followed.

A camera that balances its whites by itself, or a lamp that is switched on, changes all colours
alike. The change of most of the picture between two frames is assumed to be such a change, and
removed before a marker's hue is compared: a robot or a hand is a small part of the picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.base.kernels import kernel, smallest
from tracking.markers.colours import NO_CAST

#: Pixels that are examined along the picture's width.
_ACROSS = 48
#: Darker than this a ratio of channels is mostly noise, brighter than this a channel is clipped.
_DARK, _CLIPPED = 24, 250
#: The level of the light is measured at pixels at least this bright in the first picture.
_LIT = 40
#: A picture with less light than this, as a fraction of that of the first, is of a covered lens.
_COVERED = 0.05
#: Fewer usable pixels say nothing.
_LEAST = 60
#: Largest plausible factor of a cast.
_MOST = 2.0


def cast_of(frame: NDArray) -> tuple[float, float]:
    """Guess the cast of one picture: most bright pixels are assumed to be grey.

    Args:
        frame: BGR [H, W, 3] uint8.

    Returns:
        Factors of blue and of red that remove it; 1 and 1 if there is too little light.
    """
    grid = _grid(frame)
    usable = (grid.min(axis=1) > 2 * _DARK) & (grid.max(axis=1) < _CLIPPED)
    if usable.sum() < _LEAST:
        return NO_CAST
    blue, green, red = grid[usable].T
    return _believed(np.median(green / blue), np.median(green / red))


class Cast:
    """Follows the cast from a first picture on; for a camera that stands still."""

    def __init__(self, frame: NDArray, base: tuple[float, float] = NO_CAST):
        """Begin with a picture and the factors that remove its cast."""
        self._reference = _grid(frame)
        self._base = base
        self.white = base
        #: The light of the latest picture, as a fraction of that of the first.
        self.level = 1.0

    def update(self, frame: NDArray) -> tuple[float, float]:
        """Return the factors of blue and of red for a later picture of the same view."""
        grid = _grid(frame)
        usable, blue, red = _turned(grid, self._reference)
        if usable >= _LEAST:
            self.white = _believed(blue * self._base[0], red * self._base[1])
        lit, level = _dimmed(grid, self._reference)
        if lit >= _LEAST and level > _COVERED:
            self.level = level
        return self.white


@kernel()
def _ends(pixel):
    """Return the least and the largest of three channels."""
    return min(pixel[0], pixel[1], pixel[2]), max(pixel[0], pixel[1], pixel[2])


@njit(nogil=True)
def _turned(grid: NDArray, before: NDArray) -> tuple[int, float, float]:
    """Return the number of usable pixels, and the lower median gains of green over the others."""
    gained = np.empty((2, len(grid)), np.float32)
    count = 0
    for now, then in zip(grid, before):  # noqa: B905 (compiled: no strict)
        (low, high), (low_then, high_then) = _ends(now), _ends(then)
        if min(low, low_then) > _DARK and max(high, high_then) < _CLIPPED:
            green = now[1] / then[1]
            gained[0, count] = green / (now[0] / then[0])
            gained[1, count] = green / (now[2] / then[2])
            count += 1
    if count == 0:
        return 0, 1.0, 1.0
    middle = (count - 1) // 2
    return count, smallest(gained[0], count, middle), smallest(gained[1], count, middle)


@njit(nogil=True)
def _dimmed(grid: NDArray, before: NDArray) -> tuple[int, float]:
    """Return the number of lit pixels, and the lower median of their light over that before."""
    fractions = np.empty(len(grid), np.float32)
    count = 0
    for now, then in zip(grid, before):  # noqa: B905 (compiled: no strict)
        (_, high), (_, high_then) = _ends(now), _ends(then)
        if high_then > _LIT and max(high, high_then) < _CLIPPED:
            fractions[count] = (now[0] + now[1] + now[2]) / (then[0] + then[1] + then[2])
            count += 1
    if count == 0:
        return 0, 1.0
    return count, smallest(fractions, count, (count - 1) // 2)


def _grid(frame: NDArray) -> NDArray:
    step = max(1, frame.shape[1] // _ACROSS)
    return frame[step // 2 :: step, step // 2 :: step].reshape(-1, 3).astype(np.float32)


def _believed(blue: float, red: float) -> tuple[float, float]:
    return tuple(float(min(max(f, 1 / _MOST), _MOST)) for f in (blue, red))
