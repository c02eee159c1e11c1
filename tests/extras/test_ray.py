"""Populations judged by a local Ray cluster of several processes (``make test-extras``)."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from motion_networks import noise_model, random_motion_network
from patience import PATIENCE, wait_until

from neurosim.base.errors import UserError
from neurosim.cli.main import cli, run_plugin
from neurosim.controllers import Function, Plan
from neurosim.loop.evaluate import evaluate
from neurosim.simulators.registry import write_simulator
from neurosim.tasks.nine_rectangles import NineRectangles

pytestmark = pytest.mark.skipif(
    not os.environ.get("NEUROSIM_EXTRAS"), reason="run by make test-extras, which installs Ray"
)

SAMPLES = 64
ROOT = Path(__file__).resolve().parents[2]
SWEEP = """
[sweep]
seed = [0, 1]

[train]
dataset = "{data}"
trainer = "ga"
generations = 1
population = 10
seed = 5

[evolve]
generations = 30
population = 20
runs = 1
"""
ENDLESS = """
[sweep]
seed = [0, 1]

[evolve]
simulator = "simulator"
extrapolate = true
generations = 100000
population = 20
runs = 1
"""


@pytest.fixture(scope="module")
def simulator():
    return random_motion_network(1, noise=noise_model(1, size=-6.0))


@pytest.fixture
def cluster(request):
    """Start a cluster with this number of workers; it ends with the test."""
    import ray

    ray.init(num_cpus=request.param, include_dashboard=False, log_to_driver=False)
    yield request.param
    ray.shutdown()


def genes_of(plan, count):
    return np.random.default_rng(0).random((count, plan.genes))


@pytest.mark.parametrize("cluster", [1, 3], indirect=True)
def test_a_worker_is_killed_in_the_middle(cluster, simulator, tmp_path):
    folder, driver = str(tmp_path), os.getpid()

    @dataclass(frozen=True)
    class Deadly(NineRectangles):
        """Kills the process that judges the third part, once."""

        def judge(self, trajectory):
            if os.getpid() != driver:
                number = len(os.listdir(folder))
                with open(
                    os.path.join(folder, f"{number}-{os.getpid()}-{os.urandom(4).hex()}"), "w"
                ):
                    pass
                if number >= 2:
                    try:
                        os.close(os.open(os.path.join(folder, "killed"), os.O_CREAT | os.O_EXCL))
                    except FileExistsError:
                        pass
                    else:
                        os.kill(os.getpid(), signal.SIGKILL)
            return super().judge(trajectory)

    plan = Plan(slots=10)
    genes = genes_of(plan, 4500)  # seven parts
    expected = evaluate(simulator, NineRectangles(), plan, samples=SAMPLES)(genes)
    given = {"samples": SAMPLES, "workers": "ray"}
    result = evaluate(simulator, Deadly(), plan, **given)(genes)
    np.testing.assert_array_equal(result, expected)
    judged = [name.split("-")[1] for name in os.listdir(folder) if name != "killed"]
    assert (tmp_path / "killed").exists()
    assert len(judged) >= 8  # one of the seven twice
    assert len(set(judged)) >= 2  # another process went on


@pytest.mark.parametrize("cluster", [2], indirect=True)
def test_runs_of_an_evolution_by_the_command(cluster, simulator, tmp_path):
    write_simulator(simulator, tmp_path / "simulator")
    words = ["evolve", str(tmp_path / "simulator"), "--generations", "3", "--runs", "2"]
    words += ["--population", "2000", "--robust", "--robust-generations", "2", "--draws", "32"]
    results = []
    for workers in ("local", "ray"):
        out = tmp_path / workers
        done = CliRunner().invoke(
            cli, [*words, "--extrapolate", "--workers", workers, "-o", str(out)]
        )
        assert done.exception is None, done.exception
        results.append(json.loads((out / "controller.json").read_text()))
    for one in results:
        one.pop("created", None)
    assert results[0] == results[1]


MINE = """
from dataclasses import dataclass
from pathlib import Path
from neurosim.tasks.nine_rectangles import NineRectangles

@dataclass(frozen=True)
class Mine(NineRectangles):
    def judge(self, trajectory):
        return helper(super().judge(trajectory))

def helper(judgement):
    return judgement
"""


@pytest.mark.parametrize("cluster", [2], indirect=True)
def test_what_a_file_registers_is_sent_along(cluster, simulator, tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    run_plugin(tmp_path / "mine.py")
    task, plan = sys.modules["neurosim_plugin_mine"].Mine(), Plan(slots=3)
    genes = genes_of(plan, 50)
    result = evaluate(simulator, task, plan, workers="ray")(genes)
    np.testing.assert_array_equal(result, evaluate(simulator, task, plan)(genes))


@pytest.mark.parametrize("cluster", [2], indirect=True)
def test_what_a_worker_refuses_is_one_sentence(cluster, simulator):
    def refuses(seen, genes):
        raise UserError("this controller refuses")

    family = Function(refuses, inputs=("x",), genes=1, name="refuses")
    fitness = evaluate(simulator, NineRectangles(), family, workers="ray")
    with pytest.raises(UserError, match=r"^this controller refuses$"):
        fitness(np.zeros((3, 1)))


@pytest.mark.parametrize("cluster", [2], indirect=True)
def test_a_sweep_runs_on_a_cluster(cluster, tmp_path):
    file = tmp_path / "sweep.toml"
    file.write_text(SWEEP.format(data=(ROOT / "data" / "reference").as_posix()))
    results = []
    for workers in ("local", "ray"):
        words = ["pipeline", str(file), "-o", str(tmp_path / workers), "--workers", workers]
        done = CliRunner().invoke(cli, [*words, "--json"], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        points = json.loads(done.stdout)["points"]
        made = [Path(point["stages"]["evolve"]["out"]) / "controller.json" for point in points]
        results.append([json.loads(path.read_text())["commands"] for path in made])
    assert results[0] == results[1]
    assert results[0][0] != results[0][1]


def test_ctrl_c_ends_what_a_cluster_runs(simulator, tmp_path):
    write_simulator(simulator, tmp_path / "simulator")
    file = tmp_path / "sweep.toml"
    file.write_text(ENDLESS)
    words = ["pipeline", str(file), "--workers", "ray", "--at-once", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "neurosim", *words], stderr=subprocess.PIPE, text=True
    )
    kept = [tmp_path / "sweep" / f"seed={seed}" / "evolve.checkpoint" for seed in (0, 1)]
    wait_until(lambda: all((one / "checkpoint.json").exists() for one in kept), "both evolutions")
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, messages
    assert "Traceback" not in messages
    assert not running_in(tmp_path)
    # Ended as by Ctrl-C: what each of them had found is written.
    assert all((one.with_name("evolve") / "controller.json").exists() for one in kept)


def running_in(folder):
    """Return the command lines of processes that name a folder."""
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(path.read_bytes().replace(b"\0", b" ").decode())
        except OSError:  # it has ended
            continue
    return [line for line in lines if str(folder) in line]
