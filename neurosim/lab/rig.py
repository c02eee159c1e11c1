"""What all virtual robots on the board have in common: how they are put there, and their lab."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.nxt.params import CameraParams, LabParams
from neurosim.lab.nxt.world import Lab
from neurosim.lab.server import Served

#: How well a person puts a robot down at a mark: standard deviations, m and rad.
PLACING = (0.003, math.radians(0.5))


def put_down(
    start: tuple[float, float, float], rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return where a robot stands that a person tried to put at ``start`` (m, m, rad)."""
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
        *,
        robot_seed: int,
        noise_seed: int,
        start: tuple[float, float, float],
        camera: CameraParams | None,
    ) -> tuple[Any, int]:
        """Put a robot into a lab of its own.

        Args:
            robot: its name in descriptions.
            stream: of the random numbers: another one for each kind of robot.
            body_of: makes its body of robot_seed and a seed of its noise; None for an NXT's.
            robot_seed, noise_seed, start: of the rig.
            camera: what the camera is like; None: there is none.

        Returns:
            The body and the seed of its noise.
        """
        self._about = {"robot_seed": robot_seed, "noise_seed": noise_seed, "robot": robot}
        rng = np.random.default_rng([noise_seed, robot_seed, stream])
        place = put_down(start, rng)
        seed = int(rng.integers(2**31))
        body = body_of(robot_seed, seed)
        params = LabParams.drawn(robot_seed)
        self.lab = Lab(seed, body=body, params=params, camera=camera, start=place)
        self.camera = self.lab.camera
        return body, seed

    def describe(self) -> dict[str, Any]:
        """Return what makes the same lab again."""
        return dict(self._about)

    def write_truth(self, folder: Path, session: int) -> None:
        """Keep the lab's truth beside a recording, under ``truth``, which no learner reads."""
        self.lab.write_truth(folder, session)
