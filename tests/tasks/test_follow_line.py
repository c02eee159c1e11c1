"""Laps by hand, lines that are lost, both directions, and what is no task."""

import math

import numpy as np
import pytest

import neurosim as ns
from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Trajectory
from neurosim.tasks.follow_line import FollowLine

CIRCLE = {"place": Place.with_line("ellipse", 1.0, 1.0)}


def around(laps, radius=0.5, steps=200):
    """Poses [T + 1, 3] of a robot that goes round the middle, counter-clockwise."""
    turn = np.linspace(0.0, 2 * math.pi * laps, steps + 1)
    heading = turn + math.copysign(math.pi / 2, laps)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), heading], axis=1)


def judged(task, *poses):
    poses = np.stack(poses)
    return task.judge(Trajectory(poses, np.zeros((*poses.shape[:1], len(poses[0]) - 1, 2)), 0.2))


def test_laps_count_in_the_direction_in_which_it_was_put_down():
    task = FollowLine(**CIRCLE, laps=2)
    result = judged(task, around(2.5), around(-2.5), around(1.5), around(2.5, radius=0.55))
    assert result.fitness == pytest.approx([2.5, 2.5, 1.5, 2.5], abs=2e-3)
    assert result.success.tolist() == [True, True, False, True]
    assert result.reason.tolist() == [-1, -1, 1, -1]
    assert result.detail["distance"] == pytest.approx([0, 0, 0, 0.05], abs=1e-3)
    back = around(1.0)[::-1]  # it faces along the line and goes backwards
    assert judged(task, back).fitness == pytest.approx([-1.0], abs=2e-3)


def test_nothing_counts_once_the_line_is_lost():
    task = FollowLine(**CIRCLE, laps=1, within=0.06)
    off = around(2.0)
    off[50:60, :2] *= 1.2
    late = around(2.0)
    late[150:, :2] *= 1.2
    nowhere = around(2.0)
    nowhere[50:] = np.nan
    result = judged(task, off, late, nowhere)
    assert result.fitness == pytest.approx([0.49, 1.49, 0.49], abs=3e-3)
    assert result.success.tolist() == [False, True, False]
    assert result.reason[0] == result.reason[2] == 0
    assert result.segment.tolist() == [49, 149, 49]
    assert task.reasons[0] == "lost the line"


def test_starts_are_on_the_line_and_face_both_ways():
    task, rng = FollowLine(), np.random.default_rng(0)
    poses = task.draw_starts(None, 400, rng)
    away, along = task.line.nearest(poses[:, :2])
    assert away.max() < 1e-9
    assert along.std() > 0.2 * task.line.length
    against = np.cos(poses[:, 2] - task.line.poses(along)[:, 2]) < 0
    assert against.mean() == pytest.approx(0.5)
    against_it = FollowLine(direction="against").draw_starts(None, 5, rng)
    along = task.line.nearest(against_it[:, :2])[1]
    assert (np.cos(against_it[:, 2] - task.line.poses(along)[:, 2]) < 0).all()
    assert task.start == tuple(task.line.poses(0.0).tolist())


def test_points_make_a_line_and_the_task_says_so():
    place = {"lines": [{"points": [[0, 0], [1, 0], [0, 1]]}]}
    task = ns.make_task("follow-line", place=place, step=0.1)
    again = ns.make_task(task.describe())
    assert again == task
    assert task.line.length == pytest.approx(2 + math.sqrt(2))
    assert [shape["polygon"] for shape in task.outline()] == [
        [[0, 0], [1, 0]],
        [[1, 0], [0, 1]],
        [[0, 1], [0, 0]],
    ]
    assert task.episode.steps == 4000


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"direction": "left"}, "direction: expected one of 'both'"),
        ({"laps": 0}, "laps: expected a number from 0.001"),
        ({"seconds": math.inf}, "seconds: .* found inf"),
        (
            {"place": "moon"},
            "moon: no such file .* of this name; there are arena, .*board, rectangle, ell",
        ),
        ({"place": "arena"}, "no closed line"),
        ({"place": {"lines": [{"points": [[0, 0]]}]}}, "at least 3 points, found 1"),
        ({"place": {"lines": [{"points": [[0, 0, 0]] * 3}]}}, r"place.lines\[0\].points\[0\]: "),
        ({"place": {"lines": [{"points": [1, 2, 3]}]}}, r"points\[0\]: expected a list of 2"),
        ({"within": 2.0}, "within must be below a quarter"),
    ],
)
def test_what_is_no_task_is_refused(settings, words):
    with pytest.raises(UserError, match=words):
        FollowLine(**settings)


def test_without_poses_it_cannot_be_judged():
    with pytest.raises(UserError, match="poses"):
        FollowLine().judge(Trajectory(None, np.zeros((3, 2)), 0.2))
