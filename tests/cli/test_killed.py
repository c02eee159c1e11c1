"""Commands that are killed (-9) at random moments lose nothing and can be continued."""

import csv
import importlib.util
import json
import os
import signal
import time

import numpy as np
import pytest
from processes import finished, started

from neurosim.controllers import FixedPlan, SavedController
from neurosim.lab import VirtualRig
from tracking.datasets.recordings import Recording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="Windows has no kill -9"),
]

#: How often each command is killed.
KILLS = int(os.environ.get("NEUROSIM_KILLS", "2"))

#: How many more kills may be tried, until one falls between the first file and the end.
MORE_KILLS = 8


def run(folder, *words, after=None):
    """Run a command in a folder, killed after some seconds; return exit code and seconds."""
    folder.mkdir(exist_ok=True, parents=True)
    child = started(*words, cwd=folder)
    begun = time.monotonic()
    if after is not None:
        time.sleep(after)
        child.kill()
    done = finished(child)
    if done.returncode not in (0, -signal.SIGKILL):
        raise AssertionError((words, done.returncode, done.stderr))
    return done.returncode, time.monotonic() - begun


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("lens") / "calibration.json"
    with VirtualRig(0, camera_size=(320, 240)) as rig:
        optics = rig.camera.optics
        optics.calibration.write(path)
    return path


def whole_lines(folder, name):
    """Return the lines of a log, up to the last line end, of a folder or of its checkpoint."""
    for path in (folder / "out" / name, folder / "out.checkpoint" / name):
        if path.exists():
            return path.read_bytes().rpartition(b"\n")[0].splitlines()
    return []


def killed(tmp_path, words, logs, rest_of, seed):
    """Kill a command at random moments, continue each, and compare its logs with a whole run's.

    The moments are one in each of equal parts of its time. If none of them fell between the first
    file and the end, as where the whole run was slower than those after it, more moments are
    drawn between those that were too early and those that were too late.

    The rows written before a kill are the first rows of the whole run, and are kept.

    Args:
        tmp_path: a folder for each run.
        words: the command, up to its output folder.
        logs: names of files that only grow.
        rest_of: gives, for an output folder that was left, the words that continue, the folder
            first;
            None: everything is there.
        seed: of the moments.

    Yields:
        The folders of the whole run and of one that was killed, and after how long it was, s.
    """
    whole = tmp_path / "whole"
    _, seconds = run(whole, *words, "out")
    generator = np.random.default_rng(seed)
    moments = list(seconds * (np.arange(KILLS) + generator.uniform(size=KILLS)) / KILLS)
    early, late, amid = 0.0, seconds, 0
    for number in range(KILLS + MORE_KILLS):
        if number >= KILLS:
            if amid:
                break
            moments.append(generator.uniform(early, late))
        after = moments[number]
        folder = tmp_path / str(number)
        code, taken = run(folder, *words, "out", after=after)
        if code == 0:
            late = min(late, taken)
            continue
        then = {name: whole_lines(folder, name) for name in logs}
        rest = rest_of(folder / "out")
        if rest is None:
            late = min(late, after)
        elif rest == ["out"]:
            early = max(early, after)
        else:
            amid += 1
        if rest:
            run(folder, *words, *rest)
        for name, lines in then.items():
            for one in (whole, folder):
                assert whole_lines(one, name)[: len(lines)] == lines, (one, name, after)
        yield whole, folder, after
    assert amid


def resumed(made):
    """Return the words that continue a command that resumes its own folder."""
    return ["out", "--resume"] if made else ["out"]


def sent(recording):
    """Return the motor command of each number."""
    results = {}
    for line in recording.commands().itertuples():
        if line.kind == "command":
            command = (line.left, line.right, line.duration)
            assert results.setdefault(line.command, command) == command
    return results


def test_a_recording(calibration, tmp_path):
    words = ["record", "--commands", 8, "--seed", 3, "--camera-size", "320x240"]
    words += ["--durations", "0.5..1.5", "--calibration", calibration]

    def rest_of(out):
        made = Recording(out) if out.exists() else None
        if made and made.meta["complete"] and made.is_tracked:
            return None
        return resumed(made)

    logs = ("commands.csv", "frames.csv", "sightings.csv")
    for whole, folder, after in killed(tmp_path, words, logs, rest_of, 0):
        recording = Recording(folder / "out")
        assert recording.meta["complete"] is True
        assert sent(recording) == sent(Recording(whole / "out")), after
        if recording.sessions == 1:
            assert whole_lines(folder, "commands.csv") == whole_lines(whole, "commands.csv")
        assert recording.is_tracked, after
        lines = list(recording.commands().itertuples())
        # A command is sent again if the kill lost what was filmed of it.
        last = {line.command: line.session for line in lines if line.kind == "command"}
        seen = set(recording.poses().session)
        assert set(last.values()) <= seen <= {line.session for line in lines}, after


def rows(path, *names):
    with path.open(newline="") as file:
        return [tuple(row[name] for name in names) for row in csv.DictReader(file)]


def test_sampling(tmp_path):
    words = ["sample", "--angles", 12, "--distances", 2, "--grid", 3]
    logs = {"motors.csv", "held_out.csv", "reaction.csv", "sensors.csv"}
    for whole, folder, after in killed(tmp_path, words, logs, lambda out: resumed(out.exists()), 1):
        runs = whole / "out", folder / "out"
        assert {path.name for path in runs[0].glob("*.csv")} == logs
        settings = [rows(run / "motors.csv", "left", "right") for run in runs]
        assert settings[0] == settings[1], after
        content, wanted = (
            json.loads((run / "sampling.json").read_text())["result"] for run in runs
        )
        assert content.keys() == wanted.keys()
        assert content["wheel_base"] == pytest.approx(wanted["wheel_base"], rel=0.02)
        sizes = [
            {path.name: len(path.read_text().split()) for path in run.glob("*.sample")}
            for run in runs
        ]
        assert sizes[0] == sizes[1], after


def test_a_trial(calibration, tmp_path):
    plan = FixedPlan(((40.0, 40.0, 2.0), (40.0, -40.0, 0.5), (40.0, 40.0, 2.0), (-30.0, 30.0, 1.0)))
    task = {"name": "nine-rectangles", "settings": {}}
    poses = np.zeros((5, 3)).tolist()
    stated = {"poses": poses, "rest": poses[-1], "fitness": 9.0, "completes": False}
    SavedController(plan, np.empty(0), task, (-0.8, 0.0, 1.5), stated).write(tmp_path / "plan")
    words = ["run", tmp_path / "plan", "--calibration", calibration, "--no-replan"]
    words += ["--camera-size", "320x240", "-o"]

    def report(trial):
        content = json.loads((trial / "trial.json").read_text())
        return {name: content[name] for name in ("commands", "start", "actual", "errors")}

    # A trial cannot be continued: it is repeated in another folder, with the same result.
    for whole, folder, after in killed(tmp_path, words, ["commands.csv"], lambda out: ["again"], 2):
        wanted = report(whole / "out")
        assert report(folder / "again") == wanted, after
        if (folder / "out" / "trial.json").exists():  # whole, or not there
            assert report(folder / "out") == wanted
        elif (folder / "out" / "recording.json").exists():
            Recording(folder / "out").commands()


@pytest.mark.skipif(not importlib.util.find_spec("mujoco"), reason="needs mujoco")
def test_back_to_reality(tmp_path):
    sizes = {"settings": "paper", "cycles": 2, "seconds": 1, "generations": 2, "seed": 5}
    sizes |= {"search-population": 6, "candidates": 2, "adapt-generations": 2, "trials": 1}
    sizes |= {"adapt-population": 4, "policy-steps": 1, "policies": 2}
    words = ["back-to-reality"]
    words += [word for name, size in sizes.items() for word in (f"--{name}", size)]

    def rest_of(out):
        return None if out.exists() else resumed(out.with_name("out.checkpoint").exists())

    def result(folder):
        content = json.loads((folder / "out" / "back-to-reality.json").read_text())
        return {name: value for name, value in content.items() if name not in VOLATILE}

    for whole, folder, after in killed(tmp_path, [*words, "-o"], ["trials.jsonl"], rest_of, 3):
        assert whole_lines(folder, "trials.jsonl") == whole_lines(whole, "trials.jsonl"), after
        assert result(folder) == result(whole), after
        assert not (folder / "out.checkpoint").exists()


#: Columns of times and durations.
VOLATILE = ("created", "seconds", "versions")
