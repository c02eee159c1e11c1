"""The rendered roof camera: exposures, its own clock, sensor noise, frames on time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from neurosim.base.perimeter import Board
from neurosim.base.place import Place
from neurosim.lab.camera import scene
from neurosim.lab.camera.optics import Optics
from neurosim.lab.nxt.params import BOARD, CameraParams
from tracking.camera.cameras import Camera, OnFrame

#: Fractions of an exposure at which the robot's pose is taken; between them it moves evenly.
_MOMENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Weight of each pose in the exposure, by the blur (in pixels of movement).
_STILL = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
_SLOW = np.array([0.25, 0.0, 0.5, 0.0, 0.25])
_FAST = np.array([0.125, 0.25, 0.25, 0.25, 0.125])
_NOISE_TILE = 256
#: Number of stored pictures of the empty board with noise, on which frames are painted.
_BANK = 8


@lru_cache(maxsize=2)
def _seen_by(params: CameraParams, board: Board) -> tuple[Optics, np.ndarray, np.ndarray]:
    """Return the optics, and board coordinates of every pixel on the ground and at marker height.

    The result is kept, because successive labs have the same camera.
    """
    optics = Optics(params, board)
    return optics, optics.plane_map(0.0), optics.plane_map(scene.MARKER_HEIGHT)


class RoofCamera(Camera):
    """A camera under the roof that sees the board, its floor and the robot.

    The lab moves it through its exposures; :meth:`render` alone makes a picture of anything.
    Frames come as ``on_frame(camera_time, picture)``, with the picture as uint8 [H, W, 3] BGR,
    which the caller may keep, and the middle of the exposure on the camera's own clock.

    Args:
        params: optics, sensor and clock.
        seed: of the board's texture and all noise.
        now: returns the lab's time in seconds.
        around: the place in its view.
    """

    #: The lab's time does not advance while a frame is taken.
    waits, looked_after = True, False

    def __init__(
        self,
        params: CameraParams,
        seed: int,
        now: Callable[[], float] = lambda: 0.0,
        around: Place = Place(),  # noqa: B008 - frozen
    ) -> None:
        self.params = params
        board = around.board or BOARD
        self.optics, ground_plane, self._plane = _seen_by(params, board)
        self._now = now
        self._rng = np.random.default_rng([seed, 0xCA3E])
        texture = scene.grain(self._rng, room=1.5)
        self._ground, self._light = scene.paint_ground(
            ground_plane, texture, params.gradient, params.vignetting, board
        )
        scene.paint_place(self._ground, self._light, ground_plane, around)
        shape = (_NOISE_TILE, _NOISE_TILE, 3)
        self._noise = params.noise * self._rng.standard_normal(shape, np.float32)
        self._bank = self._noisy_grounds()
        self._carried = scene.NO_TAG
        self._on_frame: OnFrame | None = None
        self._begun = 0.0
        self._frame = 0
        self._moment = 0
        self._poses = np.zeros((len(_MOMENTS), 3))
        self._lamp_before = 0.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.params.size

    @property
    def fps(self) -> float:
        """Frames per second, by the camera's own clock."""
        return self.params.fps

    def describe(self) -> dict[str, Any]:
        """Describe this camera for a recording."""
        return {
            "kind": "virtual roof camera",
            "size": list(self.size),
            "fps": self.fps,
            "exposure": self.params.exposure,
        }

    def start(self, on_frame: OnFrame) -> None:
        """Deliver frames from now on; the first exposure begins at once.

        Raises:
            RuntimeError: if the camera runs already.
        """
        if self._on_frame is not None:
            raise RuntimeError("the roof camera runs already; stop it first")
        self._on_frame = on_frame
        self._begun, self._frame, self._moment = self._now(), 0, 0

    def stop(self) -> None:
        """Deliver no more frames; a frame in exposure is lost."""
        self._on_frame = None

    def carry(self, markers: Mapping[str, Any]) -> None:
        """Let the robot carry these markers from now on, in the form of recording.json.

        Raises:
            UserError: if a tag does not lie on the robot.
        """
        self._carried = scene.plate_of(markers) if markers.get("tag") else scene.NO_TAG

    def draw_from(self, rng: np.random.Generator) -> None:
        """Take the noise of the next frames from a generator."""
        self._rng = rng

    @property
    def due(self) -> float:
        """The lab time of the camera's next look, infinite when it is stopped."""
        if self._on_frame is None:
            return math.inf
        return self._lab_time(_MOMENTS[self._moment])

    def look(self, pose: np.ndarray, lamp_light: float) -> None:
        """Observe the lab at :attr:`due`; deliver a frame at the end of its exposure.

        Args:
            pose: [3] (m, m, rad).
            lamp_light: the integral of the lamp's brightness so far, in seconds of full brightness.
        """
        if self._moment == 0:
            self._lamp_before = lamp_light
        self._poses[self._moment] = pose
        self._moment += 1
        if self._moment < len(_MOMENTS):
            return
        stamp = self.clock_at(self._lab_time(0.5))
        stamp += self.params.clock_jitter * self._rng.standard_normal()
        arrives = self._rng.random() >= self.params.dropped
        self._moment = 0
        self._frame += 1
        if arrives and self._on_frame is not None:
            lamp = (lamp_light - self._lamp_before) / self.params.exposure
            self._on_frame(stamp, self.render(self._poses, lamp))

    def clock_at(self, time: float) -> float:
        """Return the camera clock's time at a lab time (s), without jitter."""
        return self.params.clock_offset + (1.0 + self.params.clock_drift) * time

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points [N, 3] (m, board frame) to true pixel positions [N, 2]."""
        return self.optics.project(points)

    def render(
        self, poses: np.ndarray | None, lamp: float = 0.0, *, noise: bool = True
    ) -> np.ndarray:
        """Make a picture.

        Args:
            poses: the robot's pose [3], or its poses [5, 3] evenly over the exposure; None for
                the empty board.
            lamp: the lamp's mean brightness over the exposure, 0..1.
            noise: False for a perfect sensor.

        Returns:
            uint8 [H, W, 3], blue, green, red.
        """
        if noise:
            frame = self._bank[self._rng.integers(len(self._bank))].copy()
            shift = self._rng.integers(_NOISE_TILE, size=2)
            grain = self._noise
        else:
            frame = (self._ground + 0.5).clip(0, 255).astype(np.uint8)
            shift, grain = np.zeros(2, int), np.zeros((1, 1, 3), np.float32)
        if poses is None:
            return frame
        poses, weights = self._blur(np.atleast_2d(np.asarray(poses, float)))
        scene.paint_robot(
            frame,
            self._ground,
            self._light,
            self._plane,
            self._window(poses),
            poses,
            weights,
            min(max(lamp, 0.0), 1.0),
            grain,
            shift,
            *self._carried,
        )
        return frame

    def _lab_time(self, moment: float) -> float:
        period = 1.0 / (self.params.fps * (1.0 + self.params.clock_drift))
        return self._begun + self._frame * period + moment * self.params.exposure

    def _noisy_grounds(self) -> list[np.ndarray]:
        return [
            (self._ground + self._grain_over() + 0.5).clip(0, 255).astype(np.uint8)
            for _ in range(_BANK)
        ]

    def _grain_over(self) -> np.ndarray:
        return self.params.noise * self._rng.standard_normal(self._ground.shape, np.float32)

    def _blur(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return as many poses as the movement needs, and their fractions of the exposure."""
        if len(poses) == 1:
            return poses, np.ones(1)
        moved = poses[-1] - poses[0]
        # Half the robot's length turns through the change of heading.
        pixels = (math.hypot(moved[0], moved[1]) + 0.1 * abs(moved[2])) * (
            self.optics.matrix[0, 0] / self.params.height
        )
        weights = _STILL if pixels < 0.05 else _SLOW if pixels < 0.7 else _FAST
        return poses[weights > 0], weights[weights > 0]

    def _window(self, poses: np.ndarray) -> np.ndarray:
        """Return the part of the picture that holds the robot: u from and to, v from and to."""
        reach = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * scene.REACH
        corners = np.full((8, 3), scene.MARKER_HEIGHT)
        corners[:4, :2] = poses[0, :2] + reach
        corners[4:, :2] = poses[-1, :2] + reach
        pixels = self.project(corners)
        low, high = np.floor(pixels.min(0)) - 1, np.ceil(pixels.max(0)) + 2
        width, height = self.size
        u = np.clip([low[0], high[0]], 0, width)
        v = np.clip([low[1], high[1]], 0, height)
        return np.array([u[0], u[1], v[0], v[1]], dtype=int)
