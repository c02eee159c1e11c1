"""Drive a robot with commands, record them, and film the robot."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from neurosim.base.checkpoint import difference
from neurosim.base.errors import FileError, LinkLost, UserError
from neurosim.base.files import atomic_path, check_new_folder, check_no_links, locked
from neurosim.base.provenance import robot_kind
from neurosim.recording.agreement import Pictures
from neurosim.recording.by_hand import Hand
from neurosim.recording.closed_loop import ClosedLoopSession, missing
from neurosim.recording.commands import CommandSource, RandomCommands, SeeingSource
from neurosim.recording.hand_session import HandSession
from neurosim.recording.session import FLASHES, BatteryLow, Session
from neurosim.recording.settings import Guard, RecordSettings, Rig
from neurosim.recording.spotter import Spotter
from neurosim.robots.base import Robot, Sensors
from tracking.camera.camera_model import CameraModel
from tracking.camera.cameras import Camera, VideoSink
from tracking.datasets.recordings import Recording
from tracking.live import Seen
from tracking.poses import marker_geometry
from tracking.sightings import seen_live
from tracking.track import describe_doubtful, track

__all__ = ["BatteryLow", "Guard", "RecordSettings", "Rig", "record"]


def record(
    out: str | Path,
    rig: Rig,
    source: CommandSource | SeeingSource | Hand,
    settings: RecordSettings,
    *,
    calibration: str | Path | None = None,
    live: bool = True,
    on_seen: Callable[[Seen], None] | None = None,
    resume: bool = False,
    options: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = lambda message: print(message, file=sys.stderr, flush=True),
) -> Recording:
    """Record a robot's commands and the video of its motion.

    Args:
        out: folder of the recording; a new one, or with ``resume`` an interrupted one.
        rig: the robot, not connected yet, and its camera, if any (tracking can use a video from
            another program).
        source: source of the commands; a closed-loop one gets observations; a person drives until
            the end of the drive.
        settings: further settings.
        calibration: calibration.json of the camera, copied into the recording.
        live: with a camera and its place over the board, track while recording: the robot is
            kept on the board by its position, and poses.csv is there when the recording ends.
        on_seen: called with every tracked frame; without live tracking with every frame.
        resume: continue an interrupted recording, in a new session.
        options: kept in recording.json, for resuming.
        say: takes messages for the user.

    Raises:
        UserError: if ``out`` is wrong, a setting differs from those of the recording to be resumed,
            or a robot lacks the inputs of a closed-loop source.
        LinkLost: if the robot stopped answering; the recording so far is kept.
        BatteryLow: if the battery fell below the limit.
        CameraLost: if the camera delivers no more frames; the robot was stopped at once.
    """
    out, robot, camera = Path(out), rig.robot, rig.camera
    if calibration is not None:
        _check_calibration(Path(calibration), camera, settings.markers)
    _check_guard(settings, robot, camera, live and calibration is not None)
    if resume and isinstance(source, SeeingSource):
        raise UserError(
            "a recording in closed loop cannot be resumed: start a new one; neurosim dataset takes "
            "several recordings"
        )
    if isinstance(source, SeeingSource):
        _check_source(source, robot, camera if live else None, calibration)
    if isinstance(source, RandomCommands):
        source = replace(source, takes=robot.commands)
    wanted = {**_wanted(robot, camera, source, settings), "virtual_lab": rig.lab}
    if options is not None:
        wanted["options"] = dict(options)
    if resume:
        _resumed(out, wanted)
    else:
        check_new_folder(out)
    with robot, contextlib.ExitStack() as kept:
        if not resume:
            Recording.create(out, wanted, calibration)
        # Read again, because now no other process writes in it.
        kept.enter_context(locked(out, "recorded into"))
        recording = _resumed(out, wanted) if resume else Recording(out)
        if resume and calibration is not None:
            _check_same_calibration(out, Path(calibration))
        if recording.meta["complete"]:
            _write_poses(recording, say)
            return recording
        # After connecting it can give more: its name, its firmware.
        recording.meta["robot"] = robot.describe()
        number = recording.sessions + 1
        # The part's name is written before the part exists: after a kill at any moment the
        # recording names all its files.
        video = f"video-{number:03d}.avi" if camera is not None else None
        session = recording.begin_session(video=video)
        try:
            with contextlib.ExitStack() as stack:
                log = stack.enter_context(recording.command_log())
                spotter, pictures = None, None
                if camera is not None:
                    frames = stack.enter_context(recording.frame_log())
                    sink = VideoSink(out / str(video), frames, session, camera.size, camera.fps)
                    stack.callback(sink.close)
                    model = _model(out) if live else None
                    if model is not None:
                        spotter = Spotter(
                            recording.meta["markers"],
                            model,
                            robot.clock.now,
                            stack.enter_context(recording.sighting_log()),
                            session,
                            say,
                            waits=camera.waits,
                            on_seen=on_seen,
                        )
                        stack.callback(spotter.close)
                    else:
                        pictures = Pictures(on_seen)
                    camera.start(_to_both(sink, spotter or pictures))
                driven = _kind_of(source)(
                    recording, session, robot, source, settings, log, say, camera, spotter, pictures
                )
                try:
                    done = driven.run()
                except LinkLost as error:
                    how = driven.go_on
                    raise LinkLost(
                        f"{error}; the commands so far are kept, put the robot {how}"
                    ) from None
                finally:
                    # Before the camera stops: it should see the robot at rest, and an error of the
                    # video must not leave the motors on.
                    _stop_quietly(robot)
                    if camera is not None:
                        camera.stop()
                    if isinstance(driven, ClosedLoopSession):
                        recording.meta["deadlines"] = asdict(driven.deadlines)
                    if driven.stopped is not None:
                        recording.meta["stopped"] = driven.stopped.describe()
                    recording.save_meta()
        finally:
            if rig.finish is not None:
                rig.finish(out, session)
        if camera is not None and camera.failed:
            # After the last command: only the end of the video is missing.
            raise UserError(
                f"the camera stopped delivering frames; {out} keeps the film so far: check the "
                "camera and continue with --resume"
            )
        recording.meta["complete"] = done
        recording.save_meta()
        if done and spotter is not None:
            _write_poses(recording, say)
    return recording


def _check_guard(
    settings: RecordSettings, robot: Robot, camera: Camera | None, tracked: bool
) -> None:
    """Raise an error, before the robot moves, if the guard or the readings are impossible."""
    guard = settings.guard
    if guard.by == "position" and guard.at_line != "ignore" and (camera is None or not tracked):
        raise UserError(
            "the guard needs the robot's position: give a camera and its calibration, or let the "
            "guard ignore the board's edge"
        )
    if settings.readings and not (isinstance(robot, Sensors) and robot.sensor_names):
        kind = robot.describe().get("kind", "robot")
        raise UserError(f"readings cannot be kept: this robot ({kind}) has no sensors")


def _check_source(
    source: SeeingSource,
    robot: Robot,
    camera: Camera | None,
    calibration: str | Path | None,
) -> None:
    """Raise an error, before the robot moves, if a controller cannot drive it."""
    sees = (
        camera is not None and calibration is not None and CameraModel.read(calibration).has_board
    )
    lacks = missing(source, robot, sees=sees)
    if lacks:
        raise UserError("; ".join(lacks))


def _kind_of(source: CommandSource | SeeingSource | Hand) -> type[Session]:
    """Return the class of session for a source of commands."""
    if isinstance(source, Hand):
        return HandSession
    return ClosedLoopSession if isinstance(source, SeeingSource) else Session


def _model(out: Path) -> CameraModel | None:
    """Return the recording's calibration, if it can make poses."""
    path = out / "calibration.json"
    model = CameraModel.read(path) if path.exists() else None
    return model if model is not None and model.has_board else None


def _to_both(sink: VideoSink, other: Spotter | Pictures) -> Callable[[float, np.ndarray], None]:
    def deliver(time: float, frame: np.ndarray) -> None:
        sink.write(time, frame)
        other.take(time, frame)

    return deliver


def _write_poses(recording: Recording, say: Callable[[str], None]) -> None:
    """Make poses.csv from live tracking; a session without it is tracked from its video.

    If live tracking is doubtful, all sessions are tracked again, because the whole video tells
    more.
    """
    model = _model(recording.path)
    sessions = range(1, recording.sessions + 1)
    try:
        seen = {number: seen_live(recording, number, model) for number in sessions}
        live = {number: one for number, one in seen.items() if one}
        try:
            summary = track(recording.path, live=live)
        except UserError:
            if not live:
                raise
            summary = track(recording.path)
        if doubtful := describe_doubtful(summary):
            say(doubtful)
    except UserError as error:
        say(
            f"the recording is complete, but its poses are not: {error}; track the video again: "
            f"neurosim track {recording.path}"
        )


def _stop_quietly(robot: Robot) -> None:
    # The error of a dead line was raised already; nothing can be sent over it.
    with contextlib.suppress(UserError):
        robot.stop()


def _wanted(
    robot: Robot,
    camera: Camera | None,
    source: CommandSource | SeeingSource | Hand,
    settings: RecordSettings,
) -> dict[str, Any]:
    wanted = {
        "robot": robot.describe(),
        "camera": camera.describe() if camera is not None else {"kind": "none"},
        "settings": {
            "commands": settings.commands,
            "source": source.describe(),
            "guard": asdict(settings.guard),
            **({"readings": True} if settings.readings else {}),
            "battery_limit": settings.battery_limit,
            "flashes": [list(flash) for flash in FLASHES],
        },
        "commands": robot.commands.measured(
            full=settings.full_speed, track=settings.track
        ).describe(),
        "markers": settings.markers,
        "board": settings.board,
        **({} if settings.place is None else {"place": settings.place.to_json()}),
    }
    return json.loads(json.dumps(wanted))  # tuples become lists, as in the file


def _resumed(out: Path, wanted: dict[str, Any]) -> Recording:
    recording = Recording(out)
    check_no_links(out)
    # A recording that was killed after its last command may lack its poses.
    unseen = not recording.is_tracked and (out / "sightings.csv").exists()
    if recording.meta["complete"] and not unseen:
        raise UserError(f"{out} is complete; there is nothing to resume")
    for part, keys in _SAME.items():
        was, now = recording.meta.get(part) or {}, wanted.get(part) or {}
        if not isinstance(was, dict):
            raise FileError(out / "recording.json", "expected an object", field=part)
        if part == "robot":
            was, now = ({**side, "kind": robot_kind(side)} for side in (was, now))
        if keys is not None:
            was, now = ({key: side.get(key) for key in keys} for side in (was, now))
        if (wrong := difference(was, now, part)) is not None:
            raise UserError(
                "{} was recorded with another {} ({!r}, now {!r}); resume with the same settings, "
                "or start a new recording".format(out, *wrong)
            )
    return recording


#: Parts, or keys of parts, that must be the same when a recording is resumed.
_SAME: dict[str, tuple[str, ...] | None] = {
    "settings": None,
    "commands": ("numbers",),
    "markers": None,
    "board": None,
    "place": None,
    "robot": ("kind", "ports", "invert", "regulation", "dialect", "baud", "full_speed"),
    "camera": ("kind", "source", "size", "fps"),
    "virtual_lab": ("robot_seed", "place"),
}


def _check_calibration(path: Path, camera: Camera | None, markers: dict[str, Any]) -> None:
    """Raise an error for a wrong calibration before the robot moves."""
    model = CameraModel.read(path)
    if model.has_board:
        marker_geometry(markers, model)
    size = tuple(model.image_size)
    if camera is not None and tuple(camera.size) != size:
        raise UserError(
            f"{path} is of pictures of {size[0]}x{size[1]}, but the camera's are "
            f"{camera.size[0]}x{camera.size[1]}; calibrate at the size that is recorded"
        )


def _check_same_calibration(out: Path, calibration: Path) -> None:
    kept = out / "calibration.json"
    if not kept.exists():
        with atomic_path(kept) as partial:
            shutil.copyfile(calibration, partial)
    elif kept.read_bytes() != calibration.read_bytes():
        raise UserError(f"{out} was recorded with another calibration than {calibration}")
