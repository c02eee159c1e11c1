"""Gaits of 20 parameters: loci, timing, inverse kinematics, bounds."""

import numpy as np
import pytest
import torch

from neurosim.base.errors import UserError
from neurosim.controllers import gait, make_controller
from neurosim.robots.quadruped import LOWER, UPPER, angles_of, foot, standing


def test_a_leg_hangs_straight_down_and_folds_as_its_docstring_says():
    assert foot(np.zeros(3)) == pytest.approx([0, 0, -(UPPER + LOWER)])
    assert foot(np.array([np.pi / 2, 0, 0])) == pytest.approx([-(UPPER + LOWER), 0, 0])
    assert foot(np.array([0, np.pi / 2, 0])) == pytest.approx([0, UPPER + LOWER, 0])
    assert foot(np.array([0, 0, np.pi / 2])) == pytest.approx([-LOWER, 0, -UPPER])


@pytest.mark.parametrize("knee", [-1.0, 1.0])
def test_inverse_kinematics_undoes_forward_kinematics(knee):
    rng = np.random.default_rng(0)
    angles = rng.uniform([-1, -0.1, 0.2], [1, 0.8, 2.0], (200, 3)) * [1, 1, knee]
    result, reached = angles_of(foot(angles), np.full(200, knee))
    assert reached.all()
    np.testing.assert_allclose(result, angles, atol=1e-12)


def test_out_of_reach_is_said_and_cut_to_what_the_joints_allow():
    angles, reached = angles_of(np.array([[0.0, 0.0, -0.2], [0.0, 0.02, -0.1]]), np.ones(2))
    assert reached.tolist() == [False, True]
    assert np.isfinite(angles).all()
    assert np.linalg.norm(foot(angles[0])) < UPPER + LOWER


def test_loci_by_hand():
    """5.5 cm at 14 cm/s with 55 % of the time on the ground: 0.39 s there, a cycle of 0.71 s."""
    genes = gait.genes_of(gait.HAND_TUNED)
    feet, times, cycle = gait.loci(genes)
    assert cycle == pytest.approx(0.055 / 0.14 / 0.55)
    assert times[0] == 0.0
    assert times[-1] == 1.0
    assert (np.diff(times) > 0).all()
    np.testing.assert_allclose(feet[:, 0], feet[:, -1], atol=1e-12)
    assert feet[0, 0] == pytest.approx([0.02 + 0.0275, 0.015, -0.095])
    ground = times < 0.55 - 1e-9
    assert (feet[0, ground, 2] == -0.095).all()
    np.testing.assert_allclose(np.diff(feet[0, ground, 0]), -0.055 / 12)
    middle = np.interp(0.775, times, feet[0, :, 2])
    assert middle == pytest.approx(-0.095 + 0.02, abs=1e-3)  # of the air stage: its full height


def test_shape_goes_from_half_ellipse_to_trapezoid():
    values = dict(gait.HAND_TUNED, front_lift_height=0.02, front_descend_height=0.02, air_points=12)
    heights = []
    for shape in (0.0, 1.0):
        feet, times, cycle = gait.loci(gait.genes_of(dict(values, shape=shape)))
        up, fraction = feet[0, :, 2] + 0.095, 0.06 / cycle
        lifted = np.argmin(np.abs(times - 0.55 - fraction))
        swing = (times[lifted] - 0.55) / 0.45
        expected = 0.02 if shape else 0.02 * np.sin(np.pi * swing)
        assert up[lifted] == pytest.approx(expected)
        heights.append(up[lifted])
    assert heights[0] < heights[1]


def test_the_cycle_is_bounded():
    fast = dict(gait.HAND_TUNED, length=0.01, ground_speed=0.4)
    assert gait.loci(gait.genes_of(fast))[2] == gait.CYCLE[0]
    slow = dict(gait.HAND_TUNED, length=0.1, ground_speed=0.05)
    assert gait.loci(gait.genes_of(slow))[2] == gait.CYCLE[1]


def test_a_turn_to_the_left_skews_the_loci_so_that_front_feet_push_to_the_right():
    feet, _, _ = gait.loci(gait.genes_of(dict(gait.HAND_TUNED, turn=0.3)))
    left, right = feet[0], feet[1]
    assert left[0, 1] > left[11, 1]  # from outwards (left) to inwards (right)
    assert right[0, 1] < right[11, 1]


def test_it_is_a_trot_that_begins_from_a_stand():
    family = make_controller("gait")
    genes = gait.genes_of(gait.HAND_TUNED)[None]
    cycle = gait.loci(genes[0])[2]
    commands = family.over(genes, np.array([0.0, 1.0, 1.0 + cycle / 2, 1.0 + cycle]))[0]
    np.testing.assert_allclose(commands[0], standing())
    np.testing.assert_allclose(commands[1], commands[3], atol=1e-9)
    legs = commands.reshape(4, 4, 3) * [1, 0, 1]
    np.testing.assert_allclose(legs[1, 0], legs[2, 1], atol=1e-9)  # half a cycle apart
    act, _ = family.act(
        torch.from_numpy(genes), torch.tensor([[1.0]], dtype=torch.float64), torch.zeros(1, 0)
    )
    np.testing.assert_allclose(act[0], commands[1])


def test_values_and_genes_are_each_others_inverse():
    genes = np.random.default_rng(1).random(20)
    np.testing.assert_allclose(gait.genes_of(gait.values_of(genes)), genes)


def test_bad_gaits_are_refused():
    with pytest.raises(UserError, match=r"length is 0\.5, outside of 0\.01 to 0\.1 m"):
        gait.genes_of(dict(gait.HAND_TUNED, length=0.5))
    with pytest.raises(UserError, match="turn is missing or unknown"):
        gait.genes_of({name: value for name, value in gait.HAND_TUNED.items() if name != "turn"})
    with pytest.raises(UserError, match="length is nan"):
        gait.genes_of(dict(gait.HAND_TUNED, length=float("nan")))
    far = dict(gait.HAND_TUNED, front_x=0.08, front_z=0.125, length=0.1)
    with pytest.raises(UserError, match=r"left front foot cannot reach .* cm forward"):
        gait.Gait().check(gait.genes_of(far))
