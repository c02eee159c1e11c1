"""The course's rules by hand, and the kernel against an obvious implementation."""

import itertools
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.base.perimeter import Board, Perimeter
from neurosim.base.trajectory import Trajectory
from neurosim.tasks.base import Task
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.tasks.registry import make_task

TASK = NineRectangles()
#: Centres of the rectangles, in the order of the course.
CENTRES = [
    (-0.8, 0.0),
    (-0.8, 0.5),
    (0.0, 0.5),
    (0.8, 0.5),
    (0.8, 0.0),
    (0.8, -0.5),
    (0.0, -0.5),
    (-0.8, -0.5),
    (-0.8, 0.0),
]


def straight(points, heading=0.0):
    """Poses of a robot that slides from point to point without turning: arcs are lines."""
    return np.array([[(x, y, heading) for x, y in points]])


def driven(poses, given):
    """Return trajectories of poses (B, S + 1, 3), and given or not (B, S)."""
    given = np.array(given)
    return Trajectory(np.array(poses), np.zeros((*given.shape, 3)), 1.0, active=given)


def tracked(poses, segment, given):
    """Return the trajectory of a dense track."""
    return Trajectory.of_track(
        np.arange(len(poses)), poses, segment, np.zeros((len(given), 3)), given
    )


def judge(points, given=None, task=TASK):
    given = [True] * (len(points) - 1) if given is None else given
    result = task.judge(driven(straight(points), [given]))
    detail = {name: int(values[0]) for name, values in result.detail.items()}
    return float(result.fitness[0]), bool(result.success[0]), detail


def test_once_around():
    fitness, completes, detail = judge(CENTRES)
    assert (fitness, completes) == (64.0, True)
    assert detail == {"furthest": 8, "no_gain": 0, "fault": 0}


def test_the_start_faces_rectangle_1_and_the_name_finds_the_task():
    ahead = se2.compose(TASK.start, [0.5, 0.0, 0.0])
    assert TASK.region(TASK.start) == 0
    assert TASK.region(ahead) == 1
    task = make_task("nine-rectangles", penalty=10.0)
    assert task == NineRectangles(penalty=10.0)
    assert isinstance(task, Task)
    assert make_task(task) is task
    assert make_task(task.describe()) == task
    assert make_task(task.describe(), penalty=5.0) == NineRectangles(penalty=5.0)
    written = json.loads(json.dumps(task.describe()))
    assert make_task(written["name"], **written["settings"]) == task
    with pytest.raises(UserError, match="no task 'ten-rectangles'; choose from nine-rectangles"):
        make_task("ten-rectangles")
    with pytest.raises(UserError, match="has no setting 'size'; it has penalty, "):
        make_task("nine-rectangles", size=1)
    with pytest.raises(UserError, match=r"penalty: .* found -1"):
        make_task("nine-rectangles", penalty=-1.0)


@pytest.mark.parametrize(("reached", "expected"), [(0, 0.0), (1, 1.0), (4, 16.0), (7, 49.0)])
def test_a_part_of_the_course(reached, expected):
    fitness, completes, _ = judge(CENTRES[: reached + 1])
    assert (fitness, completes) == (expected, False)


def test_a_closed_loop_never_gains_by_driving_over_the_line():
    """Of 600 commands of 0.1 s each counts a fifth; whole, they would cost more than a stop."""
    task = TASK.within_perimeter(Perimeter(Board(2.4), (), margin=0.05))
    # Once around in 50 s, then it waits.
    at = np.minimum(np.arange(601) / 500 * 8, 8)
    path = [np.interp(at, np.arange(9), column) for column in np.transpose(CENTRES)]
    poses = np.column_stack([*path, np.zeros(601)])[None]
    waits = task.judge(Trajectory(poses, np.zeros((1, 600, 2)), 0.1))
    assert waits.success[0]
    assert waits.fitness[0] == pytest.approx(64 - 592 * 0.2 / 10)
    away = poses.copy()
    away[0, 540:, 0] -= 0.02 * np.arange(61)
    leaves = task.judge(Trajectory(away, np.zeros((1, 600, 2)), 0.1))
    assert task.why(int(leaves.reason[0])) == "was stopped at the board's edge"
    assert leaves.fitness[0] < waits.fitness[0] - 20
    # Half a second or longer is a whole command of the paper.
    for seconds, part in ((0.1, 0.2), (0.25, 0.5), (0.5, 1.0), (3.0, 1.0)):
        idle = Trajectory(np.tile(poses[:, :1], (1, 5, 1)), np.zeros((1, 4, 2)), seconds)
        assert TASK.judge(idle).fitness[0] == pytest.approx(-0.4 * part)


def test_commands_without_gain_cost_a_tenth_each_null_ones_nothing():
    # Forward, back, forward again, on the spot: only the first gains; then one more.
    points = [*CENTRES[:2], CENTRES[0], CENTRES[1], CENTRES[1], CENTRES[2]]
    assert judge(points)[0] == pytest.approx(4 - 0.2)  # the second forward gains back what was lost
    assert judge(points)[2]["no_gain"] == 2
    nulls = [*CENTRES[:2], CENTRES[1], CENTRES[2]]
    assert judge(nulls, [True, False, True])[0] == 4.0
    assert judge(nulls, [True, True, True])[0] == pytest.approx(3.9)


def test_one_command_may_pass_several_rectangles():
    assert judge([CENTRES[0], CENTRES[1], CENTRES[3]])[0] == 9.0


@pytest.mark.parametrize(
    ("points", "furthest", "fault"),
    [
        ([(-0.8, 0), (0, 0)], 0, 1),
        ([*CENTRES[:3], (0, 0), (0.8, 0), *CENTRES[5:]], 2, 1),
        ([*CENTRES[:2], (-0.8, 0.8), *CENTRES[1:]], 1, 2),
        ([(-0.8, 0), (-0.8, -0.5)], 0, 3),  # the wrong way round
        ([(-0.402, 0.245), (-0.395, 0.256)], 0, 3),  # across the corner into 2
        ([(-0.8, 0), (0.8, 0.0)], 0, 1),  # through the centre, out on its other side
        ([(-0.8, 0.5), (0, 0.5)], 0, 3),  # does not start where it should
        ([(-3, 0), (-0.8, 0)], 0, 2),
        ([(-0.8, 0), (math.nan, 0.0)], 0, 2),
        ([(-0.8, 0), (1e300, 0.0)], 0, 2),
    ],
)
def test_breaches_stop_the_count_and_cost_the_penalty(points, furthest, fault):
    fitness, completes, detail = judge(points)
    assert (detail["furthest"], detail["fault"], completes) == (furthest, fault, False)
    assert fitness == pytest.approx(furthest**2 - detail["no_gain"] / 10 - TASK.penalty)


def test_rectangle_8_counts_for_a_robot_that_ends_there():
    assert judge([*CENTRES, CENTRES[1]])[0] == pytest.approx(49 - 0.1)
    assert judge([*CENTRES, CENTRES[7]])[0] == pytest.approx(49 - 0.1)
    assert judge([*CENTRES, CENTRES[7], CENTRES[8]])[:2] == (pytest.approx(64 - 0.1), True)
    # The motors run down after the last command: that is no command, but part of the path.
    assert judge([*CENTRES, (-0.8, -0.3)], [*[True] * 8, False])[0] == 49.0
    assert judge([*CENTRES, (-0.8, -0.1)], [*[True] * 8, False])[0] == 64.0


def test_the_path_between_poses_is_the_arc():
    # From 1 to 2, half a turn: to the right, a half circle 0.3 m high that leaves the grid at
    # the top; to the left, one through 0, the centre and back; without a turn, the line.
    for turn, fault in ((-math.pi, 2), (math.pi, 1), (0.0, 0)):
        path = np.array([[[-0.8, 0, turn / -2], [-0.7, 0.5, turn / -2], [-0.1, 0.5, turn / 2]]])
        path[0, 0, 2] = path[0, 1, 2]
        result = TASK.judge(driven(path, [[True, True]]))
        assert result.detail["fault"][0] == fault


def test_a_rectangle_that_an_arc_only_dips_into_is_reached():
    # Half a turn from 0 over the border of 1 at y = 0.25 and back again.
    path = np.array([[[-0.9, 0.2, math.pi / 2], [-0.7, 0.2, -math.pi / 2]]])
    result = TASK.judge(driven(path, [[True]]))
    assert (result.detail["furthest"][0], result.detail["no_gain"][0]) == (1, 1)


def test_turning_on_the_spot_stays_and_whole_turns_are_finite():
    for turn in (2 * math.pi, -2 * math.pi, 4 * math.pi, 6.2, 6.5, 20.0):
        spot = np.array([[[-0.8, 0, 0.0], [-0.8, 0, turn]]])
        assert TASK.judge(driven(spot, [[True]])).fitness[0] == pytest.approx(-0.1)
        # A little way in a whole turn is a straight line, not a circle as wide as the board.
        nudged = np.array([[[-0.8, 0, 0.0], [-0.79, 0.01, 2 * math.pi]]])
        assert TASK.judge(driven(nudged, [[True]])).fitness[0] == pytest.approx(-0.1)


def test_a_dense_track_counts_what_happened_between_the_boundaries():
    ends = straight(CENTRES)[0]
    dense = np.concatenate(
        [np.linspace(a, b, 11)[:-1] for a, b in itertools.pairwise(ends)] + [ends[-1:]]
    )
    segment = np.minimum(np.maximum(np.arange(len(dense)) - 1, 0) // 10, 7)
    given = np.ones(8, bool)
    result = TASK.judge(tracked(dense, segment, given))
    assert (result.fitness, result.success) == (64.0, True)
    # A detour through the centre between two boundaries shows only in the dense track.
    detour = dense.copy()
    detour[22:29] = (0.0, 0.0, 0.0)
    result = TASK.judge(tracked(detour, segment, given))
    assert (result.detail["fault"], result.reason, result.segment) == (1, 0, 2)
    # Commands in which nothing was seen gained nothing.
    few = TASK.judge(tracked(ends[:2], [0, 1], given))
    assert few.fitness == pytest.approx(1 - 0.7)
    assert TASK.judge(tracked(ends[:1], [0], given)).fitness == pytest.approx(-0.8)
    with pytest.raises(ValueError, match="at least one pose"):
        tracked(np.empty((0, 3)), [], given)


def test_a_trajectory_without_poses_is_refused():
    with pytest.raises(UserError, match="needs the robot's poses"):
        TASK.judge(Trajectory(None, np.zeros((2, 3)), 1.0))


def test_leading_axes_are_trials():
    once = straight(CENTRES)
    poses = np.stack([[once[0], once[0]], [np.repeat(once[0, :1], 9, 0)] * 2])
    result = TASK.judge(driven(poses, np.ones((2, 2, 8), bool)))
    assert result.fitness.tolist() == [[64.0, 64.0], [-0.8, -0.8]]
    assert result.success.tolist() == [[True, True], [False, False]]
    assert result.reason.tolist() == [[-1, -1], [3, 3]]
    assert result.segment.tolist() == [[7, 7], [7, 7]]
    # Where nothing is said of null commands, all were given.
    alone = Trajectory(once[0], np.zeros((8, 3)), 1.0)
    assert TASK.judge(alone).fitness == 64.0


@pytest.mark.parametrize(
    ("points", "reason", "segment"),
    [
        (CENTRES[:3], "did not end in the last rectangle", 1),
        ([*CENTRES[:3], (0, 0), (0.8, 0)], "entered a forbidden rectangle", 2),
        ([*CENTRES[:2], (-0.8, 0.8)], "left the grid", 1),
        ([CENTRES[0], CENTRES[7], CENTRES[0]], "skipped a rectangle", 0),
    ],
)
def test_a_failure_is_said_in_words(points, reason, segment):
    result = TASK.judge(driven(straight(points), np.ones((1, len(points) - 1), bool)))
    assert TASK.reasons[int(result.reason[0])] == reason
    assert result.segment[0] == segment


def test_progress_grows_towards_the_next_rectangle_and_not_after_a_breach():
    def progress(*points):
        return TASK.judge(driven(straight(points), np.ones((1, len(points) - 1), bool))).progress[0]

    # On the way from 0 to 1, whose lower border is at y = 0.25.
    values = [progress(CENTRES[0], (-0.8, y)) for y in (0.0, 0.1, 0.2, 0.24, 0.3)]
    assert values == sorted(values)
    reach = math.hypot(TASK.length, TASK.width)
    assert values[1] == pytest.approx(-0.1 + 0.9 * (1 - 0.15 / reach))
    assert values[3] < progress(*CENTRES[:2]) < progress(*CENTRES[:3])
    assert progress(*CENTRES) == 64.0
    # What comes after a breach counts no more, nor does passing near the end and going on.
    breach = [CENTRES[0], (-1.3, 0.0)]
    assert progress(*breach, *CENTRES[:2]) == pytest.approx(progress(*breach) - 0.2)
    near = [*CENTRES[:8], (-0.8, -0.26), CENTRES[7]]
    assert progress(*near) == pytest.approx(progress(*CENTRES[:8], CENTRES[7], CENTRES[7]))


def test_another_course_has_other_rectangles():
    task = NineRectangles(length=0.4, width=0.3, course=((0, 1), (3, 2)))
    assert task.last == 4
    assert task.start == pytest.approx((-0.2, 0.15, 0.0))
    around = [task.centre(number) for number in range(5)]
    assert judge(around, task=task)[:2] == (16.0, True)
    assert judge(around[:4], task=task)[:2] == (9.0, False)
    assert judge([around[0], around[3]], task=task)[2]["fault"] == 3
    assert judge([around[0], (-0.5, 0.15)], task=task)[2]["fault"] == 2
    assert task.episode.goals[:, :2].tolist() == [list(place) for place in around[1:]]
    assert len(task.outline()) == 8
    assert make_task(json.loads(json.dumps(task.describe()))) == task


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"course": ((0, 1), (2,))}, "rows of equal length"),
        ({"course": ((0, 1), (3, 5))}, "0, 1, 2, ... once each"),
        ({"course": ((0, 1),)}, "at least 3 rectangles"),
        ({"length": 0.0}, "length: expected a number from 0.0001"),
        ({"step": 0.0}, "step: expected a number from 0.001"),
        ({"seconds": 0.05}, "shorter than one step"),
    ],
)
def test_a_course_that_is_none_is_refused(settings, message):
    with pytest.raises(UserError, match=message):
        NineRectangles(**settings)


def slow(poses, given):
    """Judge one trajectory the obvious way: list the points, then walk along the list."""

    def rectangle(point):
        x, y = point[0], point[1]
        if not (-1.2 <= x < 1.2 and -0.75 < y <= 0.75):
            return "outside"
        column = 0 if x < -0.4 else 1 if x < 0.4 else 2
        row = 0 if y > 0.25 else 1 if y > -0.25 else 2
        return [[1, 2, 3], [0, "centre", 4], [7, 6, 5]][row][column]

    trail = [0] if rectangle(poses[0]) == 0 else ["fault"]
    gains = []
    for start, end in itertools.pairwise(poses):
        displacement = se2.between(start, end)
        twist = se2.log(displacement)
        length = math.hypot(twist[0], twist[1])
        count = max(math.ceil(length / 0.02), 1)
        points = se2.compose(start, se2.arc(displacement, np.arange(1, count + 1) / count))
        if not length <= TASK.longest_arc:
            count = max(math.ceil(math.hypot(*displacement[:2]) / 0.02), 1)
            points = start + (end - start) * (np.arange(1, count + 1) / count)[:, None]
        points[-1] = end
        before = [n for n in trail if n != "fault"][-1:] or [0]
        for point in points:
            if trail[-1] == "fault":
                break
            here = rectangle(point)
            near = {trail[-1] - 1, trail[-1], trail[-1] + 1}
            step = [n for n in near if n >= 0 and n % 8 == here]
            trail += step if step else ["fault"]
        after = [n for n in trail if n != "fault"][-1:] or [0]
        gains.append(min(after[0], 8) > min(before[0], 8))
    clean = trail[-1] != "fault"
    furthest = max([min(n, 7) for n in trail if n != "fault"], default=0)
    if clean and trail[-1] == 8:
        furthest = 8
    no_gain = sum(g and not gain for g, gain in zip(given, gains, strict=True))
    return furthest**2 - no_gain / 10 - (0 if clean else TASK.penalty)


@st.composite
def drives(draw):
    """Wandering along the course: near the next, the same or the last centre, any heading."""
    at, points = 0, [(*CENTRES[0], math.pi / 2)]
    for _ in range(draw(st.integers(1, 12))):
        at = max(at + draw(st.sampled_from([1, 1, 1, 1, 0, -1])), 0)
        x, y = CENTRES[at % 8]
        x += draw(st.floats(-0.45, 0.45))
        y += draw(st.floats(-0.3, 0.3))
        points.append((x, y, draw(st.floats(-7, 7))))
    return np.array(points)


@pytest.mark.slow
@given(drives(), st.data())
@settings(max_examples=150, deadline=None)
def test_the_kernel_agrees_with_the_obvious_way(poses, data):
    commands = len(poses) - 1
    given_ = data.draw(st.lists(st.booleans(), min_size=commands, max_size=commands))
    fast = TASK.judge(driven(poses[None], [given_]))
    assert fast.fitness[0] == pytest.approx(slow(poses, given_))
    assert fast.success[0] == (fast.fitness[0] > 60)
    assert -TASK.penalty - commands / 10 <= fast.fitness[0] <= 64


@given(st.lists(drives(), min_size=2, max_size=5))
@settings(max_examples=20, deadline=None)
def test_a_batch_is_judged_one_by_one_and_null_commands_do_not_matter(paths):
    length = max(map(len, paths))
    batch = np.stack([np.concatenate([p, np.repeat(p[-1:], length - len(p), 0)]) for p in paths])
    given_ = np.stack([np.arange(length - 1) < len(p) - 1 for p in paths])
    together = TASK.judge(driven(batch, given_)).fitness
    alone = [TASK.judge(driven(p, np.ones(len(p) - 1, bool))).fitness for p in paths]
    assert together.tolist() == alone


@given(st.floats(-1.5, 1.5), st.floats(-1, 1))
@settings(max_examples=100, deadline=None)
def test_regions_agree_with_their_centres(x, y):
    region = TASK.region([x, y, 0.0])
    columns, rows = abs(x) < 1.2 - 1e-9, abs(y) < 0.75 - 1e-9
    if abs(x) > 1.2 + 1e-9 or abs(y) > 0.75 + 1e-9:
        assert region == -2
    elif columns and rows and region >= 0:
        centre = CENTRES[int(region)]
        assert abs(x - centre[0]) < 0.4 + 1e-9
        assert abs(y - centre[1]) < 0.25 + 1e-9
    elif columns and rows:
        assert region == -1
        assert abs(x) < 0.4 + 1e-9
        assert abs(y) < 0.25 + 1e-9
