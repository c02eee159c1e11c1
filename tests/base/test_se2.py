import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from neurosim.base import se2
from neurosim.base.se2 import compiled, tensors

metres = st.floats(-3, 3)
turn = st.one_of(st.floats(-20, 20), st.floats(-1e-8, 1e-8), st.sampled_from([2 * math.pi, 0.0]))
pose = st.tuples(metres, metres, turn)
less_than_a_turn = st.tuples(metres, metres, st.floats(-6.2, 6.2))


def test_forward_of_a_robot_that_faces_left_is_along_y():
    assert se2.compose([1, 2, math.pi / 2], [0.5, 0.1, 1]) == pytest.approx(
        [0.9, 2.5, math.pi / 2 + 1]
    )


def test_a_quarter_circle():
    # Radius 1: a quarter turn at speed pi/2 ends one ahead and one to the left.
    assert se2.exp([math.pi / 2, 0, math.pi / 2]) == pytest.approx([1, 1, math.pi / 2])
    assert se2.log([1, 1, math.pi / 2]) == pytest.approx([math.pi / 2, 0, math.pi / 2])
    half = math.sqrt(0.5)
    assert se2.arc([1, 1, math.pi / 2], 0.5) == pytest.approx([half, 1 - half, math.pi / 4])


def test_turns_are_not_wrapped():
    assert se2.between([0, 0, 1], [0, 0, 1 + math.radians(400)])[2] == pytest.approx(
        math.radians(400)
    )


@given(pose, pose)
def test_between_undoes_compose(start, displacement):
    end = se2.compose(start, displacement)
    assert se2.between(start, end) == pytest.approx(displacement, abs=1e-9)


@given(less_than_a_turn)
def test_log_undoes_exp(twist):
    assert se2.log(se2.exp(twist)) == pytest.approx(twist, abs=1e-6)


@given(less_than_a_turn, st.floats(0, 1))
def test_an_arc_ends_at_its_displacement_and_is_cut_anywhere(displacement, fraction):
    assert se2.arc(displacement, 1.0) == pytest.approx(displacement, abs=1e-6)
    assert se2.arc(displacement, 0.0) == pytest.approx([0, 0, 0], abs=1e-9)
    first = se2.arc(displacement, fraction)
    twist = se2.log(displacement)
    rest = se2.exp(twist * (1 - fraction))
    assert se2.compose(first, rest) == pytest.approx(displacement, abs=1e-6)


@given(st.floats(-1e-3, 1e-3))
def test_small_turns_lose_no_precision(angle):
    # Against the series to the next order.
    dx, dy, _ = se2.exp(np.array([1.0, 0.0, angle]))
    assert dx == pytest.approx(1 - angle**2 / 6, abs=1e-13)
    assert dy == pytest.approx(angle / 2 - angle**3 / 24, abs=1e-13)


@given(pose)
def test_in_the_mid_turn_frame_a_twist_is_its_chord(twist):
    # Turns of a whole turn and more included: no logarithm is taken.
    factors = [se2.chord(twist[2]), se2.chord(twist[2]), 1.0]
    result = se2.mid_turn(se2.exp(twist))
    assert result == pytest.approx(np.multiply(twist, factors), abs=1e-9)


def test_the_length_of_a_half_circle_and_of_what_no_arc_leads_to():
    # Diameter 2: half of the circumference is pi.
    assert se2.arc_length([0, 2, math.pi]) == pytest.approx(math.pi)
    assert se2.arc_length([3, 4, 0]) == pytest.approx(5)
    assert se2.arc_length([0.1, 0, 2 * math.pi]) > 1e12


# The functions that compiled code calls, compiled as a part of their caller.


@njit
def _compiled(a, b, fraction):
    return (
        compiled.compose(a[0], a[1], a[2], b[0], b[1], b[2]),
        compiled.exp(a[0], a[1], a[2]),
        compiled.compose_exp(a[0], a[1], a[2], b[0], b[1], b[2]),
        compiled.mid_turn(a[0], a[1], a[2]),
        compiled.chord(a[2]),
        compiled.arc_length(a[0], a[1], a[2]),
        compiled.arc(a[0], a[1], a[2], fraction),
        compiled.rotate(a[2], b[0], b[1]),
    )


@settings(deadline=None)  # the first one compiles
@given(pose, pose, st.floats(0, 1))
def test_compiled_code_computes_the_same(a, b, fraction):
    moved, ended, moved_on, turned, chord, length, part, rotated = _compiled(a, b, fraction)
    close = {"abs": 1e-9, "rel": 1e-9}
    assert moved == pytest.approx(se2.compose(a, b), **close)
    assert ended == pytest.approx(se2.exp(a), **close)
    assert moved_on == pytest.approx(se2.compose(a, se2.exp(b)), **close)
    assert turned == pytest.approx(se2.mid_turn(a), **close)
    assert chord == pytest.approx(se2.chord(a[2]), **close)
    assert rotated == pytest.approx(se2.compose([0, 0, a[2]], b)[:2], **close)
    if abs(chord) > 1e-6:  # elsewhere rounding decides how long the arc is
        assert length == pytest.approx(se2.arc_length(a), **close)
        assert part == pytest.approx(se2.arc(a, fraction)[:2], **close)


@given(pose, pose)
def test_tensors_compute_the_same(a, b):
    first, second = torch.tensor([a, b], dtype=torch.float64)
    for name in ("compose", "between"):
        result = getattr(tensors, name)(first, second)
        assert result.tolist() == pytest.approx(getattr(se2, name)(a, b), abs=1e-9)
    for name in ("exp", "mid_turn"):
        result = getattr(tensors, name)(first)
        assert result.tolist() == pytest.approx(getattr(se2, name)(a), abs=1e-9)
    assert tensors.chord(first[2]).item() == pytest.approx(se2.chord(a[2]), abs=1e-9)
    rotated = se2.compose([0, 0, a[2]], b)[:2]
    assert tensors.rotate(first[2], second[:2]).tolist() == pytest.approx(rotated, abs=1e-9)


def test_tensors_may_have_any_leading_shape():
    a, b = torch.randn(2, 4, 5, 3, generator=torch.Generator().manual_seed(0)).double()
    for name in ("compose", "between"):
        result = getattr(tensors, name)(a, b)
        np.testing.assert_allclose(result, getattr(se2, name)(a.numpy(), b.numpy()), atol=1e-12)
    for name in ("exp", "mid_turn"):
        result = getattr(tensors, name)(a)
        np.testing.assert_allclose(result, getattr(se2, name)(a.numpy()), atol=1e-12)


def test_an_angle_is_wrapped_by_whole_turns():
    result = se2.wrapped([0.0, 3.0 * np.pi / 2.0, -4.0, np.pi, 7.0])
    assert result == pytest.approx(
        [0.0, -np.pi / 2.0, 2.0 * np.pi - 4.0, -np.pi, 7.0 - 2.0 * np.pi]
    )


def test_wheels_make_a_twist():
    # 0.2 m/s and 0.4 m/s, 0.1 m apart: 0.3 m/s ahead, 2 rad/s to the left.
    assert se2.of_wheels(0.2, 0.4, 0.1) == pytest.approx([0.3, 0.0, 2.0])
    assert se2.of_wheels([1.0, -1.0], [1.0, 1.0], 0.5).tolist() == [[1, 0, 0], [0, 0, 4]]
