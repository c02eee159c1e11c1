"""A camera above the robot measures motion that counters cannot see.

The counters do not show a larger wheel or slip.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.robots.base import Clock
from tracking.camera.camera_model import CameraModel
from tracking.camera.cameras import Camera
from tracking.live import LiveTracker, Seen
from tracking.markers.sought import sought
from tracking.poses import marker_geometry, marker_poses, unwrap

#: Largest age of an arriving picture, s.
LATE = 0.3
#: Smallest number of pictures of a motion, and smallest fraction of its time that they cover.
_PICTURES, _FRACTION = 6, 0.6


class Eye:
    """Measures steady motions with a camera; use it as a context.

    At steady speeds the robot moves by the same displacement in equal times. So the pictures' delay
    does not matter, if they all show the steady motion.

    Args:
        camera: above the robot.
        model: its calibration, with its place over the floor.
        markers: on the robot, as in recording.json.
        clock: the robot's clock.

    Raises:
        UserError: if the calibration does not fit this camera, or has no position of it.
    """

    def __init__(
        self, camera: Camera, model: CameraModel, markers: Mapping[str, Any], clock: Clock
    ):
        if not model.has_board:
            raise UserError(
                "the calibration has no position of the camera: run neurosim calibrate with "
                "--points"
            )
        if tuple(model.image_size) != tuple(camera.size):
            raise UserError(
                "the calibration is for pictures of {}x{}, but the camera gives {}x{}".format(
                    *model.image_size, *camera.size
                )
            )
        self._camera, self._model, self._markers, self._clock = camera, model, markers, clock
        self._lock = threading.Lock()
        self._seen: list[tuple[float, float, NDArray, NDArray]] = []
        self._tracker: LiveTracker | None = None

    def __enter__(self) -> Eye:
        self._tracker = LiveTracker(
            sought(self._markers),
            marker_geometry(self._markers, self._model),
            self._clock.now,
            self._look,
            waits=self._camera.waits,
        )
        self._camera.start(self._tracker.take)
        return self

    def __exit__(self, *error: object) -> None:
        """Release the camera."""
        self._camera.stop()
        if self._tracker is not None:
            self._tracker.close()

    def measure(self, duration: float) -> tuple[float, NDArray[np.float64]]:
        """Measure a steady motion for ``duration`` s.

        Returns:
            The duration (s) and the displacement [3] in it (m, m, rad), in the frame of the
            robot at its beginning.

        Raises:
            UserError: if the robot was not always in view.
        """
        begin = self._clock.now() + LATE
        with self._lock:
            self._seen.clear()
        self._clock.sleep_until(begin + duration)
        with self._lock:
            seen = [item for item in self._seen if item[0] >= begin]
        times = np.array([time for _, time, _, _ in seen])
        if len(seen) < _PICTURES or np.ptp(times) < _FRACTION * duration:
            raise UserError(
                "the camera delivers no more pictures; check it and continue with --resume"
                if self._camera.failed or self._camera.stalled
                else (
                    "the camera does not see the robot: are its markers those of --markers, and "
                    "in view? Put it in the middle of the view and continue with --resume"
                )
            )
        front, rear = (np.array([item[which] for item in seen]) for which in (2, 3))
        poses = marker_poses(front, rear, self._markers, self._model)
        return duration, se2.exp(steady_twist(times, poses) * duration)

    def _look(self, seen: Seen) -> None:
        if seen.sighting.in_view:
            item = (seen.arrived, seen.time, seen.sighting.front, seen.sighting.rear)
            with self._lock:
                self._seen.append(item)


def steady_twist(times: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the constant body twist [3] (m/s, m/s, rad/s) that fits poses best.

    Least squares, first of the heading, then, along it, of the position.

    Args:
        times: (N,) s.
        poses: (N, 3) m, m, rad.
    """
    since = times - times.mean()
    # Where many frames in a row are missing, it may have turned further than half a turn.
    rates = se2.wrapped(np.diff(poses[:, 2])) / np.diff(times)
    turned = since * (np.median(rates) if len(rates) else 0.0)
    turn, middle = np.polyfit(since, unwrap(poses[:, 2] - turned) + turned, 1)
    # The path so far of a robot that drives straight ahead, and of one that drives to its left.
    chord = since * np.sinc(turn * since / (2.0 * np.pi))
    heading = middle + turn * since / 2.0
    cos, sin, one, none = (
        chord * np.cos(heading), chord * np.sin(heading), np.ones_like(chord), np.zeros_like(chord)
    )  # fmt: skip
    terms = np.concatenate(
        [np.stack([cos, -sin, one, none], axis=1), np.stack([sin, cos, none, one], axis=1)]
    )
    solution = np.linalg.lstsq(terms, poses[:, :2].T.ravel(), rcond=None)[0]
    return np.array([solution[0], solution[1], turn])
