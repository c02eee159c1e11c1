"""Colours by name, and hue as an angle in the plane of colour differences.

The plane is that of alpha = R - (G + B) / 2 and beta = sqrt(3) / 2 (G - B) (Hanbury 2008): its
angle is the hue of HSV to within 1.2 degrees, its radius the chroma, and both are linear in the
light, so that a disc that fades to white has the same hue all over. Grey has no chroma.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError

#: Name -> hue, and the largest deviation of it in a camera's picture, in degrees.
NAMED = {
    "red": (0.0, 18.0),
    "orange": (24.0, 16.0),
    "yellow": (60.0, 22.0),
    "green": (132.0, 45.0),
    "cyan": (185.0, 22.0),
    "blue": (222.0, 32.0),
    "purple": (275.0, 26.0),
    "violet": (275.0, 26.0),
    "magenta": (300.0, 22.0),
    "pink": (332.0, 26.0),
}

#: Largest deviation of the hue from an exactly given colour, in degrees.
GIVEN_TOLERANCE = 25.0

#: Factors of blue and of red if there is no colour cast.
NO_CAST = (1.0, 1.0)

_WEIGHTS = np.array(  # columns B, G, R
    [[-0.5, -0.5, 1.0], [-math.sqrt(0.75), math.sqrt(0.75), 0.0]], np.float32
)


@dataclass(frozen=True)
class Colour:
    """A marker's colour as the user gives it; ``hue`` and ``tolerance`` in radians."""

    name: str
    hue: float
    tolerance: float

    @property
    def bgr(self) -> tuple[int, int, int]:
        """A fully saturated pixel of this hue, to draw with."""
        parts = (_hue_part(self.hue, shift) for shift in (-120.0, 120.0, 0.0))
        blue, green, red = (round(255 * part) for part in parts)
        return blue, green, red


def parse_colour(text: str) -> Colour:
    """Read a colour: a name, ``#rrggbb``, or ``hsv:h,s,v`` (degrees, percent, percent).

    Raises:
        UserError: if it is unknown, or a grey, which has no hue.
    """
    word = text.strip().lower()
    if word in NAMED:
        hue, tolerance = NAMED[word]
        return Colour(word, math.radians(hue), math.radians(tolerance))
    if re.fullmatch(r"#[0-9a-f]{6}", word):
        red, green, blue = (int(word[i : i + 2], 16) for i in (1, 3, 5))
        alpha, beta = chroma_plane(np.array([blue, green, red], np.float32))
        if math.hypot(alpha, beta) < 25:
            raise UserError(f"colour {text!r} is a grey; a marker needs a hue")
        return Colour(word, math.atan2(beta, alpha), math.radians(GIVEN_TOLERANCE))
    numbers = re.fullmatch(r"hsv[:(]([\d.]+),\s*([\d.]+),\s*([\d.]+)\)?", word)
    if numbers:
        hue, saturation, value = (float(n) for n in numbers.groups())
        if hue > 360 or saturation > 100 or value > 100:
            raise UserError(f"colour {text!r}: expected hsv:0-360,0-100,0-100")
        if saturation < 15 or value < 10:
            raise UserError(f"colour {text!r} is a grey; a marker needs a hue")
        return Colour(word, math.radians(hue), math.radians(GIVEN_TOLERANCE))
    raise UserError(
        f"colour {text!r} is not known; name one of {', '.join(NAMED)}, or give #rrggbb "
        "or hsv:h,s,v"
    )


def colour_pair(text: str) -> tuple[str, str]:
    """Read two different colours, ``FRONT,REAR``, as their names.

    Raises:
        UserError: if they are not two, or one is not known.
    """
    words = [word.strip() for word in re.findall(r"hsv[:(][^,]*,[^,]*,[^,]*|[^,]+", text)]
    if len(words) != 2 or words[0] == words[1]:
        raise UserError(
            f"{text!r}: expected two different colours, such as pink,blue, or a kind of tag, such "
            "as apriltag"
        )
    for word in words:
        parse_colour(word)  # says what colours there are
    return words[0], words[1]


def chroma_plane(image: NDArray, white: tuple[float, float] = NO_CAST) -> NDArray:
    """Return alpha and beta, float32 [2, ...], of BGR pixels [..., 3].

    ``white``: factors of blue and of red that first remove a colour cast.
    """
    pixels = np.asarray(image, np.float32)
    rows = pixels.reshape(len(pixels) if pixels.ndim > 1 else 1, -1, 3)
    return np.stack(
        cv2.split(cv2.transform(rows, _WEIGHTS * np.float32([white[0], 1.0, white[1]])))
    ).reshape(2, *pixels.shape[:-1])


def angle_between(a: float | NDArray, b: float | NDArray) -> NDArray:
    """Return a - b wrapped to (-pi, pi]."""
    return -np.remainder(np.subtract(b, a) + math.pi, 2 * math.pi) + math.pi


def _hue_part(hue: float, shift: float) -> float:
    """Return a channel's fraction of full light at a hue, 0..1."""
    distance = abs(math.degrees(float(angle_between(hue, math.radians(shift)))))
    return min(1.0, max(0.0, 2.0 - distance / 60.0))
