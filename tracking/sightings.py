"""What was seen while a recording was made: sightings.csv, and the frames that were passed over."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.files import integer, number, optional_number, read_csv
from tracking.camera_model import CameraModel
from tracking.colours import parse_colour
from tracking.recordings import SIGHTING_COLUMNS, Recording
from tracking.track import Track, marker_geometry
from tracking.tracker import Tracker
from tracking.video import Video


def seen_live(recording: Recording, session: int, camera: CameraModel) -> Track | None:
    """Return what was seen of a session while it was recorded, every frame of its video.

    Frames that the live tracker passed over are looked at in the video now, and only those.

    Args:
        recording: with sightings.csv.
        session: its number.
        camera: the calibration, for frames that were passed over.

    Returns:
        None if the session was not tracked while it was recorded.

    Raises:
        FileError: if sightings.csv or the video are not what they should be.
    """
    path, times = recording.path / "sightings.csv", recording.frame_times(session)
    if times is None or not path.exists():
        return None
    parsers = dict.fromkeys(SIGHTING_COLUMNS, optional_number)
    parsers |= {"session": integer, "frame": integer, "quality": number}
    table = read_csv(path, parsers, drop_torn_line=True)
    rows = (np.array(table["session"]) == session) & (np.array(table["frame"]) < len(times))
    if not rows.any():
        return None
    frames = np.array(table["frame"])[rows]
    values = np.full((len(times), len(SIGHTING_COLUMNS) - 2), np.nan)
    values[:, 4] = 0.0
    values[frames] = np.column_stack([table[name] for name in SIGHTING_COLUMNS[2:]])[rows]
    missing = np.setdiff1d(np.arange(len(times)), frames)
    markers = recording.meta["markers"]
    if missing.size:
        _fill(values, missing, times, recording.video(session), markers, camera)
    with Video(recording.video(session)) as video:
        size = video.size
    return Track(
        np.arange(len(times)),
        times,
        values[:, 0:2],
        values[:, 2:4],
        values[:, 4],
        values[:, 5],
        size,
        tuple({"colour": markers[which]["colour"]} for which in ("front", "rear")),
    )


def _fill(
    values: NDArray,
    missing: NDArray,
    times: NDArray,
    path: Any,
    markers: dict[str, Any],
    camera: CameraModel,
) -> None:
    front, rear = (parse_colour(markers[which]["colour"]) for which in ("front", "rear"))
    tracker = Tracker(front, rear, marker_geometry(markers, camera))
    wanted = set(missing.tolist())
    with Video(path, times) as video:
        for index, time, frame in video:
            if index in wanted:
                s = tracker.update(frame, time)
                values[index] = (*s.front, *s.rear, s.quality, s.lamp)
            if index >= missing[-1]:
                break
    values[~np.isfinite(values[:, 0]), 4] = 0.0
