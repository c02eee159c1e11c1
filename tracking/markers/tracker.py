"""The tracker: two markers from frame to frame, as one rigid pair.

A whole frame is searched only until the pair is found and after it was lost; from then on each
marker is measured in a small window around where constant velocity and constant turning put
it. The pair's separation, the markers' sizes and their last place are what keep other things of
the same colours out; a frame in which any of them does not fit has no pose.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import NO_CAST, Colour, angle_between
from tracking.markers.first_sight import FIRST_SEPARATION_TOLERANCE, on_marker, plausible, rate
from tracking.markers.markers import (
    Look,
    Measurement,
    Picture,
    compile_loops,
    learn,
    measure,
)
from tracking.markers.noise import passes_for
from tracking.markers.pair import (
    LOST,
    SEARCH_CADENCE,
    Geometry,
    Learned,
    Motion,
    Sighting,
    Strangers,
    angle_of,
    is_searched,
    lamp_luma,
    middle_of,
)
from tracking.markers.palette import SeenColour
from tracking.markers.survey import Survey
from tracking.markers.white import Cast, cast_of

#: Plausible marker areas and separations, as ratios to the expected ones.
AREA_RATIO = (0.70, 1.45)
SEPARATION_TOLERANCE = 0.08
#: The first time, with nothing learned yet.
FIRST_AREA_RATIO = (0.4, 2.2)

#: A pair that fits worse than this may be another object, and is not written.
LEAST_QUALITY = 0.05

#: Largest distance of the pair from the place of its loss: separations, and separations per second.
REACH, REACH_PER_SECOND = 1.0, 12.0
#: Largest turn since then: radians, and radians per second.
TURN, TURN_PER_SECOND = 0.7, 8.0
#: After this many seconds it may be anywhere: a hand may have moved it.
FORGET_AFTER = 2.0

#: A pair that fits elsewhere within this time after a loss (s) is another pair.
ELSEWHERE_WITHIN = 0.3

#: The image's scale is worked out again after the pair moved by this many pixels.
SCALE_REACH = 4.0
#: Number of frames between two measurements of the cast.
CAST_CADENCE = 8
#: Smallest factor of a cast that is worth removing.
CAST_TRIED = 1.06

#: The light has changed between two pictures if its level has changed by this factor.
LIGHT_CHANGED = 1.1

#: With nothing known of the separation, a pair that was seen in fewer frames and then lost for so
#: many is forgotten, and tracking begins again.
PASSING, DROP_AFTER = 15, 8

#: A patch of fewer pixels is no sign that a marker of its colour was ever in view.
SEEN_AREA = 20.0


class Tracker:
    """Tracks one pair of markers through the frames of one video part, in order.

    Args:
        front, rear: the markers' colours.
        geometry: the known geometry of the pair.
        start: pixels [2, 2] of a point on front and on rear in the first frame. No other pair is
            tracked: without a pair there in the first frame, no frame has one.
    """

    def __init__(
        self,
        front: Colour,
        rear: Colour,
        geometry: Geometry | None = None,
        start: NDArray | None = None,
    ):
        compile_loops()
        self._start = start
        self.colours = (front, rear)
        self.geometry = geometry or Geometry()
        self._survey = Survey(self.colours, self.geometry, start is not None)
        self._forgotten: tuple[SeenColour, SeenColour] | None = None
        self._learned: Learned | None = None
        self._motion: Motion | None = None
        self._cast: Cast | None = None
        # The level of the light in which the looks are as they were learned.
        self._light = 1.0
        self._passes = 0
        self._scale: tuple[float, float, float] | None = None
        self._apart: tuple[bytes, float] | None = None
        self._frames = 0
        self._lost = 0
        self._seen = [False, False]
        self._strangers = Strangers()
        #: Frames in which several pairs could have been the lost one, and all were refused.
        self.undecided = 0
        #: Frames before the pair that is followed now; pairs found in them were others.
        self.begun = 0
        self._home: NDArray | None = None

    @property
    def seen(self) -> tuple[bool, bool]:
        """Whether patches of the front's and of the rear's colour were ever found."""
        return self._seen[0], self._seen[1]

    @property
    def looks(self) -> list[Look] | None:
        """The looks of front and rear in this camera, once they were found."""
        return None if self._learned is None else list(self._learned.looks)

    @property
    def seen_colours(self) -> tuple[SeenColour, SeenColour] | None:
        """This camera's colours of front and rear with confidence, once they were found."""
        return self._survey.seen_colours or self._forgotten

    def update(self, frame: NDArray, time: float) -> Sighting:
        """Find the pair in the next frame.

        Args:
            frame: BGR [H, W, 3] uint8.
            time: in seconds, later than the frame before.
        """
        pair = None
        self._frames += 1
        if self._cast is not None and (self._lost or self._frames % CAST_CADENCE == 0):
            self._follow_light(frame)
        if self._motion is not None and self._lost == 0:
            pair = self._at_home(frame) or self._follow(frame, time)
            if pair is None:
                pair = self._follow_in_other_light(frame, time)
        if self._lost == 0 and self._motion is not None and pair is None:
            self._strangers = Strangers(2.0 * float(np.hypot(*self._motion.axis)))
        if pair is None and is_searched(self._lost):
            pair = self._search(frame, time)
        if pair is None:
            self._lost += 1
            if self._learned is not None and self._lost >= DROP_AFTER and self._is_doubtful():
                self._forget()
            return LOST
        measured, quality = pair
        pixels = np.array([m.centre for m in measured])
        if self._lost:
            self._strangers = Strangers()
            self._keep_home(pixels)
        self._lost = 0
        self._remember(measured, pixels, quality)
        self._survey.take(
            frame, self._cast.white, pixels, [m.area for m in measured], self._learned.looks
        )
        self._motion = Motion.of(self._motion, time, pixels)
        rim = max(self._radii(middle_of(pixels)))
        lamp = lamp_luma(frame, pixels, self.geometry.lamp, rim)
        return Sighting(pixels[0], pixels[1], quality, lamp)

    def _follow_light(self, frame: NDArray, most: float = 1.0) -> bool:
        """Follow cast and level of the picture's light; return whether the level has changed.

        Up to ``most`` times the light in which the pair was learned: pixels that were bright then
        may be saturated in more light, and lose their colour.
        """
        self._cast.update(frame)
        fraction = self._cast.level / self._light
        fraction = min(fraction, max(1.0, most / self._light))
        self._learned.looks = [look.lit(fraction) for look in self._learned.looks]
        self._light *= fraction
        return abs(math.log(fraction)) > math.log(LIGHT_CHANGED)

    def _follow_in_other_light(
        self, frame: NDArray, time: float
    ) -> tuple[list[Measurement], float] | None:
        """Follow the pair into a picture whose light has changed."""
        if self._follow_light(frame) and (pair := self._follow(frame, time)) is not None:
            return pair
        looks, light = self._learned.looks, self._light
        if self._follow_light(frame, math.inf) and (pair := self._follow(frame, time)) is not None:
            return pair
        self._learned.looks, self._light = looks, light
        return None

    def _is_doubtful(self) -> bool:
        """Return whether the pair may have been two objects that passed each other."""
        known = self.geometry.separation is not None or self._start is not None
        return not known and self._learned.frames < PASSING

    def _forget(self) -> None:
        self._learned = self._motion = self._cast = None
        self.begun = self._frames
        self._forgotten = self.seen_colours
        self._survey = Survey(self.colours, self.geometry)

    # Following

    def _follow(self, frame: NDArray, time: float) -> tuple[list[Measurement], float] | None:
        expected = self._motion.predict(time)
        radius = self._radii(middle_of(expected))
        # The largest departure of a robot from constant velocity between two frames.
        late = max(1.0, 30.0 * (time - self._motion.time))
        margins = [(2.0 + 0.6 * r) * min(late, 4.0) for r in radius]
        return self._measure(frame, expected, margins)

    def _keep_home(self, pixels: NDArray) -> None:
        """Keep the place where the robot was lost, if the pair found now is elsewhere."""
        if self._home is None and self._motion is not None:
            lost = self._motion.pixels
            self._home = lost if self._are_apart(lost, pixels) else None

    def _at_home(self, frame: NDArray) -> tuple[list[Measurement], float] | None:
        """Return the pair where the robot was lost; it is the robot, not the followed pair."""
        if self._home is None or self._frames % SEARCH_CADENCE:
            return None
        if not self._are_apart(self._home, self._motion.pixels):
            self._home = None  # it went there by itself
            return None
        margins = [0.5 * radius for radius in self._radii(middle_of(self._home))]
        pair = self._measure(frame, self._home, margins)
        if pair is None or not self._looks_like_it(pair[0]):
            return None
        self._home = self._motion = None
        return pair

    def _is_at(self, place: NDArray, measured: list[Measurement]) -> bool:
        """Return whether both markers are where they were, [2, 2] pixels, to half a radius."""
        return all(
            math.dist(m.centre, there) < 0.5 * radius
            for m, there, radius in zip(measured, place, self._radii(middle_of(place)), strict=True)
        )

    def _are_apart(self, one: NDArray, other: NDArray) -> bool:
        """Return whether two places of the pair, [2, 2] pixels, are too far apart to be one."""
        return math.dist(middle_of(one), middle_of(other)) > float(np.hypot(*(one[0] - one[1])))

    def _looks_like_it(self, measured: list[Measurement]) -> bool:
        """Return whether both markers are of the paint of the pair's."""
        return all(
            measurement.look.is_like(look)
            for measurement, look in zip(measured, self._learned.looks, strict=True)
        )

    def _measure(
        self, frame: NDArray, near: NDArray, margins: list[float]
    ) -> tuple[list[Measurement], float] | None:
        measured = self._measure_each(frame, near, margins)
        quality = 0.0 if measured is None else self._quality(measured)
        return (measured, quality) if quality > LEAST_QUALITY else None

    def _measure_each(
        self, frame: NDArray, near: NDArray, margins: list[float]
    ) -> list[Measurement] | None:
        radius = self._radii(middle_of(near))
        measured = []
        for place, r, look, margin in zip(near, radius, self._learned.looks, margins, strict=True):
            measurement = measure(frame, place, r, look, margin, self._cast.white, self._passes)
            if measurement is None or np.hypot(*(measurement.centre - place)) > 1.5 * margin:
                return None
            measured.append(measurement)
        return self._fitting(measured)

    def _fitting(self, measured: list[Measurement]) -> list[Measurement]:
        """If a centre is in doubt, choose the centres with the right separation."""
        if all(m.other is None for m in measured):
            return measured
        options = [[m] if m.other is None else [m, replace(m, centre=m.other)] for m in measured]

        def misfit(pair: tuple[Measurement, ...]) -> float:
            pixels = np.array([m.centre for m in pair])
            return abs(self.geometry.separation_of(pixels) - self._learned.separation)

        return list(min(itertools.product(*options), key=misfit))

    def _quality(self, measured: list[Measurement]) -> float:
        """Rate a pair, 1 as expected; 0 if a size or the separation is impossible."""
        pixels = np.array([m.centre for m in measured])
        fresh = self._learned.frames < 5
        low, high = FIRST_AREA_RATIO if fresh else AREA_RATIO
        tolerance = FIRST_SEPARATION_TOLERANCE if fresh else SEPARATION_TOLERANCE
        scale = self._pixels_per_unit(middle_of(pixels))
        misfit = 0.0
        for measurement, area in zip(measured, self._learned.areas, strict=True):
            ratio = measurement.area / (area * scale**2)
            if not low <= ratio <= high:
                return 0.0
            misfit += (math.log(ratio) / 0.2) ** 2
        separation = self._separation(pixels) / self._learned.separation
        if abs(separation - 1.0) > tolerance:
            return 0.0
        misfit += ((separation - 1.0) / 0.04) ** 2
        return math.exp(-0.5 * misfit)

    def _remember(self, measured: list[Measurement], pixels: NDArray, quality: float) -> None:
        """Update the learned properties slowly: light, lens and perspective vary over the board."""
        learned = self._learned
        learned.frames += 1
        # The first frames count fully, so that one odd first sight does not last.
        fraction = max(0.03, 1.0 / (learned.frames + 1)) if quality > 0.3 else 0.01
        scale = self._pixels_per_unit(middle_of(pixels))
        for i, measurement in enumerate(measured):
            learned.looks[i] = learned.looks[i].blend(measurement.look, fraction)
            learned.areas[i] += fraction * (measurement.area / scale**2 - learned.areas[i])
        learned.separation += fraction * (self._separation(pixels) - learned.separation)

    def _radii(self, middle: NDArray) -> list[float]:
        scale = self._pixels_per_unit(middle)
        if self.geometry.diameter is not None:
            return [self.geometry.diameter / 2 * scale] * 2
        # The white dot is not of the colour, so a disc is somewhat larger than its coloured area.
        return [1.05 * scale * math.sqrt(area / math.pi) for area in self._learned.areas]

    def _pixels_per_unit(self, middle: NDArray) -> float:
        """Return the local scale; it hardly changes over a few pixels."""
        u, v = middle.tolist()
        if (
            self._scale is None
            or max(abs(self._scale[0] - u), abs(self._scale[1] - v)) > SCALE_REACH
        ):
            self._scale = u, v, self.geometry.pixels_per_unit(middle)
        return self._scale[2]

    def _separation(self, pixels: NDArray) -> float:
        """Return the pair's separation in the plane; needed twice for every frame."""
        pair = pixels.tobytes()
        if self._apart is None or self._apart[0] != pair:
            self._apart = pair, self.geometry.separation_of(pixels)
        return self._apart[1]

    # Searching

    def _search(self, frame: NDArray, time: float) -> tuple[list[Measurement], float] | None:
        self._passes = passes_for(frame)
        if self._learned is None:
            return self._search_first(frame)
        own, others = [], []
        for pair in self._all_that_fit(frame):
            pixels = np.array([m.centre for m in pair[0]])
            (own if self._reachable(pixels, time) else others).append((middle_of(pixels), pair))
        if time - self._motion.time < ELSEWHERE_WITHIN:
            # The robot cannot be there yet: this is another pair, also when it moves.
            known = [place for place, _ in others if not self._strangers.near(place)]
            self._strangers.places += known
        strangers = self._strangers.follow([place for place, _ in own + others])
        own = [pair for place, pair in own if not any(place is other for other in strangers)]
        if len(own) > 1:
            # One that is where the robot was lost is the robot.
            home = self._motion.pixels if self._home is None else self._home
            own = [pair for pair in own if self._is_at(home, pair[0])] or own
        if len(own) > 1:
            self.undecided += 1
        return own[0] if len(own) == 1 else None

    def _all_that_fit(self, frame: NDArray) -> list[tuple[list[Measurement], float]]:
        """Return all pairs in a frame that are the lost one by colours, sizes and separation."""
        picture = Picture(frame, self._cast.white)
        margin = 1.5 * picture.factor + 1.0
        fitting: list[tuple[list[Measurement], float]] = []
        # The light may have changed while the pair was away: then the named colours are used.
        kinds = [self._learned.looks, self.colours]
        for colours in kinds if self._lost % 8 == 7 else kinds[:1]:
            blobs = [picture.blobs(colour) for colour in colours]
            for pair in itertools.product(*blobs):
                near = np.array([blob.centre for blob in pair])
                off = abs(self.geometry.separation_of(near) / self._learned.separation - 1.0)
                if off > 2 * SEPARATION_TOLERANCE:
                    continue
                measured = self._measure(frame, near, [margin, margin])
                if measured is None or not self._looks_like_it(measured[0]):
                    continue
                if not any(_same(measured[0], other[0]) for other in fitting):
                    fitting.append(measured)
        return fitting

    def _search_first(self, frame: NDArray) -> tuple[list[Measurement], float] | None:
        if self._start is not None and self._frames > 1:
            return None
        rated = []
        whites = [NO_CAST, cast_of(frame)]
        # In a picture with a cast, the names may mean the colours with it or without.
        for white in whites[
            : 1 + (max(abs(math.log(f)) for f in whites[1]) > math.log(CAST_TRIED))
        ]:
            picture = Picture(frame, white)
            blobs = [picture.blobs(colour) for colour in self.colours]
            self._seen = [
                seen or any(blob.area >= SEEN_AREA for blob in patches)
                for seen, patches in zip(self._seen, blobs, strict=True)
            ]
            rated += [
                (rate(pair, self.colours, self.geometry, self._start), pair, white)
                for pair in itertools.product(*blobs)
            ]
        rated.sort(key=lambda entry: -entry[0])
        for rating, pair, white in rated[:4]:
            if rating <= 0:
                break
            self._cast, self._light = Cast(frame, white), 1.0
            margins = [1.5 * picture.factor + 1.0 + 0.5 * blob.radius for blob in pair]
            pixels = np.array([blob.centre for blob in pair])
            self._learn(
                [learn(frame, blob, white, self._passes) for blob in pair],
                [b.area for b in pair],
                pixels,
            )
            measured = self._measure_each(frame, pixels, margins)
            if measured is not None:
                # Again, with the looks learned at full resolution.
                pixels = np.array([m.centre for m in measured])
                self._learn([m.look for m in measured], [m.area for m in measured], pixels)
                refined = self._measure(frame, pixels, margins)
                if (
                    refined is not None
                    and plausible(refined[0], self.colours)
                    and self._pointed_at(refined[0])
                ):
                    return refined
            self._learned = self._cast = None
        return None

    def _pointed_at(self, measured: list[Measurement]) -> bool:
        """Return whether a pair is at the place that a person gave, if any."""
        return self._start is None or all(
            on_marker(m.centre, math.sqrt(m.area / math.pi), click)
            for m, click in zip(measured, self._start, strict=True)
        )

    def _learn(self, looks: list[Look], areas: list[float], pixels: NDArray) -> None:
        scale = self._pixels_per_unit(middle_of(pixels))
        self._learned = Learned(
            looks,
            [area / scale**2 for area in areas],
            self.geometry.separation or self.geometry.separation_of(pixels),
        )

    def _reachable(self, pixels: NDArray, time: float) -> bool:
        motion = self._motion
        if motion is None or time - motion.time > FORGET_AFTER:
            return True
        gap = time - motion.time
        apart = float(np.hypot(*motion.axis))
        moved = math.dist(middle_of(pixels), motion.middle) / apart
        turned = abs(float(angle_between(angle_of(pixels[0] - pixels[1]), angle_of(motion.axis))))
        return turned < TURN + TURN_PER_SECOND * gap and moved < REACH + REACH_PER_SECOND * gap


def _same(one: list[Measurement], other: list[Measurement]) -> bool:
    """Return whether two pairs are one and the same, seen twice."""
    return all(
        math.dist(a.centre, b.centre) < 0.5 * math.sqrt(a.area)
        for a, b in zip(one, other, strict=True)
    )
