"""How long a measured speed lasts is learned from a log."""

import numpy as np
import pytest
import torch

from neurosim.base.se2 import tensors as se2
from neurosim.training.excess import fit_excess

STEP = 0.1


def log(lasting, sudden, drives=4, count=600, lasts=0.8, seed=0, aside=0.0):
    """Return a log, commanded to go straight, of a robot with errors of speed (m/s) ahead.

    Args:
        lasting: standard deviation of errors that last, s.
        sudden: of those of a single step.
        drives, count: drives, and steps of each.
        lasts: time constant, s.
        seed: of all errors.
        aside: speed to the left in times the lasting error ahead.
    """
    rng, fades = np.random.default_rng(seed), np.exp(-STEP / lasts)
    time, predicted, actual, number = [], [], [], []
    for drive in range(drives):
        error, off = np.zeros(count), rng.normal(0, lasting)
        for k in range(count):
            off = fades * off + np.sqrt(1 - fades**2) * rng.normal(0, lasting)
            error[k] = off + rng.normal(0, sudden)
        twist = np.tile([0.3, 0.0, 0.2], (count, 1)) * STEP
        real = twist.copy()
        real[:, 0] += error * STEP
        real[:, 1] += aside * error * STEP
        for path, own in ((predicted, twist), (actual, real)):
            path.append(se2.path(se2.exp(torch.from_numpy(own))))
        time.append(torch.arange(count + 1) * STEP + 1000.0 * drive)
        number.append(torch.full((count + 1,), drive))
    return tuple(map(torch.cat, (time, predicted, actual, number)))


def test_errors_that_last_are_told_from_sudden_ones():
    excess = fit_excess(*log(0.1, 0.0))
    assert excess.believed(STEP)[0, 0] >= 0.9
    assert 0.4 <= excess.lasts[0] <= 1.6
    assert not excess.covariance[1:].any()
    assert not excess.covariance[:, 1:].any()
    assert excess.shortest == pytest.approx(STEP, abs=1e-3)
    assert fit_excess(*log(0.0, 0.1)) is None


def test_a_measurement_with_errors_of_its_own_counts_less():
    assert 0.25 <= fit_excess(*log(0.1, 0.1)).believed(STEP)[0, 0] <= 0.75


def test_errors_of_poses_count_less_in_a_longer_measurement():
    time, predicted, actual, drive = log(0.1, 0.0, lasts=3.2)
    # 1 cm between two poses is as much as the excess in 0.1 s, and a quarter of it in 0.4 s.
    errors = np.random.default_rng(1).normal(0, 0.01 / np.sqrt(2), len(time))
    moved = torch.zeros_like(actual)
    moved[:, 0] = torch.from_numpy(errors)
    excess = fit_excess(time, predicted, se2.compose(actual, moved), drive)
    assert 0.3 <= excess.believed(0.1)[0, 0] <= 0.7
    assert excess.believed(0.4)[0, 0] >= 0.85
    assert 1.6 <= excess.lasts[0] <= 6.4


def test_one_part_tells_of_another_where_both_are_alike():
    excess = fit_excess(*log(0.1, 0.0, lasts=3.2, aside=-0.5))
    shared = float(excess.covariance[0, 1] / excess.covariance[0, 0])
    assert shared == pytest.approx(0.95 * -0.5, abs=0.05)
    # What is seen aside is uncertain, so that what is seen ahead decides.
    time, predicted, actual, drive = log(0.1, 0.0, lasts=3.2, aside=-0.5)
    moved = torch.zeros_like(actual)
    moved[:, 1] = torch.from_numpy(np.random.default_rng(1).normal(0, 0.01, len(time)))
    gains = fit_excess(time, predicted, se2.compose(actual, moved), drive).believed(STEP).tolist()
    assert gains[1][0] == pytest.approx(-0.45, abs=0.1)
    assert abs(gains[1][1]) < 0.2
    assert abs(gains[0][1]) < 0.1


def test_of_short_drives_nothing_is_known():
    assert fit_excess(*log(0.1, 0.0, count=3)) is None


@pytest.mark.parametrize("gap", [0.0, 5.0])
def test_a_drive_does_not_go_on_in_the_next(gap):
    time, predicted, actual, drive = log(0.1, 0.0, drives=40, count=20)
    jumps = torch.zeros(len(time), 3, dtype=torch.float64)
    jumps[:, 0] = 100.0 * drive
    time = time - drive * (1000.0 - 20 * STEP - gap)
    excess = fit_excess(time, predicted, actual + jumps, drive)
    assert excess.believed(STEP)[0, 0] >= 0.75
