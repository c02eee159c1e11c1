"""What a person points at in a picture: a marker's colour, the corners of the board."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from tracking.calibrate import locate
from tracking.camera_model import CameraModel
from tracking.colours import Colour, angle_between, chroma_plane, parse_colour
from tracking.markers import LEAST_CHROMA, Picture

#: Where one clicks lies within this share of the picture's width of the colour that is meant.
REACH = 1 / 80
#: Pixels this far in hue from the commonest one around a click are something else.
SAME_HUE = math.radians(25)
#: Hues nearer than this are not told apart safely, light and camera being what they are.
APART = math.radians(40)

#: A camera's picture is this wide where nothing says otherwise: about 58 degrees.
USUAL_FOCAL_LENGTH = 0.9


@dataclass(frozen=True)
class Pointed:
    """A colour that was pointed at.

    Attributes:
        colour: named ``#rrggbb``, as options and files take it.
        chroma: how colourful it is, 0 grey to 255.
        share: of the pixels around the click that are of it, 0..1.
        places: patches of this colour in the whole picture.
    """

    colour: Colour
    chroma: float
    share: float
    places: int

    @property
    def sure(self) -> float:
        """How sure it is that a marker of this colour will be found, 0..1."""
        strong = min(1.0, self.chroma / 90.0)
        return strong * (1.0 if self.places == 1 else 0.7 if self.places == 2 else 0.5)


def colour_at(frame: NDArray, pixel: ArrayLike) -> Pointed:
    """Learn the colour of what is at a pixel.

    A marker may fade to white where it is clicked, and the click may miss a little: the
    commonest hue around it counts.

    Args:
        frame: BGR [H, W, 3] uint8.
        pixel: u and v.

    Raises:
        UserError: if there is nothing but grey.
    """
    colour, chroma, share = colour_around(frame, pixel)
    return Pointed(colour, chroma, share, len(Picture(frame).blobs(colour)))


def colour_around(frame: NDArray, pixel: ArrayLike) -> tuple[Colour, float, float]:
    """Return the commonest colour around a pixel, its chroma, and its share of the pixels there.

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


def told_apart(a: Colour, b: Colour) -> bool:
    """Return whether two markers of these colours cannot be taken for each other."""
    return abs(float(angle_between(a.hue, b.hue))) >= APART


def camera_over_board(
    image_size: tuple[int, int],
    points: ArrayLike,
    lens: CameraModel | None = None,
    height: float | None = None,
) -> CameraModel:
    """Return the camera that sees points of the board where a person pointed at them.

    Without a lens the camera is taken for a pinhole with square pixels and its axis through the
    picture's middle. Points on a plane that is seen from straight above say nothing of its focal
    length; with the camera's height it is found, and without it is taken to be a usual one. For
    what lies on the board that is of no account; a marker 10 cm above it is displaced by a few
    millimetres at the picture's edge where the height is wrong by a tenth.

    Args:
        image_size: width and height in pixels.
        points: [N, 4], u and v in pixels, x and y in metres on the board; at least 4.
        lens: a calibration of the lens.
        height: of the camera above the board, in metres.

    Raises:
        UserError: as :func:`tracking.calibrate.locate` does, or if the lens is of another size of
            picture, or no camera at that height sees the points there.
    """
    if lens is not None:
        if tuple(lens.image_size) != tuple(image_size):
            raise UserError(
                f"the calibration is of pictures of {lens.image_size[0]}x{lens.image_size[1]}, but "
                f"the camera's are {image_size[0]}x{image_size[1]}"
            )
        return locate(lens, points)
    usual = USUAL_FOCAL_LENGTH * image_size[0]
    if height is None:
        return locate(_pinhole(image_size, usual), points)
    # The height that the points ask for grows with the focal length.
    low, high = 0.2 * usual, 5.0 * usual
    if not _height(image_size, low, points) <= height <= _height(image_size, high, points):
        raise UserError(
            f"no usual camera {height:g} m above the board sees its corners there; check the "
            "camera's height and the board's measures"
        )
    for _ in range(30):
        middle = (low + high) / 2
        if _height(image_size, middle, points) < height:
            low = middle
        else:
            high = middle
    return locate(_pinhole(image_size, (low + high) / 2), points)


def _pinhole(size: tuple[int, int], focal_length: float) -> CameraModel:
    matrix = np.array(
        [[focal_length, 0, (size[0] - 1) / 2], [0, focal_length, (size[1] - 1) / 2], [0, 0, 1]]
    )
    return CameraModel(size, matrix, np.zeros(5))


def _height(size: tuple[int, int], focal_length: float, points: ArrayLike) -> float:
    return float(locate(_pinhole(size, focal_length), points).position[2])
