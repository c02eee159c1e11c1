"""Learns a marker's colour from a click in a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from tracking.markers.colours import Colour, angle_between, chroma_plane, parse_colour
from tracking.markers.markers import LEAST_CHROMA, Picture

#: A click lies within this fraction of the picture's width of the marker's colour.
REACH = 1 / 80
#: Pixels this far in hue from the commonest one around a click are something else.
SAME_HUE = math.radians(25)
#: Hues nearer than this cannot be distinguished safely in usual light by usual cameras.
APART = math.radians(40)


@dataclass(frozen=True)
class Pointed:
    """A colour that was pointed at.

    Attributes:
        colour: named ``#rrggbb``, as options and files take it.
        chroma: how colourful it is, 0 grey to 255.
        fraction: of the pixels around the click that are of it, 0..1.
        places: patches of this colour in the whole picture.
    """

    colour: Colour
    chroma: float
    fraction: float
    places: int

    @property
    def confidence(self) -> float:
        """The confidence that a marker of this colour will be found, 0..1."""
        strong = min(1.0, self.chroma / 90.0)
        return strong * (1.0 if self.places == 1 else 0.7 if self.places == 2 else 0.5)


def colour_at(frame: NDArray, pixel: ArrayLike) -> Pointed:
    """Learn the colour of the object at a pixel.

    A marker may fade to white where it is clicked, and the click may miss a little: the
    commonest hue around it counts.

    Args:
        frame: BGR [H, W, 3] uint8.
        pixel: u and v.

    Raises:
        UserError: if there is nothing but grey.
    """
    colour, chroma, fraction = colour_around(frame, pixel)
    return Pointed(colour, chroma, fraction, len(Picture(frame).blobs(colour)))


def colour_around(frame: NDArray, pixel: ArrayLike) -> tuple[Colour, float, float]:
    """Return the commonest colour around a pixel, its chroma, and its fraction of the pixels there.

    Raises:
        UserError: as :func:`colour_at` does.
    """
    u, v = (round(float(place)) for place in np.asarray(pixel, float))
    reach = max(4, round(REACH * frame.shape[1]))
    window = frame[max(0, v - reach) : v + reach + 1, max(0, u - reach) : u + reach + 1]
    if window.size == 0:
        raise UserError(f"({u}, {v}) is outside of the picture")
    pixels = window.reshape(-1, 3)
    plane = chroma_plane(pixels)
    chroma, hue = np.hypot(*plane), np.arctan2(plane[1], plane[0])
    coloured = chroma > LEAST_CHROMA
    if coloured.mean() < 0.05:
        raise UserError("there is only grey here; click on the marker's coloured part")
    votes, edges = np.histogram(hue[coloured], 36, (-math.pi, math.pi), weights=chroma[coloured])
    votes = votes + np.roll(votes, 1) + np.roll(votes, -1)
    commonest = float(edges[votes.argmax()] + math.pi / 36)
    own = coloured & (np.abs(angle_between(hue, commonest)) < SAME_HUE)
    strongest = own & (chroma >= np.median(chroma[own]))
    blue, green, red = (round(float(c)) for c in np.median(pixels[strongest], axis=0))
    colour = parse_colour(f"#{red:02x}{green:02x}{blue:02x}")
    return colour, float(np.median(chroma[strongest])), float(own.mean())


def distinguishable(a: Colour, b: Colour) -> bool:
    """Return whether two markers of these colours can be distinguished."""
    return abs(float(angle_between(a.hue, b.hue))) >= APART
