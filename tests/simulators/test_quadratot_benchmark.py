"""The computations of the real quadruped's benchmark, by hand and on a few trials."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="pip install 'neurosim[mujoco]'")

import quadratot as benchmark

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Trajectory
from neurosim.simulators.legged.simulator import LeggedSimulator


@pytest.fixture
def record(shared_data):
    folder = shared_data / "real" / "quadratot"
    if not folder.is_dir():
        pytest.skip(f"the record of the real robot is not there ({folder})")
    return folder


@pytest.fixture
def few():
    """Ten gaits, each tried once; reality is a simulator whose floor is more slippery."""
    genes = np.random.default_rng(4).uniform([0.4, 0.05, 0, 0, 0], [1, 0.3, 1, 1, 1], (10, 5))
    trials = benchmark.Trials(genes, np.arange(10), np.zeros(10))
    robot = benchmark.robot_of(trials, (8.0, 0.7))
    slippery = LeggedSimulator(replace(benchmark.QuadraTot(), friction=0.3))
    real = benchmark.Simulated(slippery, benchmark.Roots(12.0, 0.025, 0.0), benchmark.GAIT)
    trials = trials._replace(roots=real.fitness(genes, real.as_is))
    return robot._replace(trials=trials)


def test_the_noise_is_that_of_repeats_alone():
    """Means are 2 and 3; squares are 1, 1 and 1, 1, 4, over 1 and 2 degrees of freedom."""
    gait, values = np.array([0, 0, 1, 1, 1, 2]), np.array([1.0, 3.0, 2.0, 2.0, 5.0, 9.0])
    assert benchmark.noise_of(values, gait) == pytest.approx(np.sqrt(8 / 3))


def test_measures_by_hand():
    """Pixels are 1, 4, 9, and 1, 9, 4 are predicted: 0, 5 and 5 off."""
    trials = benchmark.Trials(np.zeros((3, 5)), np.arange(3), np.array([1.0, 2.0, 3.0]))
    result = benchmark.measures(np.array([1.0, 3.0, 2.0]), trials, (2.0, 0.5))
    assert result["rank"] == pytest.approx(0.5)
    assert result["pixels"] == pytest.approx(np.sqrt(50 / 3) / 2)
    assert result["roots"] == pytest.approx(np.sqrt(2 / 3) / 0.5)


def test_the_fitness_is_the_root_of_the_displacement_in_pixels():
    """17 cm are 100 pixels."""
    poses = np.zeros((1, 481, 3))
    poses[0, :, 0] = np.linspace(0.0, 0.17, 481)
    task = benchmark.Roots(12.0, 0.025, 0.0)
    judged = task.judge(Trajectory(poses, np.zeros((1, 480, 9)), 0.025))
    assert judged.fitness == pytest.approx([10.0])


def test_the_record_is_read(record):
    trials = benchmark.read_trials(record)
    assert trials.genes.shape == (634, 5)
    assert ((trials.genes >= 0) & (trials.genes <= 1)).all()
    assert len(np.unique(trials.gait)) == 519
    assert benchmark.noise_of(trials.roots**2, trials.gait) == pytest.approx(8.09, abs=0.01)


def test_a_record_that_is_not_there_is_said(tmp_path):
    with pytest.raises(UserError, match=r"there is no .*gaits\.csv: name the folder"):
        benchmark.read_trials(tmp_path)
    (tmp_path / "gaits.csv").write_text("amp,tau_s\n1,2\n")
    with pytest.raises(UserError, match="has no column scale_in_out"):
        benchmark.read_trials(tmp_path)


@pytest.mark.slow
def test_l3_brings_the_simulator_closer_to_the_trials_that_it_compares(few):
    pytest.importorskip("cma", reason="pip install 'neurosim[cma]'")
    simulated, trials = few.simulated, benchmark.Trials(*(part[:5] for part in few.trials))
    result = benchmark.adapted(simulated, trials, seed=0, generations=2)
    again = benchmark.adapted(simulated, trials, seed=0, generations=2)
    np.testing.assert_array_equal(result, again)
    assert ((result >= 0) & (result <= 1)).all()
    apart = [
        np.linalg.norm(benchmark.predicted(simulated, trials, one) - trials.roots)
        for one in (simulated.as_is, result)
    ]
    assert apart[1] < 0.95 * apart[0]


def test_a_process_joined_with_a_perfect_simulator_is_that_simulator():
    pytest.importorskip("sklearn", reason="pip install scikit-learn")
    rng = np.random.default_rng(0)
    genes, at = rng.uniform(size=(15, 5)), rng.uniform(size=(8, 5))
    truth = lambda given: 3.0 + 2.0 * np.sin(9.0 * given[:, 0])  # noqa: E731
    mean, mean_at = (0.5 * truth(one) - 1.0 for one in (genes, at))
    result = benchmark.joined(mean, mean_at, genes, truth(genes), at)
    np.testing.assert_allclose(result, truth(at), atol=1e-6)
    near = benchmark.process(genes, genes[:, 1], genes)
    np.testing.assert_allclose(near, genes[:, 1], atol=0.1)


@pytest.mark.slow
def test_a_seed_says_what_every_method_makes_of_the_others(few):
    for package in ("sklearn", "cma"):
        pytest.importorskip(package)
    row = benchmark.one_seed(few, seed=1, sampled=6, generations=1)
    assert set(row["held out"]) == set(benchmark.METHODS)
    assert row["held out"]["mean of the sampled trials"]["rank"] is None
    before, after = (row["sampled ones"][name]["roots"] for name in ("as it is", "adapted"))
    assert after <= before
    assert list(row["parameters"]) == [one.name for one in few.simulated.parameters]
    without = benchmark.one_seed(few, seed=1, sampled=6, generations=0)
    assert "simulator adapted" not in without["held out"]
    same = "Gaussian process"
    assert without["held out"][same] == row["held out"][same]
    assert "6 trials" in benchmark.summary([row, row])
