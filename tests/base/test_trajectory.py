"""Trajectories: their times, and a trajectory made from a track."""

import re

import numpy as np
import pytest

from neurosim.base.trajectory import Draws, Trajectory, planned


def test_times_are_sums_of_durations():
    commands = np.zeros((2, 3, 2))
    even = Trajectory(None, commands, 0.1)
    assert even.shape == (2,)
    assert even.times == pytest.approx(np.tile([0.0, 0.1, 0.2, 0.3], (2, 1)))
    uneven = Trajectory(None, commands, np.array([[1.0, 0.5, 0.0], [2.0, 2.0, 2.0]]))
    assert uneven.times.tolist() == [[0.0, 1.0, 1.5, 1.5], [0.0, 2.0, 4.0, 6.0]]
    one = Trajectory(None, commands[0], np.array([1.0, 2.0, 3.0]))
    assert one.shape == ()
    assert one.times.tolist() == [0.0, 1.0, 3.0, 6.0]


POSES = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
COMMANDS = np.array([[10.0, 10, 1], [20, 20, 1], [30, 30, 1]])


def test_a_track_has_an_interval_between_two_frames():
    made = Trajectory.of_track(
        [5.0, 5.5, 6.5, 8.0], POSES, [0, 0, 0, 1], COMMANDS[:2], [True, False], [[0.1], [0.2]]
    )
    assert made.poses.tolist() == POSES.tolist()
    assert made.segment.tolist() == [0, 0, 1]
    assert made.commands[:, 0].tolist() == [10.0, 10.0, 20.0]
    assert made.durations.tolist() == [0.5, 1.0, 1.5]
    assert made.times.tolist() == [0.0, 0.5, 1.5, 3.0]
    assert made.active.tolist() == [True, True, False]
    assert made.readings.tolist() == [[0.1], [0.1], [0.2]]


@pytest.mark.parametrize(
    ("segment", "steps", "x"),
    [
        # The robot was out of sight during the second command, the first, the last, and all.
        ([0, 0, 0, 2], [0, 0, 1, 2], [0, 1, 2, 2, 3]),
        ([1, 1, 1, 2], [0, 1, 1, 2], [0, 0, 1, 2, 3]),
        ([0, 0, 0, 1], [0, 0, 1, 2], [0, 1, 2, 3, 3]),
        ([0], [0, 1, 2], [0, 0, 0, 0]),
    ],
)
def test_a_silent_command_is_an_interval_on_the_spot(segment, steps, x):
    count = len(segment)
    made = Trajectory.of_track(np.arange(count), POSES[:count], segment, COMMANDS)
    assert made.segment.tolist() == steps
    assert made.poses[:, 0].tolist() == x
    assert made.commands[:, 0].tolist() == [COMMANDS[step, 0] for step in steps]
    assert made.durations.tolist() == np.diff(x).tolist()
    assert made.active is None
    assert made.readings is None


@pytest.mark.parametrize(
    ("times", "poses", "segment"),
    [([], np.empty((0, 3)), []), ([0.0], POSES[:1], [0, 1]), ([0.0, 1.0], POSES[:1], [0])],
)
def test_a_track_that_is_none_is_refused(times, poses, segment):
    with pytest.raises(ValueError, match="a time and a segment for each"):
        Trajectory.of_track(times, poses, segment, COMMANDS)


def test_plans_rest_for_as_long_as_is_said_and_null_commands_take_no_time():
    commands = np.array([[[10.0, 10, 1], [20, 20, 2], [0, 0, 0.5]]])
    active = np.array([[False, True, False]])
    made = planned(np.zeros((1, 4, 4, 3)), commands, active, 0.5)
    assert made.shape == (1, 4)
    assert made.times[0, 3].tolist() == [0.0, 0.0, 2.0, 2.5]
    assert made.active[0, 3].tolist() == [False, True, False]
    moving = planned(np.zeros((1, 4, 4, 3)), commands, active, 0.0)
    assert moving.times[0, 0].tolist() == [0.0, 0.0, 2.0, 2.0]


@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        ("poses", (1, 2, 3), (1, 3, 3)),
        ("poses", (3, 3), (1, 3, 3)),
        ("readings", (1, 3, 8), (1, 2, 8)),
        ("active", (1, 3), (1, 2)),
        ("segment", (3,), (2,)),
    ],
)
def test_shapes_that_do_not_fit_are_refused(name, shape, expected):
    parts = {"poses": None, name: np.zeros(shape)}
    with pytest.raises(ValueError, match=re.escape(f"expected {name} {expected}, not {shape}")):
        Trajectory(commands=np.zeros((1, 2, 3)), durations=1.0, **parts)


def test_draws_are_as_many_as_their_starts():
    assert len(Draws(np.zeros((7, 3)))) == 7
