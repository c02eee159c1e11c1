"""Where the guard ends a drive: by hand-worked positions, and by a slow, plain version."""

import math
from dataclasses import asdict, replace
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base import se2
from neurosim.base.perimeter import DISTANCE_ERROR, EDGE, LINE, SPACING, STOPPING, Board, Perimeter

BOARD = Board(2.0, 1.0, line_inset=0.1, line_width=0.02)
#: A sensor 6 cm ahead of the axle and 9 cm to either side.
SENSORS = ((0.06, 0.09), (0.06, -0.09))


def end(perimeter, before, after, duration=1.0):
    guard = np.array([[*before, 0.0]])
    poses = perimeter.ends(guard, np.array([after], float), duration)
    known = np.isfinite(poses[0]).all()
    np.testing.assert_array_equal(guard[0, :3], poses[0] if known else before)
    return int(guard[0, 3]), poses[0]


def test_a_sensor_ahead_meets_the_line_before_the_axle_does():
    code, pose = end(Perimeter(BOARD, SENSORS), (0.5, 0, 0), (0.9, 0, 0), 4.0)
    assert code == LINE
    # The line's inner border is at x = 1 - 0.1 - 0.01; sensors are checked every centimetre.
    assert pose[0] == pytest.approx(0.89 - 0.06, abs=0.0101)
    assert pose[0] >= 0.89 - 0.06


def test_a_sensor_to_the_side_meets_the_line_of_the_long_side():
    code, pose = end(Perimeter(BOARD, SENSORS), (0, 0.2, 0.3), (0.3, 0.3, 0.3), 4.0)
    assert code == LINE
    across = 0.06 * math.sin(0.3) + 0.09 * math.cos(0.3)
    assert pose[1] + across == pytest.approx(0.39, abs=0.01)


def test_backwards_the_position_is_what_ends_it():
    perimeter = Perimeter(BOARD, SENSORS, margin=0.05)
    code, pose = end(perimeter, (-0.5, 0, 0), (-0.94, 0, 0), 4.4)
    assert code == EDGE
    ahead = 0.1 * STOPPING  # at 0.1 m/s
    assert pose[0] == pytest.approx(-(0.95 - (1 + DISTANCE_ERROR) * ahead), abs=0.01)
    assert end(Perimeter(BOARD, SENSORS, margin=None), (-0.5, 0, 0), (-0.94, 0, 0), 4.4)[0] == 0


def test_a_robot_that_turns_on_the_spot_sweeps_its_sensors_over_the_line():
    perimeter = Perimeter(BOARD, SENSORS)
    assert end(perimeter, (0, 0.27, -math.pi / 2), (0, 0.27, 0))[0] == 0
    code, pose = end(perimeter, (0, 0.29, -math.pi / 2), (0, 0.29, math.pi / 2))
    assert code == LINE
    assert 0 < pose[2] < math.pi / 2


def test_nothing_ends_where_nothing_is_guarded_or_known():
    free = Perimeter(Board(2.0, 1.0, line_width=0.0), SENSORS, margin=None)
    assert end(free, (0, 0, 0), (0.9, 0, 0))[0] == 0
    assert end(free, (0, 0, 0), (0.97, 0, 0))[0] == LINE  # beyond the board
    assert end(Perimeter(BOARD, SENSORS), (0, 0, 0), (math.nan, 0, 0))[0] == 0


def test_on_its_way_back_inside_a_robot_is_let_go():
    perimeter = Perimeter(BOARD, (), margin=0.05)
    assert end(perimeter, (0.97, 0, 0), (0.5, 0, 0))[0] == 0
    assert end(perimeter, (0.97, 0, 0), (0.99, 0, 0))[0] == EDGE


@settings(max_examples=200, deadline=None)
@given(
    st.tuples(st.floats(-1.1, 1.1), st.floats(-0.6, 0.6), st.floats(-4, 4)),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-4, 4)),
)
def test_what_is_not_near_the_line_does_not_reach_it_in_that_distance(start, move):
    perimeter = Perimeter(BOARD, SENSORS, margin=None)
    path = se2.arc(np.array(move), np.linspace(0, 1, 200))
    length = float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())
    code, _ = end(perimeter, start, se2.compose(np.array(start), np.array(move)))
    if not perimeter.near_line(start, 1.01 * length + 1e-6):
        assert code == 0
    if code == LINE:
        assert perimeter.near_line(start, 1.01 * length + 1e-6)


def test_far_and_near_the_line():
    perimeter = Perimeter(BOARD, SENSORS)
    reach = math.hypot(0.06, 0.09)  # the sensors' from the axle, whichever way the robot faces
    assert not perimeter.near_line((0, 0, 0), 0.5 - 0.11 - reach - 0.001)
    assert perimeter.near_line((0, 0, 0), 0.5 - 0.11 - reach + 0.001)
    assert perimeter.near_line((0.8, 0, 1.0), 0.0)
    assert perimeter.near_line((1.5, 0, 1.0), 0.0)  # beyond it


def slowly(perimeter, before, after, duration):
    """Return whether a drive ends, checked every tenth of a millimetre."""
    displacement = se2.between(np.array(before), np.array(after))
    fractions = np.linspace(0, 1, 5001)
    poses = se2.compose(np.array(before), se2.arc(displacement, fractions))
    half = np.array([perimeter.board.length, perimeter.board.width]) / 2
    inset, width = perimeter.board.line_inset, perimeter.board.line_width
    ends = np.zeros(len(poses), bool)
    for x, y in perimeter.sensors:
        at = se2.compose(poses, np.array([x, y, 0.0]))[:, :2]
        depth = (half - np.abs(at)).min(axis=1)
        ends |= (depth < 0) | (np.abs(depth - inset) <= width / 2)
    return ends


@settings(max_examples=150, deadline=None)
@given(
    st.tuples(st.floats(-0.95, 0.95), st.floats(-0.45, 0.45), st.floats(-7, 7)),
    st.tuples(st.floats(-0.4, 0.4), st.floats(-0.1, 0.1), st.floats(-2, 2)),
)
def test_no_line_is_passed_over(before, displacement):
    perimeter = Perimeter(BOARD, SENSORS, margin=None)
    after = se2.compose(np.array(before), np.array(displacement))
    code, _ = end(perimeter, before, after)
    ends = slowly(perimeter, before, after, 1.0)
    if code:
        assert ends.any()
    # A corner of the line may be cut between two checks; a longer stretch on it must be noticed.
    moved = se2.between(np.array(before), after)
    distance = float(se2.arc_length(moved)) + math.hypot(*SENSORS[0]) * abs(moved[2])
    longest = max((len(list(run)) for on, run in groupby(ends) if on), default=0)
    if longest / len(ends) * distance > 1.01 * SPACING or ends[0]:
        assert code == LINE


def test_a_sensor_that_begins_beyond_the_edge_is_not_passed_over():
    """The right sensor is 1 mm beyond it, and inside again after 6 mm of 63 mm."""
    perimeter = Perimeter(BOARD, SENSORS, margin=None)
    before = (0.0, -0.42578125, -1.75)
    after = se2.compose(np.array(before), np.array([0.0, -0.0625, 0.0]))
    code, pose = end(perimeter, before, after)
    assert code == LINE
    assert pose == pytest.approx(before)


@pytest.mark.parametrize("width", [0.002, 0.005, 0.02])
@pytest.mark.parametrize("start", np.linspace(0.8, 0.81, 6))
def test_a_narrow_line_is_not_passed_over(width, start):
    perimeter = Perimeter(replace(BOARD, line_width=width), ((0.0, 0.0),), margin=None)
    code, pose = end(perimeter, (start, 0, 0), (0.99, 0, 0))
    assert code == LINE
    assert pose[0] == pytest.approx(0.9, abs=width / 2 + 1e-9)


def test_a_description_makes_the_same_perimeter_again():
    perimeter = Perimeter(BOARD, SENSORS, 0.03)
    assert Perimeter.from_json(perimeter.describe()) == perimeter
    assert Perimeter.from_json(None) is None
    recorded = Perimeter.of_recording(
        {"board": {"length": 2.0, "width": 1.0}, "robot": {"kind": "other"}}
    )
    assert recorded.sensors == ()
    assert recorded.board.line_width == 0
    robot = {"light_sensors": {"line_left": [0.06, 0.09], "line_right": [0.06, -0.09]}}
    about = {"board": asdict(BOARD), "robot": robot}
    assert Perimeter.of_recording(about).sensors == SENSORS
    about["settings"] = {"guard": {"by": "position"}}
    assert Perimeter.of_recording(about).sensors == ()
