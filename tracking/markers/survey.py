"""Searches whole pictures, now and then, for another pair that would fit as well."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import Colour
from tracking.markers.first_sight import CLOSE, rate
from tracking.markers.markers import Blob, Look, Picture, shrink_factor
from tracking.markers.pair import Geometry
from tracking.markers.palette import SeenColour, seen_colour, together

#: Width of the searched picture, pixels.
ACROSS = 320
#: Frames between the first look and the second; the interval then doubles each time.
SECOND_LOOK = 64


class Survey:
    """Looks at whole pictures in which a pair was found, less and less often.

    Args:
        colours: of front and rear, as they were named.
        geometry: the known geometry of the pair.
        pointed: whether a person pointed at the pair, so that no other can be meant.
    """

    def __init__(self, colours: tuple[Colour, Colour], geometry: Geometry, pointed: bool = False):
        self._colours, self._geometry, self._pointed = colours, geometry, pointed
        self._frames, self._next = 0, 1
        self._looked: list[tuple[SeenColour, SeenColour]] = []
        #: The result of all looks together; None before the first.
        self.seen_colours: tuple[SeenColour, SeenColour] | None = None

    def take(
        self,
        frame: NDArray,
        white: tuple[float, float],
        pixels: NDArray,
        areas: Sequence[float],
        looks: Sequence[Look],
    ) -> None:
        """Take the next frame in which the pair was found, and look at it if its turn has come.

        Args:
            frame: BGR [H, W, 3] uint8.
            white: factors of blue and of red that remove the picture's cast.
            pixels: [2, 2] of front and rear.
            areas: of the two markers, pixels.
            looks: their appearance.
        """
        self._frames += 1
        if self._frames < self._next:
            return
        self._next = max(2 * self._next, SECOND_LOOK)
        radii = [math.sqrt(area / math.pi) for area in areas]
        rivals: tuple[float, float] | None = (0.0, 0.0)
        if not self._pointed:
            # Markers of a few pixels are not seen in the coarse picture.
            factor = shrink_factor(frame.shape[1])
            coarse = max(factor, frame.shape[1] // ACROSS)
            rivals = self._rivals(frame, white, pixels, radii, coarse)
            rivals = rivals or self._rivals(frame, white, pixels, radii, factor)
        if rivals is None:
            if self._looked:
                return
            rivals = (0.0, 0.0)
        close = 1.0
        if self._geometry.separation is None and not self._pointed:
            apart = float(np.hypot(*(pixels[0] - pixels[1]))) / sum(radii)
            close = math.exp(-0.5 * max(0.0, apart - CLOSE) ** 2)
        front, rear = (
            seen_colour(colour, look, rival, close)
            for colour, look, rival in zip(self._colours, looks, rivals, strict=True)
        )
        self._looked.append((front, rear))
        front, rear = (together(colours) for colours in zip(*self._looked, strict=True))
        self.seen_colours = front, rear

    def _rivals(
        self,
        frame: NDArray,
        white: tuple[float, float],
        pixels: NDArray,
        radii: Sequence[float],
        factor: int,
    ) -> tuple[float, float] | None:
        """Return the fits of the best pairs with another front or rear, relative to this one.

        None if this one is too small, or too much like its surroundings, to be compared in a
        picture that is reduced by this factor.
        """
        picture = Picture(frame, white, factor)
        blobs = [picture.blobs(colour) for colour in self._colours]

        def is_own(blob: Blob, which: int) -> bool:
            reach = radii[which] + picture.factor
            return math.dist(blob.centre, pixels[which]) < reach

        own, best = 0.0, [0.0, 0.0]
        for pair in itertools.product(*blobs):
            rating = rate(pair, self._colours, self._geometry, None)
            mine = [is_own(blob, which) for which, blob in enumerate(pair)]
            if all(mine):
                own = max(own, rating)
            for which in (0, 1):
                if not mine[which]:
                    best[which] = max(best[which], rating)
        if own <= 0.0:
            return None
        return best[0] / own, best[1] / own
