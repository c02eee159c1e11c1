"""``neurosim back-to-reality``, from the command line."""

import json
import sys

import pytest
from hill_climber import HillClimber
from motion_networks import random_motion_network

from neurosim.base.errors import RobotError
from neurosim.cli.main import main
from neurosim.controllers.gait import HAND_TUNED
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.simulators.registry import write_simulator
from neurosim.trials.realities import REALITIES

pytest.importorskip("mujoco", reason="pip install 'neurosim[mujoco]'")

SIZES = {
    "settings": "paper", "seconds": 1, "generations": 2, "search-population": 4, "candidates": 2,
    "adapt-generations": 2, "adapt-population": 3, "policy-steps": 1, "policies": 2, "trials": 1,
}  # fmt: skip
SMALL = [word for name, size in SIZES.items() for word in (f"--{name}", str(size))]


@pytest.fixture
def neurosim(tmp_path, monkeypatch, capsys):
    """Run a command in the folder of the test; return its exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["neurosim", *map(str, words)])
        capsys.readouterr()
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        out, message = capsys.readouterr()
        return code, out, message

    return run


@pytest.mark.slow
def test_a_run_of_test_size_and_its_report(neurosim, tmp_path):
    code, out, message = neurosim("back-to-reality", "-o", "found", *SMALL, "--json")
    assert code == 0, message
    content = json.loads(out)
    assert content["trials"] == len((tmp_path / "found/trials.jsonl").read_text().splitlines()) - 1
    assert content["start"]["fitness"] > 0.08
    assert content["reality"]["floor"] == "main"
    code, out, message = neurosim(
        "report", "found", "found/controller", "found/simulator", "-o", "page.html"
    )
    assert code == 0, message
    assert "Back to reality" in (tmp_path / "page.html").read_text()
    code, _, message = neurosim("back-to-reality", "-o", "found", *SMALL)
    assert code == 1
    assert "not empty" in message


@pytest.mark.slow
def test_our_own_choices_are_the_default(neurosim, tmp_path):
    pytest.importorskip("cma")
    words = ("--seconds", 1, "--generations", 2, "--sets", 2, "--budget", 4, "--trials", 1)
    code, out, message = neurosim(
        "back-to-reality", "-o", "found", *words, "--candidates", 1, "--confirm", 1
    )
    assert code == 0, message
    assert "were not adapted: reality returned a fitness, and no poses" in out
    content = json.loads((tmp_path / "found/back-to-reality.json").read_text())
    assert content["settings"]["compare"] == "tracked"


def test_an_interrupted_run_is_resumed_with_its_options(neurosim, tmp_path, monkeypatch):
    """A person types the results; after three trials the terminal is closed."""
    answers = iter(["0.1", "fast", "nan", "0.2", "0.3"])

    def typed():
        try:
            return next(answers)
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr("builtins.input", typed)
    monkeypatch.setattr("click.prompt", lambda *args, **settings: "")
    words = ["--reality", "by-hand", *SMALL]
    code, _, message = neurosim("back-to-reality", "-o", "found", *words)
    assert code == 130
    assert "--resume" in message
    assert "Fitness in m/s (0 if it fell): " in message
    lines = (tmp_path / "found.checkpoint/trials.jsonl").read_text().splitlines()
    assert [json.loads(line)["fitness"] for line in lines[1:]] == [0.1, 0.2, 0.3]
    monkeypatch.setattr("builtins.input", lambda: "0.15")
    code, out, message = neurosim("back-to-reality", "-o", "found", "--resume", "--json")
    assert code == 0, message
    content = json.loads(out)
    assert content["real"][:3] == [0.1, 0.2, 0.3]
    assert content["best"]["fitness"] == 0.3
    assert content["settings"]["policy"]["policies"] == 2


def test_a_robot_is_named_again_to_resume(neurosim, monkeypatch):
    """A file does not choose the robot that is driven."""

    class Robot:
        def __init__(self, controller):
            self.left = 3

        def trial(self, genes, number):
            self.left -= 1
            if not self.left:
                raise KeyboardInterrupt
            return 0.1

    monkeypatch.setitem(REALITIES._registered, "mine", Robot)
    code, _, message = neurosim("back-to-reality", "-o", "found", "--reality", "mine", *SMALL)
    assert code == 130, message
    code, _, message = neurosim("back-to-reality", "-o", "found", "--resume")
    assert code == 1
    assert "this was started with --reality mine: give it and its options again" in message
    Robot.__init__ = lambda self, controller: setattr(self, "left", 100)
    words = ("--resume", "--reality", "mine", "--json")
    code, out, message = neurosim("back-to-reality", "-o", "found", *words)
    assert code == 0, message
    assert json.loads(out)["best"]["fitness"] == 0.1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--floor", "moon"], "there is no floor 'moon' in the lab"),
        (["--task", "go-to"], "does the task walking only, not go-to"),
        (["--budget", "5"], "a budget of 5 is too small"),
        (["--settings", "best"], "paper or better"),
        (["--controller", "network", "--inputs", "time"], "commands no joint angles"),
        (["--task", "go-to", "--controller", "plan"], "commands no joint angles"),
        (["--simulator", "nowhere"], "no such simulator"),
        (["--start", "gait.json"], "the gait's length is 7, outside of 0.01 to 0.1 m"),
        (["--start", "far.json"], "foot cannot reach"),
        (["--resume"], "there is no interrupted run"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(neurosim, tmp_path, words, message):
    head = {"format": "neurosim-parameters", "version": 1}
    far = {"front_x": 0.08, "front_z": 0.125, "length": 0.1}
    for name, changes in (("gait", {"length": 7}), ("far", far)):
        text = json.dumps({**head, "parameters": {**HAND_TUNED, **changes}})
        (tmp_path / f"{name}.json").write_text(text)
    code, out, error = neurosim("back-to-reality", "-o", "found", *words)
    assert code == 1
    assert out == ""
    assert message in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["far.json", "gait.json"]


def test_evolution_goes_on_in_the_same_realities(neurosim, tmp_path, monkeypatch):
    """A plan in a motion network; reality is lost once, and is named again to resume."""

    class Robot:
        left = 3

        def __init__(self, controller, task, simulator):
            assert (controller.kind, task.name) == ("plan", "nine-rectangles")
            assert simulator.kind == "motion-network"

        def trial(self, genes, number):
            Robot.left -= 1
            if not Robot.left:
                raise RobotError("the robot is gone")
            return float(genes[1])

    monkeypatch.setitem(REALITIES._registered, "mine", Robot)
    write_simulator(random_motion_network(), tmp_path / "sim")
    words = [
        "evolve", "sim", "-o", "plan", "--commands", 3, "--generations", 1, "--population", 4,
        "--tournament", 2, "--robot-generations", 1, "--extrapolate",
    ]  # fmt: skip
    code, _, message = neurosim(*words, "--reality", "mine")
    assert code == 1
    assert (
        "the robot is gone; the best controller so far is in plan, continue with --resume"
        in message
    )
    code, _, message = neurosim("evolve", "sim", "-o", "plan", "--resume")
    assert "this was started with --reality mine: give it and its options again" in message
    Robot.left = 1000
    code, out, message = neurosim(
        "evolve", "sim", "-o", "plan", "--resume", "--reality", "mine", "--json"
    )
    assert code == 0, message
    result = json.loads(out)
    assert (result["transfer"], len(result["best"]), result["runs"]) == (1, 2, 1)
    assert not (tmp_path / "plan.checkpoint").exists()
    code, _, message = neurosim("evolve", "sim", "-o", "other", "--camera", "0", *words[4:])
    assert "the reality virtual-nxt needs no camera: leave it out" in message


def test_an_optimiser_that_makes_one_run_of_several(tmp_path, monkeypatch, neurosim):
    monkeypatch.setitem(OPTIMISERS._registered, "own", HillClimber)
    write_simulator(random_motion_network(), tmp_path / "sim")
    words = ["evolve", "sim", "--optimiser", "own", "--generations", 3, "--extrapolate"]
    for more, says in (([], False), (["--runs", 1], False), (["--runs", 3], True)):
        out = f"plan-{len(more)}-{says}"
        code, printed, message = neurosim(*words, *more, "-o", out, "--all", "--json")
        assert code == 0, message
        assert ("the optimiser own made 1 run, not 3" in message) == says
        for folder in json.loads(printed)["controllers"]:
            assert (tmp_path / folder / "controller.json").exists()
