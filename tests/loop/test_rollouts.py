"""The compiled rollouts against the slow, obvious method: the simulator's own steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from given_plans import EPISODE, RUN_DOWN, GivenPlans, by_protocol, expected, sampled_poses
from motion_networks import NAMES, random_motion_network

from neurosim.loop.stepped import SteppedRollouts
from neurosim.simulators.engine import CompiledRollouts

START = (-0.8, 0.0, 1.5)


#: One whose networks predict the displacement, or the difference from a drive model; large outputs.
DISPLACEMENT = {"drives": False, "units": 0, "swing": None, "size": 0.2}
DRIVEN = {"size": 0.2}


def plans(batch, count):
    rng = np.random.default_rng(0)
    commands = rng.uniform((-50, -50, 0.5), (50, 50, 3), (batch, count, 3))
    # Zeros, speeds within the dead band, equal speeds, and the same speeds backwards.
    commands[0, 0, :2] = 0.0
    commands[1, :, 0] = 2.0
    commands[2, :, 1] = commands[2, :, 0]
    commands[-1, 1:, :2] = -commands[-1, :-1, :2]
    commands[-1, 1::2, :2] *= 0.5
    # The same command again: with a drive model it continues, until it has lasted too long.
    commands[-2, 1:4] = [30.0, -20.0, 1.2]
    given = rng.random((batch, count)) < 0.75
    given[3] = False
    return GivenPlans(commands, given)


def both(sim, family):
    """Return compiled and stepped rollouts."""
    compiled = sim.rollouts(family, EPISODE)
    assert isinstance(compiled, CompiledRollouts)
    return compiled, SteppedRollouts(sim, family, EPISODE)


def same(result, wanted):
    np.testing.assert_allclose(result, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("swing", [None, 0.03])
@pytest.mark.parametrize("names", [NAMES, (*NAMES[2:], *NAMES[:2])])
@pytest.mark.parametrize(
    ("members", "form", "central"),
    [(1, DISPLACEMENT, False), (1, DRIVEN, False), (3, DRIVEN, False), (3, DRIVEN, True)],
)
def test_expected_paths_are_those_of_single_steps(members, form, central, names, swing):
    how = {**form, "names": names, "noise": False, "swing": swing}
    sim, family = random_motion_network(members=members, central=central, **how), plans(8, 6)
    fast, slow = both(sim, family)
    wanted = by_protocol(sim, [START] * 8, family)
    assert np.abs(wanted - np.array(START)).max() > 0.1
    same(expected(slow, family, START), wanted)
    same(expected(fast, family, START), wanted)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("members", "form", "noise", "central"),
    [
        (1, DISPLACEMENT, True, False),
        (4, DISPLACEMENT, False, False),
        (4, DRIVEN, False, False),
        (4, DRIVEN, True, False),
        (4, DRIVEN, True, True),
    ],
)
@pytest.mark.parametrize("stepped_draws", [False, True])
def test_drawn_paths_are_those_of_single_steps_with_the_same_draws(
    members, form, noise, central, stepped_draws
):
    how = {"members": members, "noise": noise, "central": central}
    sim, family = random_motion_network(**how, **form), plans(6, 5)
    fast, slow = both(sim, family)
    draws = (slow if stepped_draws else fast).draw(np.tile(START, (9, 1)), 3, (0.01, 0.05))
    paths = sampled_poses(fast, family, draws)
    assert paths.shape == (6, 9, 7, 3)
    assert paths[4, :, -1].std(axis=0).min() > 1e-3
    same(sampled_poses(slow, family, draws), paths)
    still = replace(draws, noise=None)
    same(sampled_poses(slow, family, still), sampled_poses(fast, family, still))
    for b in range(6):
        for r in range(9):
            same(obvious(sim, family, b, draws, r), paths[b, r])


def obvious(sim, family, b, draws, r):
    """One plan, one sample, straight from the simulator's displacement and noise."""
    pose, poses, sent = draws.starts[r], [draws.starts[r]], 0
    member = -1 if draws.member is None else int(draws.member[r])
    each = zip(family.all_commands[b], family.given[b], strict=True)
    speed, commanded, lasted, under = (
        torch.zeros(1, 2).double(),
        torch.zeros(1, 2).double(),
        0.0,
        None,
    )
    if sim.drive:
        under = sim.drive.begun(speed, speed)
    for command, is_given in [*each, ((0.0, 0.0, RUN_DOWN), True)]:
        if is_given:
            x = sim.scaled(torch.tensor([[0.0, 0.0, *command]], dtype=torch.float64))
            goes_on = (
                sim.drive and torch.equal(x[:, 2:4], commanded) and 0 < lasted + command[2] < 3.15
            )
            if not goes_on or lasted == 0.0:
                if sim.drive and lasted > 0.0:
                    time = torch.tensor([lasted])
                    reached = sim.drive.reached(under, commanded, time)
                    under = sim.drive.after(under, commanded, time, reached)
                    speed = under.speed
                elif not sim.drive:
                    speed = commanded
                began, lasted, number, commanded = pose, 0.0, sent, x[:, 2:4]
            lasted += command[2]
            x[:, :2], x[:, 4] = speed, lasted / 3.0
            moved = sim.displacement_of(x, member, under)
            if draws.noise is not None:
                moved = sim.disturbed(x, moved, torch.from_numpy(draws.noise[r, number])[None])
            dx, dy, turn = moved[0].tolist()
            cos, sin = np.cos(began[2]), np.sin(began[2])
            pose = began + np.array([cos * dx - sin * dy, sin * dx + cos * dy, turn])
            sent += 1
        poses.append(pose)
    return np.array(poses)


@pytest.mark.parametrize("form", [DISPLACEMENT, DRIVEN])
def test_samples_spread_as_the_steps_of_the_protocol_do(form):
    sim, family = random_motion_network(**form), plans(8, 3)
    family = GivenPlans(family.all_commands[4:5], np.ones((1, 3), bool))
    fast, slow = both(sim, family)
    starts, placing = np.tile(START, (10_000, 1)), (0.003, 0.01)
    paths = {
        "compiled": sampled_poses(fast, family, fast.draw(starts, 1, placing))[0],
        "stepped": sampled_poses(slow, family, slow.draw(starts, 2, placing))[0],
    }
    # Noise and members that the simulator draws for itself.
    put_down = slow.draw(starts, 3, placing).starts
    many = GivenPlans(np.repeat(family.all_commands, 10_000, 0), np.ones((10_000, 3), bool))
    own = by_protocol(sim, put_down, many, torch.Generator().manual_seed(4))
    for value in paths.values():
        for quantile in (0.1, 0.5, 0.9):
            a, b = (np.quantile(each[:, 1:], quantile, axis=0) for each in (value, own))
            assert np.abs(a - b).max() < 0.1 * own[:, 1:].std(axis=0).max() + 1e-3


def test_draws_are_the_same_for_the_same_seed_and_use_all_members_alike():
    for driver in both(random_motion_network(members=4, central=False), plans(6, 3)):
        starts = np.tile(START, (40, 1))
        a, b, c = (driver.draw(starts, seed, (0.003, 0.01)) for seed in (1, 1, 2))
        assert np.array_equal(a.noise, b.noise)
        assert not np.array_equal(a.noise, c.noise)
        assert np.bincount(a.member).tolist() == [10] * 4
        still = driver.draw(starts[:5], 1, (0.0, 0.0))
        assert np.array_equal(still.starts, starts[:5])
        assert np.array_equal(driver.draw(starts[:5], 1, None).starts, starts[:5])
