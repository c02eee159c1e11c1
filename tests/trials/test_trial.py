"""A trial compared with its prediction, on recordings made by hand."""

import json
import math

import numpy as np
import pytest

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.controllers import FixedPlan, SavedController
from neurosim.trials.trial import compare
from tracking.datasets.recordings import Poses, Recording

#: From the start pose up into rectangle 1, then right into 2 and 3.
COMMANDS = ((40.0, 40.0, 2.0), (40.0, -40.0, 0.5), (40.0, 40.0, 2.0))
STEPS = np.array([[0.5, 0, 0], [0, 0, -math.pi / 2], [0.8, 0, 0]])
START = (-0.8, 0.0, math.pi / 2)


def predicted() -> list[list[float]]:
    poses = [np.array(START)]
    for step in STEPS:
        poses.append(se2.compose(poses[-1], step))
    return [pose.tolist() for pose in poses]


def make(folder, *, scale=1.0, cut_at=None):
    """Write plan and recording; the robot drives ``scale`` times the predicted distance."""
    plan = SavedController(
        FixedPlan((COMMANDS[0], None, *COMMANDS[1:])),
        np.empty(0),
        task={"name": "nine-rectangles", "settings": {}},
        start=START,
        predicted={
            "poses": predicted(),
            "rest": predicted()[-1],
            "fitness": 9.0,
            "completes": False,
        },
    )
    plan.write(folder / "plan")
    recording = Recording.create(folder / "trial", {})
    recording.begin_session(video=None)
    times = list(np.arange(0, 1 - 1e-9, 1 / 30))
    poses, now, pose = [np.array(START)] * len(times), 1.0, np.array(START)
    with recording.command_log() as log:
        for number, (command, step) in enumerate(zip(COMMANDS, STEPS, strict=True)):
            log.append(1, number, "command", now, *command)
            fraction = 0.5 if cut_at == number else 1.0
            for part in np.arange(now, now + fraction * command[2] - 1e-9, 1 / 30):
                times.append(part)
                poses.append(se2.compose(pose, se2.arc(scale * step, (part - now) / command[2])))
            pose = se2.compose(pose, se2.arc(scale * step, fraction))
            now += fraction * command[2]
            if cut_at == number:
                log.append(1, number, "cut", now, 0, 0, None)
                break
        log.append(1, None, "stop", now, 0, 0, None)
    for rest in np.arange(now, now + 1.5, 1 / 30):
        times.append(rest)
        poses.append(pose)
    times, poses = np.array(times), np.array(poses)
    count = len(times)
    recording.write_poses(
        Poses(np.ones(count, int), np.arange(count), times, poses, np.ones(count))
    )
    return folder / "plan", folder / "trial"


def test_a_perfect_prediction_has_no_error(tmp_path):
    report = compare(*make(tmp_path))
    assert [error["position"] for error in report["errors"]] == pytest.approx([0] * 4, abs=2e-3)
    assert [error["heading"] for error in report["errors"]] == pytest.approx([0] * 4, abs=1e-2)
    assert report["actual"]["fitness"] == pytest.approx(4 - 0.1)  # 1, a turn on the spot, 2
    assert report["actual"]["completes"] is False
    assert report["ended_early"] is False
    assert report["plan_length"] == 4
    assert json.loads((tmp_path / "trial" / "trial.json").read_text())["errors"] == report["errors"]


def test_a_robot_that_goes_a_tenth_less_far_falls_behind(tmp_path):
    report = compare(*make(tmp_path, scale=0.9))
    first = report["errors"][1]
    assert first["position"] == pytest.approx(0.05, abs=3e-3)
    assert report["errors"][2]["heading"] == pytest.approx(math.radians(9), abs=2e-2)


def test_a_command_that_was_cut_is_no_error_of_the_simulator(tmp_path):
    report = compare(*make(tmp_path, cut_at=0))
    assert report["ended_early"] is True
    assert report["errors"][0]["position"] == pytest.approx(0, abs=2e-3)
    assert report["errors"][1:] == [None] * 3
    assert report["actual"]["poses"][1:] == [None] * 3
    assert report["actual"]["cut"][1] == pytest.approx(0.25, abs=5e-3)
    # Only the given commands count: one, which did not leave the start rectangle.
    assert report["actual"]["fitness"] == pytest.approx(-0.1, abs=1e-9)


def test_the_trial_of_another_plan_is_refused(tmp_path):
    plan, trial = make(tmp_path)
    text = (plan / "controller.json").read_text()
    (plan / "controller.json").write_text(text.replace("-40.0", "-41.0"))
    with pytest.raises(UserError, match="command 2 is not that of the plan"):
        compare(plan, trial)
