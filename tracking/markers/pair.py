"""A pair of markers: its geometry, its sightings, its learned properties, and its motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import angle_between
from tracking.markers.markers import Look
from tracking.markers.patches import mean_luma

#: While a robot is lost every frame is searched for a while, then only every few.
SEARCH_EVERY_FRAME, SEARCH_CADENCE = 30, 4


@dataclass(frozen=True)
class Geometry:
    """The geometry of the pair that is known before the first frame.

    Attributes:
        to_plane: pixels [N, 2] to coordinates [N, 2] in which the separation is constant; board
            metres at marker height where the camera is calibrated, the pixels themselves else.
        separation: between the two centres, in that plane; None to learn it.
        diameter: of a marker, likewise.
        lamp: where the lamp is: the fraction of the way from the rear to the front marker, and to
            the left of it as a fraction of the separation.
    """

    to_plane: Callable[[NDArray], NDArray] | None = None
    separation: float | None = None
    diameter: float | None = None
    lamp: tuple[float, float] = (0.5, 0.0)

    def plane(self, pixels: NDArray) -> NDArray:
        """Return plane coordinates [N, 2] of pixels [N, 2]."""
        return pixels if self.to_plane is None else self.to_plane(pixels)

    def separation_of(self, pixels: NDArray) -> float:
        """Return the distance between front and rear, [2, 2] pixels, in the plane."""
        front, rear = self.plane(pixels)
        return math.hypot(front[0] - rear[0], front[1] - rear[1])

    def pixels_per_unit(self, pixel: NDArray) -> float:
        """Return the local scale of the image."""
        if self.to_plane is None:
            return 1.0
        a, b, c = self.to_plane(pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        (p, q), (r, s) = b - a, c - a
        return 1.0 / math.sqrt(max(abs(p * s - q * r), 1e-18))


@dataclass(frozen=True)
class Sighting:
    """The robot in one frame.

    Attributes:
        front, rear: pixels [2] of the two centres, NaN where the pair was not found.
        quality: 0 not found, up to 1 as expected.
        lamp: mean luma where the lamp is, NaN where the pair was not found.
    """

    front: NDArray
    rear: NDArray
    quality: float
    lamp: float

    @property
    def in_view(self) -> bool:
        """Whether both markers were found."""
        return self.quality > 0


LOST = Sighting(np.full(2, np.nan), np.full(2, np.nan), 0.0, math.nan)


@dataclass
class Learned:
    """The learned properties of the pair; areas in plane units squared."""

    looks: list[Look]
    areas: list[float]
    separation: float
    frames: int = 0


def is_searched(lost: int) -> bool:
    """Return whether the whole frame is searched after this many frames without the pair."""
    return lost < SEARCH_EVERY_FRAME or lost % SEARCH_CADENCE == 0


@dataclass
class Motion:
    """The pair's last place and its motion, in pixels."""

    time: float
    middle: NDArray
    axis: NDArray  # from rear to front
    velocity: NDArray = field(default_factory=lambda: np.zeros(2))
    turning: float = 0.0

    @classmethod
    def of(cls, before: Motion | None, time: float, pixels: NDArray) -> Motion:
        """Return the motion at a pair of centres, [2, 2], after the motion before it, if any."""
        if before is not None:
            return before.after(time, pixels)
        return cls(time, middle_of(pixels), pixels[0] - pixels[1])

    @property
    def pixels(self) -> NDArray:
        """The pixels of front and rear at that time, [2, 2]."""
        return np.array([self.middle + self.axis / 2, self.middle - self.axis / 2])

    def predict(self, time: float) -> NDArray:
        """Return where front and rear will be, [2, 2]."""
        # A prediction far ahead is useless; the pair has more likely stopped.
        ahead = min(time - self.time, 0.2)
        (u, v), (du, dv), (across, down) = (
            pair.tolist() for pair in (self.middle, self.velocity, self.axis)
        )
        u, v = u + du * ahead, v + dv * ahead
        cos, sin = math.cos(self.turning * ahead), math.sin(self.turning * ahead)
        across, down = (cos * across - sin * down) / 2, (sin * across + cos * down) / 2
        return np.array([[u + across, v + down], [u - across, v - down]])

    def after(self, time: float, pixels: NDArray) -> Motion:
        """Return the motion with one more pair of centres."""
        middle, axis = middle_of(pixels), pixels[0] - pixels[1]
        gap = time - self.time
        if not 0 < gap < 0.5:
            return Motion.of(None, time, pixels)
        turned = float(angle_between(angle_of(axis), angle_of(self.axis)))
        return Motion(time, middle, axis, (middle - self.middle) / gap, turned / gap)


@dataclass
class Strangers:
    """Pairs that look like a lost one but were elsewhere when it was lost.

    Attributes:
        reach: largest motion of a pair between two looks, px.
        places: of their middles, [2] each, px.
    """

    reach: float = 0.0
    places: list[NDArray] = field(default_factory=list)

    def near(self, place: NDArray) -> bool:
        """Return whether one of them may be at a place."""
        return any(math.dist(place, known) < self.reach for known in self.places)

    def follow(self, seen: list[NDArray]) -> list[NDArray]:
        """Follow them to the places of the pairs seen now, and return their places."""
        left, theirs = list(range(len(seen))), []
        for i, known in enumerate(self.places):
            nearest = min(left, key=lambda k: math.dist(seen[k], known), default=None)
            if nearest is not None and math.dist(seen[nearest], known) < self.reach:
                left.remove(nearest)
                self.places[i] = seen[nearest]
                theirs.append(seen[nearest])
        return theirs


def lamp_luma(frame: NDArray, pixels: NDArray, place: tuple[float, float], rim: float) -> float:
    """Return the mean luma around the lamp, between the markers' rims; NaN if there is no room.

    Args:
        frame: BGR [H, W, 3] uint8.
        pixels: [2, 2] of front and rear.
        place: of the lamp, as in :attr:`Geometry.lamp`.
        rim: radius of the larger marker, px.
    """
    (front_u, front_v), (rear_u, rear_v) = pixels.tolist()
    axis_u, axis_v = front_u - rear_u, front_v - rear_v
    ahead, aside = place
    # Left of the robot is clockwise from ahead as the image's v runs down.
    u, v = rear_u + ahead * axis_u + aside * axis_v, rear_v + ahead * axis_v - aside * axis_u
    nearest = min(math.hypot(u - front_u, v - front_v), math.hypot(u - rear_u, v - rear_v))
    reach = min(max(nearest - rim - 1.0, 0.0), 0.3 * math.hypot(axis_u, axis_v))
    return math.nan if reach < 1.0 else mean_luma(frame, u, v, reach)


def middle_of(pixels: NDArray) -> NDArray:
    """Return the point half way between front and rear, [2, 2]."""
    return (pixels[0] + pixels[1]) / 2


def angle_of(axis: NDArray) -> float:
    """Return the direction of an axis [2], in radians."""
    return math.atan2(axis[1], axis[0])
