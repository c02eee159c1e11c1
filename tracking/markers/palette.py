"""This camera's idea of two named colours, and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import Colour, angle_between
from tracking.markers.markers import Look

#: A marker with this much chroma (of 255) cannot be taken for grey.
STRONG_CHROMA = 60.0
#: Less sure than this, and a person should look.
SURE_ENOUGH = 0.6
#: A pair that never moved may be a thing of the same colours, and is this sure at most.
STILL_SURE = 0.5

GREY = "it is close to grey"
RIVAL = "something else of this colour fits nearly as well"
OTHER_HUE = "it is nearly another colour"
APART = "the two are far apart for their size"
STILL = "the pair never moves"


@dataclass(frozen=True)
class Found:
    """A marker's colour as a camera sees it.

    Attributes:
        colour: as it was named, with the hue that was found.
        chroma: of 255.
        rgb: the rim's colour, ``#rrggbb``, free of the picture's cast.
        sure: 0..1: how far its chroma is from grey, times how much better than any other patch
            of its colour it fits the pair, times how well its hue fits the name, times how
            close the pair stands together; over pictures, the mean.
        doubt: what makes it least sure.
    """

    colour: Colour
    chroma: float
    rgb: str
    sure: float
    doubt: str = ""

    @property
    def told(self) -> dict[str, Any]:
        """What files say of it."""
        return {
            "colour": self.colour.name,
            "rgb": self.rgb,
            "hue_deg": math.degrees(self.colour.hue) % 360,
            "chroma": self.chroma,
            "sure": round(self.sure, 3),
            "doubt": self.doubt if self.sure < SURE_ENOUGH else None,
        }


def found_colour(colour: Colour, look: Look, rival: float, together: float = 1.0) -> Found:
    """Return what a look says of a named colour.

    Args:
        colour: as it was named.
        look: of the marker that was taken for it.
        rival: how well the next best patch would have done, as a share of this one.
        together: how close the pair stands for its size, 0..1.
    """
    alpha, beta = look.chroma * np.asarray(look.direction, float)
    # Red, green and blue from alpha, beta and luma (Rec. 601).
    between = beta / math.sqrt(0.75)
    green = look.light + 0.114 * between - 0.299 * (alpha - 0.5 * between)
    rgb = np.array([green + alpha - 0.5 * between, green, green - between])
    rgb = np.clip(np.round(rgb), 0, 255).astype(int)
    hue = math.atan2(beta, alpha)
    off = float(angle_between(hue, colour.hue)) / colour.tolerance
    shares = {
        GREY: min(1.0, look.chroma / STRONG_CHROMA),
        RIVAL: 1.0 / (1.0 + rival),
        OTHER_HUE: math.exp(-0.5 * off**4),
        APART: together,
    }
    return Found(
        replace(colour, hue=hue),
        float(look.chroma),
        "#" + "".join(f"{channel:02x}" for channel in rgb),
        math.prod(shares.values()),
        min(shares, key=shares.get),
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
    doubt = min(seen, key=lambda found: found.sure).doubt
    return replace(middle, colour=replace(middle.colour, hue=hue), sure=sure, doubt=doubt)


def unless_still(founds: Sequence[Found], front: NDArray, rear: NDArray) -> tuple[Found, ...]:
    """Return what was found, less sure where the pair [N, 2] and [N, 2] (pixels) never moves."""
    apart = np.nanmedian(np.hypot(*(front - rear).T))
    both = np.concatenate([front, rear], axis=1)
    reach = np.max(np.nanmax(both, axis=0) - np.nanmin(both, axis=0))
    if reach > 0.5 * apart:
        return tuple(founds)
    return tuple(
        replace(found, sure=STILL_SURE, doubt=STILL) if found.sure > STILL_SURE else found
        for found in founds
    )


def least_sure(sessions: Sequence[Mapping[str, Any]]) -> Mapping[str, Mapping[str, Any]]:
    """Return the ``markers`` of that session of tracking.json in which they are least sure."""
    told = [session["markers"] for session in sessions if "markers" in session]

    def sure(markers: Mapping[str, Mapping[str, Any]]) -> float:
        return min(seen.get("sure", 1.0) for seen in markers.values())

    return min(told, key=sure, default={})


def in_words(markers: Mapping[str, Mapping[str, Any]]) -> str:
    """Say what files say of the colours of ``front`` and ``rear``, in a line."""
    return ", ".join(
        f"{where} {seen['colour']} is {seen['rgb']} here (sure: {100 * seen['sure']:.0f} %)"
        for where, seen in markers.items()
        if "rgb" in seen
    )


def warning(markers: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Return what a person should know of colours that are not sure; None where they are."""
    doubts: dict[str, list[str]] = {}
    for where, seen in markers.items():
        if seen.get("doubt"):
            doubts.setdefault(seen["doubt"], []).append(f"{where} {seen['colour']}")
    if not doubts:
        return None
    told = "; ".join(f"{' and '.join(which)}: {doubt}" for doubt, which in doubts.items())
    return f"it is not sure that these are the robot's markers ({told})"
