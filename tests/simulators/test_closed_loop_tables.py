"""Networks that drive in tables: compiled rollouts are the stepped ones."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loops import (
    KINDS,
    POSES_GOALS_TIME,
    assert_alike,
    assert_reused,
    both,
    families,
    genes_of,
    repeated,
)
from khepera_data import made_up

from neurosim.base.trajectory import Draws, Episode
from neurosim.controllers import Network
from neurosim.loop.stepped import SteppedRollouts
from neurosim.simulators import TableSimulator
from neurosim.simulators.sampling import PLACING
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.reaction import Reaction
from neurosim.simulators.tables.sensor_table import SensorTable

GOALS = np.array([[0.0, 0.1, 0.3], [0.2, -0.1, 2.0], [-0.2, 0.1, -1.0]])
EPISODE = Episode(0.1, 40, 0.5, GOALS, reach=0.15)


def simulator(noise="uniform", sensors=8, **changes):
    """Return tables of ``count`` sensors, without rounding, which would amplify last digits."""
    table = made_up(3, 0.01)
    pick = np.arange(sensors) % table.mean.shape[-1]
    table = SensorTable(
        table.mean[..., pick], table.spread[..., pick], table.first_distance, table.distance_step
    )
    ideal = MotorTable.ideal()
    motors = replace(ideal, spread=np.full_like(ideal.twist, 0.002), resolution=0.0)
    return TableSimulator(table, motors, noise=noise, **changes)


def starts(sim):
    return sim.free_poses(5, np.random.default_rng(2))


def assert_as_stepped(sim, family, episode, draws):
    assert_alike(*both(sim, family, episode, draws), 1e-5, 1e-2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("noise", ["none", "uniform", "samples"])
def test_every_network_as_stepped(kind, noise):
    sim = simulator(noise)
    family = families((*sim.reading_names, *POSES_GOALS_TIME), scale=(100.0, 80.0))[kind]
    draws = sim.rollouts(family, EPISODE).draw(starts(sim), 3, PLACING)
    assert_as_stepped(sim, family, EPISODE, draws)
    # From the numbers themselves in place of seeds.
    given = SteppedRollouts(sim, family, EPISODE).draw(starts(sim), 4)
    assert (given.noise is None) == (noise == "none")
    assert_as_stepped(sim, family, EPISODE, given)


@pytest.mark.parametrize("sensors", [1, 6, 8, 11])
@pytest.mark.parametrize("noise", ["uniform", "samples"])
def test_any_number_of_sensors(sensors, noise):
    sim = simulator(noise, sensors)
    family = Network(sim.reading_names[::-1], (3,))
    draws = sim.rollouts(family, EPISODE).draw(starts(sim), 3)
    assert_as_stepped(sim, family, EPISODE, draws)


@pytest.mark.parametrize("rest", [0.0, 0.3])
@pytest.mark.parametrize("reads", [False, True])
def test_with_and_without(rest, reads):
    sim = simulator(reaction=Reaction(0.03, 0.04, (0.03, 0.06)))
    family = Network(("x", "sin_heading", "time"))
    episode = Episode(0.1, 20, rest, readings=reads)
    draws = sim.rollouts(family, episode).draw(starts(sim), 3)
    assert_as_stepped(sim, family, episode, draws)
    assert_as_stepped(sim, family, episode, Draws(draws.starts))


@pytest.mark.parametrize("noise", ["uniform", "samples"])
def test_seeds_expand_to_numbers_of_their_kind(noise):
    sim = simulator(noise)
    seeds = np.random.default_rng(0).integers(0, 2**64, 400, dtype=np.uint64)
    result = sim.noise_of(seeds, 50)
    assert result.shape == (400, 50, 11)
    assert np.abs(result.mean(axis=(0, 1))).max() < 0.03
    width = 1.0 if noise == "samples" else 1.0 / np.sqrt(3.0)
    assert result.std(axis=(0, 1)) == pytest.approx(np.full(11, width), rel=0.03)
    assert (np.abs(result).max() <= 1.0) == (noise == "uniform")
    between = np.corrcoef(result.reshape(-1, 11).T) - np.eye(11)
    assert np.abs(between).max() < 0.03
    assert (sim.noise_of(seeds[3:5], 20) == result[3:5, :20]).all()


def test_the_same_outcome_is_the_same_for_all():
    sim = simulator("samples")
    family = families((*sim.reading_names, "time"))["ctrnn"]
    rollouts = sim.rollouts(family, EPISODE)
    draws = rollouts.draw(starts(sim), np.random.default_rng(1))
    assert (rollouts.draw(starts(sim), 1).noise == draws.noise).all()
    rolled_out = rollouts.run(genes_of(family)[[0, 0]], repeated(draws, 2)).poses
    assert (rolled_out == rolled_out[0, 0]).all()
    assert_reused(sim, family, EPISODE, draws)
