"""Samples -> simulator -> network -> picture, through the command line's own commands."""

import json
import math
import re
import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from khepera_data import made_up
from matplotlib.image import imread

from neurosim.base.errors import FileError, LinkLost, UserError
from neurosim.base.files import write_json
from neurosim.base.place import Place
from neurosim.cli.main import cli
from neurosim.controllers import FixedPlan, SavedController, read_controller
from neurosim.loop.unmet import Unmet
from neurosim.sampling import FORMAT, VERSION
from neurosim.simulators import read_simulator
from neurosim.simulators.motion.files import read_motion
from neurosim.simulators.tables.samples import Samples
from neurosim.trials.floor import OnFloor


def call(*words):
    """Run a command; a UserError is raised unchanged."""
    done = CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    table = made_up()
    for index, name in enumerate(("wall", "cylinder")):
        Samples(np.clip(table.mean[index], 0, 1), 0.005, 0.005).write(folder / f"{name}.sample")
    Place.rectangle(0.5, 0.4, [(0, 0, 0.0275)]).write(folder / "arena.json")
    call("build-tables", folder / "wall.sample", folder / "cylinder.sample", "-o", folder / "sim")
    call(
        "evolve", folder / "sim", "--task", "obstacle-avoidance", "-o", folder / "net",
        "--generations", 15, "--place", folder / "arena.json", "--steps", 250, "--noise", "none",
    )  # fmt: skip
    return folder


def test_simulator_and_network(folder):
    simulator = read_simulator(folder / "sim")
    assert simulator.noise == "uniform"
    assert len(json.loads((folder / "sim" / "simulator.json").read_text())["source"]) == 2
    network = read_controller(folder / "net")
    assert network.genes.shape == (18,)
    assert network.task["settings"]["steps"] == 250
    assert network.evolution["noise"]["kind"] == "none"
    assert network.evolution["place"]["obstacles"] == [[0, 0, 0.0275]]


def test_a_network_that_touches_more_than_a_vehicle_comes_with_a_warning(folder):
    words = ["evolve", folder / "sim", "--task", "obstacle-avoidance", "-o", folder / "poor"]
    words += ["--generations", 1, "--population", 5, "--noise", "none"]
    done = call(*words, "--json")
    unmet = json.loads(done.stdout)["unmet"]
    assert unmet["touched"] > unmet["vehicle"]
    assert read_controller(folder / "poor").predicted["unmet"] == unmet
    assert f"neurosim: {Unmet(**unmet)}\n" in done.stderr
    assert "more often than a hand-written vehicle" in done.stderr


@pytest.mark.slow
def test_generations_on_a_robot(folder):
    done = call(
        "evolve", folder / "sim", "--task", "obstacle-avoidance", "-o", folder / "driven",
        "--generations", 3, "--population", 20, "--place", folder / "arena.json", "--steps", 20,
        "--starts", 2, "--robot-generations", 2, "--lab-seed", 1, "--json",
    )  # fmt: skip
    result = json.loads(done.stdout)
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
    assert made.evolution["robot"]["virtual"] is True
    call("report", folder / "driven", "-o", folder / "page.html")
    assert "(Virtual lab.)" in (folder / "page.html").read_text()
    assert "from generation 4 on the robot" in (folder / "page.html").read_text()
    assert "in the simulator and on the robot, start 1" in (folder / "page.html").read_text()


@pytest.mark.slow
def test_a_robot_samples_a_light_and_drives_to_it(tmp_path):
    """From the first sample to the trial, through the virtual robot's serial line."""
    samples = tmp_path / "samples"
    done = call(
        "sample", samples, "--light", "--cylinders", "27.5,12.5", "--angles", 24, "--distances", 3,
        "--step", 15, "--light-step", 120, "--grid", 3, "--lab-seed", 2,
    )  # fmt: skip
    names = ("wall", "cylinder", "cylinder-12.5mm", "light")
    paths = [samples / f"{name}.sample" for name in names]
    assert all(str(path) in done.output for path in paths)
    near = [Samples.read(path).activations[0] for path in paths[:3]]
    wall, large, small = (float(each.sum()) for each in near)
    assert wall > large > small
    light = Samples.read(paths[3])
    assert (light.first_distance, light.distance_step) == (0.005, 0.12)
    brightest = light.activations.max(axis=(1, 2))
    # A light halves the reading of 480 at 12 cm, and 512 is dark: 1 - 480 / (1 + (12 / d)^2) / 512.
    assert brightest == pytest.approx([1.0, 0.53, 0.23], abs=0.06)
    done = call("build-tables", *paths, "--motors", samples / "motors.csv", "-o", tmp_path / "sim")
    assert "of wall, cylinder-12.5mm, cylinder, light; motors of" in done.output
    place = Place((*Place.rectangle(0.6, 0.5).outline,), lights=((0.15, 0.1),), start=(-0.2, 0, 0))
    place.write(tmp_path / "lit.json")
    done = call(
        "evolve", tmp_path / "sim", "--task", "phototaxis", "--place", tmp_path / "lit.json",
        "--generations", 12, "--population", 40, "--seconds", 20, "-o", tmp_path / "net",
    )  # fmt: skip
    network = read_controller(tmp_path / "net")
    assert {one.partition("_")[0] for one in network.controller.inputs} == {"light"}
    call(
        "run", tmp_path / "net", "--robot", "virtual-khepera", "--camera", "none",
        "-o", tmp_path / "trial", "--lab-seed", 2,
    )  # fmt: skip
    trial = json.loads((tmp_path / "trial" / "trial.json").read_text())
    assert trial["actual"]["fitness"] > 0.4
    observed = (tmp_path / "trial" / "observations.csv").read_text().splitlines()
    assert observed[0].endswith(",light_0,light_1,light_2,light_3,light_4,light_5,light_6,light_7")
    call("report", tmp_path / "sim", "-o", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Light sensors: their highest reading" in page
    # In a place whose obstacles have another size, the most similar one is named.
    odd = Place.rectangle(0.6, 0.5, [(0.1, 0.1, 0.02)])
    odd.write(tmp_path / "odd.json")
    done = call(
        "evolve", tmp_path / "sim", "--task", "obstacle-avoidance", "--generations", 1,
        "--population", 5, "--place", tmp_path / "odd.json", "-o", tmp_path / "other",
    )  # fmt: skip
    assert "obstacles of 20 mm radius were not sampled: they look like those of" in done.stderr


@pytest.mark.parametrize("virtual", [True, False, None])
@pytest.mark.slow
def test_where_samples_are_from_goes_with_them(folder, tmp_path, virtual):
    for name in ("wall", "cylinder"):
        shutil.copy(folder / f"{name}.sample", tmp_path)
    if virtual is not None:
        robot = {"robot": "khepera", "virtual": virtual}
        write_json(tmp_path / "sampling.json", FORMAT, VERSION, {"robot": robot})
    call(
        "build-tables",
        tmp_path / "wall.sample",
        tmp_path / "cylinder.sample",
        "-o",
        tmp_path / "sim",
    )
    call(
        "evolve", tmp_path / "sim", "--task", "obstacle-avoidance", "-o", tmp_path / "net",
        "--generations", 1, "--population", 20, "--steps", 5,
    )  # fmt: skip
    for name in ("sim", "net"):
        done = call("report", tmp_path / name, "-o", tmp_path / "page.html", "--json")
        assert json.loads(done.stdout)["virtual"] is virtual
        assert ("Virtual lab" in (tmp_path / "page.html").read_text()) is bool(virtual)


@pytest.mark.parametrize(
    ("task", "words", "message"),
    [
        ("obstacle-avoidance", ["--commands", 13], "network has no option --commands: leave it ou"),
        ("obstacle-avoidance", ["--longest-arc", 2], "or choose --task nine-rectangles"),
        (
            "obstacle-avoidance",
            ["--port", "COM3"],
            "leave it out, or choose --reality khep",
        ),
        (
            "obstacle-avoidance",
            ["--lab-seed", 2],
            "--reality needs --robot-generations",
        ),
        ("nine-rectangles", ["--steps", 10], "or choose --task obstacle-avoidance"),
    ],
)
def test_options_of_another_task_are_refused(folder, task, words, message):
    with pytest.raises(UserError, match=message):
        call("evolve", folder / "sim", "--task", task, "-o", folder / "other", *words)


@pytest.mark.slow
def test_resume_takes_the_options_it_was_begun_with(folder):
    begun = [
        "evolve", folder / "sim", "--task", "obstacle-avoidance", "-o", folder / "resumed",
        "--generations", 2, "--population", 20, "--place", folder / "arena.json", "--steps", 20,
        "--starts", 2, "--robot-generations", 1, "--noise", "none", "--seed", 3,
    ]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OnFloor, "trial", lost)
        with pytest.raises(LinkLost, match="continue with --resume"):
            call(*begun)
    with pytest.raises(UserError, match="begun with generations = 2, not 3"):
        call("evolve", folder / "sim", "-o", folder / "resumed", "--resume", "--generations", 3)
    for words, message in (
        (["--lab-seed", 1], r"begun with robot\.virtual_lab\.robot_seed = 0, not 1;"),
        (["--baud", 19200], r"begun with robot\.baud = 9600, not 19200;"),
    ):
        with pytest.raises(UserError, match=message):
            call("evolve", folder / "sim", "-o", folder / "resumed", "--resume", *words)
    done = call("evolve", folder / "sim", "-o", folder / "resumed", "--resume", "--json")
    assert json.loads(done.stdout)["transfer"] == 2
    evolution = read_controller(folder / "resumed").evolution
    assert evolution["place"]["obstacles"] == [[0, 0, 0.0275]]
    assert evolution["robot"]["virtual_lab"]["robot_seed"] == 0


@pytest.mark.slow
def test_a_robot_on_another_line_than_its_samples(folder, tmp_path):
    for name in ("wall", "cylinder"):
        shutil.copy(folder / f"{name}.sample", tmp_path)
    write_json(tmp_path / "sampling.json", FORMAT, VERSION, {"robot": {"baud": 38400}})
    sim = tmp_path / "sim"
    call("build-tables", tmp_path / "wall.sample", tmp_path / "cylinder.sample", "-o", sim)
    words = [
        "evolve", sim, "--task", "obstacle-avoidance", "-o", tmp_path / "net", "--generations", 1,
        "--population", 20, "--steps", 10, "--starts", 1, "--robot-generations", 1,
    ]  # fmt: skip
    for line in ([], ["--reality", "khepera", "--port", "/dev/no-such-port"]):
        with pytest.raises(UserError, match=r"measured at 38400 baud.*is at 9600: give --baud 384"):
            call(*words, *line)
    with pytest.raises(UserError, match="virtual-khepera has no option --port"):
        call(*words, "--port", "COM3")
    assert not (tmp_path / "net").exists()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OnFloor, "trial", lambda reality, genes, number: 1.0)
        call(*words, "--baud", 38400)
    assert read_controller(tmp_path / "net").evolution["robot"]["baud"] == 38400


def test_speeds_and_radius_are_those_of_the_robot_that_sampled_itself(folder, tmp_path):
    for name in ("wall", "cylinder"):
        shutil.copy(folder / f"{name}.sample", tmp_path)
    with open(tmp_path / "motors.csv", "w") as file:
        print("left,right,duration,dx,dy,dtheta", file=file)
        for left in (-100, 100):
            for right in (-100, 100):
                print(left, right, 1, (left + right) / 2000, 0, 0, sep=",", file=file)
    robot = {"robot": "khepera", "dialect": "epuck", "full_speed": 1000}
    write_json(tmp_path / "sampling.json", FORMAT, VERSION, {"robot": robot})
    samples = [tmp_path / "wall.sample", tmp_path / "cylinder.sample"]
    for name, words, resolution in (
        ("driven", ["--motors", tmp_path / "motors.csv"], 0.1),
        ("said", ["--motors", tmp_path / "motors.csv", "--units", 20], 5.0),
        ("ideal", [], 10.0),
    ):
        call("build-tables", *samples, *words, "-o", tmp_path / name)
        simulator = read_simulator(tmp_path / name)
        assert simulator.motors.resolution == pytest.approx(resolution)
        assert simulator.radius == 0.035
    write_json(tmp_path / "sampling.json", FORMAT, VERSION, {"robot": {"full_speed": "fast"}})
    with pytest.raises(FileError, match=r"'robot\.full_speed': expected a whole number"):
        call("build-tables", *samples, "-o", tmp_path / "x")


def test_a_small_population_has_parents_and_children(folder, tmp_path):
    done = call(
        "evolve", folder / "sim", "--task", "obstacle-avoidance", "-o", tmp_path / "net",
        "--generations", 2, "--population", 7, "--steps", 10,
    )  # fmt: skip
    assert "the population's mean went from" in done.output
    assert read_controller(tmp_path / "net").evolution["settings"]["genetic"]["parents"] == 1


def lost(reality, genes, number):
    raise LinkLost("the robot stopped answering")


def test_view(folder):
    out = folder / "path.png"
    done = call(
        "view", folder / "arena.json", "--simulator", folder / "sim", "--controller",
        folder / "net", "--pose", 15, 10, 90, "--seconds", 5, "-o", out, "--json",
    )  # fmt: skip
    result = json.loads(done.stdout)
    assert result["path"][0] == pytest.approx([0.15, 0.10, math.pi / 2])
    assert len(result["path"]) == 51
    assert len(result["readings"]) == 8
    assert 0 < result["fitness"] <= result["steps"] == 50
    picture = imread(out)
    assert picture.shape[1] > 800
    blue = (picture[..., 2] > 0.55) & (picture[..., 0] < 0.1)  # the colour of the path
    assert blue.sum() > 500
    call("view", folder / "arena.json", "-o", folder / "empty.svg")
    assert (folder / "empty.svg").read_text().startswith("<?xml")


def test_view_counts_what_the_network_was_evolved_for(folder, tmp_path):
    net = tmp_path / "net"
    shutil.copytree(folder / "net", net)
    content = json.loads((net / "controller.json").read_text())
    words = ["view", folder / "sim", "--controller", net, "--pose", 15, 10, 90, "--seconds", 5]
    content["task"]["settings"]["fitness"] = "cells"
    (net / "controller.json").write_text(json.dumps(content))
    result = json.loads(call(*words, "-o", tmp_path / "x.png", "--json").stdout)
    path = np.array(result["path"])[:, :2]
    assert result["fitness"] == len(set(map(tuple, np.floor(path / 0.05))))
    content["task"]["settings"]["fitness"] = "of-somebody-else"
    (net / "controller.json").write_text(json.dumps(content))
    with pytest.raises(FileError, match=r"task\.settings\.fitness.*found 'of-somebody-else'"):
        call(*words, "-o", tmp_path / "y.png")
    assert not (tmp_path / "y.png").exists()


def test_view_of_a_plan(folder):
    plan = SavedController(
        FixedPlan(((50.0, 50.0, 1.0),)),
        np.zeros(0),
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
    result = json.loads(done.stdout)
    assert result["pose"] == pytest.approx([0.15, 0.1, 0])
    assert "the task x is not registered on this computer" in result["note"]
    assert result["contacts"] == 0


def test_a_drawn_path_has_a_title_its_fitness_and_its_contacts(folder, tmp_path, monkeypatch):
    from neurosim.reports import view

    figures, make = [], view.picture
    monkeypatch.setattr(
        view, "picture", lambda *a, **b: figures.append(make(*a, **b)) or figures[-1]
    )
    for name in ("sim", "net"):
        shutil.copytree(folder / name, tmp_path / name)
    folder = tmp_path
    test_view_of_a_plan(folder)  # it ends 7 cm from the wall
    words = ["view", folder / "sim", "--controller", folder / "plan", "--overwrite"]
    out = folder / "plan.png"
    # The arena of the simulator is 60 x 35 cm: 1 cm before the wall on the right.
    result = json.loads(call(*words, "--pose", 26, 10, 0, "-o", out, "--json").stdout)
    assert result["contacts"] == 1
    assert result["pose"][0] == pytest.approx(0.3 - 0.0275, abs=1e-3)
    free, hit = (figure.axes[0] for figure in figures)
    assert free.get_title("left") == "plan in sim, no contact"
    assert hit.get_title("left") == "plan in sim, 1 contact (x)"
    crosses = [[line for line in axes.lines if line.get_marker() == "x"] for axes in (free, hit)]
    assert (len(crosses[0]), len(crosses[1])) == (0, 1)
    message = call(
        "view", folder / "sim", "--controller", folder / "net", "--pose", 15, 10, 90,
        "--seconds", 2, "-o", out, "--overwrite",
    ).stdout  # fmt: skip
    fitness = f"fitness {float(message.split('fitness ')[1].split(',')[0]):z.4g}"
    title = figures[-1].axes[0].get_title("left")
    assert title.startswith(f"net in sim, {fitness}, ")
    assert title.endswith(message.strip().split(", ")[-1])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["view", "arena.json", "-o", "x.bmp"], r"a picture ends in \.png, \.svg, \.pdf"),
        (["view", "arena.json", "-o", "x.png", "--pose", 0, 0, 0], "in a wall or an obstacle"),
        (["view", "arena.json", "-o", "x.png", "--controller", "net"], "give --simulator"),
        (["view", "none", "-o", "x.png"], "no such file"),
        (["build-tables", "wall.sample", "-o", "x"], "no samples of the cylinder"),
        (["build-tables", "wall.sample", "cut-cylinder.sample", "-o", "x"], "is cut short"),
        (
            ["evolve", "sim", "--task", "obstacle-avoidance", "-o", "x", "--tournament", 5],
            "--tournament: leave it out, or choose --controller plan",
        ),
        (
            ["evolve", "sim", "--task", "obstacle-avoidance", "-o", "x", "--steps", 7],
            "steps must be a multiple of starts: 7 steps, 5 starts",
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
                "--robot-generations",
                1,
            ],
            "obstacle-avoidance needs the robot's poses: use a camera",
        ),
        (
            ["build-tables", "wall.sample", "-o", "x", "--motors", "m.csv", "--wheel-base", 50],
            "the wheel base is for an ideal robot",
        ),
        (
            ["lab", "khepera", "--port", 5, "--seconds", 0.1],
            "--port is the port of a socket: add --socket",
        ),
        (
            ["lab", "nxt", "--port", 5, "--seconds", 0.1],
            "--port is the port of a socket: add --socket",
        ),
        (["evolve", "sim", "--task", "flying", "-o", "x"], "there is no task 'flying'"),
        (["evaluate", "sim", "dataset"], "is not a motion network"),
    ],
)
@pytest.mark.slow
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
        read_motion(tmp_path / "sim")


@pytest.mark.slow
def test_a_network_drives_a_khepera_on_its_own_and_the_report_shows_its_path(folder, tmp_path):
    done = call(
        "run", folder / "net", "--robot", "virtual-khepera", "--lab-seed", 2, "--camera", "none",
        "-o", tmp_path / "trial", "--json",
    )  # fmt: skip
    trial = json.loads((tmp_path / "trial" / "trial.json").read_text())
    assert json.loads(done.stdout)["fitness"]["actual"] == trial["actual"]["fitness"] > 0
    assert trial["kind"] == "network"
    assert trial["virtual"] is True
    assert trial["actual"]["seen_by"] == "counters"
    # The counters' path belongs to the driven commands: half the sum of the wheels' distances.
    path, commands = np.array(trial["actual"]["path"]), np.array(trial["commands"])
    assert len(commands) == 50
    assert len(path) == 52
    distance = np.linalg.norm(np.diff(path[:, 1:3], axis=0), axis=1).sum()
    commanded = np.abs(commands[:, :2].mean(1)).sum() / 100 * 0.1 * 0.1  # 0.1 m/s at 100 %
    assert 0.05 < distance < 1.1 * commanded
    call("report", folder / "sim", folder / "net", tmp_path / "trial", "-o", tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert "Its path is that of its own counters." in page
    sampled = re.findall(r'<path d="([^"]+)"[^>]*stroke: var\(--actual\)', page)
    points = np.array(
        max((re.findall(r"(-?[\d.]+) (-?[\d.]+)", d) for d in sampled), key=len), float
    )
    # In the picture it is as long and as wide as it was, y upwards.
    scale = np.ptp(points, axis=0) / np.ptp(path[:, 1:3], axis=0)
    assert scale[0] == pytest.approx(scale[1], rel=0.02)
    begin, end = points[[0, -1]] / scale[0] * [1, -1]
    assert end - begin == pytest.approx(path[-1, 1:3] - path[0, 1:3], abs=0.002)
