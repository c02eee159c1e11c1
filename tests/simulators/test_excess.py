"""A robot that is seen to move otherwise than simulated goes on so for a while."""

import json

import numpy as np
import pytest
import torch
from motion_networks import random_motion_network

from neurosim.base.errors import FileError
from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.excess import Excess
from neurosim.simulators.motion.files import read_motion, write_motion
from neurosim.simulators.motion.noise import added

FADES = Excess(
    torch.tensor([0.5, 0.25, 1.0]),
    torch.diag(torch.tensor([1.0, 1.0, 0.0])),
    torch.tensor([1e-12, 0.01, 1.0]),
    torch.tensor([0.05]),
)
STANDS = torch.zeros(2, 3, dtype=torch.float64)


def double(rows):
    return torch.tensor(rows, dtype=torch.float64)


def seen_at_rest(moved):
    """Return a simulator, and states of two robots that were commanded to stand for 0.1 s."""
    sim = random_motion_network(size=0.0, units=0, noise=False, excess=FADES)
    before = sim.start(STANDS)
    state = sim.step(before, double([[0.0, 0.0, 0.1]] * 2))
    return sim, sim.seen(state, before, double(moved), 0.1)


def test_a_robot_that_slides_comes_to_rest_by_hand():
    sim, state = seen_at_rest([[0.02, 0.01, 0.0], [float("nan")] * 3])
    after = sim.step(state, double([[0.0, 0.0, 1.0]] * 2))
    # For 0.1 s, z is 0.2 and 0.4, a 0.9063462 and 0.8241999, b 0.9365377 and 0.8790006. Measured
    # without errors, 0.2 m/s ahead count a / b; 0.1 m/s to the left, as uncertain as the excess is
    # large, count a / (b + 1).
    ahead = 0.5 * 0.2 * 0.9677627 * (1 - np.exp(-2))
    left = 0.25 * 0.1 * 0.4386374 * (1 - np.exp(-4))
    assert after[0, :3] == pytest.approx([ahead, left, 0.0], rel=1e-6)
    assert after[1, :3] == pytest.approx([0.0, 0.0, 0.0])  # it was not measured
    further = sim.step(after, double([[0.0, 0.0, 9.0]] * 2))
    assert further[0, :3] == pytest.approx([0.09677627, 0.01096594, 0.0], abs=1e-7)


@pytest.mark.parametrize(
    ("seconds", "lasts", "sd"),
    [(0.1, 0.5, 0.001), (0.4, 0.2, 0.02), (1.0, 2.0, 0.3), (2.0, 0.3, 0.1)],
)
def test_gains_are_the_best_ones_for_a_random_excess(seconds, lasts, sd):
    """Compared with the regression of 160,000 random paths, whose poses are seen with errors."""
    rng, steps = np.random.default_rng(0), 50
    # One that turns more drifts more.
    covariance = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, -0.6], [0.0, -0.6, 1.0]])
    errors = sd * np.array([1.0, 3.0, 0.5])
    root, fades = np.linalg.cholesky(covariance), np.exp(-seconds / steps / lasts)
    excess = rng.standard_normal((160_000, 3)) @ root.T
    distance = np.zeros_like(excess)
    for _ in range(steps):
        more = rng.standard_normal(excess.shape) @ root.T
        after = fades * excess + np.sqrt(1 - fades**2) * more
        distance += (excess + after) / 2 * seconds / steps
        excess = after
    seen = (distance + rng.normal(0, errors, excess.shape)) / seconds
    gains = np.linalg.lstsq(seen, excess, rcond=None)[0].T
    parts = torch.full((3,), lasts), double(covariance), double(errors) ** 2, torch.tensor([0.1])
    learned = Excess(*parts).believed(seconds)
    assert learned.numpy() == pytest.approx(gains, abs=0.03)


def test_a_measurement_shorter_than_any_in_the_rows_counts_like_the_shortest():
    assert torch.equal(FADES.believed(0.01), FADES.believed(0.05))
    assert FADES.believed(0.05)[1, 1] < FADES.believed(0.06)[1, 1]
    assert FADES.believed(0.05)[2].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.slow
def test_a_curve_is_driven_with_the_excess_in_the_robots_frame():
    """Compared with small steps in which both twists are added."""
    lasts, shortest = torch.tensor([1.0, 2.0, 0.7]), torch.tensor([0.01])
    exceeds = Excess(lasts, torch.eye(3), torch.full((3,), 1e-12), shortest)
    sim = random_motion_network(noise=False, excess=exceeds)
    same, command = double([[0.0, 0.0, 0.0]]), double([[30.0, -20.0, 0.5]])
    state = sim.step(sim.start(same), command)
    plain, excess = state, double([[0.05, -0.08, 0.3]]) / exceeds.believed(0.01).diagonal()
    moved = added(se2.between(sim.start(same)[:, :3], state[:, :3]), 0.01 * excess)
    state = sim.seen(state, sim.start(same), moved, 0.01)
    own = state[:, [sim.state_names.index(f"excess_{name}") for name in ("x", "y", "theta")]]
    assert own[0, 2] == pytest.approx(0.3)
    pose, count = state[:, :3].clone(), 400
    for k in range(count):
        old, plain = plain, sim.step(plain, double([[30.0, -20.0, 1.0 / count]]))
        fades = torch.exp(-(k + 0.5) / count / exceeds.lasts)
        twist = se2.between(old[:, :3], plain[:, :3]) + own * fades / count
        pose = se2.compose(pose, twist)
    stepped = state
    for _ in range(20):
        stepped = sim.step(stepped, double([[30.0, -20.0, 0.05]]))
    assert stepped[0, :3] == pytest.approx(pose[0], abs=1e-4)


@pytest.mark.parametrize("noise", [False, True])
def test_it_is_compiled_as_it_is_defined(noise):
    sim = random_motion_network(noise=noise, excess=FADES)
    rng, stepper = np.random.default_rng(0), sim.stepper()
    before = stepper.start(rng.normal(0, 1, (5, 3)), np.array([-1, 0, 1, 2, 0]))
    fastest = sim.domain["left"][1]
    commands = rng.uniform((-fastest, -fastest, 0.1), (fastest, fastest, 1.0), (3, 5, 3))
    state = stepper.step(before, commands[0], None)
    state = sim.seen(state, before, rng.normal(0, 0.1, (5, 3)), 0.5)
    assert isinstance(state, np.ndarray)
    defined = torch.from_numpy(state)
    for command in commands:
        z = rng.standard_normal((5, sim.noise_width), np.float32).astype(float) if noise else None
        state = stepper.step(state, command, z)
        z = None if z is None else torch.from_numpy(z)
        defined = sim.step(defined, torch.from_numpy(command), z=z)
        np.testing.assert_allclose(state, defined.numpy(), rtol=0, atol=1e-9)


def test_without_one_a_measured_speed_does_not_count():
    sim = random_motion_network(noise=False)
    state = sim.step(sim.start(STANDS), double([[10.0, 10.0, 1.0]] * 2))
    assert sim.seen(state, sim.start(STANDS), STANDS, 1.0) is state
    with pytest.raises(ValueError, match="needs a drive model"):
        random_motion_network(drives=False, excess=FADES)


def test_it_is_kept_with_the_simulator(tmp_path):
    sim = random_motion_network(excess=FADES)
    write_motion(sim, tmp_path)
    read = read_motion(tmp_path)
    assert read.excess is not None
    for name in ("lasts", "covariance", "errors", "shortest"):
        assert torch.equal(getattr(read.excess, name), getattr(FADES, name))
    assert read.state_names == sim.state_names
    assert read.adjusted(np.array([1.1, 1.0, 0.0, 0.0, 0.0])).excess is read.excess
    content = json.loads((tmp_path / "simulator.json").read_text())
    (tmp_path / "simulator.json").write_text(json.dumps({**content, "excess": "much"}))
    with pytest.raises(FileError, match="excess"):
        read_motion(tmp_path)
    (tmp_path / "simulator.json").write_text(json.dumps({**content, "version": 13}))
    with pytest.raises(FileError, match="how certain measured speeds are: train the simulator"):
        read_motion(tmp_path)


def test_a_simulator_of_the_version_before_without_one_is_read(tmp_path):
    write_motion(random_motion_network(), tmp_path)
    content = json.loads((tmp_path / "simulator.json").read_text())
    (tmp_path / "simulator.json").write_text(json.dumps({**content, "version": 13}))
    assert read_motion(tmp_path).excess is None


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"lasts": torch.zeros(3)}, "must be above 0"),
        ({"errors": torch.zeros(3)}, "must be above 0"),
        ({"shortest": torch.zeros(1)}, "must be above 0"),
        ({"covariance": -torch.eye(3)}, "no eigenvalue below 0"),
        ({"covariance": torch.tensor([[1.0, 0.5, 0.0], [0.0] * 3, [0.0] * 3])}, "symmetric"),
        ({"covariance": torch.ones(3)}, "shape"),
    ],
)
def test_impossible_numbers_are_refused(wrong, says):
    parts = {name: getattr(FADES, name) for name in ("lasts", "covariance", "errors", "shortest")}
    with pytest.raises(ValueError, match=says):
        Excess(**(parts | wrong))
