"""Steps of whole batches, compiled, are those of the simulator's own step() and sense()."""

import numpy as np
import pytest
from motion_networks import random_motion_network
from simulators_of_tests import Walker, motion_network, tables

from neurosim.simulators.sampling import Stepper
from neurosim.simulators.tables.reaction import Reaction

MADE = {
    "motion network": motion_network,
    "one network": lambda: random_motion_network(members=1, central=False),
    "driven": random_motion_network,
    "driven, no noise": lambda: random_motion_network(noise=False),
    "driven, no kernel units": lambda: random_motion_network(units=0, central=False, swing=None),
    "on a floor": lambda: random_motion_network(floor=True),
    "one network, on a floor": lambda: random_motion_network(
        members=1, central=False, drives=False, swing=None, floor=True
    ),
    "tables": tables,
    "tables, late": lambda: tables().changed(reaction=Reaction(answer=0.03, lag=(0.05, 0.08))),
    "tables, no noise": lambda: tables().changed(noise="none"),
}


def commands(simulator, rows, seed, duration):
    """Return commands; some continue those of another call with the same seed."""
    rng = np.random.default_rng(seed)
    given = rng.uniform(-50, 50, (rows, len(simulator.command_names)))
    given[:, -1] = duration
    return given


@pytest.mark.parametrize("noisy", [False, True], ids=["expected", "drawn"])
@pytest.mark.parametrize("name", MADE)
def test_compiled_steps_are_the_simulators_own(name, noisy):
    simulator = MADE[name]()
    noisy = noisy and simulator.has_noise
    compiled, plain, rng = simulator.stepper(), Stepper(simulator), np.random.default_rng(0)
    assert type(compiled) is not Stepper
    poses = simulator.free_poses(40, rng)
    poses = rng.normal(0, 0.2, (40, 3)) if poses is None else poses
    member = np.arange(40) % (simulator.members + 1) - 1
    seeds = rng.integers(2**64, size=40, dtype=np.uint64)
    state = compiled.start(poses, member)
    assert np.array_equal(state, plain.start(poses, member))
    for step, (seed, duration) in enumerate([(1, 0.1), (1, 0.1), (1, 0.25), (2, 0.1), (3, 0.7)]):
        noise = compiled.noise(seeds, np.full(40, step)) if noisy else None
        if simulator.reading_names:
            seen, own = (each.sense(state, noise) for each in (compiled, plain))
            np.testing.assert_allclose(seen, own, atol=2e-6)
        given = commands(simulator, 40, seed, duration)
        after, own = (each.step(state, given, noise) for each in (compiled, plain))
        np.testing.assert_allclose(after, own, rtol=1e-9, atol=1e-9)
        assert np.abs(after[:, :3] - state[:, :3]).max() > 1e-3
        state = after


def test_noise_of_tables_is_that_of_their_rollouts():
    simulator, seeds = tables(), np.array([7, 2**63 + 1], np.uint64)
    expanded = simulator.noise_of(seeds, 5)
    stepper = simulator.stepper()
    for step in range(5):
        sampled = stepper.noise(seeds, np.full(2, step))
        np.testing.assert_allclose(sampled, expanded[:, step], atol=1e-6)


def test_numbers_of_motion_networks_are_standard_normal():
    stepper = random_motion_network().stepper()
    seeds = np.arange(5000, dtype=np.uint64)
    z = np.concatenate([stepper.noise(seeds, np.full(5000, step)) for step in range(4)])
    assert np.abs(z.mean(axis=0)).max() < 0.03
    assert np.abs(np.corrcoef(z.T) - np.eye(4)).max() < 0.03
    assert np.abs(z.std(axis=0) - 1).max() < 0.03
    assert 0.001 < (np.abs(z) > 3).mean() < 0.005


@pytest.mark.parametrize("make", [Walker, tables, random_motion_network])
def test_a_robot_meets_the_same_whoever_else_there_is(make):
    simulator = make()
    stepper, seeds = simulator.stepper(), np.arange(6, dtype=np.uint64)
    state = stepper.start(np.tile([0.0, 0.1, 0.5], (6, 1)))
    given = commands(simulator, 6, 0, 0.1)
    noise = stepper.noise(seeds, np.arange(6))
    together = stepper.step(state, given, noise)
    for row in range(6):
        one = slice(row, row + 1)
        own = stepper.noise(seeds[one], np.arange(6)[one])
        assert np.array_equal(stepper.step(state[one], given[one], own), together[one])
    assert len(np.unique(together[:, 0])) == 6
