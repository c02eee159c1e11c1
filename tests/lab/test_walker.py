"""Walking robots of the lab: what a learner is shown, and what it is not."""

import numpy as np
import pytest

from neurosim.base.errors import UserError
from neurosim.controllers import Network
from neurosim.controllers.gait import HAND_TUNED, Gait, genes_of
from neurosim.robots.quadruped import standing

pytest.importorskip("mujoco", reason="pip install 'neurosim[mujoco]'")

from neurosim.lab.walker import PLACES, VirtualWalker
from neurosim.lab.walker.robot import servo

HAND = genes_of(HAND_TUNED)


@pytest.fixture(scope="module")
def walker():
    return VirtualWalker(Gait())


@pytest.mark.slow
@pytest.mark.parametrize("place", list(PLACES))
def test_the_hand_tuned_gait_crosses_the_circle_in_every_place(place):
    found = VirtualWalker(Gait(), place).trials(np.stack([HAND, HAND]), np.arange(2))
    assert (found > 0.08).all()
    assert (found < 0.16).all()
    assert found[0] != found[1]


def test_a_trial_depends_on_its_number_and_the_seed_alone(walker):
    alone = walker.trial(HAND, 7)
    genes = np.stack([np.clip(HAND + 0.02, 0.0, 1.0), HAND])
    assert walker.trials(genes, np.array([6, 7]))[1] == alone
    assert VirtualWalker(Gait(), seed=1).trial(HAND, 7) != alone


def test_a_gait_that_stays_where_it_is_fails(walker):
    still = genes_of(dict(HAND_TUNED, length=0.01, ground_speed=0.05))
    assert walker.trial(still, 0) == 0.0


def test_servos_lag_and_have_a_greatest_speed():
    """Half of the way that is left in a frame, 0.1 rad at most."""
    commands = np.tile(standing(), (4, 1))
    commands[:, 0] += 0.3
    moved = servo(commands, standing(), 0.5, 0.1)[:, 0] - standing()[0]
    assert moved == pytest.approx([0.1, 0.2, 0.25, 0.275])


def test_no_place_is_like_the_simulator():
    for place in PLACES.values():
        build = place.build
        assert build.timestep == 0.002
        assert build.cone == "pyramidal"
        assert min(build.backlash, build.joint_friction, place.lag, place.sag, place.bumps) > 0.0
        assert len(set(build.legs)) > 1


def test_what_cannot_be_is_refused():
    with pytest.raises(UserError, match="there is no place 'moon' in the lab; there is main"):
        VirtualWalker(Gait(), "moon")
    with pytest.raises(UserError, match="the walking robot of the lab does gaits"):
        VirtualWalker(Network(("time",)))
