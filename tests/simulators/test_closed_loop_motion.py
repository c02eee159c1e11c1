"""Networks that drive in a motion network: compiled rollouts are the stepped ones."""

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
from motion_networks import random_motion_network

from neurosim.base.trajectory import Draws, Episode
from neurosim.controllers import Network
from neurosim.simulators.sampling import PLACING

GOALS = np.array([[0.05, 0.02, 0.3], [0.3, -0.2, 2.0], [-0.4, 0.1, -1.0]])
EPISODE = Episode(0.4, 25, 0.5, GOALS, reach=0.1)
STARTS = np.array([[0.02, 0.0, 0.4], [0.5, 0.2, -3.0], [-0.1, 0.4, 7.0], [0.0, 0.0, 0.0]] * 2)

#: Without a drive model, with one, and with all optional parts.
FORMS = {
    "displacement": {"drives": False, "units": 0, "swing": None},
    "displacement, all": {"drives": False},
    "drive model": {"units": 0, "swing": None},
    "drive model, all": {},
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_network_as_stepped(kind, form):
    sim, family = (
        random_motion_network(**form),
        families(POSES_GOALS_TIME, scale=(40.0, 35.0))[kind],
    )
    draws = sim.rollouts(family, EPISODE).draw(STARTS, 3, PLACING)
    result, expected = both(sim, family, EPISODE, draws)
    assert_alike(result, expected, 1e-9, 1e-6)
    near = np.linalg.norm(result.poses[..., None, :2] - GOALS[:, :2], axis=-1) <= EPISODE.reach
    assert near[..., :-2, 0].any()  # the second goal became the next one
    assert result.commands[..., -1, :].max() == 0.0  # at rest


@pytest.mark.parametrize("rest", [0.0, 0.5])
@pytest.mark.parametrize("goals", [None, GOALS])
@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("central", [False, True])
@pytest.mark.parametrize("drives", [False, True])
def test_with_and_without(rest, goals, noise, central, drives):
    sim = random_motion_network(central=central, noise=noise, drives=drives, units=0, swing=None)
    inputs = POSES_GOALS_TIME if goals is not None else ("x", "sin_heading", "time")
    episode = Episode(0.4, 12, rest, goals, reach=0.1)
    family = families(inputs, scale=40.0)["elman"]
    draws = sim.rollouts(family, episode).draw(STARTS, np.random.default_rng(1))
    assert (draws.noise is not None) == noise
    assert sorted(set(draws.member)) == [0, 1, 2]
    assert_alike(*both(sim, family, episode, draws), 1e-9, 1e-6)
    # The expected path, and ensemble members in addition to the mean.
    assert_alike(*both(sim, family, episode, Draws(STARTS)), 1e-9, 1e-6)
    mixed = Draws(STARTS, np.array([-1, 0, 1, 2] * 2), draws.noise)
    assert_alike(*both(sim, family, episode, mixed), 1e-9, 1e-6)


def test_one_member_moves_as_the_mean():
    family = families(POSES_GOALS_TIME, scale=40.0)["hidden"]
    for central in (False, True):
        sim = random_motion_network(members=1, central=central)
        draws = sim.rollouts(family, EPISODE).draw(STARTS, 3, PLACING)
        assert draws.member is None
        assert_alike(*both(sim, family, EPISODE, draws), 1e-9, 1e-6)


def test_any_columns_of_commands():
    names, scale = ("prev_b", "a", "b", "c"), (1.0, 2.0, 1.0, 5.0)
    sim = random_motion_network(names=names, scale=scale, **FORMS["displacement"])
    family = Network(("x", "time"), (3,), outputs=("a", "b", "c"), scale=(2.0, 1.0, 5.0))
    draws = sim.rollouts(family, EPISODE).draw(STARTS, 3)
    assert_alike(*both(sim, family, EPISODE, draws), 1e-9, 1e-6)
    other = Network(("x", "time"), outputs=("a", "c", "b"))
    assert sim.rollouts(other, EPISODE) is None


def test_the_same_outcome_is_the_same_for_all():
    sim, family = random_motion_network(), families(POSES_GOALS_TIME)["ctrnn"]
    rollouts = sim.rollouts(family, EPISODE)
    draws = rollouts.draw(STARTS, 3, PLACING)
    rolled_out = rollouts.run(genes_of(family)[[0, 0]], repeated(draws, 2)).poses
    assert (rolled_out == rolled_out[0, 0]).all()
    assert_reused(sim, family, EPISODE, draws)


def test_what_kernels_do_not_look_at_is_refused():
    sim, family = random_motion_network(), families(POSES_GOALS_TIME)["hidden"]
    rollouts = sim.rollouts(family, EPISODE)
    with pytest.raises(ValueError, match=r"expected genes \[P, 77\], got \[4, 76\]"):
        rollouts.run(genes_of(family)[:, 1:], Draws(STARTS))
    with pytest.raises(ValueError, match=r"expected noise \[8, 26, 4\], got \[8, 25, 4\]"):
        rollouts.run(genes_of(family), Draws(STARTS, noise=np.zeros((8, 25, 4))))
