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

FADES = Excess(torch.tensor([0.5, 0.25, 1.0]), torch.tensor([1.0, 0.5, 0.0]))
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
    # 0.2 m/s ahead count whole, 0.1 m/s to the left count half.
    ahead, left = 0.5 * 0.2 * (1 - np.exp(-2)), 0.25 * 0.05 * (1 - np.exp(-4))
    assert after[0, :3] == pytest.approx([ahead, left, 0.0])
    assert after[1, :3] == pytest.approx([0.0, 0.0, 0.0])  # it was not measured
    further = sim.step(after, double([[0.0, 0.0, 9.0]] * 2))
    assert further[0, :3] == pytest.approx([0.1, 0.0125, 0.0], abs=1e-8)


def test_what_is_seen_again_as_expected_changes_nothing():
    sim, state = seen_at_rest([[0.02, 0.01, 0.03]] * 2)
    before = sim.step(state, double([[0.0, 0.0, 0.1]] * 2))
    after = sim.step(before, double([[0.0, 0.0, 0.1]] * 2))
    moved = se2.between(before[:, :3], after[:, :3])
    assert torch.allclose(sim.seen(after, before, moved, 0.1), after, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_curve_is_driven_with_the_excess_in_the_robots_frame():
    """Compared with small steps in which both twists are added."""
    exceeds = Excess(torch.tensor([1.0, 2.0, 0.7]), torch.ones(3))
    sim = random_motion_network(noise=False, excess=exceeds)
    same, command = double([[0.0, 0.0, 0.0]]), double([[30.0, -20.0, 0.5]])
    state = sim.step(sim.start(same), command)
    plain, excess = state, double([[0.05, -0.08, 0.3]])
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
    assert torch.equal(read.excess.believed, FADES.believed)
    assert read.state_names == sim.state_names
    assert read.adjusted(np.array([1.1, 1.0, 0.0, 0.0, 0.0])).excess is read.excess
    content = json.loads((tmp_path / "simulator.json").read_text())
    (tmp_path / "simulator.json").write_text(json.dumps({**content, "excess": "much"}))
    with pytest.raises(FileError, match="excess"):
        read_motion(tmp_path)


@pytest.mark.parametrize("wrong", [{"lasts": 0.0}, {"believed": 1.5}, {"believed": -0.1}])
def test_impossible_numbers_are_refused(wrong):
    numbers = {"lasts": 1.0, "believed": 0.5} | wrong
    with pytest.raises(ValueError, match="must be"):
        Excess(**{name: torch.full((3,), value) for name, value in numbers.items()})
    with pytest.raises(ValueError, match="shape"):
        Excess(torch.ones(2), torch.ones(3))
