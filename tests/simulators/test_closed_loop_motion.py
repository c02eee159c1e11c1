"""Networks that drive in a motion network: compiled rollouts are the stepped ones."""

import numpy as np
import pytest
import torch
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

from neurosim.base.trajectory import Draws, Episode
from neurosim.controllers import Network
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.simulators.base import PLACING
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.noise import NoiseModel

GOALS = np.array([[0.05, 0.02, 0.3], [0.3, -0.2, 2.0], [-0.4, 0.1, -1.0]])
EPISODE = Episode(0.4, 25, 0.5, GOALS, reach=0.1)
SWINGING = Derived(True, 0.03)
STARTS = np.array([[0.02, 0.0, 0.4], [0.5, 0.2, -3.0], [-0.1, 0.4, 7.0], [0.0, 0.0, 0.0]] * 2)


def normal(seed, *shape):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def noise_model():
    drawn = {name: 0.2 * normal(len(name), *shape) for name, shape in NoiseModel.SHAPES.items()}
    drawn["unit"] = torch.tensor([1.0, 0.2, 0.1])
    drawn["log_scale"][:, 0] -= 5.0
    drawn["motion"] = (0.001 * drawn["motion"]).abs()
    return NoiseModel(**drawn)


def simulator(
    names=("prev_left", "prev_right", "left", "right", "duration"),
    members=3,
    central=True,
    noise=True,
    derived=SWINGING,
    scale=(50.0, 50.0, 50.0, 50.0, 3.0),
    coordinates="twist-offset",
):
    """Return an ensemble of random networks, of unequally many units."""
    inputs, outputs = len(names) + len(derived), 5 if coordinates == "twist-offset" else 3
    network = ProductSummationNetwork(inputs, 4, 1, phases=True, ceilings=True)
    genes = 0.3 * normal(0, members + central, outputs, network.genes)
    weights = network.split(genes).product_weights
    weights[0, 0, :2] = weights[-1, 2] = 0.0  # units that are left out
    return MotionNetwork(
        [{"name": name, "unit": ""} for name in names],
        network,
        genes,
        torch.tensor(scale),
        torch.full((outputs,), 0.05),
        coordinates,
        noise=noise_model() if noise else None,
        dead_zone=torch.tensor([0.05 * (name != "duration") for name in names]),
        central=central,
        derived=derived,
    )


@pytest.mark.parametrize("kind", KINDS)
def test_every_network_as_stepped(kind):
    sim, family = simulator(), families(POSES_GOALS_TIME, scale=(40.0, 35.0))[kind]
    draws = sim.rollouts(family, EPISODE).draw(STARTS, 3, PLACING)
    found, expected = both(sim, family, EPISODE, draws)
    assert_alike(found, expected, 1e-9, 1e-6)
    near = np.linalg.norm(found.poses[..., None, :2] - GOALS[:, :2], axis=-1) <= EPISODE.reach
    assert near[..., :-2, 0].any()  # the second goal became the next one
    assert found.commands[..., -1, :].max() == 0.0  # at rest


@pytest.mark.parametrize("rest", [0.0, 0.5])
@pytest.mark.parametrize("goals", [None, GOALS])
@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("central", [False, True])
def test_with_and_without(rest, goals, noise, central):
    sim = simulator(central=central, noise=noise, derived=Derived())
    inputs = POSES_GOALS_TIME if goals is not None else ("x", "sin_heading", "time")
    episode = Episode(0.4, 12, rest, goals, reach=0.1)
    family = families(inputs, scale=40.0)["elman"]
    draws = sim.rollouts(family, episode).draw(STARTS, np.random.default_rng(1))
    assert (draws.noise is not None) == noise
    assert sorted(set(draws.member)) == [0, 1, 2]
    assert_alike(*both(sim, family, episode, draws), 1e-9, 1e-6)
    # What is expected, and members beside the mean of all.
    assert_alike(*both(sim, family, episode, Draws(STARTS)), 1e-9, 1e-6)
    mixed = Draws(STARTS, np.array([-1, 0, 1, 2] * 2), draws.noise)
    assert_alike(*both(sim, family, episode, mixed), 1e-9, 1e-6)


def test_one_member_moves_as_the_mean():
    family = families(POSES_GOALS_TIME, scale=40.0)["hidden"]
    for central in (False, True):
        sim = simulator(members=1, central=central)
        draws = sim.rollouts(family, EPISODE).draw(STARTS, 3, PLACING)
        assert draws.member is None
        assert_alike(*both(sim, family, EPISODE, draws), 1e-9, 1e-6)


def test_any_columns_of_commands():
    names, scale = ("prev_b", "a", "b", "c"), (1.0, 2.0, 1.0, 5.0)
    sim = simulator(names, scale=scale, derived=Derived(), coordinates="displacement")
    family = Network(("x", "time"), (3,), outputs=("a", "b", "c"), scale=(2.0, 1.0, 5.0))
    draws = sim.rollouts(family, EPISODE).draw(STARTS, 3)
    assert_alike(*both(sim, family, EPISODE, draws), 1e-9, 1e-6)
    other = Network(("x", "time"), outputs=("a", "c", "b"))
    assert sim.rollouts(other, EPISODE) is None


def test_the_same_outcome_is_the_same_for_all():
    sim, family = simulator(), families(POSES_GOALS_TIME)["ctrnn"]
    rollouts = sim.rollouts(family, EPISODE)
    draws = rollouts.draw(STARTS, 3, PLACING)
    found = rollouts.run(genes_of(family)[[0, 0]], repeated(draws, 2)).poses
    assert (found == found[0, 0]).all()
    assert_reused(sim, family, EPISODE, draws)


def test_what_kernels_do_not_look_at_is_refused():
    sim, family = simulator(), families(POSES_GOALS_TIME)["hidden"]
    rollouts = sim.rollouts(family, EPISODE)
    with pytest.raises(ValueError, match=r"expected genes \[P, 62\], got \[4, 61\]"):
        rollouts.run(genes_of(family)[:, 1:], Draws(STARTS))
    with pytest.raises(ValueError, match=r"expected noise \[8, 26, 4\], got \[8, 25, 4\]"):
        rollouts.run(genes_of(family), Draws(STARTS, noise=np.zeros((8, 25, 4))))
