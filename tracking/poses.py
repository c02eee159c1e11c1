"""From the pixels of two markers to poses on the board."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from tracking.camera.camera_model import CameraModel
from tracking.follow import Track
from tracking.markers.pair import Geometry
from tracking.markers.sought import sought
from tracking.markers.tags import SMALLEST_CELL, Tag

#: Longest time between two sightings that poses are interpolated over, s.
GAP = 0.2


def marker_geometry(markers: Mapping[str, Any], camera: CameraModel) -> Geometry:
    """Return the tracker's geometry from recording.json's ``markers`` and a camera."""
    front, rear = (np.array([markers[m]["x"], markers[m]["y"]], float) for m in ("front", "rear"))
    height = float(markers.get("height", 0.0))
    axis = front - rear
    separation = float(np.hypot(*axis))
    if separation < 1e-3:
        raise UserError("recording.json puts both markers in one place; correct markers.front.x")
    lamp = markers.get("lamp")
    position = (0.5, 0.0)
    if lamp is not None:
        offset = np.array([lamp["x"], lamp["y"]], float) - rear
        position = (
            float(offset @ axis) / separation**2,
            float(axis[0] * offset[1] - axis[1] * offset[0]) / separation**2,
        )
    return Geometry(
        lambda pixels: camera.to_board(pixels, height),
        separation,
        markers.get("diameter"),
        position,
    )


def too_small(markers: Mapping[str, Any], camera: CameraModel) -> str | None:
    """Return a sentence about a tag that is too small in the picture's middle; None: it is not."""
    what = sought(markers)
    if not isinstance(what, Tag):
        return None
    geometry = marker_geometry(markers, camera)
    assert geometry.separation is not None
    side = geometry.separation * geometry.pixels_per_unit(np.array(camera.image_size) / 2)
    cell = side / len(what.cells)
    if cell >= SMALLEST_CELL:
        return None
    return (
        f"a cell of the tag is {cell:.1f} pixels wide in the picture, and {SMALLEST_CELL:g} are "
        "needed: use larger frames, a larger tag, or a lower camera"
    )


def board_poses(seen: Track, markers: Mapping[str, Any], camera: CameraModel) -> NDArray:
    """Return poses [N, 3] of the middle of the axle from the two markers of every frame.

    The rigid fit of two points: heading from the line between them, position by least squares. NaN
    where the pair was not found.
    """
    return marker_poses(seen.front, seen.rear, markers, camera)


def marker_poses(
    front: NDArray, rear: NDArray, markers: Mapping[str, Any], camera: CameraModel
) -> NDArray:
    """Return poses [N, 3] from the pixels [N, 2] of the two markers; see :func:`board_poses`."""
    height = float(markers.get("height", 0.0))
    front, rear = np.split(camera.to_board(np.concatenate([front, rear]), height), 2)
    own = np.array([[markers[m]["x"], markers[m]["y"]] for m in ("front", "rear")], float)
    axis, own_axis = front - rear, own[0] - own[1]
    theta = unwrap(np.arctan2(axis[:, 1], axis[:, 0]) - math.atan2(own_axis[1], own_axis[0]))
    cos, sin = np.cos(theta), np.sin(theta)
    x, y = own.mean(axis=0)
    middle = (front + rear) / 2
    return np.stack(
        [middle[:, 0] - cos * x + sin * y, middle[:, 1] - sin * x - cos * y, theta], axis=-1
    )


def between(moments: NDArray, poses: NDArray, times: NDArray) -> NDArray:
    """Return poses [T, 3] at times [T], interpolated between sightings.

    Args:
        moments: of the sightings, ascending, [N] s.
        poses: seen then, [N, 3]; NaN: not seen.
        times: s, of the same clock.

    Returns:
        NaN before the first sighting, after the last one, and in gaps of more than :data:`GAP`.
    """
    seen = np.isfinite(poses).all(axis=1)
    result = np.full((len(times), 3), np.nan)
    if not seen.any():
        return result
    moments, poses = moments[seen], poses[seen]
    after = np.searchsorted(moments, times)
    inside = (times >= moments[0]) & (times <= moments[-1])
    after = np.clip(after, 1, len(moments) - 1) if len(moments) > 1 else after * 0
    inside &= moments[after] - moments[after - 1] <= GAP
    columns = [np.interp(times, moments, column) for column in poses.T]
    result[inside] = np.stack(columns, axis=-1)[inside]
    return result


def unwrap(angles: NDArray) -> NDArray:
    """Return angles [N] in radians without jumps of a full turn, across NaN as well."""
    angles = np.array(angles, float)
    seen = np.isfinite(angles)
    angles[seen] = np.unwrap(angles[seen])
    return angles
