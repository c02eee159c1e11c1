"""A model car and bases are driven by plans, replanned plans and networks."""

import numpy as np
import pytest
import torch

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.controllers import FixedPlan, Network, SavedController, make_controller
from neurosim.lab import VirtualLinesRig, VirtualRosRig, read_truth
from neurosim.lab.lines.planar import KINDS
from neurosim.loop.evolve import evolve
from neurosim.loop.replan import ReplanSettings
from neurosim.loop.settings import EvolveSettings
from neurosim.recording.record import Guard, Rig
from neurosim.robots.ros.driver import Ros
from neurosim.simulators.base import Simulator
from neurosim.tasks.go_to import GoTo
from neurosim.trials.driver import missing
from neurosim.trials.trial import run_trial
from tracking.track import track

SIZE = (320, 240)
TAKES = {**KINDS, "ros": Ros(max_v=0.3, max_omega=2.0).commands}
QUICK = EvolveSettings(generations=40, runs=1)
#: Of the bodies' drives, about; s.
LAG = 0.1
pytestmark = pytest.mark.slow


class Ideal(Simulator):
    """A robot of the lab without errors, whose speeds approach the commanded ones in ``LAG``."""

    state_names = ("x", "y", "theta", "vx", "vy", "omega")

    def __init__(self, takes):
        self.takes = takes
        self.command_names = (*takes.names, "duration")
        self.inputs = [{"name": one.name, "unit": one.unit} for one in takes.numbers]

    @property
    def domain(self):
        # Slowly: most reactions of the robot are not in this simulator.
        fractions = (0.4 if one.speed else 1.0 for one in self.takes.numbers)
        pairs = zip(self.takes.numbers, fractions, strict=True)
        return {one.name: (fraction * one.low, fraction * one.high) for one, fraction in pairs}

    def start(self, pose, generator=None):
        return torch.cat([pose, torch.zeros(*pose.shape[:-1], 3, dtype=pose.dtype)], dim=-1)

    def step(self, state, command, generator=None):
        state, command = state.numpy(), command.numpy()
        speeds, duration = self.takes.twist(command[:, :-1]), command[:, -1:]
        missing = state[:, 3:] - speeds
        left = missing * np.exp(-duration / LAG)
        moved = se2.exp(speeds * duration + LAG * (missing - left))
        ends = se2.compose(state[:, :3], moved)
        return torch.from_numpy(np.concatenate([ends, speeds + left], axis=1))


def drive(kind, folder, controller, **options):
    """Return trial.json, and the RMS error of its path, m and rad."""
    lab = {"noise_seed": 4, "camera_size": SIZE}
    with VirtualRosRig(2, **lab) if kind == "ros" else VirtualLinesRig(2, kind=kind, **lab) as rig:
        optics = rig.camera.optics
        optics.calibration.write(folder / "calibration.json")
        rig.robot.connect()
        report = run_trial(
            controller, folder / "trial", Rig.of_lab(rig), track=track,
            calibration=folder / "calibration.json", guard=Guard("ignore"), **options,
        )  # fmt: skip
    truth, path = read_truth(folder / "trial"), np.array(report["actual"]["path"])
    off = path[:, 1:] - truth.pose_at(path[:, 0])
    off[:, 2] = se2.wrapped(off[:, 2])
    return report, np.sqrt((off**2).mean(axis=0))


@pytest.mark.parametrize("kind", TAKES)
def test_a_plan_that_was_evolved_drives_it(kind, tmp_path):
    sim, task = Ideal(TAKES[kind]), GoTo(goals=((0.6, 0.2, 0.5),), tolerance=0.1)
    family = make_controller("plan", sim, task, slots=5)
    (saved,) = evolve(sim, task, family, settings=QUICK, seed=1, out=tmp_path / "plan")
    report, off = drive(kind, tmp_path, tmp_path / "plan")
    assert [one["name"] for one in report["columns"]] == [*TAKES[kind].names, "duration"]
    assert report["commands"] == [pytest.approx(one) for one in saved.given]
    assert report["ended_early"] is False
    # The robot is not ideal, but its poses are known, even without a lamp.
    last = report["errors"][-1]
    assert 0.005 < last["position"] < 0.25
    assert (off < (0.006, 0.006, 0.03)).all()


@pytest.mark.parametrize(
    ("kind", "goal", "first"),
    [
        ("omni", (0.5, 0.25, 0.5), (0.2, 0.1, 0.2, 2.0)),
        ("ros", (0.5, 0.2, 0.6), (0.12, 0.1, 2.0)),
    ],
)
def test_a_replanned_plan_ends_where_it_should(kind, goal, first, tmp_path):
    takes = TAKES[kind]
    sim, task = Ideal(takes), GoTo(goals=(goal,), tolerance=0.02, heading_tolerance=0.05)
    units = tuple(one.unit for one in takes.numbers)
    plan = FixedPlan((first, None, None, None), takes.names, units)
    after = se2.exp(takes.twist(np.array(first[:-1])) * first[-1]).tolist()
    predicted = {
        "poses": [[0.0, 0.0, 0.0], after], "rest": after, "fitness": 0.5, "completes": False,
    }  # fmt: skip
    saved = SavedController(plan, np.empty(0), task.describe(), (0.0, 0.0, 0.0), predicted)
    saved.write(tmp_path / "plan")
    settings = ReplanSettings(generations=30, draws=8, most=6)
    report, _ = drive(kind, tmp_path, tmp_path / "plan", replan=(sim, settings))
    assert report["replanned"] is True
    assert len(report["commands"]) > 2
    assert report["actual"]["completes"] is True
    away = np.array(report["actual"]["rest"]) - task.goals[0]
    assert np.hypot(*away[:2]) < task.tolerance


def test_a_network_in_closed_loop_drives_a_car_without_a_lamp(tmp_path):
    task = GoTo(goals=((1.5, 0.0, 0.0),), seconds=6.0)
    names = KINDS["car"].names
    # Steers back to the line y = 0.2 from below it.
    weights = [[0.0, 0.0, 1.0], [-2.5, -1.5, 0.4]]
    family = Network(("y", "sin_heading"), (), names, (0.35, 0.45))
    genes = np.ravel(np.array(weights, float))
    SavedController(family, genes, task.describe(), (0.0, 0.0, 0.0), {"fitness": 1.0}).write(
        tmp_path / "network"
    )
    report, off = drive("car", tmp_path, tmp_path / "network")
    path = np.array(report["actual"]["path"])
    assert path[-1, 1] > 0.8
    assert path[-1, 2] == pytest.approx(0.16, abs=0.06)
    assert (off < (0.015, 0.01, 0.04)).all()


def test_a_plan_that_the_robot_does_not_take_is_refused_before_it_moves():
    task, omni = GoTo(), KINDS["omni"]
    units = tuple(one.unit for one in omni.numbers)

    def lacks(command, names):
        plan = FixedPlan((command,), names, units)
        with VirtualLinesRig(1, kind="omni", camera=False) as rig, rig.robot as robot:
            return missing(SavedController(plan, np.empty(0), {}), robot, None, task)

    assert "vx: 0.5 is beyond its limits" in lacks((0.5, 0.0, 0.0, 1.0), omni.names)[0]
    assert "in another order (vy, vx, omega)" in lacks((0.1,) * 4, ("vy", "vx", "omega"))[0]
    assert "driven by vx, vy, omega" in lacks((0.1,) * 4, ("a", "b", "c"))[0]
    with pytest.raises(UserError, match="takes vx, vy, omega, duration"):
        plan = make_controller("plan")
        evolve(Ideal(omni), task, plan, settings=QUICK)
