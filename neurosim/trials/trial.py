"""Run a controller on a robot and compare the drive with the prediction.

A trial is a recording of a controller's drive, with a ``trial.json``. Poses come from a camera, or
from the counters of the wheels. For plans this is section 7.2 of Pretorius, du Plessis and Cilliers
(2009), Figures 6 and 7; for closed-loop controllers see :class:`~neurosim.trials.driver.Driver`.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import formats, se2
from neurosim.base.errors import UserError
from neurosim.base.files import read_json, write_json
from neurosim.base.perimeter import Perimeter
from neurosim.base.provenance import is_virtual
from neurosim.base.trajectory import RUN_DOWN, Trajectory
from neurosim.controllers import SavedController, read_controller
from neurosim.loop.replan import Foreseen, ReplanSettings
from neurosim.recording.commands import Command, CommandSource, FixedCommands, SeeingSource
from neurosim.recording.perimeter import Stop
from neurosim.recording.record import Guard, RecordSettings, Rig, record
from neurosim.robots.base import Counters, Robot, WholeSpeeds
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.registry import make_task
from neurosim.trials.driver import Driver, Replanned, missing, plan_of, source_of
from tracking.camera.camera_model import CameraModel
from tracking.datasets.displacements import Track
from tracking.datasets.recordings import CommandLine, Observations, Poses, Recording

FORMAT, VERSION = "neurosim-trial", 1
#: File of the predictions at each command of a replanned plan.
FORESEEN, FORMAT_FORESEEN = "foreseen.json", "neurosim-foreseen"

#: x (m), y (m), heading (rad), or None if unknown.
Pose = list[float] | None


def run_trial(
    controller: str | Path,
    out: str | Path,
    rig: Rig,
    *,
    track: Callable[[Path], Any] | None = None,
    calibration: str | Path | None = None,
    guard: Guard = Guard(at_line="end", margin=0.05),  # noqa: B008 - frozen
    settings: dict[str, Any] | None = None,
    replan: tuple[Simulator, ReplanSettings] | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Drive a robot with a controller, record and track it, and compare.

    A plan is sent unchanged, or replanned after every command; a closed-loop controller gives a
    command at each step of its task. Poses come from a camera, or, without one, from the counters
    of the wheels and the start pose.

    The trial ends where a light sensor meets the perimeter line, unless the guard is set otherwise:
    the robot is then at the grid's edge or beyond, can gain little, and may fall.

    Args:
        controller: folder of a controller of any kind.
        out: folder of the trial; new.
        rig: the robot at the controller's start pose, and its camera.
        track: tracks the recording in a folder, if it was not tracked live.
        calibration: the camera's.
        guard: of the perimeter line.
        settings: of :class:`~neurosim.recording.record.RecordSettings`, in addition to commands and
        guard.
        replan: simulator and settings for replanning a plan after every command; None: no
            replanning.
        seed: of replanning.

    Returns:
        The content of trial.json.

    Raises:
        UserError: if a file or setting is wrong; before the robot moves, if it lacks inputs of the
            controller or the task.
    """
    saved, robot, camera = read_controller(controller), rig.robot, rig.camera
    task = make_task(saved.task)
    if calibration is not None and not CameraModel.read(calibration).has_board:
        raise UserError(
            f"{calibration} has no points on the board, so poses cannot be compared with the "
            "plan; run neurosim calibrate with at least 4 marked points"
        )
    source: CommandSource | SeeingSource | None = None
    if replan is not None:
        about = source_of(Path(controller))
        source = Replanned(saved, task, *replan, clock=robot.clock, about=about, seed=seed)
    lacks = missing(saved, robot, camera, task, calibration=calibration, source=source)
    if lacks:
        raise UserError("; ".join(lacks))
    if source is not None:
        count = source.steps
    elif saved.controller.open_loop and camera is not None and not task.episode.readings:
        source = FixedCommands(plan_of(saved))
        count = len(source.commands)
    else:
        source = Driver(saved, task.episode, source_of(Path(controller)), robot.commands)
        count = source.steps
    known = _perimeter_of(saved)
    around: dict[str, Any] = {} if known is None else {"board": asdict(known.board)}
    if task.place is not None:
        around["place"] = task.place
    record(
        out,
        rig,
        source,
        RecordSettings(count, guard, **{**_size_of(robot), **around, **(settings or {})}),
        calibration=calibration,
    )
    if isinstance(source, Replanned):
        _write_foreseen(Path(out) / FORESEEN, source.replanner.foreseen)
    if camera is not None and not Recording(out).is_tracked and track is not None:
        track(Path(out))
    return compare(controller, out)


def compare(controller: str | Path, out: str | Path) -> dict[str, Any]:
    """Compare a recording of a controller with its prediction; write and return trial.json.

    Raises:
        UserError: if the recording is not of this controller, or the camera did not see the robot
            at its start.
    """
    saved, recording = read_controller(controller), Recording(out)
    source, plan = source_of(Path(controller)), plan_of(saved)
    driven, foreseen = _Drive.read(recording), _read_foreseen(recording.path / FORESEEN)
    by_command = bool(plan)
    if foreseen is not None:
        # The plan changed after every command: only the sent commands exist.
        plan = [Command(line.numbers, line.duration) for line in driven.sent]
        _check_driver(source, recording)
    elif plan:
        _check_same(plan, driven.sent, recording.path)
    else:
        _check_driver(source, recording)
    task = make_task(saved.task)
    # A robot that must stop is observed until it rests; a plan's always is.
    trajectory = driven.trajectory(by_command, by_command or task.episode.rest > 0)
    stopped = recording.meta.get("stopped")
    stop = None if stopped is None else Stop.of(stopped)
    judged = task.ended(task.judge(trajectory), 0 if stop is None else stop.code)
    ended_early = driven.cut or len(driven.sent) < (len(plan) or task.episode.steps)
    completes = bool(judged.success) and not ended_early
    predicted, actual = saved.predicted, driven.at
    # The pose at a cut is not the end of the command.
    reached = actual[:-1] if driven.cut else actual
    if foreseen is not None:
        # The probability is that of the plan in open loop, and a cut plan was not predicted to rest
        # at the pose of its last search.
        predicted = {**predicted, **foreseen, "probability": None}
        if ended_early:
            predicted["rest"] = None
    poses = predicted.get("poses")
    boundaries = len(plan or driven.sent) + 1
    report = {
        "kind": saved.kind,
        "controller": source,
        "simulator": dict(saved.simulator) or None,
        "virtual": bool(is_virtual(recording.meta)),
        "task": dict(saved.task),
        "columns": [
            *({"name": one.name, "unit": one.unit} for one in recording.takes.numbers),
            {"name": "duration", "unit": "s"},
        ],
        "commands": [[*line.numbers, line.duration] for line in driven.sent],
        "start": {"planned": list(saved.start), "actual": actual[0]},
        "predicted": {
            name: predicted.get(name)
            for name in ("poses", "rest", "fitness", "completes", "probability")
        },
        "actual": {
            "seen_by": driven.seen_by,
            "poses": [*reached, *[None] * (boundaries - len(reached))],
            "cut": actual[-1] if driven.cut else None,
            "rest": driven.rest,
            "fitness": _whole(task, judged),
            "completes": completes,
            "reason": _reason(task, judged, stop, ended_early),
            "cut_error": driven.cut_error(poses),
            "path": np.round(driven.path, 5).tolist(),
        },
        "errors": [],
        "ended_early": ended_early,
        "stopped": stopped,
        "guard": {
            "predicted": _perimeter_of(saved) is not None,
            "driven": _guarded(recording),
        },
        "replanned": foreseen is not None,
        "deadlines": recording.meta.get("deadlines"),
        "observations": driven.summary(),
        "created": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    if plan:
        # All commands of the plan, also those that were not sent.
        report["commands"] = [list(command.row) for command in plan]
        report["plan_length"] = len(saved.commands) or len(plan)
        report["errors"] = [
            _error(number, was, reached[number] if number < len(reached) else None)
            for number, was in enumerate(poses or [])
        ]
    write_json(recording.path / "trial.json", FORMAT, VERSION, report)
    return report


def _write_foreseen(path: Path, foreseen: list[Foreseen]) -> None:
    """Write the predictions at each command of a replanned plan."""
    commands = [one._asdict() for one in foreseen]
    write_json(path, FORMAT_FORESEEN, VERSION, {"commands": commands})


def _read_foreseen(path: Path) -> dict[str, Any] | None:
    """Return the prediction of a replanned plan: poses, and the pose at rest.

    The poses are the start, and the predicted end of each command when it was given. None: it was
    not replanned.
    """
    if not path.exists():
        return None
    content = read_json(path, FORMAT_FORESEEN, VERSION, formats.Foreseen)
    commands = content["commands"]
    if not commands:
        return None
    poses = [commands[0]["pose"], *(one["after"] for one in commands)]
    return {"poses": poses, "rest": commands[-1]["rest"]}


@dataclass(frozen=True)
class _Drive:
    """The commands of a recording, and the robot's poses.

    Attributes:
        sent: the commands.
        boundaries: times of the commands' beginnings, and of the last end, s.
        cut: whether the last was cut short.
        seen_by: source of the poses: ``camera``, ``counters``, or None.
        at: poses at the boundaries.
        rest: pose at rest.
        path: [M, 4] time (s) and pose, all known ones.
        looks: the controller's observations, or None.
    """

    sent: list[CommandLine]
    boundaries: list[float]
    cut: bool
    seen_by: str | None
    at: list[Pose]
    rest: Pose
    path: NDArray
    looks: Observations | None

    @classmethod
    def read(cls, recording: Recording) -> _Drive:
        """Read the first session of a recording.

        Raises:
            UserError: if no command was sent, the last did not end, or the robot was not seen.
        """
        motor = [
            line
            for line in recording.commands().itertuples()
            if line.is_motor and line.session == 1
        ]
        sent = [line for line in motor if line.kind == "command"]
        if not sent:
            raise UserError(f"{recording.path}: no command was sent")
        boundaries = [line.time for line in motor][: len(sent) + 1]
        if len(boundaries) == len(sent):
            raise UserError(f"{recording.path}: the recording stops before the last command ended")
        looks = recording.observations()
        looks = None if looks is None else looks.of_session(1)
        cut = any(line.kind == "cut" for line in motor)
        if recording.is_tracked:
            tracked = _by_camera(recording.poses().of_session(1).certain(), boundaries)
            if tracked[0][0] is None:
                raise UserError(f"{recording.path}: the robot was not seen at its start")
            return cls(sent, boundaries, cut, "camera", *tracked, looks)
        if looks is not None and np.isfinite(looks.pose).all(axis=1).any():
            return cls(sent, boundaries, cut, "counters", *_by_counters(looks, len(sent)), looks)
        nowhere: list[Pose] = [None] * len(boundaries)
        return cls(sent, boundaries, cut, None, nowhere, None, np.empty((0, 4)), looks)

    def trajectory(self, timed: bool, stops: bool) -> Trajectory:
        """Return the trajectory for the task.

        Args:
            timed: whether commands have their duration as a column.
            stops: whether the motion until rest belongs to it.
        """
        columns = [(*line.numbers, *([line.duration] * timed)) for line in self.sent]
        commands = np.array(columns + [(0.0,) * len(columns[0])] * stops)
        active = np.append(np.ones(len(self.sent), bool), [False] * stops)
        readings = None
        if self.looks is not None and self.looks.names:
            readings = self.looks.readings[: len(commands)]
        if self.seen_by is None:
            durations = np.append(np.diff(self.boundaries), [0.0] * stops)
            return Trajectory(None, commands, durations, readings, active)
        times = self.path[:, 0]
        until = self.boundaries[-1] + (2 * RUN_DOWN if stops else 0.0)
        path = self.path[times <= until]
        segment = np.searchsorted(self.boundaries, path[:, 0], side="right") - 1
        segment = np.clip(segment, 0, len(commands) - 1)
        return Trajectory.of_track(path[:, 0], path[:, 1:], segment, commands, active, readings)

    def cut_error(self, predicted: list[list[float]] | None) -> dict[str, Any] | None:
        """Return a robot's distance from the prediction at the cut of its last command.

        The predicted pose there is on the arc of constant twist to the command's end.

        Args:
            predicted: poses [K + 1, 3] before the first command and after each (m, m, rad).
        """
        last = len(self.sent) - 1
        if not self.cut or predicted is None or len(predicted) < last + 2 or self.at[-1] is None:
            return None
        before, after = np.array(predicted[last : last + 2], float)
        fraction = (self.boundaries[-1] - self.boundaries[-2]) / self.sent[-1].duration
        part = se2.arc(se2.between(before, after), min(max(fraction, 0.0), 1.0))
        return _error(last + 1, se2.compose(before, part).tolist(), self.at[-1])

    def summary(self) -> dict[str, Any] | None:
        """Return the number of observations, and a summary of the readings; None without any."""
        if self.looks is None:
            return None
        columns = zip(self.looks.names, self.looks.readings.T, strict=True)
        sensors = {
            name: {"min": float(c.min()), "mean": float(c.mean()), "max": float(c.max())}
            for name, c in ((name, c[np.isfinite(c)]) for name, c in columns)
            if len(c)
        }
        return {"looks": len(self.looks.time), "sensors": sensors}


def _by_camera(poses: Poses, boundaries: list[float]) -> tuple[list[Pose], Pose, NDArray]:
    """Return the poses seen by a camera: at the boundaries, at rest, and the whole path."""
    track, end = Track(poses.time, poses.pose, poses.quality), boundaries[-1]
    at = [_pose_at(track, time) for time in boundaries]
    seen = np.isfinite(poses.pose).all(axis=1)
    seen &= (poses.time >= boundaries[0]) & (poses.time <= end + 2 * RUN_DOWN)
    path = np.column_stack([poses.time[seen], poses.pose[seen]])
    resting = path[path[:, 0] >= end + RUN_DOWN, 1:]
    return at, np.median(resting, axis=0).tolist() if len(resting) else None, path


def _by_counters(looks: Observations, count: int) -> tuple[list[Pose], Pose, NDArray]:
    """Return the poses by the counters, in the form of a camera's."""
    # An observation for every command, one at the stop of the motors, and one at rest.
    path = np.column_stack([looks.time, looks.pose])
    at = [pose.tolist() for pose in looks.pose[: count + 1]]
    return at, looks.pose[-1].tolist(), path


def _whole(task: Task, judged: Judgement) -> float:
    """Return the fitness of a trial from all of the task's starts, if all were like this one."""
    return float(task.whole(np.repeat(judged.fitness, task.trial_starts)))


def _perimeter_of(saved: SavedController) -> Perimeter | None:
    """Return the perimeter of a controller's simulator; None: it has none."""
    return Perimeter.from_json(saved.simulator.get("perimeter"))


def _guarded(recording: Recording) -> bool:
    """Return whether the guard could stop the robot at the board's edge or its line."""
    meta = recording.meta
    guard = meta.get("settings", {}).get("guard") or {}
    if guard.get("at_line") == "ignore":
        return False
    sees = guard.get("by") != "position" and bool(meta["robot"].get("light_sensors"))
    return sees or (meta.get("camera") or {}).get("kind") != "none"


def _reason(task: Task, judged: Judgement, stop: Stop | None, ended_early: bool) -> str | None:
    """Return why the task is not done, in words that follow "the robot"; None if it is done."""
    if stop is not None:
        return str(stop).removeprefix("the robot ")
    if judged.reason >= 0:
        return task.why(int(judged.reason))
    return "was stopped before the end" if ended_early else None


def _size_of(robot: Robot) -> dict[str, float]:
    """Return full speed (m/s) and wheel base (m), if a robot gives them."""
    sizes = {}
    if isinstance(robot, WholeSpeeds):
        sizes["full_speed"] = robot.full_speed * robot.speed_unit
    if isinstance(robot, Counters):
        sizes["track"] = robot.geometry.wheel_base
    return sizes


def _check_driver(source: Mapping[str, str], recording: Recording) -> None:
    driver = recording.meta["settings"].get("source", {}).get("controller") or {}
    if any(driver.get(name) != value for name, value in source.items() if name != "path"):
        raise UserError(
            f"{recording.path}: another controller drove it ({driver.get('path')}), or this one "
            "has changed since"
        )


def _check_same(plan: list[Command], sent: list[CommandLine], path: Path) -> None:
    for number, (one, line) in enumerate(zip(plan, sent, strict=False), start=1):
        same = line.numbers == one.numbers
        if not same or abs(line.duration - one.duration) > 1e-6:
            raise UserError(
                f"{path}: command {number} is not that of the plan; this is a trial of another plan"
            )


def _pose_at(track: Track, time: float) -> Pose:
    sample = track.pose_at(time)
    return None if sample is None else [float(value) for value in sample[0]]


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
