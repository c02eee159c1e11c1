"""A camera above the virtual Khepera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.nxt.params import CameraParams

#: Size of this camera's objects and of its height, relative to the roof camera's.
SCALE = 0.2


class KheperaCamera(RoofCamera):
    """The roof camera and its view, a fifth as large: 55 x 37 cm of floor.

    So the robot in its pictures looks like a small NXT, with small markers
    (:data:`tracking.datasets.recordings.KHEPERA_MARKERS`).

    Args:
        params: optics, sensor and clock, like the roof camera's.
        seed: of the floor's texture and all noise.
        now: returns the lab's time in seconds.
        centre: the point at which it looks (m).
    """

    def __init__(
        self,
        params: CameraParams,
        seed: int,
        now: Callable[[], float],
        centre: tuple[float, float],
    ) -> None:
        super().__init__(params, seed, now)
        self._centre = np.array([*centre, 0.0])

    def carry(self, markers: Mapping[str, Any]) -> None:
        """Let the robot carry these markers; see :meth:`RoofCamera.carry`."""
        ends = {
            which: {**markers[which], **{axis: markers[which][axis] / SCALE for axis in "xy"}}
            for which in ("front", "rear")
        }
        super().carry({**markers, **ends})

    def look(self, pose: np.ndarray, lamp_light: float) -> None:
        """Observe the lab at :attr:`due`; see :meth:`RoofCamera.look`."""
        super().look((pose - self._centre) / [SCALE, SCALE, 1.0], lamp_light)
