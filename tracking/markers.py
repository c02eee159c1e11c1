"""One coloured marker: found in a whole frame, and measured to a fraction of a pixel.

Colour says where a marker is, how large it is and whether it is covered; light says where its
centre is. The centre is the centroid of luma above the black backing within the disc. Every
pixel of the marker counts towards it, the fade to the white dot (section 5.2 of Pretorius et
al. 2009) most of all, because there the light is greatest; it is symmetric about the centre,
so nothing pulls it aside. Luma, because video stores it at full resolution and chroma not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.colours import Colour, chroma_plane

#: Less chroma than this (of 255) is a grey with noise on it.
LEAST_CHROMA = 22.0
LEAST_SATURATION = 0.22
#: Fewer pixels of the reduced frame are noise.
LEAST_AREA = 6

#: Chroma across the marker's hue that is tolerated, as a share of that along it: 34 degrees.
_ACROSS = 1.5


@dataclass(frozen=True)
class Blob:
    """A patch of one colour in a frame; pixels of the full frame.

    ``contrast`` is how dark the patch's surroundings are beside it: 1 black, 0 as bright.
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
    """What one marker looks like to this camera in this light.

    Attributes:
        direction: unit vector of its hue in the chroma plane.
        chroma: along that direction near the rim, of 255.
        light: luma above the backing, mean over the coloured part.
    """

    direction: NDArray
    chroma: float
    light: float

    def blend(self, new: Look, share: float) -> Look:
        """Return this look moved by ``share`` towards ``new``: light differs over the board."""
        direction = (1 - share) * self.direction + share * new.direction
        return Look(
            direction / np.linalg.norm(direction),
            (1 - share) * self.chroma + share * new.chroma,
            (1 - share) * self.light + share * new.light,
        )

    def membership(self, plane: NDArray) -> NDArray:
        """Return how much pixels of the chroma plane [2, ...] are this colour, 0..1."""
        along, across = _components(plane, self.direction)
        share = (along - _ACROSS * np.abs(across)) * np.float32(1.0 / (0.35 * self.chroma))
        return _clip(share - np.float32(0.25 / 0.35))

    def explained(self, plane: NDArray) -> NDArray:
        """Return how much light above the backing a marker of this colour can explain.

        Mixing with black at the rim leaves the ratio of chroma to light as it is; a grey board
        or another colour has less of this chroma. Twice the ratio of the rim, so that the
        brighter part of the fade counts in full.
        """
        along, across = _components(plane, self.direction)
        own = along - np.float32(0.7) * np.abs(across)
        return np.maximum(own, 0) * np.float32(2.0 * self.light / self.chroma)


@dataclass(frozen=True)
class Measurement:
    """A marker measured in a frame: centre and area in pixels, and its look just now."""

    centre: NDArray
    area: float
    look: Look


def shrink_factor(width: int) -> int:
    """By how much a whole frame is reduced before it is searched."""
    return max(1, width // 640)


class Picture:
    """A whole frame reduced for searching, with its chroma worked out once for both markers."""

    def __init__(self, frame: NDArray):
        self.factor = shrink_factor(frame.shape[1])
        size = (frame.shape[1] // self.factor, frame.shape[0] // self.factor)
        self.small = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
        self.scale = np.array([frame.shape[1] / size[0], frame.shape[0] / size[1]])
        self.plane = chroma_plane(self.small)
        self.luma = cv2.cvtColor(self.small, cv2.COLOR_BGR2GRAY)

    def blobs(self, colour: Colour | Look, most: int = 12) -> list[Blob]:
        """Find patches of a named colour, or of a look already learned, the largest first."""
        if isinstance(colour, Look):
            mask = colour.membership(self.plane) > 0.35
        else:
            mask = self._near(colour)
        # The white dot and compression leave holes; a marker is one patch.
        mask = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        count, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8)
        largest = 0.03 * mask.size
        found = []
        for label in range(1, count):
            _, _, width, height, area = stats[label]
            stretched = max(width, height) > 3.5 * min(width, height)
            if not LEAST_AREA <= area <= largest or stretched or area < 0.4 * width * height:
                continue
            found.append((area, label))
        found.sort(reverse=True)
        return [self._describe(labels, stats, centres, label) for _, label in found[:most]]

    def _near(self, colour: Colour) -> NDArray:
        direction = np.array([math.cos(colour.hue), math.sin(colour.hue)], np.float32)
        along, across = _components(self.plane, direction)
        near = (along > LEAST_CHROMA * math.cos(colour.tolerance)) & (
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


class Patch:
    """The part of a frame around one place, with its colour and light."""

    def __init__(self, frame: NDArray, centre: NDArray, reach: float):
        height, width = frame.shape[:2]
        u, v, reach = round(float(centre[0])), round(float(centre[1])), math.ceil(reach)
        self.left, self.right = max(0, u - reach), min(width, u + reach + 1)
        self.top, self.bottom = max(0, v - reach), min(height, v + reach + 1)
        self.empty = self.right - self.left < 3 or self.bottom - self.top < 3
        if self.empty:
            return
        pixels = frame[self.top : self.bottom, self.left : self.right]
        self.plane = chroma_plane(pixels)
        self.luma = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(np.float32)
        self._u = np.arange(self.left, self.right, dtype=np.float32)
        self._v = np.arange(self.top, self.bottom, dtype=np.float32)[:, None]

    def disc(self, centre: NDArray, radius: float) -> NDArray:
        """Return a window [H, W] of 1 within ``radius``, 0 without, soft over one pixel."""
        return _clip(np.float32(radius + 0.5) - np.sqrt(self.squares(centre)))

    def squares(self, centre: NDArray) -> NDArray:
        """Return the squared distance [H, W] of every pixel from a place."""
        return (self._u - np.float32(centre[0])) ** 2 + (self._v - np.float32(centre[1])) ** 2

    def centroid(self, weight: NDArray) -> tuple[NDArray, float]:
        """Return the centroid in pixels of the frame, and the sum of the weight."""
        columns, rows = weight.sum(axis=0), weight.sum(axis=1)
        total = float(rows.sum())
        if total <= 0:
            return np.full(2, np.nan), 0.0
        middle = (float(columns @ self._u) / total, float(rows @ self._v[:, 0]) / total)
        return np.array(middle), total


def measure(
    frame: NDArray, near: NDArray, radius: float, look: Look, margin: float
) -> Measurement | None:
    """Measure the marker of a known look nearest to a place.

    Args:
        frame: BGR [H, W, 3].
        near: pixel [2] where it is expected.
        radius: expected, in pixels.
        look: what it looks like.
        margin: how far from ``near`` its centre may lie, in pixels.

    Returns:
        None where there is nothing of that colour.
    """
    patch = Patch(frame, near, radius + margin + 3)
    if patch.empty:
        return None
    member = look.membership(patch.plane)
    start = _densest(patch, member, near, radius, margin)
    if start is None:
        return None
    centre, area = start, 0.0
    for _ in range(2):
        centre, area = patch.centroid(member * patch.disc(centre, 1.4 * radius + 1))
        if area <= 0:
            return None
    backing = _backing(patch.luma)
    # A dead zone takes out what is left of the backing; more of it would cost edge pixels.
    light = np.maximum(patch.luma - np.float32(backing + 0.15 * look.light), 0)
    # Outside the white dot only light that goes with the marker's colour counts: the backing
    # may be narrow, and the board beyond it is bright.
    rim = np.minimum(light, look.explained(patch.plane))
    bright = centre
    for _ in range(4):
        weight = rim + (light - rim) * patch.disc(bright, 0.55 * radius)
        bright, total = patch.centroid(weight * patch.disc(bright, radius + 1.0))
        if total <= 0:
            return None
    # Where something bright beside the marker pulls at the light, only the colour can be trusted.
    if math.dist(bright, centre) < 0.5 + 0.15 * radius:
        centre = bright
    return Measurement(centre, area, _look(patch, centre, radius, look, backing))


def learn(frame: NDArray, blob: Blob) -> Look:
    """Learn a marker's look from the patch in which it was found."""
    patch = Patch(frame, blob.centre, blob.radius + 4)
    direction = np.array([math.cos(blob.hue), math.sin(blob.hue)])
    return _look(
        patch,
        blob.centre,
        blob.radius,
        Look(direction, max(blob.chroma, 1.0), 1.0),
        _backing(patch.luma),
    )


def _components(plane: NDArray, direction: NDArray) -> tuple[NDArray, NDArray]:
    """Split the chroma plane [2, ...] into along a unit vector and across it."""
    p, q = np.asarray(direction, np.float32)
    return p * plane[0] + q * plane[1], p * plane[1] - q * plane[0]


def _clip(values: NDArray) -> NDArray:
    return np.minimum(np.maximum(values, 0), 1)


def _densest(
    patch: Patch, member: NDArray, near: NDArray, radius: float, margin: float
) -> NDArray | None:
    side = max(1, 2 * int(0.8 * radius) + 1)
    density = cv2.blur(member, (side, side), borderType=cv2.BORDER_CONSTANT)
    # What is near the prediction wins over as much colour farther off.
    density *= np.exp(np.float32(-0.5 / (margin + radius) ** 2) * patch.squares(near))
    row, column = divmod(int(density.argmax()), density.shape[1])
    if density[row, column] < 0.15:
        return None
    return np.array([patch.left + column, patch.top + row], float)


def _backing(luma: NDArray) -> float:
    flat = luma.ravel()
    place = flat.size // 10
    return float(np.partition(flat, place)[place])


def _look(patch: Patch, centre: NDArray, radius: float, look: Look, backing: float) -> Look:
    """Read a marker's look off a patch, given roughly what it is."""
    window = patch.disc(centre, radius)
    weight = look.membership(patch.plane) * window
    total = float(weight.sum())
    if total < 1:
        return look
    mean = patch.plane.reshape(2, -1) @ weight.ravel() / total
    direction = mean / max(float(np.hypot(*mean)), 1e-6)
    along, _ = _components(patch.plane, direction)
    coloured = along[weight > 0.5]
    if coloured.size < 3:
        return look
    place = (coloured.size * 3) // 4
    chroma = float(np.partition(coloured, place)[place])
    light = float((weight * patch.luma).sum() / total) - backing
    return replace(look, direction=direction, chroma=max(chroma, 1.0), light=max(light, 1.0))
