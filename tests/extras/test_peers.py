"""The peers in the benchmarks run (``make test-extras``; extra ``bench``)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


pytestmark = pytest.mark.skipif(
    not os.environ.get("NEUROSIM_EXTRAS"), reason="run by make test-extras, which installs them"
)


def measured(name, *words):
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / name), *words, "--json"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])  # peers may print before it


def test_genetic_algorithms():
    seconds = measured("ga_training.py", "--repeats", "2")["seconds"]
    assert {"neurosim", "EvoTorch", "DEAP", "PyGAD"} <= set(seconds)
    assert all(value > 0 for value in seconds.values())


def test_a_simulator_of_the_same_robot_in_jax():
    rows = measured("table_rollout.py", "--quick")["rows"]
    for name in ("ours, noise uniform", "PyTorch", "Kheperax (JAX)"):
        result = [row["steps_per_second"] for row in rows if row["name"] == name]
        assert len(result) == 2
        assert min(result) > 0


def test_rollouts_of_a_rigid_body_engine():
    rows = measured("planner_speed.py", "--quick")["rows"]
    (result,) = (row for row in rows if row["name"].startswith("MuJoCo"))
    assert result["physics_steps_per_second"] > result["command_steps_per_second"] > 0


def test_a_gaussian_process_beside_the_simulator_of_a_real_quadruped(shared_data):
    folder = shared_data / "real" / "quadratot"
    if not folder.is_dir():
        pytest.skip(f"the record of the real robot is not there ({folder})")
    (row,) = measured("quadratot.py", "--quick", "--seeds", "1", "--data", str(folder))["seeds"]
    assert len(row["held out"]) == 6
    assert row["held out"]["simulator as it is"]["rank"] > 0.4


def test_the_zoo_measured_in_parts_is_the_zoo_measured_at_once(tmp_path):
    words = ("zoo.py", "--robots", "late", "--sizes", "30", "--seeds", "1")
    peers = ("--peers", str(tmp_path / "peers.json"))

    def learners(*more):
        return measured(*words, *more)["rows"]["30"]["robots"]["late"]["learners"]

    learners("--learners", "fitted,process+u", *peers)
    result = learners("--learners", "lagged,process+l", *peers)
    assert result == learners(*("--learners", "fitted,process+u,lagged,process+l"), *peers)
    # A robot with a delay and a lag: these two learners model both, the others do not.
    assert result["lagged"]["ratio"] < result["fitted"]["ratio"]
    assert result["process+l"]["ratio"] < result["process+u"]["ratio"]
