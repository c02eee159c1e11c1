"""The virtual lab's NXT as the reality of back to reality: plans are driven, filmed and tracked."""

from __future__ import annotations

import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import Seed, checks
from neurosim.base.errors import UserError
from neurosim.base.trajectory import Tracked, planned
from neurosim.controllers import FixedPlan, SavedController
from neurosim.controllers.plan import COMMAND_NAMES, commands_of
from neurosim.lab import LabParams, VirtualRig
from neurosim.trials.trial import run_trial
from tracking.camera.camera_model import CameraModel
from tracking.track import track

#: Of the roof camera's frames, pixels: half of the lab's own, for a third of the time.
SIZE = (320, 240)


class VirtualNxt:
    """Drives plans on a robot of the virtual lab, as ``neurosim run`` does, and tracks it.

    Every trial is a session of its own, with its own noise. Where a person did not put the robot
    exactly at the start, its poses are told as if it had stood there.

    Attributes:
        controller: a family of plans.
        task: judges the trials, and says where they start.
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
            controller: a family of plans.
            task: that is to be done.
            lab_seed: Which of the virtual lab's robots and boards.
            seed: Of the lab's noise from trial to trial.
            slip: Mean share of their way by which the wheels slip on the floor.  [the lab's own]
            battery: The battery's voltage before a trial, V.  [that of the robot]
            worn: Share of its diameter that the left wheel has lost.

        Raises:
            UserError: if the controller is no plan, or a number is none that can be.
        """
        if not getattr(controller, "blind", False) or tuple(controller.outputs) != COMMAND_NAMES:
            raise UserError(
                f"the virtual NXT drives plans; a controller of the kind {controller.kind} is none"
            )
        self.controller, self.task = controller, task
        self._lab_seed, self._seed = lab_seed, seed
        changes = {"slip_mean": slip, "battery": battery}
        if worn:
            changes["diameter_left"] = (1.0 - worn) * LabParams.drawn(lab_seed).diameter_left
        assert set(changes) <= {field.name for field in fields(LabParams)}
        self.changes = {name: value for name, value in changes.items() if value is not None}

    def describe(self) -> dict[str, Any]:
        """Return which robot it is."""
        return {
            "kind": "virtual-nxt",
            "virtual": True,
            "lab_seed": self._lab_seed,
            "seed": self._seed,
            "changes": self.changes,
            "task": self.task.describe(),
        }

    def trial(self, genes: NDArray[np.float64], number: int) -> Tracked:
        """Drive an individual [G] once.

        Args:
            genes: of it.
            number: of the trial; it says what the noise is.

        Returns:
            Its fitness, and where it was after each of its commands and at rest; NaN for null
            commands, and for what came after the line at the board's edge, where trials end.

        Raises:
            UserError: if the robot was not seen at its start.
            RobotError: if it was lost.
        """
        start, rest = np.array(self.task.start, np.float64), self.task.episode.rest
        commands, active = self.controller.commands(genes[None], rest)
        poses = np.full((commands.shape[1], 3), np.nan)
        if not active.any():
            poses[:] = start
            still = np.tile(start, (1, 1, len(poses) + 1, 1))
            judged = self.task.judge(planned(still, commands, active, rest))
            return Tracked(float(judged.fitness[0, 0]), poses)
        actual, ended_early = self._drive(genes, number)
        seen = [[np.nan] * 3 if pose is None else pose for pose in actual["poses"]]
        poses[active[0]] = seen[1:]
        if rest > 0 and not ended_early and actual["rest"] is not None:
            poses[-1] = actual["rest"]
        there = se2.compose(start, se2.between(seen[0], poses))
        return Tracked(float(actual["fitness"]), there)

    def _drive(self, genes: NDArray[np.float64], number: int) -> tuple[dict[str, Any], bool]:
        """Return what trial.json says of what was driven, and whether it ended early."""
        start, plan = self.task.start, FixedPlan(tuple(commands_of(self.controller, genes)))
        # A plan's file says what is expected of it; here nobody asks.
        nothing = {
            "poses": [list(start)] * (len(plan.given) + 1),
            "rest": list(start),
            "fitness": 0.0,
            "completes": False,
        }
        saved = SavedController(plan, np.empty(0), self.task.describe(), start, nothing)
        noise = int(np.random.default_rng([self._seed, number, 0x0271]).integers(2**31))
        with (
            tempfile.TemporaryDirectory() as name,
            VirtualRig(
                self._lab_seed,
                noise_seed=noise,
                start=start,
                camera_size=SIZE,
                changes=self.changes,
            ) as rig,
        ):
            folder, camera = Path(name), rig.camera
            assert camera is not None
            saved.write(folder / "plan")
            o = camera.optics
            model = CameraModel(SIZE, o.matrix, o.distortion, o.rotation, o.translation)
            model.write(folder / "calibration.json")
            report = run_trial(
                folder / "plan",
                folder / "trial",
                rig.robot,
                camera,
                track=track,
                calibration=folder / "calibration.json",
                lab=rig.describe(),
            )
        return report["actual"], report["ended_early"]
