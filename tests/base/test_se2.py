import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim.base import se2

metres = st.floats(-3, 3)
pose = st.tuples(metres, metres, st.floats(-20, 20))
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
