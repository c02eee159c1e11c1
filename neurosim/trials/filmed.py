"""Trials in reality as ``neurosim run`` makes them: recorded, tracked, and judged by the task."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import Seed, checks
from neurosim.base.errors import UserError
from neurosim.base.interrupts import not_suspended
from neurosim.base.trajectory import Tracked, planned
from neurosim.controllers import SavedController
from neurosim.controllers.base import WHEELS
from neurosim.lab import LabParams, VirtualRig
from neurosim.recording.settings import Rig
from neurosim.robots.base import Proximity, Robot
from neurosim.simulators.sampling import trial_steps
from neurosim.trials.by_hand import put_at
from neurosim.trials.driver import missing
from neurosim.trials.floor import about_robot, on_floor
from neurosim.trials.trial import run_trial
from tracking.camera.cameras import Camera, open_camera
from tracking.track import track

#: Of the virtual roof camera's frames, pixels: half of the lab's own, for a third of the time.
SIZE = (320, 240)


class Driven:
    """Drives controllers of any kind, and gives the robot's poses.

    Every trial is a separate session. Poses are corrected for the error of the start. Without a
    camera, poses come from the counters.

    Attributes:
        controller: the family.
        task: judges the trials, and has their start.
        instruction: a person's task before each trial, or None.
    """

    instruction: str | None

    def __init__(
        self,
        controller: Any,
        task: Any,
        robot: Robot | None = None,
        camera: Camera | None = None,
        calibration: str | Path | None = None,
    ):
        """Prepare trials.

        Args:
            controller: the family.
            task: the task.
            robot: connected; None: each trial has another one.
            camera: its camera, or None.
            calibration: the camera's.

        Raises:
            UserError: if the robot lacks inputs of the controller or the task.
        """
        self.controller, self.task = controller, task
        self._robot, self._camera, self._calibration = robot, camera, calibration
        self._steps = trial_steps(controller, task.episode)
        if robot is None:
            self.instruction = None
            return
        saved = self._saved(np.zeros(controller.genes))
        if lacks := missing(saved, robot, camera, task, calibration=calibration):
            raise UserError("; ".join(lacks))
        self.instruction = f"{put_at(task.start)}, and press Enter"

    def describe(self) -> dict[str, Any]:
        """Return the description of the robot."""
        assert self._robot is not None
        return about_robot(self._robot)

    def stop(self) -> None:
        """Stop the robot, because a trial is given up."""
        if self._robot is not None:
            self._robot.stop()

    def trial(self, genes: NDArray[np.float64], number: int) -> Tracked:
        """Drive an individual [G] once.

        Args:
            genes: of it.
            number: of the trial.

        Returns:
            Its fitness, and the poses after each of its commands and at rest; NaN for null
            commands, and after a stop of the robot.

        Raises:
            UserError: if the robot was not seen at its start.
            RobotError: if it was lost.
        """
        start, rest = np.array(self.task.start, np.float64), self.task.episode.rest
        poses = np.full((self._steps, 3), np.nan)
        given = np.arange(self._steps) < self.task.episode.steps
        if self.controller.open_loop:
            commands, active = self.controller.commands(genes[None], rest)
            if not active.any():
                poses[:] = start
                still = np.tile(start, (1, 1, self._steps + 1, 1))
                judged = self.task.judge(planned(still, commands, active, rest))
                return Tracked(float(judged.fitness[0, 0]), poses)
            given = active[0]
        with (
            tempfile.TemporaryDirectory() as name,
            self._opened(number, Path(name)) as (rig, calibration),
        ):
            self._saved(genes).write(Path(name) / "controller")
            report = run_trial(
                Path(name) / "controller",
                Path(name) / "trial",
                rig,
                track=track,
                calibration=calibration,
            )
        actual = report["actual"]
        seen = np.array([[np.nan] * 3 if pose is None else pose for pose in actual["poses"]])
        given = np.flatnonzero(given)[: len(seen) - 1]
        poses[given] = seen[1:]
        if rest > 0 and not report["ended_early"] and actual["rest"] is not None:
            poses[-1] = actual["rest"]
        return Tracked(float(actual["fitness"]), se2.compose(start, se2.between(seen[0], poses)))

    def _saved(self, genes: NDArray[np.float64]) -> SavedController:
        """Return an individual in its saved form, without predictions."""
        task, start = self.task.describe(), self.task.start
        saved = SavedController.of(self.controller, genes, task, start)
        nothing = {
            "poses": [list(start)] * (len(saved.given) + 1),
            "rest": list(start),
            "fitness": 0.0,
            "completes": False,
        }
        return replace(saved, predicted=nothing)

    @contextmanager
    def _opened(self, number: int, folder: Path) -> Iterator[tuple[Rig, Path | str]]:
        """Give the robot and the camera of a trial, and the camera's calibration."""
        yield Rig(self._robot, self._camera), self._calibration


class VirtualNxt(Driven):
    """Drives controllers on an NXT of the virtual lab, like ``neurosim run``, and tracks it.

    Every trial has its own noise.

    Attributes:
        changes: of the lab's parameters, by name.
    """

    @checks
    def __init__(
        self,
        controller: Any,
        task: Any,
        lab_seed: Seed = 0,
        seed: Seed = 0,
        slip: Annotated[float, Meta(ge=0, le=0.9)] | None = None,
        battery: Annotated[float, Meta(ge=6, le=10)] | None = None,
        worn: Annotated[float, Meta(ge=0, le=0.5)] = 0.0,
    ):
        """Choose robot and floor.

        Args:
            controller: the family.
            task: the task.
            lab_seed: Number of the virtual lab's robot and board.
            seed: Random seed of the lab's noise between trials.
            slip: Mean slip of the wheels on the floor, as a fraction of the distance.
                [default: the lab's own]
            battery: The battery's voltage before a trial, V.  [default: the robot's own]
            worn: Wear of the left wheel, as a fraction of its diameter.

        Raises:
            UserError: if the controller does not command wheels, or a value is out of range.
        """
        if {*controller.outputs} - {"duration"} != {*WHEELS}:
            raise UserError(
                f"the virtual NXT has two wheels; a controller of the kind {controller.kind} "
                f"commands {', '.join(controller.outputs)}"
            )
        super().__init__(controller, task)
        self._lab_seed, self._seed = lab_seed, seed
        changes = {"slip_mean": slip, "battery": battery}
        if worn:
            changes["diameter_left"] = (1.0 - worn) * LabParams.sampled(lab_seed).diameter_left
        assert set(changes) <= {field.name for field in fields(LabParams)}
        self.changes = {name: value for name, value in changes.items() if value is not None}

    def describe(self) -> dict[str, Any]:
        """Return the description of the robot."""
        return {
            "kind": "virtual-nxt",
            "virtual": True,
            "lab_seed": self._lab_seed,
            "seed": self._seed,
            "changes": self.changes,
            "task": self.task.describe(),
        }

    @contextmanager
    def _opened(self, number: int, folder: Path) -> Iterator[tuple[Rig, Path | str]]:
        noise = int(np.random.default_rng([self._seed, number, 0x0271]).integers(2**31))
        with VirtualRig(
            self._lab_seed,
            noise_seed=noise,
            start=self.task.start,
            camera_size=SIZE,
            changes=self.changes,
        ) as rig:
            assert rig.camera is not None
            o, calibration = rig.camera.optics, folder / "calibration.json"
            model = o.calibration
            model.write(calibration)
            yield Rig.of_lab(rig), calibration


@contextmanager
def on_robot(
    robot: Robot,
    controller: Any,
    task: Any,
    simulator: Any,
    camera: str | None = None,
    calibration: str | Path | None = None,
) -> Iterator[Any]:
    """Connect a robot and give its reality.

    A robot with proximity sensors and without a camera stays on its floor between trials
    (:class:`~neurosim.trials.floor.OnFloor`); a person puts any other one back.

    Args:
        robot: not connected yet.
        controller, task, simulator: see :func:`neurosim.trials.realities.make_reality`.
        camera: a camera's number, a file or URL that OpenCV opens, or None.
        calibration: the camera's.

    Raises:
        UserError: if the robot lacks inputs of the controller or the task.
        RobotError: if it cannot be reached.
    """
    if camera is None and isinstance(robot, Proximity):
        with on_floor(robot, controller, task, simulator) as reality:
            yield reality
        return
    with not_suspended(), robot:
        film = None if camera is None else open_camera(camera, robot.clock.now)
        yield Driven(controller, task, robot, film, calibration)
