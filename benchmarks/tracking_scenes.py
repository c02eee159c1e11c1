"""Clips of a robot on the board with known poses, for the benchmarks of the tracker.

The board, its floor and its camera are the virtual lab's; what goes on in front of the camera is
made here: light, colour casts, long exposures, other things of the markers' colours, hands and
cables, other cameras. A robot may carry two coloured markers or one tag in the middle, in
otherwise the same scene. Everything of the robot is painted in the plane of its markers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from neurosim.lab.camera import scene
from neurosim.lab.camera.optics import Optics
from neurosim.lab.nxt.params import CameraParams
from tracking.camera.camera_model import CameraModel
from tracking.markers.tags import QUIET, Tag

FPS = 30.0
MARKERS = {
    "front": {"colour": "pink", "x": scene.FRONT_MARKER[0], "y": scene.FRONT_MARKER[1]},
    "rear": {"colour": "blue", "x": scene.REAR_MARKER[0], "y": scene.REAR_MARKER[1]},
    "diameter": scene.MARKER_DIAMETER,
    "height": scene.MARKER_HEIGHT,
}
#: A tag of few cells.
ARUCO = Tag("4X4_50", 7)
#: Where the tag's centre is in the robot frame (m).
TAG_PLACE = (-0.01, 0.0)

PINK, BLUE = (150.0, 60.0, 232.0), (205.0, 85.0, 25.0)  # BGR, as on the lab's robot
WHITE, BLACK = (238.0, 240.0, 240.0), (20.0, 20.0, 21.0)
SKIN, CABLE, SLEEVE = (135.0, 160.0, 205.0), (52.0, 50.0, 48.0), (120.0, 70.0, 40.0)
#: Metres a texel of the robot's texture, and texels from its origin to its edge.
_TEXEL, _HALF = 0.0004, 360
#: Samples along a pixel's side.
_FINE = 3


@dataclass(frozen=True)
class Scenario:
    """The content of a clip.

    Attributes:
        name, says: its name, and a description for people.
        shape: of the markers: "dot" fades to white, "plain" and "square" do not.
        speed: of the wheels at most, m/s.
        exposure: of a frame, s.
        noise: standard deviation on the sensor, grey levels.
        gradient: how many times brighter the bright side is than the dark one.
        lamp: turns that side makes in a second.
        cast: by how much red is won and blue lost, from minus to plus, over a clip.
        compressed: whether the clip goes through MPEG-4 at the bit rate of a webcam.
        others: whether other things of the markers' colours are in view.
        covered: whether hands and cables come over the markers.
        leaves: whether the robot leaves the picture.
        tilt: of the camera, rad.
        bend: by how much the lens displaces the picture's corners.
    """

    name: str
    says: str
    shape: str = "dot"
    speed: float = 0.25
    exposure: float = 0.008
    noise: float = 2.0
    gradient: float = 1.25
    lamp: float = 0.0
    cast: float = 0.0
    compressed: bool = False
    others: bool = False
    covered: bool = False
    leaves: bool = False
    tilt: float = 0.02
    bend: float = 0.01


SCENARIOS = (
    Scenario("clean", "half speed, 8 ms exposure, noise of 2 grey levels"),
    Scenario("plain", "markers without a white dot", shape="plain"),
    Scenario("square", "square markers", shape="square"),
    Scenario("lamp", "4:1 gradient, the lamp walks round the board", gradient=4.0, lamp=0.1),
    Scenario("cast", "white balance drifts, red and blue by 30 % each", cast=0.3),
    Scenario("blur", "full speed, exposed for the whole frame", speed=0.5, exposure=0.033),
    Scenario("compressed", "MPEG-4 at a webcam's bit rate", compressed=True),
    Scenario("noise", "noise of 10 grey levels", noise=10.0),
    Scenario("others", "other things of the same colours, still and moving", others=True),
    Scenario("covered", "a hand or a cable over one marker or both", covered=True),
    Scenario("leaves", "the robot leaves the picture and comes back", leaves=True, speed=0.5),
    Scenario("tilted", "camera tilted by 8 degrees, lens bent by 5 %", tilt=0.14, bend=0.05),
    Scenario(
        "all", "4:1 gradient, cast, blur, compression, others and noise of 5 at once",
        speed=0.5, exposure=0.02, noise=5.0, gradient=4.0, lamp=0.1, cast=0.2,
        compressed=True, others=True, tilt=0.08, bend=0.05,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """One frame of a clip.

    Attributes:
        time: of the middle of the exposure, s.
        picture: BGR uint8 [H, W, 3].
        pose: the robot's at that time, [3] (m, m, rad).
        visible: fraction of the front and of the rear marker that shows, [2]; twice that of a tag.
    """

    time: float
    picture: NDArray
    pose: NDArray
    visible: NDArray


class Clip:
    """Renders one clip of a scenario; iterate over it for its :class:`Frame` objects.

    Args:
        scenario: what it shows.
        size: width and height in pixels.
        seed: of the robot's path and of all noise.
        seconds: how long it is.
        tag: that the robot carries instead of its two markers.
        side: of the tag's black square, in m.
    """

    def __init__(
        self,
        scenario: Scenario,
        size: tuple[int, int],
        seed: int,
        seconds: float,
        tag: Tag | None = None,
        side: float = 0.06,
    ):
        self.scenario, self.size, self.frames = scenario, size, round(seconds * FPS)
        rng = np.random.default_rng([seed, 0x7AC])
        radius2 = 0.25 * (size[0] ** 2 + size[1] ** 2)
        focal = CameraParams.height * min(size[0] / 2.76, size[1] / 1.84)
        self.optics = Optics(
            CameraParams(
                size=size, margin=0.0, tilt=scenario.tilt, pan=-0.4 * scenario.tilt,
                distortion=(-scenario.bend * focal**2 / radius2, 0.0, 0.0, 0.0, 0.0),
            )
        )  # fmt: skip
        self._plane = self.optics.plane_map(scene.MARKER_HEIGHT)
        self._ground, self._light = scene.paint_ground(
            self.optics.plane_map(0.0), scene.grain(rng, room=1.5), 0.0, 0.18
        )
        self._still_colour, self._still_fraction = None, None
        #: The name of the robot's markers.
        self.carried = "pair" if tag is None else f"{tag.dictionary}-{tag.number}-{side}"
        self._tag_side = None if tag is None else side
        self._texture = robot_texture(scenario.shape, tag, side)
        self._path = path_of(scenario, rng, seconds)
        if scenario.others:
            self._litter(rng)
        self._noise = scenario.noise * rng.standard_normal(
            (size[1] + 64, size[0] + 64, 3), np.float32
        )
        self._rng = rng
        across, down = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 24))
        self._across, self._down = across.astype(np.float32), down.astype(np.float32)

    @property
    def camera(self) -> CameraModel:
        """The camera as it is."""
        o = self.optics
        return o.calibration

    def __iter__(self) -> Iterator[Frame]:
        for index in range(self.frames):
            yield self._frame(index)

    def _frame(self, index: int) -> Frame:
        time, scenario = index / FPS, self.scenario
        pose = self._path(time)
        moments = 1 if scenario.exposure < 0.002 else max(5, round(scenario.exposure / 0.002))
        spread = (np.arange(moments) + 0.5) / moments - 0.5
        poses = [self._path(time + scenario.exposure * fraction) for fraction in spread]
        picture = self._ground.copy()
        if scenario.others:
            self._other_robot(picture, time)
        self._paint(picture, self._texture, poses)
        mask = np.zeros(self.size[::-1], np.float32)
        if scenario.covered:
            self._cover(picture, mask, pose, time)
        picture *= self._lamp(time)[..., None]
        drift = scenario.cast * (2.0 * index / max(self.frames - 1, 1) - 1.0)
        if drift:
            picture *= np.array([1.0 - drift, 1.0, 1.0 + drift], np.float32)
        dv, du = self._rng.integers(64, size=2)
        picture += self._noise[dv : dv + self.size[1], du : du + self.size[0]]
        picture += 0.5
        np.clip(picture, 0, 255, out=picture)
        return Frame(time, picture.astype(np.uint8), pose, self._visible(pose, mask))

    # Painting

    def _paint(self, picture: NDArray, texture: NDArray, poses: list[NDArray]) -> None:
        """Paint a texture with its origin at poses, blended over them, into a picture."""
        window = self._window(poses)
        if window is None:
            return
        top, bottom, left, right = window
        plane = self._plane[top:bottom, left:right]
        along = self._gradient(top, bottom, left, right, 1)
        down = self._gradient(top, bottom, left, right, 0)
        steps = (np.arange(_FINE) + 0.5) / _FINE - 0.5
        total = np.zeros((bottom - top, right - left, 4), np.float32)
        for dv in steps:
            for du in steps:
                points = plane + du * along + dv * down
                for pose in poses:
                    x, y = points[..., 0] - pose[0], points[..., 1] - pose[1]
                    cos, sin = math.cos(pose[2]), math.sin(pose[2])
                    column = (cos * x + sin * y) / _TEXEL + (_HALF - 0.5)
                    row = (cos * y - sin * x) / _TEXEL + (_HALF - 0.5)
                    total += cv2.remap(
                        texture, column.astype(np.float32), row.astype(np.float32),
                        cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
                    )  # fmt: skip
        total /= _FINE**2 * len(poses)
        part = picture[top:bottom, left:right]
        lit = self._light[top:bottom, left:right, None]
        part[:] = part * (1.0 - total[..., 3:]) + lit * total[..., :3]

    def _gradient(self, top: int, bottom: int, left: int, right: int, axis: int) -> NDArray:
        window = self._plane[top:bottom, left:right]
        if window.shape[axis] < 2:
            return np.zeros_like(window)
        return np.gradient(window, axis=axis)

    def _window(self, poses: list[NDArray]) -> tuple[int, int, int, int] | None:
        reach = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * _HALF * _TEXEL
        corners = np.concatenate([pose[:2] + reach for pose in poses])
        height = np.full(len(corners), scene.MARKER_HEIGHT)
        pixels = self.optics.project(np.column_stack([corners, height]))
        left, top = np.maximum(np.floor(pixels.min(0)).astype(int) - 2, 0)
        right, bottom = np.minimum(np.ceil(pixels.max(0)).astype(int) + 3, self.size)
        return None if right - left < 2 or bottom - top < 2 else (top, bottom, left, right)

    def _litter(self, rng: np.random.Generator) -> None:
        """Put still things of the markers' colours on the board."""
        kinds = [
            shapes_texture([("disc", (0, 0), 0.03, PINK)]),
            shapes_texture([("disc", (0, 0), 0.03, BLUE)]),
            shapes_texture([("box", (0, 0), (0.105, 0.074), BLUE)]),
            shapes_texture([("disc", (0, 0), 0.06, PINK)]),
            shapes_texture([("disc", (0.1, 0), 0.03, PINK), ("disc", (-0.1, 0), 0.03, BLUE)]),
            shapes_texture([("box", (0, 0), (0.12, 0.006), PINK)]),
            shapes_texture([("box", (0, 0), (0.02, 0.02), BLUE)]),
            shapes_texture([("disc", (0, 0), 0.03, WHITE)]),
        ]
        for texture in (*kinds, *kinds[:2]):
            place = rng.uniform((-1.3, -0.85), (1.3, 0.85))
            self._paint(self._ground, texture, [np.array([*place, rng.uniform(-3, 3)])])

    def _other_robot(self, picture: NDArray, time: float) -> None:
        """Paint a robot with two blue markers, going round the middle of the board."""
        if self._still_colour is None:
            self._still_colour = shapes_texture(
                [
                    ("box", (0, 0), (0.12, 0.05), BLACK),
                    ("fade", (0.08, 0), 0.03, BLUE),
                    ("fade", (-0.08, 0), 0.03, BLUE),
                ]
            )
        angle = 0.6 * time
        place = [0.9 * math.cos(angle), 0.5 * math.sin(angle), angle + math.pi / 2]
        self._paint(picture, self._still_colour, [np.array(place)])

    def _cover(self, picture: NDArray, mask: NDArray, pose: NDArray, time: float) -> None:
        """Let hands and a cable come over the markers, each once in a little over five seconds."""
        front, rear = self.marker_pixels(pose)
        scale = self.optics.matrix[0, 0] / CameraParams.height
        for start, end, where, what in _COVERS:
            near = min(1.0, (time - start) / 0.15, (end - time) / 0.15)
            if near <= -1.0:
                continue
            middle = {"front": front, "rear": rear, "both": (front + rear) / 2}[where]
            away = np.array([0.6, -0.8]) * scale
            if what == "cable":
                across = np.array([0.8, 0.6]) * scale
                at = middle + (1.0 - near) * 0.1 * away
                _stroke(picture, mask, at - 2 * across, at + 2 * across, 0.010 * scale, CABLE)
                continue
            at = middle + (1.0 - near) * 0.25 * away
            broad = (0.32 if where == "both" else 0.15) * scale
            _stroke(picture, mask, at, at + 0.12 * away, broad, SKIN)
            _stroke(picture, mask, at + 0.25 * away, at + 3.0 * away, 0.10 * scale, SLEEVE)

    def _lamp(self, time: float) -> NDArray:
        """Return the light [H, W] of a lamp to one side: 1 there, 1 / gradient opposite."""
        angle = 2.0 * math.pi * (self.scenario.lamp * time) + 0.4
        distance = math.cos(angle) * self._across + math.sin(angle) * self._down
        fraction = 0.5 + 0.5 * distance / (abs(math.cos(angle)) + abs(math.sin(angle)))
        return cv2.resize(self.scenario.gradient ** (fraction - 1.0), self.size)

    # Truth

    def marker_pixels(self, pose: NDArray) -> NDArray:
        """Return where front and rear marker are seen, [2, 2]."""
        return self.optics.project(_on_robot(pose, np.array([[*_at("front")], [*_at("rear")]])))

    def _visible(self, pose: NDArray, mask: NDArray) -> NDArray:
        if self._tag_side is None:
            angle = np.arange(24) * math.pi / 12
            ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            disc = np.concatenate([radius * ring for radius in (0.0145, 0.023, 0.029)])
            parts = [_at(name) + disc for name in ("front", "rear")]
        else:
            grid = self._tag_side * (np.arange(12) / 11 - 0.5)
            parts = 2 * [TAG_PLACE + np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)]
        fractions = []
        for part in parts:
            pixels = np.round(self.optics.project(_on_robot(pose, part))).astype(int)
            inside = ((pixels >= 0) & (pixels < self.size)).all(axis=1)
            u, v = pixels[inside].T
            fractions.append((1.0 - mask[v, u]).sum() / len(part))
        return np.array(fractions)


#: From and until when (s), over what, and what.
_COVERS = (
    (0.7, 1.2, "front", "hand"),
    (1.6, 2.1, "rear", "hand"),
    (2.5, 3.5, "both", "hand"),
    (3.9, 4.3, "front", "cable"),
    (4.5, 4.9, "rear", "cable"),
)


def path_of(scenario: Scenario, rng: np.random.Generator, seconds: float):
    """Return a function from time (s) to pose [3]: commands as in a recording, smoothed.

    The wheels follow a command within a tenth of a second, as the lab's do; commands that would
    take the robot over the perimeter line are chosen again.
    """
    step, lag = 0.002, 0.08
    count = math.ceil((seconds + 0.1) / step) + 60
    if scenario.leaves:
        out = np.clip(np.arange(count) * step - 0.1, 0.0, None)
        y = 0.45 + 0.95 * np.sin(np.pi * np.minimum(out * 0.5 / 0.95 / 1.6, 1.0)) ** 2
        poses = np.stack([0.3 + 0.1 * y, y, np.full(count, math.atan2(1.0, 0.1))], axis=-1)
        return _interpolator(poses, step)
    for _ in range(200):
        pose = np.array([*rng.uniform((-0.9, -0.5), (0.9, 0.5)), rng.uniform(-math.pi, math.pi)])
        wheels, wanted, until = np.zeros(2), np.zeros(2), 0.0
        poses = np.empty((count, 3))
        for i in range(count):
            if i * step >= until:
                kind = rng.random()
                wanted = rng.uniform(-1, 1, 2) * scenario.speed
                if kind < 0.4:
                    wanted[:] = (
                        wanted[0]
                        if abs(wanted[0]) > 0.5 * scenario.speed
                        else (scenario.speed * np.sign(wanted[0]))
                    )
                elif kind < 0.5:
                    wanted[:] = 0.0
                until = i * step + rng.uniform(0.4, 1.2)
            wheels += (wanted - wheels) * step / lag
            speed, turning = wheels.mean(), (wheels[1] - wheels[0]) / 0.13
            pose = pose + step * np.array(
                [speed * math.cos(pose[2]), speed * math.sin(pose[2]), turning]
            )
            poses[i] = pose
        if (np.abs(poses[:, :2]) < (1.2, 0.74)).all():
            return _interpolator(poses, step)
    raise RuntimeError("no way was found that stays on the board")


def _interpolator(poses: NDArray, step: float):
    def at(time: float) -> NDArray:
        # Time 0 is a little after the beginning, so that an exposure may begin before it.
        place = (time + 0.05) / step
        i = int(place)
        return poses[i] + (place - i) * (poses[i + 1] - poses[i])

    return at


def robot_texture(shape: str = "dot", tag: Tag | None = None, side: float = 0.06) -> NDArray:
    """Return the robot's texture, BGR and cover premultiplied, row along y, column along x."""
    shapes: list[tuple] = [
        ("box", (0.0, 0.066), (0.028, 0.0135), (118.0, 118.0, 116.0)),
        ("box", (0.0, -0.066), (0.028, 0.0135), (118.0, 118.0, 116.0)),
        ("box", (0.06, 0.0), (0.015, 0.102), (40.0, 38.0, 38.0)),
        ("box", (-0.01, 0.0), (0.118, 0.052), BLACK),
    ]
    if tag is not None:
        count = len(tag.cells)
        cell = side / count
        shapes.append(("box", TAG_PLACE, 2 * [0.5 * side + QUIET * cell], WHITE))
        for row, column in np.argwhere(~tag.cells):
            # The tag's upper edge is ahead, its left edge on the left.
            ahead, left = (count - 1) / 2 - row, (count - 1) / 2 - column
            place = (TAG_PLACE[0] + ahead * cell, TAG_PLACE[1] + left * cell)
            shapes.append(("box", place, (cell / 2, cell / 2), BLACK))
        return shapes_texture(shapes)
    kind = {"dot": "fade", "plain": "disc", "square": "box"}[shape]
    size = (0.026, 0.026) if kind == "box" else 0.03
    shapes += [(kind, _at("front"), size, PINK), (kind, _at("rear"), size, BLUE)]
    shapes.append(("disc", scene.LAMP, 0.010, (120.0, 135.0, 140.0)))
    return shapes_texture(shapes)


def shapes_texture(shapes: list[tuple]) -> NDArray:
    """Paint shapes (kind, centre, size, BGR), one over the other; float32 [N, N, 4]."""
    fine = ((np.arange(2 * _HALF * 2) + 0.5) / 2 - _HALF) * _TEXEL
    x, y = np.meshgrid(fine, fine)
    picture = np.zeros((*x.shape, 4), np.float32)
    for kind, (cx, cy), size, colour in shapes:
        rgba = np.array([*colour, 1.0], np.float32)
        if kind == "box":
            inside = (np.abs(x - cx) <= size[0]) & (np.abs(y - cy) <= size[1])
            picture[inside] = rgba
            continue
        r = np.hypot(x - cx, y - cy)
        inside = r <= size
        picture[inside] = rgba
        if kind == "fade":
            fade = np.clip((size - r[inside]) / (size - 0.003), 0, 1)[:, None]
            picture[inside, :3] += (fade * (np.array(WHITE) - np.array(colour))).astype(np.float32)
    return cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def _stroke(picture, mask, start, end, breadth, colour) -> None:
    """Draw a thick straight line with round ends, antialiased, and add it to the mask."""
    sampled = np.zeros(mask.shape, np.uint8)
    fixed = [tuple(int(c) for c in np.round(np.asarray(p) * 16)) for p in (start, end)]
    cv2.line(sampled, *fixed, 255, max(1, round(breadth)), cv2.LINE_AA, 4)
    fraction = sampled.astype(np.float32)[..., None] / 255.0
    picture *= 1.0 - fraction
    picture += fraction * np.array(colour, np.float32)
    np.maximum(mask, fraction[..., 0], out=mask)


def _at(name: str) -> tuple[float, float]:
    return scene.FRONT_MARKER if name == "front" else scene.REAR_MARKER


def _on_robot(pose: NDArray, points: NDArray) -> NDArray:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    turned = points @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    return np.column_stack([turned, np.full(len(points), scene.MARKER_HEIGHT)])
