"""Run a controller on a robot and hold what happened against what was predicted.

Section 7.2 of Pretorius, du Plessis and Cilliers (2009), Figures 6 and 7. A trial is a recording
of a controller at work, with ``trial.json`` beside it.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import sha256, write_json
from neurosim.base.provenance import is_virtual
from neurosim.base.trajectory import Trajectory
from neurosim.controllers import SavedController, read_controller
from neurosim.recording.commands import Command, FixedCommands
from neurosim.recording.record import Guard, RecordSettings, record
from neurosim.robots.base import Robot
from neurosim.tasks.registry import make_task
from tracking.camera.camera_model import CameraModel
from tracking.camera.cameras import Camera
from tracking.datasets.displacements import Track
from tracking.datasets.recordings import CommandLine, Poses, Recording

FORMAT, VERSION = "neurosim-trial", 1

#: The motors have run down this long after the last command, s.
AT_REST = 0.5


def run_trial(
    controller: str | Path,
    out: str | Path,
    robot: Robot,
    camera: Camera | None,
    *,
    track: Callable[[Path], Any],
    calibration: str | Path | None = None,
    guard: Guard = Guard(at_line="end", margin=0.05),  # noqa: B008 - frozen
    settings: dict[str, Any] | None = None,
    finish: Callable[[Path, int], None] | None = None,
    lab: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Drive a plan, record and track it, and compare.

    The trial ends where a light sensor meets the perimeter line, unless the guard says otherwise:
    the robot is then at the grid's edge or beyond, with little left to win and a fall to fear.

    Args:
        controller: folder of a plan.
        out: folder of the trial; new.
        robot: standing at the plan's start pose.
        camera: what films it.
        track: tracks the recording in a folder, where it was not tracked as it was made.
        calibration: the camera's.
        guard: of the perimeter line.
        settings: of :class:`~neurosim.recording.record.RecordSettings`, beside commands and guard.
        finish, lab: as :func:`neurosim.recording.record.record` takes them.

    Returns:
        What trial.json says.

    Raises:
        UserError: if anything on the way is not what it should be.
    """
    plan = read_controller(controller)
    if calibration is not None and not CameraModel.read(calibration).has_board:
        raise UserError(
            f"{calibration} has no points on the board, so poses cannot be held against the plan; "
            "run neurosim calibrate with at least 4 marked points"
        )
    commands = [Command(*command) for command in plan.given]
    record(
        out,
        robot,
        camera,
        FixedCommands(commands),
        RecordSettings(len(commands), guard, **(settings or {})),
        calibration=calibration,
        finish=finish,
        lab=lab,
    )
    if not Recording(out).is_tracked:
        track(Path(out))
    return compare(controller, out)


def compare(controller: str | Path, out: str | Path) -> dict[str, Any]:
    """Hold a tracked recording of a plan against its prediction; write and return trial.json.

    Raises:
        UserError: if the recording is not of this plan, or the robot was not seen at its start.
    """
    plan, recording = read_controller(controller), Recording(out)
    motor = [line for line in recording.commands() if line.is_motor and line.session == 1]
    sent = [line for line in motor if line.kind == "command"]
    _check_same(plan, sent, recording.path)
    boundaries = [line.time for line in motor][: len(sent) + 1]
    if len(boundaries) == len(sent):
        raise UserError(f"{recording.path}: the recording stops before the last command ended")
    poses = recording.poses().of_session(1)
    track = Track(poses.time, poses.pose, poses.quality)
    actual = [_pose_at(track, time) for time in boundaries]
    # Where a command was cut short is not where it would have led.
    cut = actual.pop() if any(line.kind == "cut" for line in motor) else None
    ended_early = len(sent) < len(plan.given) or len(actual) == len(sent)
    if actual[0] is None:
        raise UserError(f"{recording.path}: the robot was not seen at its start")
    dense, segment = _dense(poses, boundaries)
    driven = Trajectory.of_track(
        dense[:, 0],
        dense[:, 1:],
        segment,
        np.array([(line.left, line.right, line.duration) for line in sent] + [(0.0, 0.0, 0.0)]),
        np.append(np.ones(len(sent), bool), False),
    )
    judged = make_task(plan.task).judge(driven)
    predicted = plan.predicted["poses"]
    rest = _median_pose(poses, boundaries[-1] + AT_REST, boundaries[-1] + 2 * AT_REST)
    report = {
        "controller": _source(Path(controller) / "controller.json"),
        "simulator": dict(plan.simulator) or None,
        "virtual": bool(is_virtual(recording.meta)),
        "task": dict(plan.task),
        "commands": [list(command) for command in plan.given],
        "plan_length": len(plan.commands),
        "start": {"planned": list(plan.start), "actual": actual[0]},
        "predicted": {
            "poses": predicted,
            "rest": plan.predicted["rest"],
            "fitness": plan.predicted["fitness"],
            "completes": plan.predicted["completes"],
            "probability": plan.predicted.get("probability"),
        },
        "actual": {
            "poses": [*actual, *[None] * (len(predicted) - len(actual))],
            "cut": cut,
            "rest": rest,
            "fitness": float(judged.fitness),
            "completes": bool(judged.success) and not ended_early,
            "path": np.round(dense, 5).tolist(),
        },
        "errors": [
            _error(number, was, actual[number] if number < len(actual) else None)
            for number, was in enumerate(predicted)
        ],
        "ended_early": ended_early,
        "created": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    write_json(recording.path / "trial.json", FORMAT, VERSION, report)
    return report


def _check_same(plan: SavedController, sent: list[CommandLine], path: Path) -> None:
    for number, (command, line) in enumerate(zip(plan.given, sent, strict=False), start=1):
        if (line.left, line.right) != command[:2] or abs(line.duration - command[2]) > 1e-6:
            raise UserError(f"{path}: command {number} is not the plan's; it is another's trial")
    if not sent:
        raise UserError(f"{path}: no command was sent")


def _pose_at(track: Track, time: float) -> list[float] | None:
    found = track.pose_at(time)
    return None if found is None else [float(value) for value in found[0]]


def _dense(poses: Poses, boundaries: list[float]) -> tuple[NDArray, NDArray]:
    """Return the seen poses [M, 4] (time, x, y, theta) and during which command each was."""
    seen = np.isfinite(poses.pose).all(axis=1)
    seen &= (poses.time >= boundaries[0]) & (poses.time <= boundaries[-1] + 2 * AT_REST)
    times = poses.time[seen]
    segment = np.searchsorted(boundaries, times, side="right") - 1
    return np.column_stack([times, poses.pose[seen]]), segment


def _median_pose(poses: Poses, begin: float, end: float) -> list[float] | None:
    rows = (poses.time >= begin) & (poses.time <= end) & np.isfinite(poses.pose).all(axis=1)
    return np.median(poses.pose[rows], axis=0).tolist() if rows.any() else None


def _error(number: int, was: list[float], now: list[float] | None) -> dict[str, Any] | None:
    if now is None:
        return None
    turn = now[2] - was[2]
    return {
        "command": number,
        "position": math.hypot(now[0] - was[0], now[1] - was[1]),
        # The tracker's first heading is known up to whole turns only.
        "heading": math.remainder(turn, 2 * math.pi),
    }


def _source(path: Path) -> dict[str, str]:
    return {"path": str(path.parent), "sha256": sha256(path)}
