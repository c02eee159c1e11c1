"""Plans driven in tables by compiled code, against the simulator's own steps."""

import numpy as np
import pytest
import torch
from khepera_data import made_up
from neurosim.loop.rollouts import TableRollouts, rollouts, stepped

from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.arena import Arena
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.reaction import Reaction

START = (-0.1, 0.02, 1.5)
BATCH, COUNT, COMMANDS = 12, 5, 6


def simulator(noise="none", reaction=Reaction()):  # noqa: B008 - frozen
    levels = np.linspace(-100, 100, 5)
    left, right = np.meshgrid(levels / 1000, levels / 1000, indexing="ij")
    twist = np.stack([0.48 * (left + right), 0.03 * (right - left), (right - left) / 0.05], -1)
    motors = MotorTable(levels, twist, 0.002 + 0.02 * np.abs(twist), 10.0)
    arena = Arena.rectangle(0.6, 0.35)
    return TableSimulator(made_up(2, 0.01), motors, arena=arena, noise=noise, reaction=reaction)


def plans():
    rng = np.random.default_rng(3)
    commands = rng.uniform((-100, -100, 0.05), (100, 100, 3), (BATCH, COMMANDS, 3))
    commands[0, :, :2] = 90.0  # into the wall
    commands[1, 2, :2] = 0.0
    given = rng.random((BATCH, COMMANDS)) < 0.8
    given[2] = False
    return commands, given


REACTIONS = [Reaction(), Reaction(0.03, 0.04, (0.03, 0.06)), Reaction(0.0, 0.25, (0.0, 0.1))]


@pytest.mark.parametrize("reaction", REACTIONS)
def test_expected_paths_are_the_steps_of_the_protocol(reaction):
    sim, (commands, given) = simulator(reaction=reaction), plans()
    found = rollouts(sim, START).expected(commands, given)
    starts = torch.tensor([START] * BATCH, dtype=torch.float64)
    slow = stepped(sim, starts, torch.from_numpy(commands), torch.from_numpy(given)).numpy()
    np.testing.assert_allclose(found, slow, atol=1e-9)
    # The first plan's robot came to the wall, and not through it.
    assert np.abs(found[0, -1, 1]) == pytest.approx(0.175 - 0.0275, abs=1e-3)
    assert (found[2] == START).all()


@pytest.mark.parametrize("noise", ["uniform", "samples"])
def test_drawn_paths_are_the_steps_through_the_same_noise(noise, monkeypatch):
    sim, (commands, given) = simulator(noise, REACTIONS[1]), plans()
    driver = rollouts(sim, START)
    draws = driver.draw(COUNT, COMMANDS, 7, (0.003, 0.01))
    found = driver.drawn(commands, given, draws)
    assert found.shape == (BATCH, COUNT, COMMANDS + 2, 3)

    made = iter(draws.kept.transpose(1, 0, 2))  # the next command's

    def handed(shape, **kind):
        z = torch.from_numpy(np.tile(next(made), (BATCH, 1)))
        return (z + 1.0) / 2.0 if noise == "uniform" else z

    monkeypatch.setattr(torch, "rand" if noise == "uniform" else "randn", handed)
    slow = stepped(
        sim,
        torch.from_numpy(np.tile(draws.starts, (BATCH, 1))),
        torch.from_numpy(commands).repeat_interleave(COUNT, 0),
        torch.from_numpy(given).repeat_interleave(COUNT, 0),
        torch.Generator(),
    )
    np.testing.assert_allclose(found, slow.unflatten(0, (-1, COUNT)).numpy(), atol=1e-9)
    assert found[3, :, -1].std(axis=0).min() > 1e-4


def test_draws_are_the_same_for_the_same_seed_and_all_plans():
    sim, (commands, given) = simulator("uniform"), plans()
    driver = rollouts(sim, START)
    assert isinstance(driver, TableRollouts)
    one, same, other = (driver.draw(COUNT, COMMANDS, seed, (0.0, 0.0)) for seed in (1, 1, 2))
    assert (one.kept == same.kept).all()
    assert (one.kept != other.kept).any()
    assert np.abs(one.kept).max() <= 1.0
    twice = driver.drawn(commands[[3, 3]], given[[3, 3]], one)
    assert (twice[0] == twice[1]).all()


def test_no_noise_draws_only_where_the_robot_is_put_down():
    sim, (commands, given) = simulator("none"), plans()
    driver = rollouts(sim, START)
    paths = driver.drawn(commands, given, driver.draw(COUNT, COMMANDS, 1, (0.0, 0.0)))
    assert np.ptp(paths, axis=1).max() == 0.0
