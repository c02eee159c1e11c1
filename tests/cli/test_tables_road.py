"""Samples -> simulator -> network -> picture, through the command line's own verbs."""

import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread

from neurosim.base.errors import FileError, UserError
from neurosim.cli.main import cli
from neurosim.controllers import Plan, read_controller
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.simulators.arena import Arena
from neurosim.simulators.samples import Samples

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "simulators"))
from khepera_data import made_up


def call(*words):
    """Run a verb; errors that a user can cause come out as they are."""
    done = CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    table = made_up()
    for index, name in enumerate(("wall", "cylinder")):
        Samples(np.clip(table.mean[index], 0, 1), 0.005, 0.005).write(folder / f"{name}.sample")
    Arena.rectangle(0.5, 0.4, [(0, 0, 0.0275)]).write(folder / "arena.json")
    call("tables", folder / "wall.sample", folder / "cylinder.sample", "-o", folder / "sim")
    call(
        "evolve", folder / "sim", "--task", "obstacle-avoidance", "-o", folder / "net",
        "--generations", 15, "--arena", folder / "arena.json", "--steps", 250, "--noise", "none",
    )  # fmt: skip
    return folder


def test_simulator_and_network(folder):
    simulator = read_simulator(folder / "sim")
    assert simulator.noise == "uniform"
    assert len(json.loads((folder / "sim" / "simulator.json").read_text())["source"]) == 2
    network = read_controller(folder / "net")
    assert network.weights.shape == (2, 9)
    assert network.task["settings"]["steps"] == 250
    assert network.evolution["noise"]["kind"] == "none"
    assert network.evolution["arena"]["obstacles"] == [[0, 0, 0.0275]]


def test_generations_on_a_robot(folder):
    done = call(
        "evolve", folder / "sim", "--task", "obstacle-avoidance", "-o", folder / "driven",
        "--generations", 3, "--population", 20, "--arena", folder / "arena.json", "--steps", 20,
        "--starts", 2, "--then-on-robot", 2, "--lab-seed", 1, "--json",
    )  # fmt: skip
    result = json.loads(done.output)
    assert result["transfer"] == 3
    assert len(result["best"]) == len(result["mean"]) == 5
    assert all(0 < best <= 20 for best in result["best"])
    made = read_controller(folder / "driven")
    for drive in made.evolution["trajectories"]:
        simulated, robot = (np.array(drive[name]) for name in ("simulated", "robot"))
        assert simulated.shape == robot.shape == (101, 3)
        assert robot[0] == pytest.approx(simulated[0], abs=1e-3)
        assert np.abs(np.diff(robot[:, :2], axis=0)).max() < 0.012
        assert np.ptp(robot, axis=0).max() > 0.01
    call("report", folder / "driven", "-o", folder / "page.html")
    assert "from generation 4 on the robot (Figure 3)" in (folder / "page.html").read_text()
    assert "(Figure 4)" in (folder / "page.html").read_text()


def test_view(folder):
    out = folder / "path.png"
    done = call(
        "view", folder / "arena.json", "--simulator", folder / "sim", "--controller",
        folder / "net", "--pose", 15, 10, 90, "--seconds", 5, "-o", out, "--json",
    )  # fmt: skip
    result = json.loads(done.output)
    assert result["path"][0] == pytest.approx([0.15, 0.10, math.pi / 2])
    assert len(result["path"]) == 51
    assert len(result["readings"]) == 8
    assert 0 < result["fitness"] <= result["steps"] == 50
    picture = imread(out)
    assert picture.shape[1] > 800
    blue = (picture[..., 2] > 0.55) & (picture[..., 0] < 0.1)  # the path's colour
    assert blue.sum() > 500
    call("view", folder / "arena.json", "-o", folder / "empty.svg")
    assert (folder / "empty.svg").read_text().startswith("<?xml")


def test_view_of_a_plan(folder):
    plan = Plan(
        commands=((50.0, 50.0, 1.0),),
        task={"name": "x"},
        start=(0.0, 0.0, 0.0),
        predicted={
            "poses": [[0, 0, 0], [0.05, 0, 0]],
            "rest": [0.05, 0, 0],
            "fitness": 0.0,
            "completes": False,
        },
    )
    plan.write(folder / "plan")
    done = call(
        "view", folder / "sim", "--controller", folder / "plan", "--pose", 10, 10, 0,
        "-o", folder / "plan.png", "--json",
    )  # fmt: skip
    assert json.loads(done.output)["pose"] == pytest.approx([0.15, 0.1, 0])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["view", "arena.json", "-o", "x.bmp"], r"a picture ends in \.png, \.svg, \.pdf"),
        (["view", "arena.json", "-o", "x.png", "--pose", 0, 0, 0], "in a wall or an obstacle"),
        (["view", "arena.json", "-o", "x.png", "--controller", "net"], "give --simulator"),
        (["view", "none", "-o", "x.png"], "no such file"),
        (["tables", "wall.sample", "-o", "x"], "no samples of the cylinder"),
        (["tables", "wall.sample", "cut-cylinder.sample", "-o", "x"], "is cut short"),
        (
            ["evolve", "sim", "--task", "obstacle-avoidance", "-o", "x", "--tournament", 5],
            "--tournament has no meaning for obstacle avoidance",
        ),
        (
            ["evolve", "sim", "--task", "obstacle-avoidance", "-o", "x", "--steps", 7],
            "7 steps cannot be shared out evenly among 5 starts",
        ),
        (
            [
                "evolve",
                "sim",
                "--task",
                "obstacle-avoidance",
                "-o",
                "x",
                "--fitness",
                "cells",
                "--then-on-robot",
                1,
            ],
            "needs the robot's poses",
        ),
        (["evolve", "sim", "--task", "flying", "-o", "x"], "there is no task 'flying'"),
        (["evaluate", "sim", "dataset"], "is no motion network"),
        (["plan-check", "net", "sim"], "expected 'plan', found 'network'"),
    ],
)
def test_refusals(folder, words, message):
    whole = (folder / "cylinder.sample").read_bytes()
    (folder / "cut-cylinder.sample").write_bytes(whole[: len(whole) // 2])
    names = {"x", *(path.name for path in folder.iterdir())}
    paths = [folder / w if w in names or ".png" in str(w) else w for w in words]
    with pytest.raises(UserError, match=message):
        call(*paths)
    assert not (folder / "x").exists()
    assert not (folder / "x.png").exists()


def test_broken_folders_are_named(folder, tmp_path):
    shutil.copytree(folder / "sim", tmp_path / "sim")
    shutil.copytree(folder / "net", tmp_path / "net")
    tables = tmp_path / "sim" / "tables.safetensors"
    tables.write_bytes(tables.read_bytes()[:1000])
    with pytest.raises(FileError, match=r"tables\.safetensors"):
        read_simulator(tmp_path / "sim")
    (tmp_path / "net" / "weights.safetensors").unlink()
    with pytest.raises(FileError, match=r"weights\.safetensors: no such file"):
        read_controller(tmp_path / "net")
    with pytest.raises(FileError, match="expected 'motion-network', found 'tables'"):
        MotionNetwork.read(tmp_path / "sim")
