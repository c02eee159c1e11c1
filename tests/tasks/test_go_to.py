"""Going to poses, by hand."""

import json
import math

import numpy as np
import pytest

from neurosim.base import se2
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import write_json
from neurosim.base.place import Place
from neurosim.base.trajectory import Trajectory
from neurosim.tasks.files import FORMAT, VERSION, read_task
from neurosim.tasks.go_to import GoTo
from neurosim.tasks.registry import make_task

TASK = GoTo(goals=((0.5, 0.0, 0.0), (0.5, 0.5, math.pi / 2)), within=0.08, tolerance=0.05)
WALLED = GoTo(goals=((0.5, 0.0, 0.0),), place=Place(walls=((0.305, -0.2, 0.305, 0.2),)), radius=0.1)


def drive(*points, task=TASK, heading=0.0):
    poses = np.array([(x, y, heading) for x, y in points])
    return task.judge(Trajectory(poses, np.zeros((len(points) - 1, 3)), 1.0))


def reason(judged, task=TASK):
    return task.reasons[int(judged.reason)]


def test_goals_are_passed_in_turn_and_the_last_is_stopped_at():
    there = drive((0, 0), (0.5, 0.0), (0.5, 0.5))
    assert (bool(there.success), int(there.reason), int(there.segment)) == (True, -1, 1)
    # Both passed, and the last one hit exactly.
    assert there.fitness == pytest.approx(2 + 1)
    # The second first: it counts only after the first.
    wrong = drive((0, 0), (0.5, 0.5), (0.5, 0.0))
    assert not wrong.success
    assert reason(wrong) == "did not pass all goals"
    assert int(wrong.detail["passed"]) == 1
    # On the way: half of the leg to the first goal, then all of it and half of the second.
    assert drive((0, 0), (0.25, 0.0)).fitness == pytest.approx(0.5)
    assert drive((0, 0), (0.5, 0.0), (0.5, 0.25)).fitness == pytest.approx(1.5)


def test_between_two_poses_the_robot_passes_what_is_on_the_way():
    # A single command leads past the first goal at 7 cm.
    assert int(drive((0, 0.07), (1.0, 0.07)).detail["passed"]) == 1
    assert int(drive((0, 0.09), (1.0, 0.09)).detail["passed"]) == 0


def test_a_curved_command_passes_what_is_on_its_arc_not_on_its_chord():
    # Half a circle to the left of radius 0.4 m, from (0, 0) to (0, 0.8).
    task = GoTo(goals=((0.4, 0.4, 0.0), (0.0, 0.8, 0.0)), within=0.05, tolerance=0.05)
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.8, math.pi]])
    assert task.judge(Trajectory(poses, np.zeros((1, 3)), 1.0)).success
    chord = GoTo(goals=((0.0, 0.4, 0.0), (0.0, 0.8, 0.0)), within=0.05, tolerance=0.05)
    judged = chord.judge(Trajectory(poses, np.zeros((1, 3)), 1.0))
    assert reason(judged) == "did not pass all goals"
    assert judged.fitness == pytest.approx(0.0, abs=0.05)
    # To the right it is the other half; and a heading that is not known leaves the chord.
    other = poses * (1.0, 1.0, -1.0)
    assert not task.judge(Trajectory(other, np.zeros((1, 3)), 1.0)).success
    whole = np.array([[0.0, 0.0, 0.0], [0.0, 0.8, 2 * math.pi]])
    assert int(chord.judge(Trajectory(whole, np.zeros((1, 3)), 1.0)).detail["passed"]) == 1


def test_one_straight_command_passes_several_goals():
    task = GoTo(goals=((0.4, 0.0, 0.0), (0.8, 0.0, 0.0)), within=0.08, tolerance=0.05)
    poses = np.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0]])
    assert task.judge(Trajectory(poses, np.zeros((1, 3)), 1.0)).success


def test_an_arc_that_touches_a_wall_is_seen_to():
    # Around the wall on its chord, at a distance of 0.2 m at least, or into one on its way.
    around = Place(walls=((-0.1, 0.4, 0.1, 0.4),))
    task = GoTo(goals=((0.0, 0.8, 0.0),), place=around, radius=0.1)
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.8, math.pi]])
    assert task.judge(Trajectory(poses, np.zeros((1, 3)), 1.0)).success
    into = GoTo(goals=task.goals, place=Place(walls=((0.35, 0.4, 0.45, 0.4),)), radius=0.1)
    assert reason(into.judge(Trajectory(poses, np.zeros((1, 3)), 1.0)), into) == into.reasons[0]


@pytest.mark.parametrize("turn", [0.4, -1.5, 3.0, 5.0])
def test_an_arc_is_judged_like_many_short_commands(turn):
    rng, twist = np.random.default_rng(0), np.array([0.6, 0.1, turn])
    many = np.array([se2.exp(twist * part) for part in np.linspace(0, 1, 201)])
    for _ in range(20):
        x, y = rng.uniform(-0.6, 0.6, 2)
        task = GoTo(goals=((x, y, 0.0), (50.0, 0.0, 0.0)), within=0.1)
        once = task.judge(Trajectory(many[[0, -1]], np.zeros((1, 3)), 1.0))
        often = task.judge(Trajectory(many, np.zeros((200, 3)), 0.01))
        nearest = float(np.hypot(*(many[:, :2] - (x, y)).T).min())
        if abs(nearest - 0.1) > 0.003:
            assert int(once.detail["passed"]) == int(often.detail["passed"]) == (nearest < 0.1)


def test_a_robot_that_drives_past_the_last_goal_did_not_stop_there():
    past = drive((0, 0), (0.5, 0.0), (0.5, 0.6))
    assert reason(past) == "did not stop at the last goal"
    assert past.detail["distance"] == pytest.approx(0.1)
    assert 2 < past.fitness < drive((0, 0), (0.5, 0.0), (0.5, 0.53)).fitness < 3


def test_the_heading_counts_where_it_is_asked_for():
    task = GoTo(goals=TASK.goals, heading_tolerance=0.2)
    for heading, good in ((math.pi / 2, True), (math.pi / 2 + 2 * math.pi, True), (0.0, False)):
        judged = drive((0, 0), (0.5, 0.0), (0.5, 0.5), task=task, heading=heading)
        assert bool(judged.success) is good
    assert reason(judged, task) == "stopped at the last goal, turned wrongly"
    assert drive((0, 0), (0.5, 0.0), (0.5, 0.5), heading=3.0).success


@pytest.mark.parametrize(
    ("points", "segment"),
    [
        ([(0, 0), (0.5, 0.0)], 0),  # through the wall
        ([(0, 0), (0.1, 0.0), (0.21, 0.0)], 1),  # its rim touches
        ([(0, 0), (0.1, 0.29), (0.4, 0.29), (0.5, 0.0)], 1),  # round its end, too narrowly
    ],
)
def test_a_robot_that_touches_a_wall_gets_nothing_for_what_follows(points, segment):
    judged = drive(*points, task=WALLED)
    assert not judged.success
    assert (reason(judged, WALLED), int(judged.segment)) == (
        "touched a wall or an obstacle",
        segment,
    )
    assert judged.fitness <= 1.0


def test_a_robot_that_keeps_off_the_wall_gets_there():
    judged = drive((0, 0), (0.1, 0.35), (0.5, 0.35), (0.5, 0.0), task=WALLED)
    assert judged.success
    # Whoever touches it after having passed the goal is not paid for having hit it.
    later = drive((0, 0), (0.1, 0.35), (0.5, 0.35), (0.5, 0.0), (0.2, 0.0), task=WALLED)
    assert (reason(later, WALLED), float(later.fitness)) == ("touched a wall or an obstacle", 1.0)


def test_leading_axes_and_poses_that_are_no_numbers():
    poses = np.zeros((2, 3, 3, 3))
    poses[0, :, 1:] = (0.5, 0.0, 0.0)
    poses[1, 0, 1:] = math.nan
    judged = TASK.judge(Trajectory(poses, np.zeros((2, 3, 2, 2)), 1.0))
    assert judged.fitness.shape == (2, 3)
    assert np.isfinite(judged.fitness).all()
    assert judged.detail["passed"].tolist() == [[1, 1, 1], [0, 0, 0]]
    with pytest.raises(UserError, match="needs the robot's poses"):
        TASK.judge(Trajectory(None, np.zeros((2, 2)), 1.0))


def test_a_task_is_made_from_its_description():
    made = make_task(json.loads(json.dumps(WALLED.describe())))
    assert made == WALLED
    assert made.start == (0.0, 0.0, 0.0)
    assert made.episode.steps == 150
    assert made.episode.goals.tolist() == [[0.5, 0.0, 0.0]]
    shapes = made.outline()
    assert sum("circle" in shape for shape in shapes) == 1
    assert sum(shape.get("forbidden", False) for shape in shapes) == 1


def test_starts_anywhere_on_a_board_are_seen_from_a_goal_anywhere_on_it():
    goal = (0.3, -0.2, 2.0)
    task = make_task(json.loads(json.dumps(GoTo(goals=(goal,), area=(2.0, 1.0)).describe())))
    starts = task.draw_starts(None, 4000, np.random.default_rng(1))
    assert np.array_equal(starts, task.draw_starts(None, 4000, np.random.default_rng(1)))
    away = np.linalg.norm(starts[:, :2] - goal[:2], axis=1)
    assert away.max() < math.hypot(2.0, 1.0)
    # The mean distance of two points drawn in a rectangle, by the integral of Ghosh (1951).
    assert away.mean() == pytest.approx(0.8046, abs=0.02)
    turned = np.abs(np.remainder(starts[:, 2] - goal[2] + np.pi, 2 * np.pi) - np.pi)
    assert turned.mean() == pytest.approx(np.pi / 2, abs=0.05)
    assert TASK.draw_starts(None, 3, np.random.default_rng(0)) is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"goals": ()}, "at least one goal"),
        ({"goals": ((0.0, 1.0),)}, r"goals\[0\]: expected a list of 3"),
        ({"goals": ((0.0, 1.0, math.nan),)}, r"goals\[0\]\[2\]: .* found nan"),
        ({"place": {"walls": ((0.0, 1.0, 2.0),)}}, r"place.walls\[0\]: expected a list of 4"),
        ({"place": Place.rectangle(1.0, 1.0), "begin": (0.45, 0.0, 0.0)}, "cannot start at x 45.0"),
        ({"place": Place.rectangle(1.0, 1.0)}, "cannot reach the goal at x 60.0 cm, y 30.0 cm"),
        ({"begin": (0.0, 1.0)}, "begin: expected a list of 3"),
        ({"tolerance": 0.0}, "tolerance: expected a number from 0.0001"),
        ({"radius": -1.0}, "radius: expected a number from 0"),
        ({"area": (1.0, 0.0)}, r"area\[1\]: .* found 0"),
        ({"area": (1.0, math.inf)}, r"area\[1\]: .* found inf"),
        ({"area": (1.0, 1.0), "goals": ((0.0, 1.0, 0.0),) * 2}, "needs a single goal"),
        ({"area": (1.0, 1.0), "place": "arena"}, "needs a single goal"),
    ],
)
def test_settings_that_cannot_be_are_named(settings, message):
    with pytest.raises(UserError, match=message):
        GoTo(**settings)


def test_goals_may_be_an_array():
    goals = np.array([[0.3, 0.1, 0.5], [0.0, 0.2, 0.0]])
    task = make_task("go-to", goals=goals)
    assert task == make_task("go-to", goals=goals.tolist())
    assert make_task(json.loads(json.dumps(task.describe()))) == task


def test_a_misspelt_setting_in_a_file_is_named(tmp_path):
    path = tmp_path / "task.json"
    write_json(path, FORMAT, VERSION, {"name": "go-to", "settings": {"gaols": [[0.3, 0.1, 0.0]]}})
    with pytest.raises(FileError, match=r"field 'settings': .* no setting 'gaols'; it has .*goals"):
        read_task(str(path))
