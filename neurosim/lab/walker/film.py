"""Films of the lab's walking robots: rendered, tracked, and made a path."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.perimeter import Board
from neurosim.base.place import Place
from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.nxt.params import CameraParams
from tracking.datasets.recordings import DEFAULT_MARKERS
from tracking.markers.sought import sought, tracker_of
from tracking.poses import between, marker_geometry, marker_poses

#: The floor in the camera's view, and the camera's frames. Markers of 6 cm are 9 pixels wide.
FLOOR = Place(board=Board(length=6.0, width=6.0, line_width=0.0))
CAMERA = CameraParams(size=(960, 960), margin=0.0, height=4.0)
#: Standard deviation of the time of the first command on the camera's clock, as a flash tells it,
#: s.
LATE = 0.002


@lru_cache(maxsize=1)
def _camera(seed: int) -> RoofCamera:
    return RoofCamera(CAMERA, seed, around=FLOOR)


def film(
    path: NDArray[np.float64], step: float, steps: int, seed: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the poses [T, 3] of a path, after each of T steps, as the roof camera saw them.

    The robot carries the two markers of the lab's NXT on its back. The film ends with the path.

    Args:
        path: [any, 3] m, m, rad; NaN from a fall on.
        step: between its poses, s.
        steps: T.
        seed: of the camera, and of the film.

    Returns:
        The poses as if the trial had begun at the origin; NaN where the robot was not seen.
    """
    camera, rng = _camera(seed[0]), np.random.default_rng([*seed, 0xF117])
    times, stood = np.arange(len(path)) * step, int(np.isfinite(path).all(axis=1).sum())
    optics = camera.optics.calibration
    tracker = tracker_of(sought(DEFAULT_MARKERS), marker_geometry(DEFAULT_MARKERS, optics))
    seen: list[tuple[float, NDArray, NDArray]] = []

    def look(moment: float, frame: NDArray) -> None:
        sighting = tracker.update(frame, moment)
        seen.append((moment, sighting.front, sighting.rear))

    camera.draw_from(rng)
    camera.start(look)
    begin = camera.due + rng.uniform(0.1, 0.2)  # it stands until then
    while (now := camera.due - begin) <= times[stood - 1]:
        pose = [np.interp(now, times[:stood], column[:stood]) for column in path.T]
        camera.look(np.array(pose), 0.0)
    camera.stop()
    begun = camera.clock_at(begin) + LATE * rng.standard_normal()
    moments, front, rear = (np.array(part) for part in zip(*seen, strict=True))
    poses = marker_poses(front, rear, DEFAULT_MARKERS, optics)
    tracked = between(moments - begun, poses, np.arange(steps + 1) * step)
    return np.round(se2.between(tracked[0], tracked[1:]), 5)
