"""The common part of all virtual robots on the board: their start and their lab."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from neurosim.base.place import Place
from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.nxt.params import CameraParams, LabParams
from neurosim.lab.nxt.world import Lab
from neurosim.lab.server import Served

#: A person's error in placing a robot at a mark: standard deviations, m and rad.
PLACING = (0.003, math.radians(0.5))


class OnBoard(TypedDict, total=False):
    """Keywords of the rigs on the board.

    Attributes:
        noise_seed: of all differences between sessions (0).
        start: the pose at which a person tries to place the robot, m, m, rad, board frame (its
            middle).
        camera: whether there is a camera (True).
        camera_size: its frames, (width, height) in pixels (640, 480).
        fps: frames per second (30).
        around: the place: lines and objects on the floor (only the board).
    """

    noise_seed: int
    start: tuple[float, float, float]
    camera: bool
    camera_size: tuple[int, int]
    fps: float
    around: Place


def put_down(
    start: tuple[float, float, float], rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return the pose of a robot that a person tried to place at ``start`` (m, m, rad)."""
    spread = np.array([PLACING[0], PLACING[0], PLACING[1]])
    x, y, theta = np.asarray(start) + spread * rng.standard_normal(3)
    return float(x), float(y), float(theta)


class BoardRig(Served):
    """A robot of the virtual lab on its board, with the roof camera over it.

    Attributes:
        lab: the lab itself; no learner looks into it.
        camera: the roof camera, or None.
    """

    lab: Lab
    camera: RoofCamera | None
    _about: dict[str, Any]

    def _set_up(
        self,
        robot: str,
        stream: int,
        body_of: Callable[[int, int], Any],
        robot_seed: int,
        **board: Unpack[OnBoard],
    ) -> tuple[Any, int]:
        """Make a lab with a robot in it.

        Args:
            robot: its name in descriptions.
            stream: of the random numbers; each kind of robot has its own.
            body_of: makes its body from robot_seed and a seed of its noise; None for an NXT's.
            robot_seed: number of robot and board.
            **board: see :class:`OnBoard`.

        Returns:
            The body and the seed of its noise.
        """
        noise_seed = board.get("noise_seed", 0)
        self._about = {"robot_seed": robot_seed, "noise_seed": noise_seed, "robot": robot}
        rng = np.random.default_rng([noise_seed, robot_seed, stream])
        place = put_down(board.get("start", (0.0, 0.0, 0.0)), rng)
        seed = int(rng.integers(2**31))
        body = body_of(robot_seed, seed)
        camera = None
        if board.get("camera", True):
            size, fps = board.get("camera_size", (640, 480)), board.get("fps", 30.0)
            camera = CameraParams(size=size, fps=fps)
        params, around = LabParams.sampled(robot_seed), board.get("around", Place())
        if around != Place():
            self._about["place"] = around.to_json()
        if hasattr(body, "around"):
            body.around = around
        self.lab = Lab(seed, body=body, params=params, camera=camera, start=place, around=around)
        self.camera = self.lab.camera
        return body, seed

    def describe(self) -> dict[str, Any]:
        """Return settings from which the same lab can be made again."""
        return dict(self._about)

    def write_truth(self, folder: Path, session: int) -> None:
        """Write the lab's truth into a recording, under ``truth``, which no learner reads."""
        self.lab.write_truth(folder, session)
