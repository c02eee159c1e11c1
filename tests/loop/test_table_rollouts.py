"""Plans driven in tables by compiled code, against the simulator's own steps."""

import numpy as np
import pytest
from given_plans import EPISODE, GivenPlans, by_protocol, expected, sampled_poses
from khepera_data import made_up

from neurosim.base.place import Place
from neurosim.loop.stepped import SteppedRollouts
from neurosim.simulators import TableSimulator
from neurosim.simulators.engine import CompiledRollouts
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.reaction import Reaction

START = (-0.1, 0.02, 1.5)
BATCH, COUNT, COMMANDS = 12, 5, 6


def simulator(noise="none", reaction=Reaction()):  # noqa: B008 - frozen
    levels = np.linspace(-100, 100, 5)
    left, right = np.meshgrid(levels / 1000, levels / 1000, indexing="ij")
    twist = np.stack([0.48 * (left + right), 0.03 * (right - left), (right - left) / 0.05], -1)
    motors = MotorTable(levels, twist, 0.002 + 0.02 * np.abs(twist), 10.0)
    arena = Place.rectangle(0.6, 0.35)
    return TableSimulator(made_up(2, 0.01), motors, place=arena, noise=noise, reaction=reaction)


def plans():
    rng = np.random.default_rng(3)
    commands = rng.uniform((-100, -100, 0.05), (100, 100, 3), (BATCH, COMMANDS, 3))
    commands[0, :, :2] = 90.0  # into the wall
    commands[1, 2, :2] = 0.0
    given = rng.random((BATCH, COMMANDS)) < 0.8
    given[2] = False
    return GivenPlans(commands, given)


def compiled(sim, family):
    driver = sim.rollouts(family, EPISODE)
    assert isinstance(driver, CompiledRollouts)
    return driver


def starts(count=COUNT):
    return np.tile(START, (count, 1))


REACTIONS = [Reaction(), Reaction(0.03, 0.04, (0.03, 0.06)), Reaction(0.0, 0.25, (0.0, 0.1))]


@pytest.mark.parametrize("reaction", REACTIONS)
def test_expected_paths_are_the_steps_of_the_protocol(reaction):
    sim, family = simulator(reaction=reaction), plans()
    result = expected(compiled(sim, family), family, START)
    np.testing.assert_allclose(result, by_protocol(sim, starts(BATCH), family), atol=1e-9)
    stepped = expected(SteppedRollouts(sim, family, EPISODE), family, START)
    np.testing.assert_allclose(result, stepped, atol=1e-9)
    # The first plan's robot came to the wall, and not through it.
    assert np.abs(result[0, -1, 1]) == pytest.approx(0.175 - 0.0275, abs=1e-3)
    assert (result[2] == START).all()


@pytest.mark.parametrize("noise", ["uniform", "samples"])
@pytest.mark.parametrize("reaction", REACTIONS)
def test_drawn_paths_are_the_steps_through_the_same_noise(noise, reaction):
    sim, family = simulator(noise, reaction), plans()
    fast = compiled(sim, family)
    draws = fast.draw(starts(), 7, (0.003, 0.01))
    result = sampled_poses(fast, family, draws)
    assert result.shape == (BATCH, COUNT, COMMANDS + 2, 3)
    assert result[3, :, -1].std(axis=0).min() > 1e-4
    stepped = sampled_poses(SteppedRollouts(sim, family, EPISODE), family, draws)
    np.testing.assert_allclose(result, stepped, atol=1e-9)


def test_draws_are_the_same_for_the_same_seed_and_all_plans():
    sim, family = simulator("uniform"), plans()
    driver = compiled(sim, family)
    one, same, other = (driver.draw(starts(), seed, (0.0, 0.0)) for seed in (1, 1, 2))
    assert (one.noise == same.noise).all()
    assert (one.noise != other.noise).any()
    assert np.abs(one.noise).max() <= 1.0
    twice = GivenPlans(family.all_commands[[3, 3]], family.given[[3, 3]])
    twice = sampled_poses(compiled(sim, twice), twice, one)
    assert (twice[0] == twice[1]).all()


def test_no_noise_draws_only_where_the_robot_is_put_down():
    sim, family = simulator("none"), plans()
    driver = compiled(sim, family)
    paths = sampled_poses(driver, family, driver.draw(starts(), 1, (0.0, 0.0)))
    assert np.ptp(paths, axis=1).max() == 0.0
