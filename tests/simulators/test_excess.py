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
    torch.tensor([0.5, 0.25, 1.0]), torch.tensor([1e9, 100.0, 0.0]), torch.tensor([0.05])
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
    [(0.1, 0.5, 0.0), (0.4, 0.2, 0.02), (1.0, 2.0, 0.3), (2.0, 0.3, 0.1)],
)
def test_a_gain_is_the_best_one_for_a_random_excess(seconds, lasts, sd):
    """Compared with the regression of 20,000 random paths, whose poses are seen with errors."""
    rng, steps = np.random.default_rng(0), 100
    fades = np.exp(-seconds / steps / lasts)
    excess = rng.standard_normal(20_000)
    distance = np.zeros_like(excess)
    for _ in range(steps):
        after = fades * excess + np.sqrt(1 - fades**2) * rng.standard_normal(len(excess))
        distance += (excess + after) / 2 * seconds / steps
        excess = after
    seen = (distance + rng.normal(0, sd, len(excess))) / seconds
    gain = (seen @ excess) / (seen @ seen)
    clarity = torch.full((3,), 1.0 / max(sd, 1e-9) ** 2)
    learned = Excess(torch.full((3,), lasts), clarity, torch.tensor([0.1])).believed(seconds)
    assert learned.tolist() == pytest.approx([gain] * 3, abs=0.02)


def test_a_measurement_shorter_than_any_in_the_rows_counts_like_the_shortest():
    assert torch.equal(FADES.believed(0.01), FADES.believed(0.05))
    assert FADES.believed(0.05)[1] < FADES.believed(0.06)[1]


def test_what_is_seen_again_as_expected_changes_nothing():
    sim, state = seen_at_rest([[0.02, 0.01, 0.03]] * 2)
    before = sim.step(state, double([[0.0, 0.0, 0.1]] * 2))
    after = sim.step(before, double([[0.0, 0.0, 0.1]] * 2))
    moved = se2.between(before[:, :3], after[:, :3])
    assert torch.allclose(sim.seen(after, before, moved, 0.1), after, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_curve_is_driven_with_the_excess_in_the_robots_frame():
    """Compared with small steps in which both twists are added."""
    exceeds = Excess(torch.tensor([1.0, 2.0, 0.7]), torch.full((3,), 1e12), torch.tensor([0.01]))
    sim = random_motion_network(noise=False, excess=exceeds)
    same, command = double([[0.0, 0.0, 0.0]]), double([[30.0, -20.0, 0.5]])
    state = sim.step(sim.start(same), command)
    plain, excess = state, double([[0.05, -0.08, 0.3]]) / exceeds.believed(0.01)
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
    assert torch.equal(read.excess.lasts, FADES.lasts)
    assert torch.equal(read.excess.clarity, FADES.clarity)
    assert torch.equal(read.excess.shortest, FADES.shortest)
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


@pytest.mark.parametrize("wrong", [{"lasts": 0.0}, {"clarity": -0.1}, {"shortest": 0.0}])
def test_impossible_numbers_are_refused(wrong):
    numbers = {"lasts": 1.0, "clarity": 0.5, "shortest": 0.1} | wrong
    sizes = {"lasts": 3, "clarity": 3, "shortest": 1}
    with pytest.raises(ValueError, match="must be"):
        Excess(**{name: torch.full((sizes[name],), value) for name, value in numbers.items()})
    with pytest.raises(ValueError, match="shape"):
        Excess(torch.ones(2), torch.ones(3), torch.ones(1))
