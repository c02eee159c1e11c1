"""Gaits of one sine wave for nine servos, by hand from the authors' formula."""

import numpy as np
import pytest
import torch

from neurosim.base.errors import UserError
from neurosim.controllers import make_controller
from neurosim.controllers.sine_gait import SineGait
from neurosim.robots.quadratot import JOINTS, LIMITS, READY, STEP, angles_of

VALUES = {"amp": 100.0, "tau": 4.0, "scale_in_out": 1.5, "mult_fb": -0.5, "mult_lr": 0.8}


def test_positions_by_hand():
    """After a quarter of the period the wave is 100, of outer servos 150; at its end it is 0."""
    gait = SineGait()
    result = gait.positions(gait.from_named(VALUES)[None], np.array([1.0, 4.0]))
    leg_one = [800 + 0.8 * 100, 40 + 0.8 * 150]
    leg_two = [800 - 0.5 * 100, 40 - 0.5 * 150]
    leg_three = [800 + 100, 40 + 150]
    leg_four = [800 - 0.5 * 0.8 * 100, 40 - 0.5 * 0.8 * 150]
    np.testing.assert_allclose(result[0, 0], [*leg_one, *leg_two, *leg_three, *leg_four, 512])
    np.testing.assert_allclose(result[0, 1], [800, 40] * 4 + [512], atol=1e-10)


def test_commands_are_whole_positions_within_the_limits_as_angles():
    """At 5 s: 880, 160, 750, -35, 900, 190, 760, -20; inner ones are cut to 770, outer to 30."""
    gait = SineGait()
    (command,) = gait.over(gait.from_named(VALUES)[None], np.array([5.0]))[0]
    expected = np.array([770, 160, 750, 30, 770, 190, 760, 30, 512])
    np.testing.assert_allclose(command, (expected - 512) * np.radians(300 / 1024), atol=1e-12)
    assert angles_of(np.array([600.9] * 9))[0] == pytest.approx(STEP * 88)


def test_a_trial_begins_and_ends_in_the_crouch():
    """It is halfway after half a second, and one second before the end."""
    gait = SineGait(seconds=12.0)
    genes = gait.from_named(VALUES | {"amp": 0.0})[None]
    result = gait.over(genes, np.array([0.0, 12.0, 0.5, 11.0, 6.0]))[0]
    np.testing.assert_allclose(result[:2], np.tile(angles_of(READY), (2, 1)))
    # The crouch is 770 and 40, the gait without a wave 800 and 40: 770 and 40 everywhere.
    np.testing.assert_allclose(result[2:], np.tile(angles_of(READY), (3, 1)))
    genes = gait.from_named(VALUES)[None]
    half = gait.positions(genes, np.array([11.0]))[0, 0]
    expected = angles_of(READY + 0.5 * (half - READY))
    np.testing.assert_allclose(gait.over(genes, np.array([11.0]))[0, 0], expected)
    assert (expected != angles_of(READY)).any()


def test_acting_is_the_same_as_all_commands_at_once():
    gait = make_controller("sine-gait", seconds=6.0)
    genes = np.random.default_rng(0).uniform(size=(4, 5))
    times = np.array([0.1, 0.1, 2.0, 3.3])
    seen = torch.from_numpy(times[:, None])
    result, _ = gait.act(torch.from_numpy(genes), seen, gait.start(4))
    whole = gait.over(genes, times)
    np.testing.assert_allclose(result.numpy(), whole[range(4), range(4)])
    assert result.shape == (4, len(JOINTS)) == (4, len(LIMITS))
    assert gait.settings() == {"seconds": 6.0}


def test_parameters_have_names_and_bounds():
    gait = SineGait()
    assert gait.named(gait.from_named(VALUES)) == pytest.approx(VALUES)
    with pytest.raises(UserError, match=r"tau is 9, outside of 0\.5 to 8 s"):
        gait.from_named(VALUES | {"tau": 9.0})
    with pytest.raises(UserError, match="mult_lr is missing or unknown"):
        gait.from_named({name: value for name, value in VALUES.items() if name != "mult_lr"})
