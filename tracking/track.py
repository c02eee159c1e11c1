"""Tracks a recording's video, or any video: a pose for each frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import FileError, UserError
from neurosim.base.files import new_folder, write_csv, write_json
from neurosim.base.progress import Progress
from tracking.camera.camera_model import CameraModel
from tracking.camera.video import Video
from tracking.clock.motion import disagreement, fit_clock_to_motion, follows_commands
from tracking.clock.motor_delay import Delay, motion_delay
from tracking.clock.sync import ClockFit, fit_clock, pulses
from tracking.datasets.recordings import (
    TRACKING_FORMAT,
    TRACKING_VERSION,
    CommandLine,
    Poses,
    Recording,
    ended_sessions,
)
from tracking.follow import Track, follow
from tracking.markers.colours import Colour, parse_colour
from tracking.markers.pair import Geometry
from tracking.markers.palette import STILL, warning
from tracking.markers.sought import Sought, sought
from tracking.markers.tag_tracker import TagTracker, numbers_in
from tracking.markers.tags import Tag
from tracking.poses import board_poses, marker_geometry, too_small, unwrap

#: Time between the frames that are searched for tags, s.
LOOK_FOR_TAGS_EVERY = 0.5


def track(
    recording: str | Path,
    colours: tuple[str, str] | None = None,
    calibration: str | Path | CameraModel | None = None,
    overlay: str | Path | None = None,
    videos: Sequence[str | Path] = (),
    *,
    markers: Mapping[str, Any] | None = None,
    partial: bool = False,
    live: Mapping[int, Track] | None = None,
    sync: str | None = None,
    doubtful: bool = False,
) -> dict[str, Any]:
    """Track a recording: poses.csv and tracking.json into its folder.

    Poses are of the middle of the axle on the board, in metres and radians, heading unwrapped
    over each session; times are on the session's robot clock. A session that ended before its
    first command is left out, as is one that was killed before its first frame was written.

    Args:
        recording: its folder.
        colours: of front and rear, if they differ from the markers' description.
        calibration: a calibration file or model; default the recording's calibration.json.
        overlay: write a video with the markers drawn over it here; with several sessions, the
            session's number is added to the name.
        videos: filmed with something else, of the sessions that have no video of their own, in
            order.
        markers: replaces ``markers`` of recording.json; as
            :func:`tracking.datasets.recordings.read_markers` returns it.
        partial: use a video that was cut short although its session ended as it should. (The video
            of a killed session is always used up to its end.)
        live: sightings of live tracking, by session; the videos of these sessions are not tracked
            again.
        sync: the signal that matches the camera's clock to the robot's: the lamp's ``flash``, or
            ``motion``,
            the robot's answers to its commands. None: the lamp, if it was ever switched on.
        doubtful: whether poses are wanted of a pair that may not be the robot's; they are marked.

    Returns:
        The content of tracking.json: frames, fraction found, median quality, clock per session.

    Raises:
        UserError: naming what is missing or wrong, and in which session; also if the pair may not
            be the robot's.
    """
    source = Recording(recording)
    markers = markers or source.meta["markers"]
    camera = _camera(source, calibration)
    geometry = marker_geometry(markers, camera)
    what = sought(markers) if colours is None else _pair_of(colours)
    lines = list(source.commands().itertuples())
    if sync is None:
        sync = "flash" if any(line.kind == "lamp-on" for line in lines) else "motion"
    parts: list[Poses] = []
    tracks: list[tuple[str | Path, Track]] = []
    sessions = []
    paths, normally_ended = _videos(source, videos), ended_sessions(lines)
    for session, path in enumerate(paths, start=1):
        if not any(line.session == session and line.kind == "command" for line in lines):
            # Interrupted before its first command: there may not even be a video.
            sessions.append({"session": session, "left_out": "no command was sent"})
            continue
        times = source.frame_times(session)
        ended = session in normally_ended
        resumed = not ended and session < len(paths) and session not in (live or {})
        if resumed and _holds_nothing(path):
            # Killed before its first frame was written; --resume sent its commands again.
            sessions.append({"session": session, "left_out": "nothing was filmed"})
            continue
        if ended and not partial and session not in (live or {}):
            _check_times(source, session, 0 if times is None else len(times))
        tracked_live = (live or {}).get(session)
        small = None if tracked_live else too_small(markers, camera)  # told before a live drive
        seen = tracked_live or follow(
            path,
            what,
            geometry=geometry,
            times=times,
            overlay=_overlay_of(overlay, session, source.sessions),
            expected_size=camera.image_size,
        )
        missing = seen.missing if times is None else len(times) - len(seen.frame)
        if ended and not partial:
            _check_whole(path, len(seen.frame), missing)
        tracks.append((path, seen))
        poses = board_poses(seen, markers, camera)
        certain = np.where(seen.doubtful[:, None], np.nan, poses)
        own = [line for line in lines if line.session == session]
        driven = [line for line in own if line.is_motor]
        problem, whole = None, ended and times is not None
        try:
            if sync == "motion":
                clock = fit_clock_to_motion(seen.time, certain, driven, whole=whole)
            else:
                clock = fit_clock(seen.time, seen.lamp, pulses(own))
                problem = disagreement(clock, seen.time, certain, driven, whole=whole)
        except UserError as error:
            raise UserError(f"{path}: {small or error}") from None
        at = clock.to_robot(seen.time)
        unclear = _unclear(seen.doubtful, at, poses, driven)
        part = Poses(
            np.full(len(seen.frame), session), seen.frame, at, poses, seen.quality,
            unclear & seen.in_view,
        )  # fmt: skip
        delay = motion_delay(at, part.certain().pose, driven)
        parts.append(part)
        sessions.append(
            {
                **_session_summary(session, path, seen, clock, delay),
                "frames_missing": max(missing, 0),
                "warning": problem or small,
            }
        )
    if not parts:
        raise UserError(f"{source.path}: no command was sent in it, so there is nothing to track")
    for (path, seen), part in zip(tracks, parts, strict=True):
        reason = _reason_of(seen, tracks)
        if reason and not doubtful:
            raise UserError(_refusal(path, reason))
        part.doubtful[:] |= bool(reason) & seen.in_view
    joined = Poses(
        *(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Poses))
    )
    tracked = joined.quality > 0
    summary = {
        "units": {"x": "m", "y": "m", "theta": "rad", "time": "s"},
        "frames": len(tracked),
        "in_view": float(tracked.mean()),
        "quality": float(np.median(joined.quality[tracked])),
        "undecided": sum(session.get("undecided", 0) for session in sessions),
        "doubtful": int(joined.doubtful.sum()),
        "sessions": sessions,
    }
    source.write_poses(joined)
    write_json(source.path / "tracking.json", TRACKING_FORMAT, TRACKING_VERSION, summary)
    return summary


def track_video(
    path: str | Path,
    what: Sought | tuple[str, str] | None,
    out: str | Path | None = None,
    *,
    markers: Mapping[str, Any] | None = None,
    calibration: str | Path | CameraModel | None = None,
    height: float | None = None,
    overlay: str | Path | None = None,
    clicks: ArrayLike | None = None,
    doubtful: bool = False,
    partial: bool = False,
) -> dict[str, Any]:
    """Track two coloured markers, or a tag, in any video, without a recording.

    The pose is of the middle between the two markers, its heading from the rear to the front
    one, counter-clockwise as seen, unwrapped; of a tag these are the middles of its lower and its
    upper edge, as it is printed. Without a calibration positions are in pixels,
    ``u`` to the right and ``v`` down; with one in metres, ``x`` and ``y`` on the board. With a
    calibration of the lens alone they are in pixels of a picture without its distortion.

    Args:
        path: the video.
        what: colours of the front and the rear marker, or the tag to look for; None with clicks.
        out: a new folder for poses.csv (frame, time, u, v or x, y, theta, quality,
            doubtful, front_u, front_v, rear_u, rear_v) and tracking.json; None to write nothing.
        markers: their places on the robot, as in recording.json, which give their distance, size
            and height; used with a calibration over the board only.
        calibration: a calibration file or model.
        height: of the markers above the board, in metres, by default that of ``markers``, or 0;
            used with a calibration over the board only.
        overlay: write a video with the markers drawn over it here.
        clicks: pixels [2, 2] of both markers in the first frame, instead of their colours.
        doubtful: whether poses are wanted of a pair that may not be the robot's; they are marked.
        partial: use a video that was cut short, up to its end.

    Returns:
        The content of tracking.json, and under ``poses`` the columns of poses.csv.

    Raises:
        UserError: as :func:`follow` does, if the pair may not be the robot's, if ``out`` is not
            empty, or if there is a height and no calibration over the board.
    """
    if height is not None and not math.isfinite(height):
        raise UserError(f"a marker's height of {height} m is not a number")
    camera = _read_camera(calibration)
    over_board = camera is not None and camera.has_board
    if height is not None and not over_board:
        raise UserError(
            "a height over the board needs a calibration with points on the board; leave it out, "
            "or name such a calibration"
        )
    if height is None:
        height = float((markers or {}).get("height") or 0.0)
    geometry = None
    if camera is not None:

        def plane(pixels: NDArray) -> NDArray:
            return camera.to_board(pixels, height) if over_board else camera.straighten(pixels)

        geometry = Geometry(to_plane=plane)
        if over_board and markers is not None:
            geometry = marker_geometry({**markers, "height": height}, camera)
    size = None if camera is None else camera.image_size
    with ExitStack() as stack:
        folder = None if out is None else stack.enter_context(new_folder(out))
        seen = follow(
            path, what if isinstance(what, Tag | None) else _pair_of(what),
            geometry=geometry, overlay=overlay, expected_size=size, clicks=clicks,
        )  # fmt: skip
        if not partial:
            _check_whole(path, len(seen.frame), seen.missing)
        reason = _reason_of(seen, [(path, seen)])
        if reason and not doubtful:
            raise UserError(_refusal(path, reason))
        unclear = (seen.doubtful | bool(reason)) & seen.in_view
        ahead, behind = seen.front, seen.rear
        if camera is not None:
            ahead, behind = plane(seen.front), plane(seen.rear)
        names, unit = (("x", "y"), "m") if over_board else (("u", "v"), "pixel")
        # v runs down: mirrored, the heading is counter-clockwise as seen.
        axis = (ahead - behind) * (1.0, 1.0 if over_board else -1.0)
        middle = (ahead + behind) / 2
        columns = {
            "frame": seen.frame,
            "time": np.round(seen.time, 6),
            names[0]: np.round(middle[:, 0], 5),
            names[1]: np.round(middle[:, 1], 5),
            "theta": np.round(unwrap(np.arctan2(axis[:, 1], axis[:, 0])), 6),
            "quality": np.round(seen.quality, 3),
            "doubtful": unclear.astype(int),
            "front_u": np.round(seen.front[:, 0], 4),
            "front_v": np.round(seen.front[:, 1], 4),
            "rear_u": np.round(seen.rear[:, 0], 4),
            "rear_v": np.round(seen.rear[:, 1], 4),
        }
        summary = {
            "units": {names[0]: unit, names[1]: unit, "theta": "rad", "time": "s"},
            "video": str(path),
            "frames": len(seen.frame),
            "frames_missing": seen.missing,
            "in_view": float(seen.in_view.mean()),
            "quality": float(np.median(seen.quality[seen.in_view])),
            "markers": seen.markers,
            "undecided": seen.undecided,
            "doubtful": int(unclear.sum()),
        }
        if folder is not None:
            write_csv(folder / "poses.csv", columns)
            write_json(folder / "tracking.json", TRACKING_FORMAT, TRACKING_VERSION, summary)
    return {**summary, "poses": columns}


def track_tags(
    path: str | Path,
    kind: str,
    out: str | Path,
    *,
    overlay: str | Path | None = None,
    **options: Any,
) -> dict[int, dict[str, Any]]:
    """Track every tag of a dictionary that is in a video: several robots at once.

    Args:
        path: the video.
        kind: the dictionary, as OpenCV names it, without ``DICT_``.
        out: a new folder, for one of each tag: ``tag-3`` and so on, as :func:`track_video`
            writes it.
        overlay: write a video for each tag here; its number is added to the name.
        **options: of :func:`track_video`.

    Returns:
        The results of :func:`track_video`, by the tag's number.

    Raises:
        UserError: if there is no such tag in the video, or as :func:`track_video` does.
    """
    path, any_one = Path(path), Tag(kind)
    seen: set[int] = set()
    with (
        Video(path) as video,
        Progress(f"tags in {path.name}", video.frames or None, "frames") as progress,
    ):
        every = max(1, round(LOOK_FOR_TAGS_EVERY * video.fps))
        for index, _, frame in video:
            if index % every == 0:
                fresh = numbers_in(frame, any_one) - seen
                # The detector may mistake other things for a tag: the pattern must fit.
                seen |= {n for n in fresh if TagTracker(Tag(kind, n)).update(frame, 0.0).in_view}
            progress.advance()
    if not seen:
        raise UserError(f"{path}: no tag of {any_one.dictionary} was found in any frame")
    tracked: dict[int, dict[str, Any]] = {}
    with new_folder(out) as folder:
        for number in sorted(seen):
            overlay_here = None
            if overlay is not None:
                overlay_here = Path(overlay).with_stem(f"{Path(overlay).stem}-tag-{number}")
            tracked[number] = track_video(
                path, Tag(kind, number), folder / f"tag-{number}", overlay=overlay_here, **options
            )
    return tracked


def describe_doubtful(summary: Mapping[str, Any]) -> str | None:
    """Return a warning about doubtful poses, from tracking.json; None without any."""
    if not summary["doubtful"]:
        return None
    return (
        f"{summary['doubtful']} poses may be of another pair than the robot's: the robot was lost, "
        "and one like it was found where it may not have come to by itself; they are marked as "
        "doubtful, and neurosim dataset leaves them out"
    )


def _pair_of(colours: tuple[Colour | str, Colour | str]) -> tuple[Colour, Colour]:
    front, rear = (c if isinstance(c, Colour) else parse_colour(c) for c in colours)
    return front, rear


def _videos(source: Recording, given: Sequence[str | Path]) -> list[Path]:
    """Return the video of every session, the given ones where the recording has none."""
    own = [source.video(session) for session in range(1, source.sessions + 1)]
    missing = [session for session, path in enumerate(own, start=1) if path is None]
    if len(given) != len(missing):
        names = ", ".join(str(session) for session in missing)
        raise UserError(
            f"{source.path}: session {names} has no video; name one for each with --video"
            if len(given) < len(missing)
            else f"{source.path}: {len(given)} videos are named with --video, but "
            f"{len(missing)} of its sessions have none of their own"
        )
    rest = iter(given)
    return [Path(next(rest)) if path is None else path for path in own]


def _holds_nothing(path: str | Path) -> bool:
    """Return whether a video is there, and no frame of it can be read."""
    try:
        Video(path).close()
    except FileError:
        return Path(path).is_file()
    return False


def _check_whole(path: str | Path, frames: int, missing: int) -> None:
    """Refuse a video without its last frames."""
    if missing > 0:
        raise UserError(
            f"{path} ends after {frames} of {frames + missing} frames: it was cut short after it "
            "was recorded; restore it, or use the existing part with --partial"
        )


def _check_times(source: Recording, session: int, count: int) -> None:
    """Refuse a frames.csv with times for only the first ``count`` frames of a session."""
    path, times = source.video(session), source.path / "frames.csv"
    if path is None or not times.exists():
        return
    with Video(path) as video:
        # A container's number of frames may be a guess: there is one more only if it can be read.
        frames = video.frames
        if frames <= count or video.at(count) is None:
            return
    raise FileError(
        times,
        f"has {count} rows of session {session}, but {path.name} has {frames} frames: it was cut "
        "short after it was recorded; restore it, or use the existing part with --partial",
    )


def _reason_of(seen: Track, tracks: Sequence[tuple[str | Path, Track]]) -> str | None:
    """Return why a pair may not be the robot's; in one session of several it may stand still."""
    moves = any(
        all(marker.get("reason") is None for marker in one.markers.values()) for _, one in tracks
    )
    still = all(marker.get("reason") in (None, STILL) for marker in seen.markers.values())
    if moves and still:
        return None
    return warning(seen.markers)


def _refusal(path: str | Path, reason: str) -> str:
    return (
        f"{path}: {reason}, and no poses are written; click on each with --click U,V (of a video "
        "file) or in neurosim watch, name others with --colours, or take these with --doubtful"
    )


def _unclear(
    doubtful: NDArray, times: NDArray, poses: NDArray, lines: Sequence[CommandLine]
) -> NDArray:
    """Return where [N] a pair may not be the robot, unless it moves as commanded.

    Args:
        doubtful: [N] by its place alone.
        times: [N] on the robot's clock, s.
        poses: [N, 3].
        lines: commands sent to the motors.
    """
    doubtful = doubtful.copy()
    edges = np.flatnonzero(np.diff(np.pad(doubtful, 1).astype(int)))
    for begin, end in edges.reshape(-1, 2):
        if follows_commands(times[begin:end], poses[begin:end], lines):
            doubtful[begin:end] = False
    return doubtful


def _camera(source: Recording, calibration: str | Path | CameraModel | None) -> CameraModel:
    own = source.path / "calibration.json"
    if calibration is None and not own.exists():
        raise FileError(
            source.path,
            "has no calibration.json; make one with neurosim calibrate and name it with "
            "--calibration",
        )
    camera = _read_camera(own if calibration is None else calibration)
    if not camera.has_board:
        raise FileError(
            own if calibration is None or isinstance(calibration, CameraModel) else calibration,
            "has no points on the board; run neurosim calibrate with at least 4 marked points",
            field="rotation",
        )
    return camera


def _read_camera(calibration: str | Path | CameraModel | None) -> CameraModel | None:
    if calibration is None or isinstance(calibration, CameraModel):
        return calibration
    return CameraModel.read(calibration)


def _overlay_of(overlay: str | Path | None, session: int, sessions: int) -> Path | None:
    if overlay is None:
        return None
    path = Path(overlay)
    return path if sessions == 1 else path.with_name(f"{path.stem}-{session:03d}{path.suffix}")


def _session_summary(
    session: int, path: Path, seen: Track, clock: ClockFit, delay: Delay | None
) -> dict[str, Any]:
    return {
        "session": session,
        "video": path.name,
        "frames": len(seen.frame),
        "in_view": float(seen.in_view.mean()),
        "markers": seen.markers,
        "undecided": seen.undecided,
        "clock": asdict(clock),
        "motor_delay": None if delay is None else asdict(delay),
    }
