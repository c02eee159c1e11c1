"""Dead zones of hand-made rows, and of the lab's robots."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base import se2
from neurosim.lab.nxt.params import LabParams
from neurosim.lab.nxt.physics import displacements, new_state, slip_field
from neurosim.recording.commands import RandomCommands
from neurosim.training.trainers.dead_zone import find_dead_zone

NAMES = ("prev_left", "prev_right", "left", "right", "duration")
LAG, HALF_TRACK = 0.1, 0.065


def commands(count, seed=0, straight=0.3):
    """Inputs [N, 5], whole percents and seconds; a quarter of the speeds are at most 12 %."""
    rng = np.random.default_rng(seed)
    speeds = rng.integers(-50, 51, (count, 2)).astype(float)
    slow = rng.random((count, 2)) < 0.25
    speeds[slow] = rng.integers(-12, 13, slow.sum())
    equal = rng.random(count) < straight
    speeds[equal, 1] = speeds[equal, 0]
    before = np.vstack([np.zeros(2), speeds[:-1]])
    return np.column_stack([before, speeds, rng.uniform(0.5, 3.0, count)])


def driven(x, zone, seed=0):
    """Displacements [N, 3] of wheels with a lag that stand below a command (%), 2 % of noise."""
    rng = np.random.default_rng(seed)
    felt = np.where(np.abs(x[:, :4]) < np.tile(zone, 2), 0.0, x[:, :4]) * 0.005
    before, now, duration = felt[:, :2], felt[:, 2:], x[:, 4, None]
    left, right = ((now * duration + (before - now) * LAG) * rng.normal(1.0, 0.02, now.shape)).T
    still = np.zeros(len(x))
    twist = np.column_stack([(left + right) / 2, still, (right - left) / (2 * HALF_TRACK)])
    return se2.exp(twist) + rng.normal(0.0, 4e-4, (len(x), 3))


def found(x, y, names=NAMES):
    """The zone in the units of x."""
    scale = np.abs(x).max(0)
    return find_dead_zone(names, torch.tensor(x / scale), torch.tensor(y)).numpy() * scale


@pytest.mark.parametrize("zone", [(3.5, 4.5), (9.5, 6.5), (0.0, 4.5), (20.5, 20.5), (0.0, 0.0)])
def test_each_motor_has_its_own(zone):
    x = commands(600)
    # Whole turns are among them, at whose end the way cannot be told from no way.
    y = driven(x, zone)
    assert np.abs(y[:, 2]).max() > 2 * np.pi
    np.testing.assert_allclose(found(x, y), [*zone, *zone, 0.0], atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 8), st.integers(0, 8))
def test_what_120_rows_say_of_a_command_is_right(seed, left, right):
    x = commands(120, seed)
    zone = np.array([left, right]) - 0.5
    said, size = found(x, driven(x, zone, seed))[2:4], np.abs(x[:, 2:4])
    # Where every row stood or moved as it would with no zone at all, there is none to be found;
    # one per cent, or a row or two, may pass as that.
    wrong = ((size < said) != (size < zone)) & (size > 1)
    assert wrong.sum() <= 1


def test_wild_rows_do_not_hide_it():
    x = commands(400)
    y = driven(x, (3.5, 4.5))
    y[::10] += np.random.default_rng(1).normal(0.0, 1.0, y[::10].shape)
    np.testing.assert_allclose(found(x, y), [3.5, 4.5, 3.5, 4.5, 0.0])


def test_where_both_creep_neither_is_judged_alone():
    """Slow rows are all straight: forward way is missing, and either wheel could be it."""
    x = commands(80, straight=0.0)
    x = x[(np.abs(x[:, 2:4]) > 12).all(1)]
    slow = np.repeat(np.arange(1.0, 9.0), 3)
    x = np.vstack([x, np.column_stack([0 * slow, 0 * slow, slow, slow, 1.0 + slow / 8])])
    np.testing.assert_allclose(found(x, driven(x, (4.5, 4.5)))[2:4], 4.5)


def test_speed_and_rate_of_turn_as_inputs():
    x = commands(500, straight=0.0)
    felt = np.where(np.abs(x[:, 2:4]) < [0.0, 5.5], 0.0, x[:, 2:4]) * [0.005, 0.04]
    twist = np.column_stack([felt[:, 0], np.zeros(500), felt[:, 1]]) * x[:, 4:]
    y = se2.exp(twist) + np.random.default_rng(0).normal(0.0, 1e-3, (500, 3))
    names = ("prev_v", "prev_w", "v", "w", "duration")
    np.testing.assert_allclose(found(x, y, names), [0.0, 5.5, 0.0, 5.5, 0.0])
    # Commands of one duration, and nothing known of the ones before.
    x[:, 4] = 1.5
    twist = np.column_stack([felt[:, 0], np.zeros(500), felt[:, 1]]) * 1.5
    np.testing.assert_allclose(found(x[:, 2:4], se2.exp(twist), ("v", "w")), [0.0, 5.5])


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_not_taken_for_one(seed):
    x = commands(300, seed)
    x[:, :4] += np.random.default_rng(seed).uniform(-0.5, 0.5, (300, 4))  # not whole percents
    assert not found(x, driven(x, (0.0, 0.0), seed)).any()


def test_inputs_of_one_sign_have_none():
    x = np.abs(commands(200))
    assert not found(x, driven(x, (4.5, 4.5))).any()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_the_labs_robots_200_rows_tell_which_commands_do_nothing(seed):
    params, source = LabParams.drawn(seed), RandomCommands(seed=seed)
    drawn = [source.command(n) for n in range(200)]
    told = np.array([c.row for c in drawn])
    state = new_state(params, seed, (0.0, 0.0, 0.0))
    poses = displacements(state, told, params.coefficients(), slip_field(params))
    x = np.column_stack([np.vstack([np.zeros(2), told[:-1, :2]]), told])
    said = found(x, se2.between(poses[:-1], poses[1:]))[2:4]
    size = np.abs(told[:, :2])
    stands = size < [params.dead_band_left, params.dead_band_right]
    np.testing.assert_array_equal((size < said)[size > 0], stands[size > 0])
