"""Walking robots of the lab: quantities that a learner sees, and hidden ones."""

import numpy as np
import pytest

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.controllers import Network
from neurosim.controllers.gait import HAND_TUNED, Gait, genes_of

pytest.importorskip("mujoco", reason="pip install 'neurosim[mujoco]'")

from neurosim.lab.walker import FLOORS, VirtualWalker
from neurosim.lab.walker.film import film
from neurosim.lab.walker.robot import RADIUS
from neurosim.tasks.walking import Walking

HAND = genes_of(HAND_TUNED)


@pytest.fixture(scope="module")
def walker():
    return VirtualWalker(Gait())


@pytest.mark.slow
@pytest.mark.parametrize("floor", list(FLOORS))
def test_the_hand_tuned_gait_crosses_the_circle_on_every_floor(floor):
    result = VirtualWalker(Gait(), floor).trials(np.stack([HAND, HAND]), np.arange(2))
    assert (result > 0.08).all()
    assert (result < 0.16).all()
    assert result[0] != result[1]


@pytest.mark.slow
def test_a_trial_depends_on_its_number_and_the_seed_alone(walker):
    alone = walker.trial(HAND, 7)
    genes = np.stack([np.clip(HAND + 0.02, 0.0, 1.0), HAND])
    assert walker.trials(genes, np.array([6, 7]))[1] == alone
    assert VirtualWalker(Gait(), seed=1).trial(HAND, 7) != alone


@pytest.mark.slow
def test_a_gait_that_stays_where_it_is_fails(walker):
    still = genes_of(dict(HAND_TUNED, length=0.01, ground_speed=0.05))
    assert walker.trial(still, 0) == 0.0


class Seen:
    """Physics that keeps its arguments; every robot is at the edge after the tenth frame."""

    def walk(self, models, starts, commands, reach):
        self.models, self.starts = models, starts
        poses = np.zeros((len(models), commands.shape[1] + 1, 3)) + starts[:, None]
        poses[:, 10:, 0] += reach
        return poses


def test_a_trial_has_its_battery_its_floor_and_its_noise(monkeypatch):
    walker = VirtualWalker(Gait())
    place, walker._physics = FLOORS["main"], Seen()
    builds = []
    monkeypatch.setattr("neurosim.lab.walker.robot.compile_model", builds.append)
    numbers = np.array([0, place.charge - 1, place.charge])
    result = walker.trials(np.stack([HAND] * 3), numbers)
    left = 1.0 - place.sag * (place.charge - 1) / place.charge
    torques = np.array([build.torque for build in builds]) / place.build.torque
    assert torques == pytest.approx([1.0, left, 1.0])
    assert left < 0.99
    speeds = np.array([build.speed for build in builds]) / place.build.speed
    assert speeds == pytest.approx([1.0, left, 1.0])
    assert len({build.friction for build in builds}) == 3
    assert len(builds[0].bumps) > 0
    assert all(build.bumps == builds[0].bumps for build in builds)
    assert max(height for *_, height in builds[0].bumps) <= place.height
    assert len(set(walker._physics.starts[:, 2])) == 3
    # The stopwatch: ten frames, plus the error of the hand that stops it.
    late = RADIUS / result - 10 * 0.008
    assert len(set(late)) == 3
    assert np.abs(late).max() < 5.0 * place.scatter[2]


def test_no_floor_is_like_the_simulator():
    for place in FLOORS.values():
        build = place.build
        assert build.timestep == 0.002
        assert build.cone == "pyramidal"
        assert min(build.backlash, build.joint_friction, build.lag, place.sag, place.bumps) > 0.0
        assert len(set(build.legs)) > 1


@pytest.mark.slow
def test_a_film_shows_where_the_robot_walks():
    """The path is that of the physics, to a millimetre; a fitness is as without a camera."""
    task = Walking(1.0)
    filmed = VirtualWalker(Gait(), task=task, camera="lab")
    result = filmed.trial(HAND, 0)
    assert result.fitness == VirtualWalker(Gait()).trial(HAND, 0)
    assert result.poses.shape == (125, 3)
    kept = []

    class Kept(type(filmed._physics)):
        def walk(self, *given):
            kept.append(super().walk(*given)[0])
            return kept[-1][None]

    filmed._physics.__class__ = Kept
    again = filmed.trial(HAND, 0)
    assert np.array_equal(again.poses, result.poses)
    true = se2.between(kept[0][0], kept[0][1:126])
    assert np.abs(again.poses - true)[:, :2].max() < 0.003
    assert np.abs(again.poses - true)[:, 2].max() < 0.03
    assert true[-1, 0] > 0.05


@pytest.mark.slow
def test_a_film_lasts_five_seconds_at_most():
    walker = VirtualWalker(Gait(), task=Walking(20.0), camera="lab")
    fast = walker.trial(HAND, 0)
    assert walker.filmed == len(fast.poses) == 625
    assert walker.describe()["filmed"] == 5.0
    assert np.isfinite(fast.poses).all()


@pytest.mark.slow
def test_a_trial_ends_at_the_circle_of_its_task():
    near, far = (VirtualWalker(Gait(), task=Walking(20.0, circle=c)) for c in (0.5, 0.0))
    assert far.trial(HAND, 0) == VirtualWalker(Gait()).trial(HAND, 0)
    assert near.trial(HAND, 0) == pytest.approx(far.trial(HAND, 0), rel=0.25)
    assert near.trial(HAND, 0) != far.trial(HAND, 0)
    filmed = VirtualWalker(Gait(), task=Walking(20.0, circle=0.3), camera="lab").trial(HAND, 0)
    seen = filmed.poses[np.isfinite(filmed.poses).all(axis=1)]
    assert 0.29 < np.hypot(*seen[-1, :2]) < 0.31
    assert len(seen) < 500


def test_a_film_ends_with_a_fall():
    path = np.zeros((126, 3))
    path[:, 0] = 0.003 * np.arange(126)
    path[60:] = np.nan
    seen = film(path, 0.008, 125, (0, 0))
    assert np.isfinite(seen[:50]).all()
    assert np.isnan(seen[60:]).all()
    assert seen[49, 0] == pytest.approx(0.15, abs=0.003)


def test_what_cannot_be_is_refused():
    with pytest.raises(UserError, match="filmed by the lab's own camera: --camera lab"):
        VirtualWalker(Gait(), camera="0")
    for task in (None, Walking(step=0.016)):
        with pytest.raises(UserError, match=r"use --task walking --step 0\.008"):
            VirtualWalker(Gait(), task=task, camera="lab")
    with pytest.raises(UserError, match="there is no floor 'moon' in the lab; choose from main"):
        VirtualWalker(Gait(), "moon")
    with pytest.raises(UserError, match="the walking robot of the lab needs a gait"):
        VirtualWalker(Network(("time",)))
