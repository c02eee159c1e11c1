"""The tracker of one printed tag: found by OpenCV's detector, followed by a fit of its pattern."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.markers.pair import (
    LOST,
    Geometry,
    Motion,
    Sighting,
    angle_of,
    is_searched,
    lamp_luma,
    middle_of,
)
from tracking.markers.tag_fit import Placed, fit
from tracking.markers.tags import Tag

#: Least correlation of a tag with the pattern, and the fraction of it that must be visible.
LEAST_LIKENESS, LEAST_SEEN = 0.8, 0.75
#: After this time without a frame (s) its number is read again, because another tag may be there.
FOLLOWED_FOR = 0.5
#: Largest deviation of a plausible side, as a fraction of the known or learned side.
SIDE_TOLERANCE = 0.08
#: A tag is searched in a picture in which its side has about this many pixels, or in the whole one.
SEARCH_SIDE = 36.0
#: Largest enlargement of pictures for the search, and largest number of their pixels.
MOST_ENLARGED, MOST_PIXELS = 3, 2_500_000


class TagTracker:
    """Tracks one tag through the frames of one video part, in order.

    Its two points are the middles of the front and the rear edge of its black square: a pair of
    points, as two markers are. Front is the upper edge, as the tag is printed.

    Args:
        tag: the tag to track.
        geometry: the known geometry of the pair; its separation is the side of the black square.
    """

    def __init__(self, tag: Tag, geometry: Geometry | None = None):
        self.tag = tag
        self.geometry = geometry or Geometry()
        self._detector = _detector(tag)
        self._side = self.geometry.separation
        self._placed: Placed | None = None
        self._motion: Motion | None = None
        self._lost = 0
        #: Numbers of other tags of the dictionary that were seen while this one was searched.
        self.others: set[int] = set()
        #: Frames with several copies of this tag, which were refused.
        self.undecided = 0
        #: Whether the tag was ever found.
        self.ever_seen = False

    @property
    def seen_colours(self) -> None:
        """A tag has no colours that could be mistaken."""
        return None

    def update(self, frame: NDArray, time: float) -> Sighting:
        """Find the tag in the next frame.

        Args:
            frame: BGR [H, W, 3] uint8.
            time: in seconds, later than the frame before.
        """
        motion = self._motion
        followed = motion is not None and not self._lost and time - motion.time < FOLLOWED_FOR
        placed = self._follow(frame, time) if followed else None
        if placed is None and is_searched(self._lost):
            placed = self._search(frame)
        if placed is None:
            self._lost += 1
            return LOST
        pixels = self._ends(placed)
        quality = self._quality(placed, pixels)
        self._motion = Motion.of(None if self._lost else self._motion, time, pixels)
        self._placed, self._lost, self.ever_seen = placed, 0, True
        apart = self.geometry.separation_of(pixels)
        self._side = apart if self._side is None else self._side
        if self.geometry.separation is None:
            self._side += 0.03 * (apart - self._side)
        return Sighting(*pixels, quality, lamp_luma(frame, pixels, self.geometry.lamp, 0.0))

    def _follow(self, frame: NDArray, time: float) -> Placed | None:
        """Return the tag near its predicted place and heading; None if it is not there."""
        before = self._motion.pixels
        ahead = self._motion.predict(time)
        turn = angle_of(ahead[0] - ahead[1]) - angle_of(before[0] - before[1])
        cos, sin = math.cos(turn), math.sin(turn)
        guess = Placed(middle_of(ahead), np.array([[cos, -sin], [sin, cos]]) @ self._placed.axes)
        fitted = self._fit(_grey_around(frame, guess, 1.0), guess)
        if fitted is not None:
            return fitted
        part = _grey_around(frame, guess, 2.0 + 30.0 * (time - self._motion.time))
        seen = self._detect(*part, min(_enlargement(guess.side), MOST_ENLARGED))
        return seen[0] if len(seen) == 1 else None

    def _search(self, frame: NDArray) -> Placed | None:
        """Return the tag anywhere in a frame; None if it is not in view, or several times."""
        part = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.zeros(2, int)
        for factor in self._enlargements(part[0]):
            seen = self._detect(*part, factor)
            self.undecided += len(seen) > 1
            if seen:
                return seen[0] if len(seen) == 1 else None
        return None

    def _enlargements(self, grey: NDArray) -> Iterator[int]:
        """Yield the enlargements of a picture for a search, one after the other."""
        most = _most_enlarged(grey)
        middle = (np.array(grey.shape[::-1]) - 1) / 2
        if self._side is None:
            yield from range(1, most + 1)
        else:
            side = self._side * self.geometry.pixels_per_unit(middle)
            yield min(_enlargement(side), most)

    def _detect(self, grey: NDArray, origin: NDArray, factor: int) -> list[Placed]:
        """Return all of this tag in a part of a picture, from ``origin`` on, px, fitted."""
        if min(grey.shape) < 8:
            return []
        corners, numbers = _seen(self._detector, grey, factor)
        self.others |= {number for number in numbers if number != self.tag.number}
        tags = []
        for number, corner in zip(numbers, corners, strict=True):
            if number == self.tag.number:
                fitted = self._fit((grey, origin), Placed.of_corners(corner + origin))
                tags += [] if fitted is None else [fitted]
        return tags

    def _fit(self, part: tuple[NDArray, NDArray], guess: Placed) -> Placed | None:
        """Return the tag near a guess, in a part of a picture with its origin; None: not there."""
        grey, origin = part
        placed = fit(grey, self.tag, replace(guess, centre=guess.centre - origin))
        if placed is None or placed.likeness < LEAST_LIKENESS or placed.seen < LEAST_SEEN:
            return None
        placed = replace(placed, centre=placed.centre + origin)
        return placed if self._quality(placed, self._ends(placed)) > 0 else None

    def _quality(self, placed: Placed, pixels: NDArray) -> float:
        """Rate a tag, 1 as expected; 0 if its size is impossible."""
        off = 0.0
        if self._side is not None:
            off = self.geometry.separation_of(pixels) / self._side - 1.0
        if abs(off) > SIDE_TOLERANCE:
            return 0.0
        return placed.likeness * placed.seen * math.exp(-0.5 * (off / 0.04) ** 2)

    def _ends(self, placed: Placed) -> NDArray:
        """Return the middles of the front and the rear edge, [2, 2] px, of the best square.

        In the plane in which its sides are equal, both axes of the tag give its heading.
        """
        steps = placed.centre + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        zero, right, down = self.geometry.plane(steps)
        plane = np.stack([right - zero, down - zero], axis=1)
        (a, b), (c, d) = plane @ placed.axes
        mirror = math.copysign(1.0, a * d - b * c)
        angle = math.atan2(c - mirror * b, a + mirror * d)
        cos, sin = math.cos(angle), math.sin(angle)
        side = ((a + mirror * d) * cos + (c - mirror * b) * sin) / 2
        half = np.linalg.solve(plane, mirror * side / 2 * np.array([sin, -cos]))
        return np.array([placed.centre + half, placed.centre - half])


def numbers_in(frame: NDArray, tag: Tag) -> set[int]:
    """Return the numbers of all tags in a frame, BGR [H, W, 3] uint8, of a tag's dictionary."""
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    detector = _detector(tag)
    factors = range(1, _most_enlarged(grey) + 1)
    return {number for factor in factors for number in _seen(detector, grey, factor)[1]}


def _detector(tag: Tag) -> cv2.aruco.ArucoDetector:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(tag.words, settings)


def _seen(
    detector: cv2.aruco.ArucoDetector, grey: NDArray, factor: int
) -> tuple[list[NDArray], list[int]]:
    """Return the corners, [4, 2] px each, and the numbers of all tags in an enlarged picture."""
    large = grey
    if factor > 1:
        large = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    corners, numbers, _ = detector.detectMarkers(large)
    places = [(corner.reshape(4, 2).astype(float) + 0.5) / factor - 0.5 for corner in corners]
    return places, [] if numbers is None else np.ravel(numbers).tolist()


def _most_enlarged(grey: NDArray) -> int:
    return max(1, min(MOST_ENLARGED, math.isqrt(MOST_PIXELS // grey.size)))


def _enlargement(side: float) -> int:
    """Return the enlargement of a picture to search for a tag whose side has this many pixels."""
    return max(1, math.ceil(SEARCH_SIDE / max(side, 1.0)))


def _grey_around(frame: NDArray, placed: Placed, margin: float) -> tuple[NDArray, NDArray]:
    """Return the part of a frame around a tag, grey, and its origin (px).

    Args:
        frame: BGR [H, W, 3] uint8.
        placed: the tag.
        margin: beyond it, in its sides.
    """
    reach = (0.75 + margin) * placed.side
    size = frame.shape[1::-1]
    low = np.clip(np.floor(placed.centre - reach), 0, size).astype(int)
    high = np.clip(np.ceil(placed.centre + reach), 0, size).astype(int)
    part = frame[low[1] : high[1], low[0] : high[0]]
    return (cv2.cvtColor(part, cv2.COLOR_BGR2GRAY) if part.size else part[..., 0]), low
