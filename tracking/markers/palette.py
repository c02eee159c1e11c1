"""The colours of two markers as a camera sees them, with a confidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import Colour, angle_between
from tracking.markers.markers import Look

#: A marker with this much chroma (of 255), or in little light with this fraction of its brightest
#: channel, cannot be mistaken for grey.
STRONG_CHROMA, STRONG_SATURATION = 60.0, 0.6
#: Below this confidence a person should look.
CONFIDENT = 0.6
#: A pair that never moved may be another object of the same colours, and has this confidence at
#: most.
STILL_CONFIDENCE = 0.5

GREY = "it is close to grey"
RIVAL = "something else of this colour fits nearly as well"
OTHER_HUE = "it is nearly another colour"
APART = "the two are far apart for their size"
STILL = "the pair never moves"


@dataclass(frozen=True)
class SeenColour:
    """A marker's colour as a camera sees it.

    Attributes:
        colour: the named colour, with its measured hue.
        chroma: of 255.
        rgb: the rim's colour, ``#rrggbb``, free of the picture's cast.
        confidence: 0..1: how far its chroma is from grey, times how much better than any other
            patch of its colour it fits the pair, times how well its hue fits the name, times how
            close the pair stands together; over pictures, the mean.
        reason: the main cause of a low confidence.
    """

    colour: Colour
    chroma: float
    rgb: str
    confidence: float
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "colour": self.colour.name,
            "rgb": self.rgb,
            "hue_deg": math.degrees(self.colour.hue) % 360,
            "chroma": self.chroma,
            "confidence": round(self.confidence, 3),
            "reason": self.reason if self.confidence < CONFIDENT else None,
        }


def seen_colour(colour: Colour, look: Look, rival: float, together: float = 1.0) -> SeenColour:
    """Return a named colour as a camera sees it.

    Args:
        colour: as it was named.
        look: of the marker of this colour.
        rival: fit of the next best patch, as a fraction of this one's.
        together: how close the pair stands for its size, 0..1.
    """
    rgb = np.clip(np.round(look.rgb), 0, 255).astype(int)
    hue = math.atan2(look.direction[1], look.direction[0])
    off = float(angle_between(hue, colour.hue)) / colour.tolerance
    fractions = {
        GREY: min(1.0, look.chroma / min(STRONG_CHROMA, STRONG_SATURATION * look.rgb.max())),
        RIVAL: 1.0 / (1.0 + rival),
        OTHER_HUE: math.exp(-0.5 * off**4),
        APART: together,
    }
    return SeenColour(
        replace(colour, hue=hue),
        float(look.chroma),
        "#" + "".join(f"{channel:02x}" for channel in rgb),
        math.prod(fractions.values()),
        min(fractions, key=fractions.get),
    )


def together(colours: Sequence[SeenColour | None]) -> SeenColour | None:
    """Return the result of several pictures; None where none shows the colour."""
    seen = [colour for colour in colours if colour is not None]
    if not seen:
        return None
    hues = np.array([colour.colour.hue for colour in seen])
    hue = math.atan2(np.sin(hues).mean(), np.cos(hues).mean())
    middle = sorted(seen, key=lambda colour: colour.chroma)[len(seen) // 2]
    # Hues that differ from picture to picture are of different objects.
    agreement = float(np.hypot(np.sin(hues).mean(), np.cos(hues).mean()))
    confidence = sum(colour.confidence for colour in seen) / len(colours) * agreement
    reason = min(seen, key=lambda colour: colour.confidence).reason
    return replace(
        middle, colour=replace(middle.colour, hue=hue), confidence=confidence, reason=reason
    )


def unless_still(
    colours: Sequence[SeenColour], front: NDArray, rear: NDArray
) -> tuple[SeenColour, ...]:
    """Return the colours, less certain if the pair, [N, 2] each (pixels), never moves."""
    apart = np.nanmedian(np.hypot(*(front - rear).T))
    both = np.concatenate([front, rear], axis=1)
    reach = np.max(np.nanmax(both, axis=0) - np.nanmin(both, axis=0))
    if reach > 0.5 * apart:
        return tuple(colours)
    return tuple(
        replace(colour, confidence=STILL_CONFIDENCE, reason=STILL)
        if colour.confidence > STILL_CONFIDENCE
        else colour
        for colour in colours
    )


def least_confident(sessions: Sequence[Mapping[str, Any]]) -> Mapping[str, Mapping[str, Any]]:
    """Return the ``markers`` of that session of tracking.json with the lowest confidence."""
    every = [session["markers"] for session in sessions if "markers" in session]

    def confidence(markers: Mapping[str, Mapping[str, Any]]) -> float:
        return min(seen.get("confidence", 1.0) for seen in markers.values())

    return min(every, key=confidence, default={})


def describe_markers(markers: Mapping[str, Mapping[str, Any]]) -> str:
    """Describe the colours of ``front`` and ``rear``, or a tag, in a line."""
    tag = markers.get("tag")
    if tag:
        others = ", ".join(map(str, tag.get("others") or ()))
        return f"tag {tag['id']} of {tag['dictionary']}" + (
            f", others in view: {others}" if others else ""
        )
    return ", ".join(
        f"{where} {seen['colour']} is {seen['rgb']} here "
        f"(confidence: {100 * seen['confidence']:.0f} %)"
        for where, seen in markers.items()
        if "rgb" in seen
    )


def warning(markers: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Return a warning about colours of low confidence; None if there are none."""
    reasons: dict[str, list[str]] = {}
    for where, seen in markers.items():
        if seen.get("reason"):
            reasons.setdefault(seen["reason"], []).append(f"{where} {seen['colour']}")
    if not reasons:
        return None
    listed = "; ".join(f"{' and '.join(which)}: {reason}" for reason, which in reasons.items())
    return f"these may not be the robot's markers ({listed})"
