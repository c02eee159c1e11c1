"""Where a known tag is in a picture, to hundredths of a pixel: its pattern is fitted to the pixels.

Corners of a tag of a few pixels a cell are known to a tenth of a pixel at best; all edges of its
cells together say ten times as much. An affine map from the tag to the picture, and the levels of
black and white, are fitted by Gauss-Newton steps (Lucas and Kanade 1981; Baker and Matthews 2004).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.markers.tags import QUIET, Tag

#: Texels a cell of the pattern.
_TEXELS = 8
#: Blur of a picture by pixels and lens together, px (standard deviation).
_BLUR = 0.5
#: Width of the white around the square that counts, in cells: its neighbours blur into the rest.
_RIM = 0.6
#: A tag whose side has more pixels is fitted in a smaller picture.
MOST_PIXELS = 56.0
_STEPS = 8
#: A pixel this far from the pattern (times the median, and as a fraction of white less black) is of
#: something that covers it; and where something does, one that is nearer.
_FAR, _NEAR = (5.0, 0.25), (3.0, 0.15)
#: An uncovered tag has at least this fraction of counting pixels, and this correlation.
_WHOLE = 0.95
#: Largest number of repetitions of the fit with the remaining pixels.
_ROUNDS = 6
#: White is lighter than black by this many grey levels at least.
_LEAST_CONTRAST = 8.0
#: A step smaller than this (px) is the last one.
_ENOUGH = 0.003


@dataclass(frozen=True)
class Placed:
    """A tag's place: u = centre + axes x, x in sides of the black square from its middle.

    Attributes:
        centre: px [2].
        axes: px [2, 2], columns: the tag's x, to the right, and its y, down, as it is printed.
        likeness: correlation of the pixels that count with the pattern, of 1.
        seen: fraction of the pixels that count: the others are far from the pattern, as of a hand.
    """

    centre: NDArray
    axes: NDArray
    likeness: float = 0.0
    seen: float = 1.0

    @property
    def side(self) -> float:
        """Of the black square, px."""
        return math.sqrt(abs(float(np.linalg.det(self.axes))))

    @property
    def corners(self) -> NDArray:
        """[4, 2] px, of the black square, from its top left one clockwise, as it is printed."""
        return self.centre + _SQUARE @ self.axes.T

    @classmethod
    def of_corners(cls, corners: NDArray) -> Placed:
        """Return the affine map that fits four corners [4, 2] best."""
        centre = corners.mean(axis=0)
        return cls(centre, (corners - centre).T @ _SQUARE)


_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def fit(grey: NDArray, tag: Tag, guess: Placed) -> Placed | None:
    """Return a tag's place, from a guess that is off by a cell or less; None if the fit fails.

    Args:
        grey: the picture [H, W] uint8.
        tag: the tag to fit.
        guess: its approximate place.
    """
    factor = math.ceil(guess.side / MOST_PIXELS)
    cells = len(tag.cells)
    reach = np.abs(guess.axes).sum(axis=1) * (0.5 + QUIET / cells) + 1.0
    low = np.maximum(np.floor(guess.centre - reach).astype(int), 0)
    high = np.minimum(np.ceil(guess.centre + reach).astype(int) + 1, grey.shape[::-1])
    size = (high - low) // factor
    if (size < 4).any():
        return None
    window = grey[low[1] : low[1] + size[1] * factor, low[0] : low[0] + size[0] * factor]
    if factor > 1:
        window = cv2.resize(window, tuple(size.tolist()), interpolation=cv2.INTER_AREA)
    shift = low + (factor - 1) / 2
    start = Placed((guess.centre - shift) / factor, guess.axes / factor)
    if start.side < 1.0:
        return None
    v, u = np.mgrid[: size[1], : size[0]]
    pixels = np.stack([u.ravel(), v.ravel()]).astype(float)
    places = np.linalg.solve(start.axes, pixels - start.centre[:, None])
    inside = np.abs(places).max(axis=0) < 0.5 + _RIM / cells
    # As many pixels as the tag has when all of it is in the picture.
    whole = (start.side * (1 + 2 * _RIM / cells)) ** 2
    pixels, seen = pixels[:, inside], window.ravel()[inside].astype(float)
    pattern = _pattern(tag.dictionary, tag.number, _blur_level(start.side / cells))
    placed, clear = start, np.ones(len(seen), bool)
    for _ in range(_ROUNDS):
        fitted = _steps(pattern, cells, pixels[:, clear], seen[clear], placed)
        if fitted is None or np.abs(fitted[0].centre - start.centre).max() > 0.5 * start.side:
            return None
        placed, white, black = fitted
        places = np.linalg.solve(placed.axes, pixels - placed.centre[:, None])
        misses = np.abs(seen - white * _sample(pattern, places, cells)[0] - black)
        before = clear
        whole_in_view = clear.mean() > _WHOLE and placed.likeness > _WHOLE
        times, levels = _FAR if whole_in_view else _NEAR
        clear = misses < max(times * float(np.median(misses)), levels * white)
        if clear.sum() < 0.5 * whole:
            return None
        if (clear == before).all():
            break
    return Placed(
        placed.centre * factor + shift,
        placed.axes * factor,
        placed.likeness,
        min(float(clear.sum()) / whole, 1.0),
    )


def _steps(
    pattern: NDArray, cells: int, pixels: NDArray, seen: NDArray, start: Placed
) -> tuple[Placed, float, float] | None:
    """Return where the pattern fits pixels [2, N] of levels [N], with white less black, and black.

    None if it does not: the size changes too much, or black is not darker than white.
    """
    centre, axes = start.centre, start.axes
    for _ in range(_STEPS):
        inverse = np.linalg.inv(axes)
        places = inverse @ (pixels - centre[:, None])
        model, slopes = _sample(pattern, places, cells)
        # How the pattern's level changes along u and v of the picture.
        along = inverse.T @ slopes
        design = np.concatenate(
            [along, along * places[0], along * places[1], model[None], np.ones((1, len(model)))]
        )
        try:
            solution = np.linalg.solve(design @ design.T, design @ seen)
        except np.linalg.LinAlgError:
            return None
        gain, black = solution[6:]
        if gain < _LEAST_CONTRAST:
            return None
        step = -solution[:6] / gain
        centre = centre + step[:2]
        axes = axes + step[2:].reshape(2, 2).T
        if not 0.7 < abs(np.linalg.det(axes)) / start.side**2 < 1.4:
            return None
        if np.abs(step[:2]).max() + 0.5 * np.abs(step[2:]).max() < _ENOUGH:
            break
    near, like = seen - seen.mean(), model - model.mean()
    likeness = float(near @ like / math.sqrt((near @ near) * (like @ like) + 1e-12))
    return Placed(centre, axes, likeness), float(gain), float(black)


def _blur_level(cell: float) -> int:
    """Return the blur of the pattern, in sixths of octaves, for cells of this many pixels."""
    return round(6 * math.log2(_BLUR * _TEXELS / cell))


@lru_cache(maxsize=64)
def _pattern(dictionary: str, number: int, level: int) -> NDArray:
    """Return a tag's pattern and its slopes along x and y, float32 [N, N, 3], 0 black, 1 white."""
    cells = np.pad(Tag(dictionary, number).cells, 3, constant_values=True).astype(np.float32)
    fine = np.kron(cells, np.ones((_TEXELS, _TEXELS), np.float32))
    blurred = cv2.GaussianBlur(fine, (0, 0), max(2 ** (level / 6), 0.6))
    down, across = np.gradient(blurred)
    return np.stack([blurred, across, down], axis=-1)


def _sample(pattern: NDArray, places: NDArray, cells: int) -> tuple[NDArray, NDArray]:
    """Return level [N] and slopes [2, N] (a side) at places [2, N] of the tag."""
    texels = cells * _TEXELS
    at = (places * texels + (len(pattern) - 1) / 2).astype(np.float32)
    seen = cv2.remap(
        pattern, at[0][None], at[1][None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )[0]
    return seen[:, 0].astype(float), seen[:, 1:].T * float(texels)
