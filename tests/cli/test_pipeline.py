"""From a robot that nobody has modelled to a trial, command by command."""

import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from patience import PATIENCE
from processes import ended_by, neurosim

from neurosim.lab import read_truth
from tracking.datasets.dataset import Dataset
from tracking.datasets.recordings import Recording


def test_the_camera_is_learned_from_photographs(pipeline):
    assert pipeline.printed["calibrate"]["rms_px"] < 0.2


def test_every_command_is_recorded_to_its_end(pipeline):
    printed = pipeline.printed["record"]
    assert printed["commands"] == 60
    assert printed["sent"] - printed["cut"] == 60


def test_tracked_poses_are_where_the_robot_was(pipeline):
    poses = Recording(pipeline / "recording").poses()
    truth = read_truth(pipeline / "recording")
    seen = poses.quality > 0
    assert seen.mean() > 0.99

    def error(late):
        """Return root mean square errors of x, y and heading, the poses being late by some time."""
        off = (poses.pose - truth.pose_at(poses.time + late))[seen]
        off[:, 2] = np.remainder(off[:, 2] + np.pi, 2 * np.pi) - np.pi
        return np.sqrt(np.mean(off**2, axis=0))

    # Poses are on the clock of the sent commands; the radio delivers these some 20 ms later, and
    # those of the two flashes a few milliseconds earlier or later.
    late = min(np.arange(0.015, 0.034, 0.001), key=lambda late: error(late)[2])
    assert late == pytest.approx(0.024, abs=0.005)
    assert (error(late)[:2] < 0.004).all()
    assert error(late)[2] < np.radians(0.2)


def test_without_the_flashes_the_motion_gives_the_clock(pipeline, tmp_path):
    """Commands count as carried out at once: the clock is late by the radio's 20 ms, no more."""
    recording = tmp_path / "recording"
    shutil.copytree(pipeline / "recording", recording)
    message = neurosim("track", recording, "--sync", "motion", "--json", cwd=tmp_path).stdout
    clock = json.loads(message)["sessions"][0]["clock"]
    assert clock["flashes"] == []
    poses, truth = Recording(recording).poses(), read_truth(recording)
    seen = poses.quality > 0
    late = np.arange(-0.03, 0.08, 0.002)
    misfit = [
        np.median(np.hypot(*(poses.pose - truth.pose_at(poses.time + each))[seen, :2].T))
        for each in late
    ]
    assert late[np.argmin(misfit)] == pytest.approx(0.02, abs=0.01)
    assert pipeline.printed["track"]["sessions"][0]["warning"] is None


def test_a_row_is_the_displacement_that_truly_happened(pipeline):
    dataset = Dataset.read(pipeline / "dataset")
    assert len(dataset) >= 57
    assert pipeline.printed["dataset"]["rows"] == len(dataset)
    truth = read_truth(pipeline / "recording")
    motor = [
        line for line in Recording(pipeline / "recording").commands().itertuples() if line.is_motor
    ]
    from neurosim.base import se2

    checked = 0
    for row in dataset.table.itertuples():
        place = max(
            i for i, line in enumerate(motor) if line.command == row.command and line.kind != "cut"
        )
        assert (motor[place].left, motor[place].right) == (row.left, row.right)
        assert (motor[place - 1].left, motor[place - 1].right) == (
            row.prev_left,
            row.prev_right,
        ) or (place == 0 and row.prev_left == row.prev_right == 0)
        start, end = truth.pose_at(np.array([motor[place].time, motor[place + 1].time]) + 0.022)
        dx, dy, dtheta = se2.between(start, end)
        assert abs(dx - row.dx) < 0.01
        assert abs(dy - row.dy) < 0.01
        assert abs(dtheta - row.dtheta) < np.radians(2.5)
        checked += 1
    assert checked == len(dataset)


def test_training_keeps_the_last_fifth_out_and_evaluate_uses_it(pipeline):
    rows = pipeline.printed["dataset"]["rows"]
    printed = pipeline.printed["evaluate"]
    assert printed["held_out"] is True
    assert printed["rows"] == rows - rows * 4 // 5 or printed["rows"] == round(rows / 5)
    assert printed["errors"] == pipeline.printed["train"]["test_errors"]
    assert printed["paper"]["dtheta"]["mean_absolute_error"] == 3.585


def test_the_trial_compares_command_by_command(pipeline):
    trial = json.loads((pipeline / "trial" / "trial.json").read_text())
    plan = json.loads((pipeline / "controller" / "controller.json").read_text())
    given = [command for command in plan["commands"] if command is not None]
    assert trial["commands"] == given
    assert len(trial["predicted"]["poses"]) == len(given) + 1
    assert trial["virtual"] is True
    truth = read_truth(pipeline / "trial")
    motor = [
        line for line in Recording(pipeline / "trial").commands().itertuples() if line.is_motor
    ]
    for line, pose in zip(motor, trial["actual"]["poses"], strict=False):
        if pose is not None:
            was = truth.pose_at(np.array(line.time + 0.022))
            assert np.hypot(*(was[:2] - pose[:2])) < 0.01


def test_the_report_stands_by_itself(pipeline):
    page = (pipeline / "report.html").read_text()
    assert "irtual lab" in page
    assert "3.585" in page


@pytest.mark.slow
def test_the_same_seed_makes_the_same_recording(pipeline, tmp_path):
    """In two processes that were started apart: no order of theirs gets in."""
    words = ["record", "--commands", "12", "--durations", "0.5..1.5", "--seed", "4"]
    words += ["--calibration", str(pipeline / "calibration.json")]
    neurosim(*words, "once", cwd=tmp_path)
    apart = [sys.executable, "-m", "neurosim", *words, "again"]
    subprocess.run(apart, cwd=tmp_path, capture_output=True, timeout=PATIENCE, check=True)
    for name in ("commands.csv", "frames.csv", "video-001.avi", "truth/truth-001.csv"):
        once, again = (tmp_path / folder / name for folder in ("once", "again"))
        assert once.read_bytes() == again.read_bytes(), name


@pytest.mark.skipif(os.name == "nt", reason="Windows has no kill -9")
def test_a_killed_recording_is_resumed_tracked_and_trained_on(pipeline, tmp_path):
    words = ["record", "killed", "--commands", "30", "--durations", "0.5..1.5", "--seed", "7"]
    words += ["--calibration", str(pipeline / "calibration.json")]
    log = "killed/commands.csv"
    killed = ended_by("SIGKILL", words, log=log, count=12, word="command", cwd=tmp_path)
    assert killed.returncode == -signal.SIGKILL
    assert Recording(tmp_path / "killed").meta["complete"] is False
    refused = neurosim(*words, "--resume", "--max-speed", 40, cwd=tmp_path, check=False)
    assert refused.returncode == 1
    assert "max_speed" in refused.stderr
    neurosim(*words, "--resume", cwd=tmp_path)
    recording = Recording(tmp_path / "killed")
    assert recording.meta["complete"] is True
    assert recording.sessions == 2
    neurosim("track", "killed", cwd=tmp_path)
    made = json.loads(neurosim("dataset", "killed", "-o", "d", "--json", cwd=tmp_path).stdout)
    # The interrupted command is sent again; some frames before the kill may be lost.
    assert made["rows"] >= 26
    neurosim("train", "d", "-o", "s", "--members", 2, cwd=tmp_path)
    assert (tmp_path / "s" / "simulator.json").exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows sends other signals")
def test_ctrl_c_leaves_everything_readable(tmp_path):
    words = ["record", "r", "--commands", "500", "--camera-size", "320x240"]
    log = "r/commands.csv"
    ended = ended_by("SIGINT", words, log=log, count=8, word="command", cwd=tmp_path)
    assert ended.returncode == 130
    assert "Traceback" not in ended.stderr
    assert "interrupted" in ended.stderr
    recording = Recording(tmp_path / "r")
    assert len(recording.commands()) > 8
    assert recording.frame_times(1) is not None
