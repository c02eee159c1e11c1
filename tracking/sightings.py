"""The sightings of a recording: sightings.csv, and the frames that were skipped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import FileError
from neurosim.base.files import integer, number, optional_number, read_csv
from tracking.camera.camera_model import CameraModel
from tracking.camera.video import Video
from tracking.datasets.recordings import SIGHTING_COLUMNS, Recording, ended_sessions
from tracking.follow import Track
from tracking.markers.colours import Colour
from tracking.markers.pair import Geometry
from tracking.markers.palette import SeenColour, together, unless_still
from tracking.markers.sought import sought, tracker_of
from tracking.markers.tags import Tag
from tracking.markers.tracker import Tracker
from tracking.poses import marker_geometry

#: Number of a video's frames that are searched for the colours of a pair that was tracked live.
LOOKS = 5


def seen_live(recording: Recording, session: int, camera: CameraModel) -> Track | None:
    """Return the sightings of a session, one for every frame of its video.

    Only frames that the live tracker skipped are tracked in the video now.

    Args:
        recording: with sightings.csv.
        session: its number.
        camera: the calibration, for frames that were skipped.

    Returns:
        None if the session was not tracked while it was recorded.

    Raises:
        FileError: if sightings.csv or the video are wrong.
    """
    path, times = recording.path / "sightings.csv", recording.frame_times(session)
    if times is None or not path.exists():
        return None
    parsers = dict.fromkeys(SIGHTING_COLUMNS, optional_number)
    parsers |= {"session": integer, "frame": integer, "quality": number}
    table = read_csv(path, parsers, drop_torn_line=True)
    table = table[(table["session"] == session) & table["frame"].between(0, len(times) - 1)]
    if table.empty:
        return None
    frames = table["frame"].to_numpy()
    values = np.full((len(times), len(SIGHTING_COLUMNS) - 2), np.nan)
    values[:, 4] = 0.0
    values[frames] = table[list(SIGHTING_COLUMNS[2:])].to_numpy()
    missing = np.setdiff1d(np.arange(len(times)), frames)
    markers = recording.meta["markers"]
    what, size = sought(markers), camera.image_size
    row = {"tag": what.as_dict()} if isinstance(what, Tag) else _names(what)
    try:
        if missing.size:
            _fill(values, missing, times, recording.video(session), markers, camera)
        with Video(recording.video(session)) as video:
            size = video.size
            if not isinstance(what, Tag):
                row = _colours(video, values, what, marker_geometry(markers, camera))
    except FileError:
        if session in ended_sessions(recording.commands().itertuples()):
            raise
        # The session was killed before its first frame was written into the video.
    return Track(
        np.arange(len(times)),
        times,
        values[:, 0:2],
        values[:, 2:4],
        values[:, 4],
        values[:, 5],
        size,
        row,
    )


def find_colours(
    frames: Sequence[NDArray],
    colours: tuple[Colour, Colour],
    geometry: Geometry | None = None,
) -> tuple[SeenColour, SeenColour] | None:
    """Find how a camera sees the colours of a pair of markers.

    Args:
        frames: BGR [H, W, 3] uint8; a few frames of a video.
        colours: of front and rear as they are named.
        geometry: the known geometry of the pair, if anything.

    Returns:
        Front and rear; None if none of the frames shows such a pair.
    """
    pairs = []
    for frame in frames:
        tracker = Tracker(*colours, geometry)
        tracker.update(frame, 0.0)
        pairs.append(tracker.seen_colours or (None, None))
    front, rear = (together([pair[i] for pair in pairs]) for i in (0, 1))
    return None if front is None or rear is None else (front, rear)


def _colours(
    video: Video, values: NDArray, colours: tuple[Colour, Colour], geometry: Geometry
) -> dict[str, dict[str, Any]]:
    """Return the colours of the pair from some of the frames in which it is in view."""
    seen = np.flatnonzero(values[:, 4] > 0)
    places = seen[np.linspace(0, len(seen) - 1, min(LOOKS, len(seen))).astype(int)]
    frames = [frame for index in places if (frame := video.at(int(index))) is not None]
    seen_colours = find_colours(frames, colours, geometry) if frames else None
    if seen_colours is None:
        return _names(colours)
    front, rear = unless_still(seen_colours, values[:, 0:2], values[:, 2:4])
    return {"front": front.as_dict(), "rear": rear.as_dict()}


def _names(colours: tuple[Colour, Colour]) -> dict[str, dict[str, Any]]:
    """Return the colours of the pair by their names alone."""
    return {"front": {"colour": colours[0].name}, "rear": {"colour": colours[1].name}}


def _fill(
    values: NDArray,
    missing: NDArray,
    times: NDArray,
    path: Any,
    markers: dict[str, Any],
    camera: CameraModel,
) -> None:
    tracker = tracker_of(sought(markers), marker_geometry(markers, camera))
    wanted = set(missing.tolist())
    with Video(path, times) as video:
        for index, time, frame in video:
            if index in wanted:
                s = tracker.update(frame, time)
                values[index] = (*s.front, *s.rear, s.quality, s.lamp)
            if index >= missing[-1]:
                break
    values[~np.isfinite(values[:, 0]), 4] = 0.0
