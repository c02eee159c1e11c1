"""This camera's idea of two named colours, and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking.colours import Colour
from tracking.markers import Look

#: A marker with this much chroma (of 255) cannot be taken for grey.
STRONG_CHROMA = 60.0


@dataclass(frozen=True)
class Found:
    """A marker's colour as a camera sees it.

    Attributes:
        colour: as it was named, with the hue that was found.
        chroma: of 255.
        rgb: the rim's colour, ``#rrggbb``, free of the picture's cast.
        sure: 0..1: how far its chroma is from grey, times how much better than any other patch
            of its colour it fits the pair, times the share of pictures in which it was found.
    """

    colour: Colour
    chroma: float
    rgb: str
    sure: float


def found_colour(colour: Colour, look: Look, rival: float) -> Found:
    """Return what a look says of a named colour.

    Args:
        colour: as it was named.
        look: of the marker that was taken for it.
        rival: how well the next best patch would have done, as a share of this one.
    """
    alpha, beta = look.chroma * np.asarray(look.direction, float)
    # Red, green and blue from alpha, beta and luma (Rec. 601).
    between = beta / math.sqrt(0.75)
    green = look.light + 0.114 * between - 0.299 * (alpha - 0.5 * between)
    rgb = np.array([green + alpha - 0.5 * between, green, green - between])
    rgb = np.clip(np.round(rgb), 0, 255).astype(int)
    return Found(
        replace(colour, hue=math.atan2(beta, alpha)),
        float(look.chroma),
        "#" + "".join(f"{channel:02x}" for channel in rgb),
        min(1.0, look.chroma / STRONG_CHROMA) / (1.0 + rival),
    )


def together(founds: Sequence[Found | None]) -> Found | None:
    """Return what several pictures say together; None where none shows the colour."""
    seen = [found for found in founds if found is not None]
    if not seen:
        return None
    hues = np.array([found.colour.hue for found in seen])
    hue = math.atan2(np.sin(hues).mean(), np.cos(hues).mean())
    middle = sorted(seen, key=lambda found: found.chroma)[len(seen) // 2]
    # Hues that differ from picture to picture are of different things.
    agreement = float(np.hypot(np.sin(hues).mean(), np.cos(hues).mean()))
    sure = sum(found.sure for found in seen) / len(founds) * agreement
    return replace(middle, colour=replace(middle.colour, hue=hue), sure=sure)


def find_colours(
    frames: Sequence[NDArray],
    colours: tuple[Colour, Colour],
    geometry: object | None = None,
) -> tuple[Found, Found] | None:
    """Find how a camera sees the colours of a pair of markers.

    Args:
        frames: BGR [H, W, 3] uint8; a handful from anywhere in a video.
        colours: of front and rear as they are named.
        geometry: what is known of the pair, a :class:`tracking.pair.Geometry`.

    Returns:
        Front and rear; None where no such pair is in any of the frames.
    """
    from tracking.tracker import Tracker

    pairs = []
    for frame in frames:
        tracker = Tracker(*colours, geometry)
        tracker.update(frame, 0.0)
        pairs.append(tracker.found or (None, None))
    front, rear = (together([pair[i] for pair in pairs]) for i in (0, 1))
    return None if front is None or rear is None else (front, rear)
