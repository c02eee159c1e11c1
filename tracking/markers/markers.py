"""One coloured marker: found in a whole frame, and measured to a fraction of a pixel.

Colour says where a marker is, how large it is and whether it is covered; light says where its
centre is. The centre is the centroid of luma above the black backing within the disc. Every
pixel of the marker counts towards it, the fade to the white dot (section 5.2 of Pretorius et
al. 2009) most of all, because there the light is greatest; it is symmetric about the centre,
so nothing pulls it aside. Luma, because video stores it at full resolution and chroma not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import NO_CAST, Colour, chroma_plane
from tracking.markers.noise import noise_of, smooth
from tracking.markers.patches import (
    ACROSS,
    darkest,
    mean_luma,
    measure_marker,
    read_look,
    read_patch,
)
from tracking.markers.white import Cast

#: Less chroma than this (of 255) is a grey.
LEAST_CHROMA = 22.0
LEAST_SATURATION = 0.22
#: Hues (rad), and ratios of chroma to light, of the same paint in other light.
SAME_HUE, SAME_SATURATION = math.radians(25.0), 2.0
#: A signal is this many times the remaining noise; with more noise nothing is concluded.
CLEAR_OF_NOISE, MOST_NOISE = 4.5, 12.0
#: Fewer pixels of the reduced frame are noise; in a smoothed frame chance makes larger patches.
LEAST_AREA, LEAST_SMOOTHED_AREA = 6, 28


@dataclass(frozen=True)
class Blob:
    """A patch of one colour in a frame; pixels of the full frame.

    ``contrast`` is how dark the patch's surroundings are next to it: 1 black, 0 as bright.
    """

    centre: NDArray
    area: float
    hue: float
    chroma: float
    contrast: float

    @property
    def radius(self) -> float:
        """Of the disc with the same area."""
        return math.sqrt(self.area / math.pi)


@dataclass(frozen=True)
class Look:
    """The appearance of one marker to this camera in this light.

    Attributes:
        direction: unit vector of its hue in the chroma plane.
        chroma: along that direction near the rim, of 255.
        light: luma above the backing, mean over the coloured part.
    """

    direction: NDArray
    chroma: float
    light: float

    def blend(self, new: Look, fraction: float) -> Look:
        """Return this look moved by ``fraction`` towards ``new``: light differs over the board."""
        (p, q), (new_p, new_q) = self.direction.tolist(), new.direction.tolist()
        p, q = (1 - fraction) * p + fraction * new_p, (1 - fraction) * q + fraction * new_q
        length = math.hypot(p, q)
        return Look(
            np.array([p / length, q / length]),
            (1 - fraction) * self.chroma + fraction * new.chroma,
            (1 - fraction) * self.light + fraction * new.light,
        )

    @property
    def rgb(self) -> NDArray:
        """Red, green and blue of the rim, [3] of 255."""
        alpha, beta = self.chroma * np.asarray(self.direction, float)
        # From alpha, beta and luma (Rec. 601).
        between = beta / math.sqrt(0.75)
        green = self.light + 0.114 * between - 0.299 * (alpha - 0.5 * between)
        return np.array([green + alpha - 0.5 * between, green, green - between])

    def lit(self, fraction: float) -> Look:
        """Return this look in light that is a fraction of the light before."""
        return Look(
            self.direction, max(fraction * self.chroma, 1.0), max(fraction * self.light, 1.0)
        )

    def is_like(self, other: Look) -> bool:
        """Return whether the other may be of the same paint, if the light may have changed."""
        alike = float(self.direction @ other.direction) > math.cos(SAME_HUE)
        ratio = (self.chroma / self.light) / (other.chroma / other.light)
        return alike and 1.0 / SAME_SATURATION < ratio < SAME_SATURATION

    def membership(self, plane: NDArray) -> NDArray:
        """Return how much pixels of the chroma plane [2, ...] are this colour, 0..1."""
        along, across = _components(plane, self.direction)
        fraction = (along - ACROSS * np.abs(across)) * np.float32(1.0 / (0.35 * self.chroma))
        return _clip(fraction - np.float32(0.25 / 0.35))


@dataclass(frozen=True)
class Measurement:
    """A marker measured in a frame.

    Attributes:
        centre: in pixels [2].
        area: in pixels.
        look: just now.
        other: another possible centre, by light and not by colour; None if both agree.
    """

    centre: NDArray
    area: float
    look: Look
    other: NDArray | None = None


def shrink_factor(width: int) -> int:
    """The factor by which a whole frame is reduced before it is searched."""
    return max(1, width // 640)


class Picture:
    """A whole frame reduced for searching, with its chroma worked out once for both markers.

    Args:
        frame: BGR [H, W, 3] uint8.
        white: factors of blue and of red that remove a colour cast.
        factor: by how much it is reduced; default :func:`shrink_factor`.
    """

    def __init__(
        self, frame: NDArray, white: tuple[float, float] = NO_CAST, factor: int | None = None
    ):
        self.factor = factor or shrink_factor(frame.shape[1])
        size = (frame.shape[1] // self.factor, frame.shape[0] // self.factor)
        self.small = frame
        if self.factor > 2 and self.factor % 2 == 0:
            # OpenCV is by far fastest at halving.
            half = (frame.shape[1] // 2, frame.shape[0] // 2)
            self.small = cv2.resize(frame, half, interpolation=cv2.INTER_AREA)
        raw = cv2.resize(self.small, size, interpolation=cv2.INTER_AREA)
        self.small = smooth(raw)
        self._least_area = LEAST_AREA if self.small is raw else LEAST_SMOOTHED_AREA
        self.scale = np.array([frame.shape[1] / size[0], frame.shape[0] / size[1]])
        self.plane = chroma_plane(self.small, white)
        self.luma = cv2.cvtColor(self.small, cv2.COLOR_BGR2GRAY)
        self._noise = noise_of(self.small)

    def blobs(self, colour: Colour | Look, most: int = 12) -> list[Blob]:
        """Find patches of a named colour, or of a look already learned, the largest first."""
        if self._noise > MOST_NOISE:
            return []
        if isinstance(colour, Look):
            mask = colour.membership(self.plane) > 0.35
        else:
            mask = self._near(colour)
        # The white dot and compression leave holes; a marker is one patch.
        mask = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        count, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8)
        largest = 0.03 * mask.size
        sized = []
        for label in range(1, count):
            _, _, width, height, area = stats[label]
            stretched = max(width, height) > 3.5 * min(width, height)
            if not self._least_area <= area <= largest or stretched or area < 0.4 * width * height:
                continue
            sized.append((area, label))
        sized.sort(reverse=True)
        return [self._describe(labels, stats, centres, label) for _, label in sized[:most]]

    def _near(self, colour: Colour) -> NDArray:
        direction = np.array([math.cos(colour.hue), math.sin(colour.hue)], np.float32)
        along, across = _components(self.plane, direction)
        least = max(LEAST_CHROMA, CLEAR_OF_NOISE * self._noise)
        near = (along > least * math.cos(colour.tolerance)) & (
            np.abs(across) < math.tan(colour.tolerance) * along
        )
        blue, green, red = cv2.split(self.small)
        brightest = cv2.max(cv2.max(blue, green), red)
        return near & (along > np.float32(LEAST_SATURATION) * brightest)

    def _describe(self, labels: NDArray, stats: NDArray, centres: NDArray, label: int) -> Blob:
        left, top, width, height, area = stats[label]
        rows = slice(max(0, top - 3), top + height + 3)
        columns = slice(max(0, left - 3), left + width + 3)
        inside = labels[rows, columns] == label
        plane = self.plane[:, rows, columns][:, inside]
        near = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        luma = self.luma[rows, columns]
        around = luma[~near]
        dark = float(np.percentile(around, 30)) if around.size else 255.0
        light = float(luma[inside].mean())
        mean = plane.mean(axis=1)
        # A reduced pixel's middle lies half a reduced pixel in, the full frame's half a full one.
        centre = (centres[label] + 0.5) * self.scale - 0.5
        return Blob(
            centre,
            float(area) * float(np.prod(self.scale)),
            math.atan2(mean[1], mean[0]),
            float(np.hypot(*mean)),
            float(np.clip(1.0 - dark / max(light, 1.0), 0.0, 1.0)),
        )


def measure(
    frame: NDArray,
    near: NDArray,
    radius: float,
    look: Look,
    margin: float,
    white: tuple[float, float] = NO_CAST,
    passes: int = 0,
) -> Measurement | None:
    """Measure the marker of a known look nearest to a place.

    Args:
        frame: BGR [H, W, 3].
        near: pixel [2] where it is expected.
        radius: expected, in pixels.
        look: its appearance.
        margin: largest distance of its centre from ``near``, in pixels.
        white: factors of blue and of red that remove a colour cast.
        passes: of smoothing, as :func:`tracking.markers.noise.passes_for` gives them.

    Returns:
        None if nothing of that colour is there.
    """
    direction = (float(look.direction[0]), float(look.direction[1]))
    seen = measure_marker(
        frame, float(near[0]), float(near[1]), float(radius), float(margin),
        *direction, float(look.chroma), float(look.light), float(white[0]), float(white[1]), passes,
    )  # fmt: skip
    if not seen[0]:
        return None
    _, u, v, light_u, light_v, area, p, q, chroma, light = seen
    other = None if (u, v) == (light_u, light_v) else np.array([light_u, light_v])
    return Measurement(np.array([u, v]), area, Look(np.array([p, q]), chroma, light), other)


def compile_loops() -> None:
    """Compile the loops over pixels, so that the first frame need not wait for them."""
    frame = np.zeros((16, 16, 3), np.uint8)
    blob = Blob(np.array([8.0, 8.0]), 12.0, 0.0, 50.0, 1.0)
    measure(frame, blob.centre, blob.radius, learn(frame, blob), 3.0)
    mean_luma(frame, 8.0, 8.0, 3.0)
    Cast(frame).update(frame)


def learn(
    frame: NDArray, blob: Blob, white: tuple[float, float] = NO_CAST, passes: int = 0
) -> Look:
    """Learn a marker's look from the patch in which it was found."""
    u, v = (float(place) for place in blob.centre)
    plane, luma, left, top = read_patch(frame, u, v, blob.radius + 4.0, *white, passes)
    p, q, chroma, light = read_look(
        plane, luma, u - left, v - top, blob.radius,
        math.cos(blob.hue), math.sin(blob.hue), max(blob.chroma, 1.0), 1.0, darkest(luma),
    )  # fmt: skip
    return Look(np.array([p, q]), chroma, light)


def _components(plane: NDArray, direction: NDArray) -> tuple[NDArray, NDArray]:
    """Split the chroma plane [2, ...] into along a unit vector and across it."""
    p, q = np.asarray(direction, np.float32)
    return p * plane[0] + q * plane[1], p * plane[1] - q * plane[0]


def _clip(values: NDArray) -> NDArray:
    return np.minimum(np.maximum(values, 0), 1)
