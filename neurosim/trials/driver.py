"""A saved controller as a session's source of commands, and the parts that a robot lacks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurosim.base.commands import TWO_WHEELS, Commands
from neurosim.base.errors import UserError
from neurosim.base.files import sha256
from neurosim.base.trajectory import Episode
from neurosim.controllers import (
    FixedPlan,
    Plan,
    SavedController,
    make_controller,
    read_controller,
)
from neurosim.controllers.base import observe
from neurosim.controllers.goals import Goals
from neurosim.loop.replan import Replanner, ReplanSettings
from neurosim.networks.control import NOT_READINGS, OF_GOALS, POSE_INPUTS
from neurosim.recording import closed_loop
from neurosim.recording.commands import Command, Observation, SeeingSource
from neurosim.recording.settings import Rig
from neurosim.robots.base import Clock, Counters, Robot, Sensors
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Task
from neurosim.tasks.registry import make_task
from tracking.camera.camera_model import CameraModel
from tracking.camera.cameras import Camera


def plan_of(saved: SavedController) -> list[Command]:
    """Return the commands of an open-loop controller without null ones; empty for other kinds."""
    if not saved.controller.open_loop:
        return []
    commands, active = saved.controller.commands(saved.genes[None], 0.0)
    return [Command.of(command) for command in commands[0][active[0]]]


class Driver:
    """Drives a robot with a saved controller: a :class:`~neurosim.recording.commands.SeeingSource`.

    An open-loop controller gives its commands in turn; a closed-loop one gives a command at each
    step of the episode, with the same goals in turn as in a simulator.

    Args:
        saved: the controller.
        episode: of the task.
        about: the controller's name for the recording.
        takes: the numbers of the robot's command.

    Attributes:
        sensors: names of the sensors that the controller reads.
        reads: whether the sensors are read, by the controller or for the task.
        needs_pose: whether the controller gets the pose, or the position of a goal relative to it.
        steps, rest, start: see :class:`~neurosim.recording.commands.SeeingSource`.
    """

    def __init__(
        self,
        saved: SavedController,
        episode: Episode,
        about: Mapping[str, Any],
        takes: Commands = TWO_WHEELS,
    ):
        family = saved.controller
        self._takes = takes
        self._family, self._episode, self._about = family, episode, dict(about)
        self._genes = torch.from_numpy(np.array(saved.genes, np.float64)[None])
        self._plan = plan_of(saved)
        self.sensors = tuple(name for name in family.inputs if name not in NOT_READINGS)
        self.reads = bool(self.sensors) or episode.readings
        self.needs_pose = not {*POSE_INPUTS, *OF_GOALS}.isdisjoint(family.inputs)
        self.steps = len(self._plan) if family.open_loop else episode.steps
        self.rest, self.start = episode.rest, saved.start
        self.begin()

    def begin(self) -> None:
        """Begin a trial: memory, goals and commands from the start."""
        self._memory, self._goals = self._family.start(1), Goals(self._episode, 1)
        self._next = 0

    def react(self, seen: Observation) -> Command:
        """Return the controller's command for an observation.

        Raises:
            UserError: if it is not a number; beyond the robot's limits it is cut.
        """
        if self._family.open_loop:
            command = self._plan[min(self._next, len(self._plan) - 1)]
            self._next += 1
            return command
        where = np.full(3, np.nan) if seen.pose is None else seen.pose
        pose = torch.from_numpy(np.array(where, np.float64)[None])
        readings = torch.tensor(
            [[seen.readings[name] for name in self.sensors]], dtype=torch.float64
        )
        with torch.no_grad():
            observed = observe(
                self._family.inputs,
                readings,
                self.sensors,
                pose,
                self._goals.at(pose) if self.needs_pose else None,
                seen.time,
            )
            given, self._memory = self._family.act(self._genes, observed, self._memory)
        speeds = dict(zip(self._family.outputs, given[0].tolist(), strict=True))
        if not all(map(math.isfinite, speeds.values())):
            raise UserError(
                f"the controller ({self._family.kind}) gave {speeds} after {seen.time:.1f} s, "
                "which is not a command: check its weights or its function"
            )
        numbers = tuple(
            min(max(speeds[one.name], one.low), one.high) for one in self._takes.numbers
        )
        return Command(numbers, self._episode.step)

    def describe(self) -> dict[str, Any]:
        """Return kind and origin of the controller."""
        return {"kind": self._family.kind, "controller": self._about}


def driver_of(
    controller: str | Path,
    rig: Rig,
    calibration: str | Path | None = None,
    steps: int | None = None,
) -> Driver:
    """Return a driver that runs a saved closed-loop controller, for a recording.

    Args:
        controller: its folder.
        rig: the robot, and its camera.
        calibration: the camera's, if the robot is tracked while it drives.
        steps: number of commands; by default that of its task.

    Raises:
        UserError: if it is a plan, or the robot lacks its inputs.
    """
    saved = read_controller(controller)
    if saved.controller.open_loop:
        raise UserError(
            f"--by-network needs a closed-loop controller, and {controller} is a {saved.kind}: "
            "drive it with neurosim run, which records it"
        )
    task = make_task(saved.task)
    driver = Driver(saved, task.episode, source_of(Path(controller)), rig.robot.commands)
    driver.steps = steps or driver.steps
    lacks = missing(saved, rig.robot, rig.camera, task, calibration=calibration, source=driver)
    if lacks:
        raise UserError("; ".join(lacks))
    return driver


def source_of(folder: Path) -> dict[str, str]:
    """Return the source of a controller: its path and a checksum of its files."""
    source = {"path": str(folder), "sha256": sha256(folder / "controller.json")}
    weights = folder / "weights.safetensors"
    return {**source, "weights_sha256": sha256(weights)} if weights.exists() else source


class Replanned:
    """Drives a robot with a plan that is replanned after every command.

    It is a :class:`~neurosim.recording.commands.SeeingSource`, as :class:`Driver` is.

    Args:
        saved: a plan.
        task: the task.
        simulator: the simulator for replanning.
        settings: how.
        clock: the robot's clock.
        about: the controller's name for the recording.
        seed: of the searches.

    Attributes:
        replanner: the replanner.
        steps, rest, start, sensors, reads, needs_pose: see
            :class:`~neurosim.recording.commands.SeeingSource`.

    Raises:
        UserError: if the controller is not a plan, or the simulator does not take its commands.
    """

    sensors: tuple[str, ...] = ()
    needs_pose = True

    def __init__(
        self,
        saved: SavedController,
        task: Task,
        simulator: Simulator,
        settings: ReplanSettings,
        clock: Clock,
        about: Mapping[str, Any],
        seed: int = 0,
    ):
        if not isinstance(saved.controller, FixedPlan):
            raise UserError(f"a {saved.kind} cannot be replanned: only a plan can")
        family = make_controller("plan", simulator, task, slots=len(saved.commands))
        assert isinstance(family, Plan)
        self.replanner = Replanner(
            simulator, task, family, saved.commands, settings, clock=clock, seed=seed
        )
        self.settings, self._about = settings, dict(about)
        self.steps, self.rest, self.start = self.replanner.steps, task.episode.rest, saved.start
        self.reads = task.episode.readings

    def begin(self) -> None:
        """Begin a trial: the plan is the first one again."""
        self.replanner.begin()

    def react(self, seen: Observation) -> Command | None:
        """Return the first command of the new plan; None: the task is done."""
        pose, ahead = (seen.pose, 0.0) if seen.sight is None else seen.sight
        assert pose is not None
        command = self.replanner.next(pose, ahead)
        return None if command is None else Command.of(command)

    def describe(self) -> dict[str, Any]:
        """Return the settings of replanning, and the origin of the plan."""
        return {"kind": "replanned", "controller": self._about, **asdict(self.settings)}


def missing(
    saved: SavedController,
    robot: Robot,
    camera: Camera | None,
    task: Task,
    *,
    calibration: str | Path | None = None,
    source: SeeingSource | None = None,
) -> list[str]:
    """Return the missing parts of a trial, a sentence for each; empty: it can be made.

    Args:
        saved: the controller.
        robot: connected or not.
        camera: its camera, or None.
        task: the task that judges the trial.
        calibration: the camera's.
        source: the source of commands; by default a :class:`Driver`.
    """
    takes = robot.commands
    driver = source or Driver(saved, task.episode, {}, takes)
    kind = robot.describe().get("kind", "robot")
    columns = [name for name in saved.controller.outputs if name != "duration"]
    lacking = []
    if sorted(columns) != sorted(takes.names):
        ours, theirs = set(columns) - set(takes.names), set(takes.names) - set(columns)
        same = ""
        if len(ours) == len(theirs) == 1:  # such as v, w and v, omega
            name, other = min(theirs), min(ours)
            same = f", or, if {other} is its {name}, import the log with --columns {name}={other}"
        lacking.append(
            f"the controller commands {', '.join(columns)}, and this robot ({kind}) is driven by "
            f"{', '.join(takes.names)}: drive another robot (--robot){same}"
        )
    elif saved.controller.open_loop and tuple(columns) != takes.names:
        lacking.append(
            f"the plan has its numbers in another order ({', '.join(columns)}) than this robot "
            f"({kind}): {', '.join(takes.names)}"
        )
    else:
        try:
            for command in plan_of(saved):
                takes.check(command.numbers)
        except UserError as error:
            lacking.append(f"this robot ({kind}) does not take a command of the plan: {error}")
    goals = [name for name in saved.controller.inputs if name in OF_GOALS]
    if goals and task.episode.goals is None:
        lacking.append(
            f"the controller needs {', '.join(goals)}, and the task {task.name} gives no goals"
        )
    sees = (
        camera is not None and calibration is not None and CameraModel.read(calibration).has_board
    )
    lacking += closed_loop.missing(driver, robot, sees=sees)
    poses = camera is not None or isinstance(robot, Counters)
    sensors = len(robot.sensor_names) if driver.reads and isinstance(robot, Sensors) else 0
    try:
        task.check_scored(poses, sensors > 0)
    except UserError as error:
        lacking.append(f"this robot ({kind}) does not suit the task: {error}")
    return lacking
