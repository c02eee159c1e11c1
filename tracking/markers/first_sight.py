"""The first sight of a pair: which two patches of the named colours are the markers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import Colour, angle_between
from tracking.markers.markers import LEAST_CHROMA, Blob, Measurement
from tracking.markers.pair import Geometry, angle_of

#: Largest deviation of the separation from its known value, before anything is learned.
FIRST_SEPARATION_TOLERANCE = 0.12
#: A marker is lighter than its background by this much luma at least.
LEAST_LIGHT = 5.0
#: A hue measured at full resolution may be this far beyond its colour's tolerance.
HUE_MARGIN = math.radians(8.0)
#: A click may miss a marker by this many pixels.
CLICK_REACH = 4.0
#: If the separation is unknown: its largest value, in sums of the two markers' radii
#: on most robots, and on nearly all.
CLOSE, REACH = 3.0, 4.0


def rate(
    pair: tuple[Blob, Blob],
    colours: tuple[Colour, Colour],
    geometry: Geometry,
    start: NDArray | None,
) -> float:
    """Rate two patches as a pair never seen before; 0 if they cannot be the pair.

    Args:
        pair: patches of the front's and of the rear's colour.
        colours: that were named.
        geometry: the known geometry of the pair.
        start: pixels [2, 2] of a point on or close to front and rear, or None.
    """
    front, rear = pair
    pixels = np.stack([front.centre, rear.centre])
    apart = float(np.hypot(*(front.centre - rear.centre)))
    rating = min(front.area, rear.area) / max(front.area, rear.area)
    if rating < 0.3:
        return 0.0
    rating *= (0.1 + front.contrast) * (0.1 + rear.contrast)
    for blob, colour in zip(pair, colours, strict=True):
        off = float(angle_between(blob.hue, colour.hue)) / colour.tolerance
        rating *= math.exp(-0.5 * off**2) * math.sqrt(blob.chroma / 255)
    if start is not None:
        for blob, place in zip(pair, start, strict=True):
            if not on_marker(blob.centre, blob.radius, place):
                return 0.0
            rating *= math.exp(-0.5 * (math.dist(blob.centre, place) / blob.radius) ** 2)
    if geometry.separation is not None:
        off = geometry.separation_of(pixels) / geometry.separation - 1.0
        if abs(off) > FIRST_SEPARATION_TOLERANCE:
            return 0.0
        rating *= math.exp(-0.5 * (off / 0.05) ** 2)
    else:
        radii = front.radius + rear.radius
        if not 0.6 * radii < apart < 8.0 * radii:
            return 0.0
        rating *= math.exp(-((apart / (REACH * radii)) ** 2))
    if geometry.diameter is not None:
        full = math.pi / 4 * geometry.diameter**2
        full *= geometry.pixels_per_unit(pixels.mean(axis=0)) ** 2
        for blob in pair:
            if not 0.3 < blob.area / full < 1.8:
                return 0.0
    return rating


def on_marker(centre: NDArray, radius: float, click: NDArray) -> bool:
    """Return whether a click is on a marker, or close to it; pixels."""
    return math.dist(centre, click) < 1.5 * radius + CLICK_REACH


def plausible(measured: list[Measurement], colours: tuple[Colour, Colour]) -> bool:
    """Return whether both look like markers of the colours that were named."""
    for measurement, colour in zip(measured, colours, strict=True):
        look = measurement.look
        off = abs(float(angle_between(angle_of(look.direction), colour.hue)))
        if off > colour.tolerance + HUE_MARGIN or look.chroma < LEAST_CHROMA:
            return False
        if look.light < LEAST_LIGHT:
            return False
    return True
