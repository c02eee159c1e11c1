"""Closed-loop controllers, and plans without a camera, driven in the virtual lab and judged."""

import json
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch
from ideal_simulator import SlippingWheels

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Episode
from neurosim.controllers import FixedPlan, Function, Network, Recurrent, SavedController
from neurosim.controllers.base import observe
from neurosim.controllers.goals import Goals
from neurosim.lab import Push, VirtualKheperaRig, VirtualRig, read_truth
from neurosim.loop.replan import ReplanSettings
from neurosim.recording.commands import Observation
from neurosim.recording.record import Guard, Rig
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.go_to import GoTo
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance
from neurosim.tasks.registry import TASKS
from neurosim.trials.driver import Driver, missing
from neurosim.trials.trial import compare, run_trial
from tracking.datasets.recordings import Recording

SIZE = (320, 240)
IGNORE = Guard("ignore")


@dataclass(frozen=True)
class FindTheLine(Task):
    """Meet the line at the board's edge; a task of a user's own, judged by readings alone."""

    name: ClassVar[str] = "find-the-line"
    reasons: ClassVar[tuple[str, ...]] = ("met no line",)

    seconds: float = 5.0

    @property
    def episode(self):
        return Episode(0.25, round(self.seconds / 0.25), readings=True)

    scored_by = ("readings",)

    def first_record(self, poses):
        return np.tile([0.0, 1.0], (len(poses), 1))

    def advance(self, record, interval):
        record[:, 1] = np.minimum(record[:, 1], interval.readings.min(axis=-1))

    def worth(self, record):
        darkest = record[:, 1]
        return Judgement.of(1.0 - darkest, darkest < 0.4)


@pytest.fixture(autouse=True)
def task_of_a_user(monkeypatch):
    monkeypatch.setattr(TASKS, "_registered", {"find-the-line": FindTheLine})


def saved(folder, family, weights, task, start=(0.0, 0.0, 0.0)):
    genes = np.ravel(np.array(weights, float))
    controller = SavedController(family, genes, task.describe(), start, {"fitness": 1.0})
    controller.write(folder)
    return folder


def test_a_network_on_the_nxt_goes_by_its_light_sensors(tmp_path):
    start = (0.9, 0.0, 0.0)
    # Ahead on the bare board, back on the dark line around it.
    family = Network(("line_left", "line_right"), scale=40.0)
    folder = saved(tmp_path / "c", family, [[20, 0, -8], [0, 20, -8]], FindTheLine(), start)
    with VirtualRig(1, start=start, camera=False) as rig:
        report = run_trial(folder, tmp_path / "t", Rig.of_lab(rig), guard=IGNORE)
    truth = read_truth(tmp_path / "t")
    assert report["kind"] == "network"
    assert report["virtual"] is True
    assert report["actual"]["completes"] is True
    assert report["actual"]["seen_by"] is None
    assert report["errors"] == []
    looks = report["observations"]
    assert looks["sensors"]["line_left"]["min"] < 0.4 < 0.5 < looks["sensors"]["line_left"]["max"]
    assert report["actual"]["fitness"] == pytest.approx(
        1 - min(sensor["min"] for sensor in looks["sensors"].values()), abs=1e-9
    )
    assert report["deadlines"]["steps"] == len(report["commands"]) == 20
    assert report["deadlines"]["missed"] == 0
    # It follows the network's answer to its readings, and stays at the line.
    seen = Recording(tmp_path / "t").observations()
    wanted = 40 * np.tanh(20 * seen.readings[:20] - 8)
    np.testing.assert_allclose([command[:2] for command in report["commands"]], wanted)
    assert truth.poses[:, 0].max() < 1.38
    assert min(command[0] for command in report["commands"]) < 0
    # The guard that is there by default ends it at the line.
    with VirtualRig(1, start=start, camera=False) as rig:
        report = run_trial(folder, tmp_path / "guarded", Rig.of_lab(rig))
    assert report["ended_early"] is True
    assert report["actual"]["completes"] is False
    assert len(report["commands"]) < 20


@pytest.mark.slow
def test_a_network_goes_to_goals_that_the_camera_shows_it(tmp_path):
    task = GoTo(goals=((0.2, 0.05, 0.0), (0.4, 0.0, 0.0)), seconds=3.0, step=0.1, tolerance=0.1)
    family = Network(("goal_x", "goal_y", "cos_heading"), scale=50.0)
    weights = [[8, -8, 0, 0], [8, 8, 0, 0]]
    folder = saved(tmp_path / "c", family, weights, task)
    with VirtualRig(2, noise_seed=5, camera_size=SIZE) as rig:
        optics = rig.camera.optics
        calibration = tmp_path / "calibration.json"
        optics.calibration.write(calibration)
        report = run_trial(folder, tmp_path / "t", Rig.of_lab(rig), calibration=calibration)
    truth = read_truth(tmp_path / "t")
    actual = report["actual"]
    assert actual["seen_by"] == "camera"
    assert actual["completes"] is True
    assert actual["reason"] is None
    assert actual["fitness"] > 2.4  # both goals, and near the last
    # The light sensors, which only the guard needs here, are read in turn: with both, an NXT's
    # commands would be late.
    assert report["deadlines"]["missed"] < 5
    looks = Recording(tmp_path / "t").observations()
    assert (np.isfinite(looks.readings).sum(axis=1) == 1).mean() > 0.8
    assert np.isfinite(looks.readings).sum(axis=0).min() > 10
    assert list(report["observations"]["sensors"]) == ["line_left", "line_right"]
    assert len(actual["path"]) > 80  # of every frame, not of every command
    path = np.array(actual["path"])
    off = path[:, 1:3] - truth.pose_at(path[:, 0])[:, :2]
    assert np.abs(off).max() < 0.02
    assert len(actual["poses"]) == len(report["commands"]) + 1
    # Compared with the same controller again; another controller is an error.
    again = compare(folder, tmp_path / "t")
    assert {**again, "created": ""} == {**report, "created": ""}
    other = saved(tmp_path / "other", family, np.add(weights, 0.1), task)
    with pytest.raises(UserError, match="another controller drove it"):
        compare(other, tmp_path / "t")


@pytest.mark.slow
def test_a_plan_is_planned_again_where_the_camera_sees_that_the_robot_was_pushed(tmp_path):
    goal = (0.5, 0.15, 0.6)
    task = GoTo(goals=(goal,), tolerance=0.03, heading_tolerance=0.09)
    # Straight on: the plan itself misses the goal, and the push moves the robot farther away.
    family = FixedPlan(((40.0, 40.0, 2.0), None, None, None))
    content = {
        "poses": [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]], "rest": [0.4, 0.0, 0.0], "fitness": 0.5,
        "completes": False,
    }  # fmt: skip
    folder = tmp_path / "c"
    SavedController(family, np.empty(0), task.describe(), predicted=content).write(folder)
    push = Push(0.1, after=1.0, direction=-math.pi / 2)
    how = ReplanSettings(generations=20, draws=8)
    with VirtualRig(2, noise_seed=5, camera_size=SIZE, push=push) as rig:
        optics = rig.camera.optics
        calibration = tmp_path / "calibration.json"
        optics.calibration.write(calibration)
        report = run_trial(
            folder, tmp_path / "t", Rig.of_lab(rig), calibration=calibration,
            replan=(SlippingWheels(), how), seed=1,
        )  # fmt: skip
    truth = read_truth(tmp_path / "t").poses[-1]
    assert math.hypot(*(truth - goal)[:2]) < 0.04
    assert abs(math.remainder(truth[2] - goal[2], 2 * math.pi)) < 0.12
    assert report["actual"]["completes"] is True
    assert report["replanned"] is True
    assert report["predicted"]["probability"] is None
    assert report["deadlines"]["steps"] == len(report["commands"])
    assert report["deadlines"]["missed"] == 0
    # Every command is compared with the prediction at its start; the start pose comes first.
    assert len(report["predicted"]["poses"]) == len(report["errors"]) == len(report["commands"]) + 1
    off = [error["position"] for error in report["errors"]]
    assert max(off) > 0.05  # the push
    assert sorted(off)[-3] < 0.04
    assert {**compare(folder, tmp_path / "t"), "created": ""} == {**report, "created": ""}
    file = tmp_path / "t" / "foreseen.json"
    file.write_text(file.read_text().replace('"probability": ', '"probability": 1', 1))
    with pytest.raises(UserError, match=r"foreseen.json.*probability"):
        compare(folder, tmp_path / "t")
    network = saved(tmp_path / "n", Network(("goal_x",)), np.zeros((2, 2)), task)
    with pytest.raises(UserError, match="a network cannot be replanned"):
        run_trial(
            network, tmp_path / "no", Rig.of_lab(rig), calibration=calibration,
            replan=(SlippingWheels(), how),
        )  # fmt: skip
    assert not (tmp_path / "no").exists()


def test_a_network_of_eight_sensors_on_the_khepera_and_its_path_by_odometry(tmp_path):
    task = ObstacleAvoidance(steps=100, starts=2)
    start = (-0.22, 0.0, 0.3)
    weights = np.zeros((2, 9))
    weights[:, 8] = 0.6  # ahead, and away from what is near
    weights[0, :3], weights[1, 3:6] = 1.5, 1.5
    weights[1, :3], weights[0, 3:6] = -3.0, -3.0
    names = tuple(f"sensor_{index}" for index in range(8))
    folder = saved(tmp_path / "c", Network(names), weights, task, start)
    with VirtualKheperaRig(1, start=start) as rig:
        report = run_trial(folder, tmp_path / "t", Rig(rig.robot, lab=rig.describe()))
        truth = rig.lab.pose
    actual = report["actual"]
    assert actual["seen_by"] == "counters"
    assert report["start"]["actual"] == pytest.approx(start, abs=1e-6)
    assert (report["deadlines"]["steps"], report["deadlines"]["missed"]) == (50, 0)
    assert len(report["commands"]) == 50
    # Five seconds of odometry are a few millimetres off.
    assert math.dist(actual["rest"][:2], truth[:2]) < 0.02
    assert math.dist(actual["rest"][:2], start[:2]) > 0.05
    # This is one of two starts; at most one point a step.
    assert 20 < actual["fitness"] < 100
    assert set(report["observations"]["sensors"]) == set(names)
    assert json.loads((tmp_path / "t" / "trial.json").read_text())["kind"] == "network"


def test_a_plan_is_driven_without_a_camera_where_wheels_are_counted(tmp_path):
    plan = FixedPlan(((50.0, 50.0, 1.0), None, (50.0, -50.0, 0.4)))
    start = (-0.2, 0.0, 0.0)
    predicted = {
        "poses": [list(start), [-0.15, 0.0, 0.0], [-0.15, 0.0, -0.8]],
        "rest": [-0.15, 0.0, -0.8], "fitness": 0.0, "completes": False,
    }  # fmt: skip
    task = GoTo(goals=((-0.15, 0.0, 0.0),), begin=start, tolerance=0.02)
    folder = tmp_path / "c"
    SavedController(plan, np.empty(0), task.describe(), start, predicted).write(folder)
    with VirtualKheperaRig(1, start=start) as rig:
        report = run_trial(folder, tmp_path / "t", Rig(rig.robot))
    assert report["kind"] == "plan"
    assert report["plan_length"] == 3
    assert report["commands"] == [[50.0, 50.0, 1.0], [50.0, -50.0, 0.4]]
    assert report["actual"]["seen_by"] == "counters"
    assert report["actual"]["completes"] is True
    assert [error["command"] for error in report["errors"]] == [0, 1, 2]
    assert max(error["position"] for error in report["errors"]) < 0.02
    assert report["deadlines"]["steps"] == 2


def test_what_is_missing_is_said_before_anything_moves(tmp_path):
    names = ("line_left", "sensor_3")
    with VirtualRig(1, camera=False) as rig:
        robot = rig.robot
        task = FindTheLine()
        folder = saved(tmp_path / "c", Network(names), np.zeros((2, 3)), task)
        with pytest.raises(UserError) as refused:
            run_trial(folder, tmp_path / "t", Rig(robot))
        assert str(refused.value) == (
            "the controller needs sensor_3, which this robot (nxt) has not: it reads line_left, "
            "line_right"
        )
        assert not (tmp_path / "t").exists()

        def lacks(family, task):
            one = SavedController(family, np.zeros(family.genes), task.describe())
            return missing(one, robot, None, task)

        assert lacks(Network(("line_left",)), task) == []
        (pose,) = lacks(Network(("x", "line_left")), task)
        assert "needs the robot's pose, and nothing says it" in pose
        goals, pose = lacks(Network(("goal_x",)), task)
        assert goals == "the controller needs goal_x, and the task find-the-line gives no goals"
        (legs,) = lacks(Network(("line_left",), outputs=("hip", "knee")), task)
        assert "commands hip, knee, and this robot (nxt) is driven by left, right" in legs
        (judged,) = lacks(Network(("line_left",)), GoTo())
        assert "go-to needs the robot's poses" in judged
    with VirtualKheperaRig(1) as rig:
        one = SavedController(Network(("x", "sensor_0")), np.zeros(6), GoTo().describe())
        assert missing(one, rig.robot, None, GoTo()) == []


def test_a_driver_asks_as_a_simulator_does():
    task = GoTo(goals=((0.2, 0.0, 0.0), (0.4, 0.3, 1.0)), within=0.05)
    family = Recurrent(("sensor_1", "goal_x", "goal_sin", "y", "time"), units=3)
    rng = np.random.default_rng(0)
    genes = rng.standard_normal(family.genes)
    driver = Driver(SavedController(family, genes, task.describe()), task.episode, {})
    assert (driver.sensors, driver.reads, driver.needs_pose) == (("sensor_1",), True, True)
    poses = np.column_stack([np.linspace(0, 0.3, 8), rng.uniform(-0.04, 0.04, (8, 2))])
    readings = rng.random((8, 2))

    def drive():
        driver.begin()
        results = []
        for step, (pose, reading) in enumerate(zip(poses, readings, strict=True)):
            named = {"sensor_0": reading[0], "sensor_1": reading[1]}
            results.append(driver.react(Observation(0.1 * step, pose, named)))
        return results

    first = drive()
    memory, goals, tensor = family.start(1), Goals(task.episode, 1), torch.from_numpy
    for step, command in enumerate(first):
        pose = tensor(poses[None, step])
        seen = observe(
            family.inputs, tensor(readings[None, step]), ("sensor_0", "sensor_1"), pose,
            goals.at(pose), 0.1 * step,
        )  # fmt: skip
        given, memory = family.act(tensor(genes[None]), seen, memory)
        assert [*command.numbers] == pytest.approx(given[0].tolist(), rel=1e-12)
        assert command.duration == task.step
    assert drive() == first  # restarted, with nothing left from before


def test_speeds_that_are_none_are_refused_and_too_fast_ones_cut_off():
    def driver(rule):
        one = SavedController(Function(rule), np.empty(0), GoTo().describe())
        return Driver(one, GoTo().episode, {})

    seen = Observation(0.0, None, {})
    command = driver(lambda seen: (250.0, -101.0)).react(seen)
    assert command.numbers == (100.0, -100.0)
    with pytest.raises(UserError, match=r"gave \{'left': nan, 'right': 1.0\} after 0.0 s"):
        driver(lambda seen: (math.nan, 1.0)).react(seen)
