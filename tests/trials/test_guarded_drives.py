"""Drives into the line, over the edge, unseen, and from a wrong start, against the simulator."""

import itertools
import math

import numpy as np
import pytest
from ideal_simulator import IdealWheels

from neurosim.base.perimeter import EDGE, ENDS, LINE, UNSEEN, Board, Perimeter
from neurosim.controllers import FixedPlan, Network, SavedController
from neurosim.lab import VirtualRig
from neurosim.loop.evaluate import Evaluator
from neurosim.networks.control import POSE_INPUTS
from neurosim.recording.record import Guard, Rig
from neurosim.reports.report import write_report
from neurosim.robots.base import LIGHT_AHEAD, LIGHT_ASIDE
from neurosim.tasks.go_to import GoTo
from neurosim.trials.trial import run_trial

SIZE = (320, 240)
PERIMETER = Perimeter(Board(), ((LIGHT_AHEAD, LIGHT_ASIDE), (LIGHT_AHEAD, -LIGHT_ASIDE)))
#: Far from the line, so that the task itself ends nothing.
TASK = GoTo(goals=((0.0, 0.0, 0.0),), within=0.02, tolerance=0.02)


@pytest.fixture
def drive(tmp_path):
    """Drive a controller in the virtual lab, from a given pose; return trial.json."""

    def run(controller, put=None, *, covered=None, **options):
        folder = controller.write(tmp_path / "c") or tmp_path / "c"
        with VirtualRig(1, noise_seed=3, start=put or controller.start, camera_size=SIZE) as rig:
            optics, calibration = rig.camera.optics, tmp_path / "calibration.json"
            optics.calibration.write(calibration)
            if covered is not None:
                _cover(rig, *covered)
            return run_trial(
                folder,
                tmp_path / "t",
                Rig.of_lab(rig),
                calibration=calibration,
                **options,
            )

    return run


def _cover(rig, begin, end):
    """Cover the lens from ``begin`` to ``end``, s after the first motor turns."""
    start = rig.camera.start

    def covered(deliver):
        def take(time, frame):
            driven = rig.lab.body.driven_at
            hidden = driven is not None and begin <= rig.lab.time - driven <= end
            deliver(time, np.zeros_like(frame) if hidden else frame)

        start(take)

    rig.camera.start = covered


def plan(*commands, start):
    about = {"perimeter": PERIMETER.describe()}
    given = FixedPlan(tuple(commands))
    evaluator = Evaluator(IdealWheels(), TASK, given)
    sampled = evaluator.rollouts.draw(np.array([start]), 0)
    poses = evaluator.run(np.empty((1, 0)), sampled).poses[0, 0].tolist()
    predicted = {"poses": poses[:-1], "rest": poses[-1], "fitness": 0.0, "completes": False}
    return SavedController(given, np.empty(0), TASK.describe(), start, predicted, about)


def simulated(controller, by="both", start=None):
    """Return the end of a plan in an ideal simulator: code, and pose there."""
    simulator = IdealWheels()
    simulator.perimeter = PERIMETER.guarded(by)
    evaluator = Evaluator(simulator, TASK, controller.controller)
    draws = evaluator.rollouts.draw(np.array([start or controller.start]), 0)
    judged, trajectory = evaluator.judge(controller.genes[None], draws)
    assert not judged.success[0, 0]
    poses, code = trajectory.poses[0, 0], 0
    for before, after in itertools.pairwise(poses):
        guard = np.array([[*before, 0.0]])
        ends = simulator.perimeter.ends(guard, after[None], 3.0)
        if guard[0, 3]:
            code, after = int(guard[0, 3]), ends[0]
            break
    expected = ENDS[code - 1] if code else TASK.reasons[int(judged.reason[0, 0])]
    assert evaluator.task.why(int(judged.reason[0, 0])) == expected
    return code, after


@pytest.mark.slow
def test_a_drive_into_the_line_ends_where_the_simulator_says(drive, tmp_path):
    controller = plan((40, 40, 3.0), (-40, -40, 1.0), start=(0.2, 0.4, math.pi / 2))
    code, pose = simulated(controller)
    report = drive(controller)
    assert code == report["stopped"]["code"] == LINE
    assert report["stopped"]["command"] == 0
    assert report["stopped"]["sensor"] in ("line_left", "line_right")
    assert np.hypot(*(np.array(report["actual"]["cut"]) - pose)[:2]) < 0.04
    assert np.hypot(*(np.array(report["stopped"]["pose"]) - report["actual"]["cut"])[:2]) < 0.03
    assert report["actual"]["completes"] is False
    assert report["actual"]["reason"].startswith("was stopped at the perimeter line by its light")
    assert "into command 1" in report["actual"]["reason"]
    assert report["guard"] == {"predicted": True, "driven": True}
    # The page shows the place, and names it.
    write_report([tmp_path / "c", tmp_path / "t"], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "was stopped at the perimeter line" in page
    assert ">stopped<" in page


@pytest.mark.slow
def test_without_its_light_sensors_the_edge_ends_it(drive):
    controller = plan((40, 40, 4.0), start=(0.6, 0.0, 0.0))
    code, pose = simulated(controller, by="position")
    report = drive(controller, guard=Guard("end", margin=0.05, by="position"))
    assert code == report["stopped"]["code"] == EDGE
    assert report["stopped"].get("sensor") is None
    assert np.hypot(*(np.array(report["stopped"]["pose"]) - pose)[:2]) < 0.05
    assert np.abs(report["actual"]["path"][-1][1]) < Board().length / 2


def test_where_the_guard_ignores_the_line_the_trial_says_so(drive):
    controller = plan((40, 40, 2.2), start=(0.2, 0.4, math.pi / 2))
    report = drive(controller, guard=Guard("ignore"))
    assert report["stopped"] is None
    assert report["ended_early"] is False
    assert report["guard"] == {"predicted": True, "driven": False}


@pytest.mark.slow
def test_a_plan_goes_on_unseen_and_a_controller_that_needs_its_pose_is_stopped(drive, tmp_path):
    open_loop = plan((30, 30, 3.0), start=(-0.6, 0.0, 0.0))
    _, pose = simulated(open_loop)
    report = drive(open_loop, covered=(0.7, 1.9))
    assert report["stopped"] is None
    seen = np.array(report["actual"]["path"])
    assert np.diff(seen[:, 0]).max() > 1.1  # covered for so long
    assert np.hypot(*(seen[-1, 1:] - pose)[:2]) < 0.06
    (tmp_path / "t").rename(tmp_path / "first")
    (tmp_path / "c").rename(tmp_path / "first-c")
    family = Network(POSE_INPUTS, scale=30.0)
    weights = np.array([[0.0] * 4 + [3.0]] * 2).ravel()
    network = SavedController(family, weights, TASK.describe(), (-0.6, 0.0, 0.0))
    report = drive(network, covered=(0.7, 2.5))
    assert report["stopped"]["code"] == UNSEEN
    lost = report["stopped"]["time"] - report["stopped"]["unseen_since"]
    assert 0.9 < lost < 1.5
    assert "was not seen, last seen at x =" in report["actual"]["reason"]


@pytest.mark.slow
def test_beside_its_start_a_drive_ends_beside_its_end(drive):
    controller = plan((30, 30, 2.0), (30, -30, 0.4), (30, 30, 2.0), start=(-0.4, -0.2, 0.0))
    put = (-0.4, -0.15, 0.0)
    report = drive(controller, put)
    begun = np.array(report["start"]["actual"])
    assert np.hypot(*(begun - controller.start)[:2]) == pytest.approx(0.05, abs=0.012)
    _, expected = simulated(controller, start=tuple(begun))
    _, planned = simulated(controller)
    end = np.array(report["actual"]["path"])[-1, 1:]
    assert np.hypot(*(end - expected)[:2]) < np.hypot(*(end - planned)[:2])
