"""Dead bands of hand-made rows, and of the lab's robots."""

import numpy as np
import pytest
import torch
from nxt_drives import displacements

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.lab.nxt.params import LabParams
from neurosim.lab.nxt.physics import new_state, slip_field
from neurosim.recording.commands import RandomCommands
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import TrainingData
from neurosim.training.train import learn
from neurosim.training.trainers.drive_fit import Motion, fit_drive

pytestmark = pytest.mark.slow

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


def driven(x, band, seed=0):
    """Displacements [N, 3] of wheels with a lag that stand below a command (%), 2 % of noise."""
    rng = np.random.default_rng(seed)
    felt = np.where(np.abs(x[:, :4]) < np.tile(band, 2), 0.0, x[:, :4]) * 0.005
    before, now, duration = felt[:, :2], felt[:, 2:], x[:, 4, None]
    left, right = ((now * duration + (before - now) * LAG) * rng.normal(1.0, 0.02, now.shape)).T
    still = np.zeros(len(x))
    twist = np.column_stack([(left + right) / 2, still, (right - left) / (2 * HALF_TRACK)])
    return se2.exp(twist) + rng.normal(0.0, 4e-4, (len(x), 3))


def dead_bands(x, y, names=NAMES):
    """The dead bands of the actuators in the units of x."""
    inputs = [{"name": name, "unit": "%"} for name in names]
    data = TrainingData(inputs, torch.tensor(x), torch.tensor(y))
    columns = CommandFeatures.of(names)
    longest = float(data.input_scale[columns.duration])
    fit = fit_drive(Motion(data.scaled_inputs, data.y, data.follows, columns, longest))
    return (fit.band * data.input_scale[list(columns.driven)]).numpy()


@pytest.mark.parametrize("band", [(9.5, 6.5), (0.0, 4.5), (0.0, 0.0)])
def test_each_motor_has_its_own(band):
    x = commands(400)
    # Some are whole turns, after which the chord is zero as if the robot had not moved.
    y = driven(x, band)
    assert np.abs(y[:, 2]).max() > 2 * np.pi
    np.testing.assert_allclose(dead_bands(x, y), band, atol=1e-9)


@pytest.mark.parametrize(("seed", "band"), [(0, (0.5, 3.5)), (1, (7.5, 1.5)), (2, (5.5, 5.5))])
def test_what_120_rows_say_of_a_command_is_right(seed, band):
    x = commands(120, seed)
    messages, size = dead_bands(x, driven(x, np.array(band), seed)), np.abs(x[:, 2:4])
    # One percent may count as standing still.
    wrong = ((size < messages) != (size < band)) & (size > 1)
    assert wrong.sum() <= 1


def test_wild_rows_do_not_hide_it():
    x = commands(400)
    y = driven(x, (3.5, 4.5))
    y[::10] += np.random.default_rng(1).normal(0.0, 1.0, y[::10].shape)
    np.testing.assert_allclose(dead_bands(x, y), [3.5, 4.5])


def test_where_both_creep_neither_is_judged_alone():
    """Slow rows are all straight: forward distance is missing, and either wheel may be why."""
    x = commands(80, straight=0.0)
    x = x[(np.abs(x[:, 2:4]) > 12).all(1)]
    slow = np.repeat(np.arange(1.0, 9.0), 3)
    x = np.vstack([x, np.column_stack([0 * slow, 0 * slow, slow, slow, 1.0 + slow / 8])])
    np.testing.assert_allclose(dead_bands(x, driven(x, (4.5, 4.5))), 4.5)


def test_given_ones_are_as_many_as_the_inputs():
    x = commands(80, straight=0.0)
    rows = torch.tensor(x), torch.tensor(driven(x, (4.5, 4.5)))
    data = TrainingData([{"name": name, "unit": ""} for name in NAMES], *rows)
    with pytest.raises(UserError, match=r"dead_band: expected 5 numbers, .*prev_left.*, not 1$"):
        learn(data, 0, dead_band=(0.1,), members=1, noise=False)


def test_of_three_actuators_each_has_its_own():
    """Also the one that moves the robot to its side."""
    rng = np.random.default_rng(0)
    speeds = rng.integers(-40, 41, (400, 3)).astype(float)
    x = np.column_stack([np.vstack([np.zeros(3), speeds[:-1]]), speeds, rng.uniform(0.5, 3, 400)])
    felt = np.where(np.abs(speeds) < [2.5, 7.5, 4.5], 0.0, speeds) * [0.01, 0.008, 0.04]
    y = se2.exp(felt * x[:, 6:]) + rng.normal(0.0, 1e-3, (400, 3))
    names = ("prev_vx", "prev_vy", "prev_w", "vx", "vy", "w", "duration")
    np.testing.assert_allclose(dead_bands(x, y, names), [2.5, 7.5, 4.5])


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_not_taken_for_one(seed):
    x = commands(300, seed)
    x[:, :4] += np.random.default_rng(seed).uniform(-0.5, 0.5, (300, 4))  # not whole percents
    assert not dead_bands(x, driven(x, (0.0, 0.0), seed)).any()


def test_steering_has_none_though_small_angles_do_little():
    """A car's turn is the product of speed and steering."""
    rng = np.random.default_rng(3)
    commanded = rng.uniform(-1.0, 1.0, (300, 2))
    x = np.column_stack(
        [np.vstack([np.zeros(2), commanded[:-1]]), commanded, rng.uniform(0.5, 3.0, 300)]
    )
    v = np.where(np.abs(commanded[:, 0]) < 0.1, 0.0, commanded[:, 0])
    w = 1.8 * v * commanded[:, 1] * rng.normal(1.0, 0.03, 300)
    y = se2.exp(np.column_stack([v, 0 * v, w]) * x[:, 4:]) + rng.normal(0.0, 2e-3, (300, 3))
    speed, steering = dead_bands(
        x, y, ("prev_speed", "prev_steering", "speed", "steering", "duration")
    )
    assert speed == pytest.approx(0.1, abs=0.01)
    assert steering < 0.02


def test_inputs_of_one_sign_have_none():
    x = np.abs(commands(200))
    assert not dead_bands(x, driven(x, (4.5, 4.5))).any()


@pytest.mark.parametrize("seed", [1, 2])
def test_of_the_labs_robots_200_rows_tell_which_commands_do_nothing(seed):
    params, source = LabParams.sampled(seed), RandomCommands(seed=seed)
    commands_sampled = [source.command(n) for n in range(200)]
    commanded = np.array([c.row for c in commands_sampled])
    state = new_state(params, seed, (0.0, 0.0, 0.0))
    poses = displacements(state, commanded, params.coefficients(), slip_field(params))
    x = np.column_stack([np.vstack([np.zeros(2), commanded[:-1, :2]]), commanded])
    message = dead_bands(x, se2.between(poses[:-1], poses[1:]))
    size = np.abs(commanded[:, :2])
    stands = size < [params.dead_band_left, params.dead_band_right]
    np.testing.assert_array_equal((size < message)[size > 0], stands[size > 0])
