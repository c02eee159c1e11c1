"""Commands that are killed (-9) at random moments lose nothing and are gone on with."""

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from patience import PATIENCE

from neurosim.controllers import FixedPlan, SavedController
from neurosim.lab import VirtualRig
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import Recording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="Windows has no kill -9"),
]

#: So many kills of each command.
KILLS = int(os.environ.get("NEUROSIM_KILLS", "4"))

#: Runs commands, each in a process of its own that has imported everything already.
ZYGOTE = """
import json, os, signal, sys, time, traceback
from neurosim.cli.main import main
import neurosim.back_to_reality.run, neurosim.trials.trial
import neurosim.recording.record, neurosim.sampling, neurosim.lab
for line in sys.stdin:
    asked = json.loads(line)
    begun = time.monotonic()
    child = os.fork()
    if child == 0:
        os.chdir(asked["cwd"])
        said = os.open("said.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(said, 1), os.dup2(said, 2)
        sys.argv = ["neurosim", *asked["words"]]
        code = 70
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush(), sys.stderr.flush()
            os._exit(code)
    if asked["after"] is not None:
        time.sleep(asked["after"])
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    print(json.dumps([code, time.monotonic() - begun]), flush=True)
"""


class Zygote:
    def __init__(self):
        self._process = subprocess.Popen(
            [sys.executable, "-c", ZYGOTE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, folder, *words, after=None):
        """Run a command in a folder, killed after so many seconds; return its code and seconds."""
        folder.mkdir(exist_ok=True, parents=True)
        asked = {"cwd": str(folder), "words": [str(word) for word in words], "after": after}
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        code, seconds = json.loads(self._process.stdout.readline())
        if code not in (0, -signal.SIGKILL):
            raise AssertionError((words, code, (folder / "said.txt").read_text()))
        return code, seconds

    def close(self):
        self._process.kill()
        self._process.communicate(timeout=PATIENCE)


@pytest.fixture(scope="module")
def zygote():
    made = Zygote()
    yield made
    made.close()


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("lens") / "calibration.json"
    with VirtualRig(0, camera_size=(320, 240)) as rig:
        optics = rig.camera.optics
        place = (optics.rotation, optics.translation)
        CameraModel((320, 240), optics.matrix, optics.distortion, *place).write(path)
    return path


def moments(seconds, seed):
    """Return random times within a command that takes so long, s."""
    return np.random.default_rng(seed).uniform(0.0, seconds, KILLS)


def whole_lines(path):
    """Return the lines of a file up to the last line end."""
    return path.read_bytes().rpartition(b"\n")[0].splitlines() if path.exists() else []


def begins_with(now, then):
    return now[: len(then)] == then


def sent(recording):
    """Return the motor command of each number, and how often it was sent."""
    found, count = {}, {}
    for line in recording.commands().itertuples():
        if line.kind == "command":
            command = (line.left, line.right, line.duration)
            assert found.setdefault(line.command, command) == command
            count[line.command] = count.get(line.command, 0) + 1
    return found, count


def test_a_recording(zygote, calibration, tmp_path):
    words = ["record", "r", "--commands", 14, "--seed", 3, "--camera-size", "320x240"]
    words += ["--calibration", calibration]
    _, seconds = zygote.run(tmp_path / "whole", *words)
    whole = Recording(tmp_path / "whole" / "r")
    planned, _ = sent(whole)
    reference = whole_lines(whole.path / "commands.csv")
    resumed = 0
    for number, after in enumerate(moments(seconds, 0)):
        folder = tmp_path / str(number)
        code, _ = zygote.run(folder, *words, after=after)
        if code == 0:
            continue
        log = folder / "r" / "commands.csv"
        begun = (folder / "r").exists()
        then = {name: whole_lines(folder / "r" / name) for name in ("commands.csv", "frames.csv")}
        # The lab's clock is its own: what was written is what the whole recording began with.
        assert begins_with(reference, then["commands.csv"]), after
        if begun and not json.loads((folder / "r" / "recording.json").read_text())["complete"]:
            resumed += 1
            zygote.run(folder, *words, "--resume")
        elif not begun:
            zygote.run(folder, *words)
        recording = Recording(folder / "r")
        assert recording.meta["complete"] is True
        for name, lines in then.items():
            assert begins_with(whole_lines(folder / "r" / name), lines), (after, name)
        found, _ = sent(recording)
        assert found == planned, after
        if recording.sessions == 1:
            assert whole_lines(log) == reference
        assert recording.is_tracked, after
        # Of each session in which a command was sent.
        sessions = {line.session for line in recording.commands().itertuples() if line.is_motor}
        assert set(recording.poses().session) == sessions, after
    assert resumed or KILLS < 4


def rows(path, *names):
    with path.open(newline="") as file:
        return [tuple(row[name] for name in names) for row in csv.DictReader(file)]


def test_sampling(zygote, tmp_path):
    words = ["sample", "s", "--angles", 36, "--distances", 5, "--grid", 3]
    _, seconds = zygote.run(tmp_path / "whole", *words)
    whole = tmp_path / "whole" / "s"
    logs = [path.name for path in sorted(whole.glob("*.csv"))]
    made = sorted(path.name for path in whole.glob("*.sample"))
    resumed = 0
    for number, after in enumerate(moments(seconds, 1)):
        folder = tmp_path / str(number)
        code, _ = zygote.run(folder, *words, after=after)
        if code == 0:
            continue
        then = {name: whole_lines(folder / "s" / name) for name in logs}
        for name, lines in then.items():
            assert begins_with(whole_lines(whole / name), lines), (after, name)
        begun = (folder / "s").exists()
        resumed += begun
        zygote.run(folder, *words, *(["--resume"] if begun else []))
        for name, lines in then.items():
            assert begins_with(whole_lines(folder / "s" / name), lines), (after, name)
        settings = [rows(each / "motors.csv", "left", "right") for each in (whole, folder / "s")]
        assert settings[0] == settings[1], after
        assert sorted(path.name for path in (folder / "s").glob("*.sample")) == made
        found, wanted = (
            json.loads((each / "sampling.json").read_text())["result"]
            for each in (folder / "s", whole)
        )
        assert found.keys() == wanted.keys()
        assert found["wheel_base"] == pytest.approx(wanted["wheel_base"], rel=0.02)
        for name in made:
            old, new = ((each / name).read_text().split() for each in (whole, folder / "s"))
            assert len(old) == len(new), (after, name)
    assert resumed or KILLS < 4


def test_a_trial(zygote, calibration, tmp_path):
    plan = FixedPlan(((40.0, 40.0, 2.0), (40.0, -40.0, 0.5), (40.0, 40.0, 2.0), (-30.0, 30.0, 1.0)))
    task = {"name": "nine-rectangles", "settings": {}}
    poses = np.zeros((5, 3)).tolist()
    said = {"poses": poses, "rest": poses[-1], "fitness": 9.0, "completes": False}
    SavedController(plan, np.empty(0), task, (-0.8, 0.0, 1.5), said).write(tmp_path / "plan")
    words = ["run", tmp_path / "plan", "-o", "t", "--calibration", calibration, "--no-replan"]
    words += ["--camera-size", "320x240"]
    _, seconds = zygote.run(tmp_path / "whole", *words)
    reference = whole_lines(tmp_path / "whole" / "t" / "commands.csv")

    def report(folder):
        content = json.loads((folder / "trial.json").read_text())
        return {name: content[name] for name in ("commands", "start", "actual", "errors")}

    for number, after in enumerate(moments(seconds, 2)):
        folder = tmp_path / str(number)
        code, _ = zygote.run(folder, *words, after=after)
        if code == 0:
            continue
        assert begins_with(reference, whole_lines(folder / "t" / "commands.csv")), after
        if (folder / "t" / "trial.json").exists():  # whole, or not there
            assert report(folder / "t") == report(tmp_path / "whole" / "t")
        elif (folder / "t" / "recording.json").exists():
            recording = Recording(folder / "t")
            # A trial is not gone on with: it is made again, elsewhere, and the same.
            recording.commands()
        again = [word if word != "t" else "u" for word in words]
        zygote.run(folder, *again)
        assert report(folder / "u") == report(tmp_path / "whole" / "t"), after


@pytest.mark.skipif(not importlib.util.find_spec("mujoco"), reason="needs mujoco")
def test_back_to_reality(zygote, tmp_path):
    sizes = {"settings": "paper", "cycles": 2, "seconds": 2, "generations": 3, "seed": 5}
    sizes |= {"search-population": 6, "candidates": 3, "adapt-generations": 3, "trials": 2}
    sizes |= {"adapt-population": 4, "policy-steps": 2, "policies": 3}
    words = ["back-to-reality", "-o", "b"]
    words += [word for name, size in sizes.items() for word in (f"--{name}", size)]
    _, seconds = zygote.run(tmp_path / "whole", *words)
    whole = tmp_path / "whole" / "b"
    reference = whole_lines(whole / "trials.jsonl")

    def result(folder):
        content = json.loads((folder / "back-to-reality.json").read_text())
        return {name: value for name, value in content.items() if name not in VOLATILE}

    resumed = 0
    for number, after in enumerate(moments(seconds, 3)):
        folder = tmp_path / str(number)
        code, _ = zygote.run(folder, *words, after=after)
        if code == 0:
            continue
        logs = [*folder.glob("b.checkpoint/trials.jsonl"), *folder.glob("b/trials.jsonl")]
        then = whole_lines(logs[0]) if logs else []
        assert begins_with(reference, then), after
        if not (folder / "b").exists():
            begun = (folder / "b.checkpoint").exists()
            resumed += begun
            zygote.run(folder, *words, *(["--resume"] if begun else []))
        assert whole_lines(folder / "b" / "trials.jsonl") == reference, after
        assert result(folder / "b") == result(whole), after
        assert not (folder / "b.checkpoint").exists()
    assert resumed or KILLS < 4


#: What says when and how long.
VOLATILE = ("created", "seconds", "versions")
