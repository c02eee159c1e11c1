"""The progress of trials under way is what the task says of the trajectory until then."""

import numpy as np
import pytest

import neurosim as ns
from neurosim.tasks.score import Interval, Replayed

TASKS = {
    "nine-rectangles": lambda: ns.make_task("nine-rectangles", seconds=4.0),
    "a smaller course": lambda: ns.make_task(
        "nine-rectangles", course=[[1, 2], [0, 3]], length=0.3, width=0.3, seconds=4.0
    ),
    "go-to": lambda: ns.make_task(
        "go-to", goals=[[0.2, 0.1, 0.0], [0.3, -0.1, 1.0]], seconds=4.0, tolerance=0.1
    ),
    "go-to, turned, between walls": lambda: ns.make_task(
        "go-to",
        goals=[[0.2, 0.05, 0.5]],
        walls=[[0.5, -1.0, 0.5, 1.0], [-1.0, -0.4, 1.0, -0.4]],
        heading_tolerance=1.0,
        seconds=4.0,
    ),
    "obstacle-avoidance": lambda: ns.make_task("obstacle-avoidance", steps=40, starts=1),
    "obstacle-avoidance, cells": lambda: ns.make_task(
        "obstacle-avoidance", steps=40, starts=1, fitness="cells"
    ),
    "follow-line": lambda: ns.make_task("follow-line", seconds=4.0, laps=0.1, within=0.2),
    "walking": lambda: ns.make_task("walking", seconds=1.0),
}


def drives(task, count, steps, rng):
    """Return poses [B, T + 1, 3] of robots: they wander, half from goal to goal; one is lost."""
    turns = np.cumsum(rng.normal(0, 0.15, (count, steps)), axis=1)
    far = np.array([np.cos(turns), np.sin(turns)]) * rng.uniform(0.0, 0.12, (count, steps))
    poses = np.zeros((count, steps + 1, 3))
    heading = task.start[2]
    turned = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    poses[:, 1:, :2] = np.moveaxis(np.tensordot(turned, np.cumsum(far, axis=2), 1), 0, -1)
    poses[:, 1:, 2] = turns
    poses += task.start
    if task.episode.goals is not None:
        places = np.vstack([task.start, task.episode.goals])
        for row in range(0, count, 2):
            share = rng.uniform(0.8, 1.6) * np.linspace(0, len(places) - 1, steps + 1)
            for column in range(3):
                way = np.interp(share, np.arange(len(places)), places[:, column])
                poses[row, :, column] = way + np.append(0, rng.normal(0, 0.02, steps))
    poses[-1, -5:] = np.nan
    return poses


@pytest.mark.parametrize("name", TASKS)
def test_scores_are_the_progress_of_the_trajectory_until_then(name):
    task, rng = TASKS[name](), np.random.default_rng(3)
    count, steps = 60, min(task.episode.steps, 40)
    poses = drives(task, count, steps, rng)
    if name == "obstacle-avoidance":
        poses = np.nan_to_num(poses)
    commands = rng.uniform(-100, 100, (count, steps, 2))
    readings = rng.uniform(0, 1, (count, steps, 3))
    fast, slow = task.score(count, 2, 3), Replayed(task, count, 2, 3)
    if name == "obstacle-avoidance, cells":
        assert isinstance(fast, Replayed)
        poses = np.nan_to_num(poses)
    assert (type(fast) is Replayed) == ("cells" in name)
    every = slice(None)
    for score in (fast, slow):
        score.begin(every, np.zeros((count, 3)))
        score.begin(np.arange(count), poses[:, 0])
    np.testing.assert_allclose(fast.progress, slow.progress, atol=1e-12)
    ended = fast.over.copy()
    for step in range(steps):
        last = step == steps - 1
        duration = 0.5 if last and task.episode.rest else task.episode.step
        moved = poses[:, step + 1], commands[:, step], readings[:, step], duration, not last
        for score in (fast, slow):
            # Not all of a batch at once, and in no order.
            order = np.arange(count) if step % 2 else rng.permutation(count)
            for rows in (order[:25], order[25:]) if step % 3 else (every,):
                score.add(rows, Interval(*(one[rows] if np.ndim(one) else one for one in moved)))
        np.testing.assert_allclose(fast.progress, slow.progress, atol=1e-9)
        assert np.array_equal(fast.success, slow.success)
        assert not (ended & ~fast.over).any()
        ended = fast.over.copy()
    assert len(np.unique(np.round(fast.progress, 6))) > 10
    if "course" in name or "walls" in name:
        assert 0 < ended.sum() < count
    if "course" in name or "go-to" in name:
        assert fast.success.any()
        assert not fast.success.all()


def test_a_trial_begins_anew():
    task = TASKS["go-to"]()
    score = task.score(2, 2, 0)
    score.begin(slice(None), np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    before = score.progress.copy()
    moved = Interval(np.array([[0.2, 0.1, 0.0]] * 2), np.zeros((2, 2)), None, 0.1)
    score.add(slice(None), moved)
    assert (score.progress > before).all()
    score.begin(np.array([1]), np.zeros((1, 3)))
    assert score.progress[1] == before[1]
    assert score.progress[0] > before[0]
