"""The progress of trials under way is what the task says of the trajectory until then."""

from copy import deepcopy

import numpy as np
import pytest

import neurosim as ns
from neurosim.base.perimeter import Board, Perimeter
from neurosim.base.trajectory import Trajectory
from neurosim.tasks.base import Interval, Judgement, Records

TASKS = {
    "nine-rectangles": lambda: ns.make_task("nine-rectangles", seconds=4.0),
    "a smaller course": lambda: ns.make_task(
        "nine-rectangles", course=[[1, 2], [0, 3]], length=0.3, width=0.3, seconds=4.0
    ),
    "nine-rectangles, guarded": lambda: ns.make_task(
        "nine-rectangles", seconds=4.0
    ).within_perimeter(Perimeter(Board(2.5, 1.6, line_inset=0.1), ((0.1, 0.0),))),
    "go-to": lambda: ns.make_task(
        "go-to", goals=[[0.2, 0.1, 0.0], [0.3, -0.1, 1.0]], seconds=4.0, tolerance=0.1
    ),
    "go-to, turned, between walls": lambda: ns.make_task(
        "go-to",
        goals=[[0.2, 0.05, 0.5]],
        place={"walls": [[0.5, -1.0, 0.5, 1.0], [-1.0, -0.4, 1.0, -0.4]]},
        heading_tolerance=1.0,
        seconds=4.0,
    ),
    "obstacle-avoidance": lambda: ns.make_task("obstacle-avoidance", steps=40, starts=1),
    "obstacle-avoidance, cells": lambda: ns.make_task(
        "obstacle-avoidance", steps=40, starts=1, fitness="cells"
    ),
    "follow-line": lambda: ns.make_task("follow-line", seconds=4.0, laps=0.1, within=0.2),
    "walking": lambda: ns.make_task("walking", seconds=1.0),
    "walking, to a circle": lambda: ns.make_task("walking", seconds=1.0, circle=0.3),
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
            fraction = rng.uniform(0.8, 1.6) * np.linspace(0, len(places) - 1, steps + 1)
            for column in range(3):
                distance = np.interp(fraction, np.arange(len(places)), places[:, column])
                poses[row, :, column] = distance + np.append(0, rng.normal(0, 0.02, steps))
    poses[-1, -5:] = np.nan
    return poses


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_a_trial_in_parts_is_worth_what_the_whole_one_is(name):
    task, rng = TASKS[name](), np.random.default_rng(3)
    count, steps = 60, min(task.episode.steps, 40)
    poses = drives(task, count, steps, rng)
    commands = rng.uniform(-100, 100, (count, steps, 2))
    readings = rng.uniform(0, 1, (count, steps, 3))
    durations = np.full((count, steps), task.episode.step)
    active = np.ones((count, steps), np.bool_)
    active[:, -1], durations[:, -1] = False, task.episode.rest or task.episode.step
    records, ended = Records(task, poses[:, 0]), np.zeros(count, np.bool_)
    seen = []
    for step in range(steps):
        order = rng.permutation(count)
        for rows in (order[:25], order[25:]):  # not all of a batch at once, and in no order
            given = poses[rows, step + 1], durations[rows, step], active[rows, step]
            interval = Interval(*given, True, commands[rows, step], readings[rows, step])
            records.add(interval, rows)
        until = slice(step + 1)
        whole = Trajectory(
            poses[:, : step + 2],
            commands[:, until],
            durations[:, until],
            readings[:, until],
            active[:, until],
        )
        judged, now = task.judge(whole), records.score()
        for one in ("fitness", "progress", "success", "reason"):
            np.testing.assert_allclose(getattr(now, one), getattr(judged, one), atol=1e-9)
        assert np.array_equal(judged.over, now.over)
        assert np.array_equal(judged.over, records.over())
        assert not (ended & ~judged.over).any()
        assert (judged.segment[~judged.over] == step).all()
        assert (judged.segment[ended] < max(step, 1)).all()
        if step == steps // 2:
            middle = deepcopy(records)
        ended = judged.over
        seen.append(judged.progress)
    half = steps // 2 + 1
    for row in (0, 1, count - 1):
        rest = Trajectory(
            poses[row, half:],
            commands[row, half:],
            durations[row, half:],
            readings[row, half:],
            active[row, half:],
        )
        earlier = Records(task, poses[[row], 0])
        earlier.own = middle.own[[row]]
        if middle.guard is not None:
            earlier.guard = middle.guard[[row]]
        onward = task.judge(rest, earlier)
        assert onward.fitness == pytest.approx(judged.fitness[row])
        assert onward.success == judged.success[row]
    assert len(np.unique(np.round(seen, 6))) > 10
    if "course" in name or "walls" in name:
        assert 0 < ended.sum() < count
    if "guarded" in name:
        assert 10 < (records.guard[:, 3] > 0).sum() < count
    if "course" in name or "go-to" in name:
        assert judged.success.any()
        assert not judged.success.all()


def test_a_judgement_stays_as_it_is_while_the_record_goes_on():
    task = TASKS["obstacle-avoidance"]()
    records = Records(task, np.zeros((1, 3)))
    before = records.score()
    given = np.array([[100.0, 100.0]]), np.zeros((1, 3))
    records.add(Interval(np.zeros((1, 3)), 0.1, True, True, *given))
    assert before.progress == 0.0
    assert records.score().progress == 1.0


def test_columns_of_a_record_may_be_given_as_they_are():
    record = np.zeros((2, 3))
    judged = Judgement.of(record[:, 1], record[:, 1] > 1, progress=record[:, 2], own=record[:, 1])
    record[:] = 5.0
    assert not judged.fitness.any()
    assert not judged.progress.any()
    assert not judged.detail["own"].any()
