import math

import numpy as np
import pytest

from neurosim.base.commands import TWO_WHEELS
from neurosim.recording.homing import bearing
from neurosim.recording.perimeter import DISTANCE_ERROR, STOPPING, PositionGuard

BOARD = {"length": 2.0, "width": 1.0}


TAKES = TWO_WHEELS.measured(full=0.5, track=0.13)


def perimeter():
    return PositionGuard(BOARD, 0.1)


def test_straight_on_is_speed_times_time():
    p = perimeter()
    p.sent(10.0, TAKES.twist((40, 40)))
    pose, distance = p.predict(np.array([0.1, 0.0, math.pi / 2]), 10.0, 10.5)
    assert pose == pytest.approx([0.1, 0.1, math.pi / 2])
    assert distance == pytest.approx(0.1)


def test_each_command_counts_for_its_time():
    p = perimeter()
    p.sent(10.0, TAKES.twist((40, 40)))  # 0.2 m/s
    p.sent(11.0, TAKES.twist((0, 0)))
    p.sent(12.0, TAKES.twist((-20, -20)))
    pose, distance = p.predict(np.zeros(3), 10.5, 12.5)
    assert pose == pytest.approx([0.1 - 0.05, 0, 0])
    assert distance == pytest.approx(0.15)


def test_a_turn_on_the_spot_goes_nowhere():
    p = perimeter()
    p.sent(0.0, TAKES.twist((-13, 13)))  # 1 rad/s
    pose, distance = p.predict(np.zeros(3), 0.0, 2.0)
    assert pose == pytest.approx([0, 0, 2.0])
    assert distance == 0


@pytest.mark.parametrize("heading", [0.0, math.pi])
def test_the_robot_is_stopped_where_it_would_come_to_stand_at_the_margin(heading):
    p = perimeter()
    speed = 0.2 if heading == 0 else -0.2
    p.sent(0.0, TAKES.twist((200 * speed, 200 * speed)))
    run_out = 0.2 * STOPPING * (1 + DISTANCE_ERROR)
    for off, leaves in ((-0.002, False), (0.002, True)):
        pose = np.array([0.9 - run_out + off, 0.0, heading])
        assert p.leaves(pose, 5.0, 5.0) is leaves
    # The same position long ago: the robot has moved on since.
    assert p.leaves(np.array([0.9 - run_out - 0.002, 0.0, heading]), 4.9, 5.0)


def test_a_robot_outside_is_let_back_in_and_not_further_out():
    p = perimeter()
    p.sent(0.0, TAKES.twist((40, 40)))
    outside = np.array([0.97, 0.0, 0.0])
    assert p.leaves(outside, 1.0, 1.0)
    assert not p.leaves(outside + (0, 0, math.pi), 1.0, 1.0)  # noqa: RUF005 - a sum
    p.sent(1.0, TAKES.twist((0, 0)))
    assert not p.leaves(outside, 2.0, 2.0)


def test_what_was_sent_long_ago_is_forgotten_and_changes_nothing():
    p = perimeter()
    for second in range(1000):
        p.sent(float(second), TAKES.twist((40, 40)))
    assert len(p._sent) < 20
    assert p.predict(np.zeros(3), 998.0, 999.0)[1] == pytest.approx(0.2)


def test_the_middle_is_clear_of_the_edges():
    p, rng = perimeter(), np.random.default_rng(1)
    places = np.array([p.middle(0.4, rng) for _ in range(200)])
    assert np.abs(places[:, 0]).max() <= 0.6
    assert np.abs(places[:, 1]).max() <= 0.1
    assert np.ptp(places[:, 0]) > 1.0
    assert p.middle(5.0, rng) == pytest.approx([0, 0])


@pytest.mark.parametrize("heading", np.linspace(-3, 3, 9))
@pytest.mark.parametrize("goal", [(1.0, 0.0), (-0.3, 0.4), (0.0, -2.0)])
def test_a_bearing_leads_to_its_goal_with_at_most_a_quarter_turn(heading, goal):
    pose, goal = np.array([0.2, -0.1, heading]), np.array(goal)
    turn, direction = bearing(pose, goal)
    assert abs(turn) <= math.pi / 2 + 1e-12
    ahead = direction * np.array([math.cos(heading + turn), math.sin(heading + turn)])
    to_goal = goal - pose[:2]
    assert ahead @ to_goal == pytest.approx(np.hypot(*to_goal))
