"""The virtual Khepera's motion, contact and light against hand-worked numbers."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base.errors import UserError
from neurosim.base.place import THICKNESS, Place, paper_arena
from neurosim.lab import KheperaParams
from neurosim.lab.khepera import physics
from neurosim.lab.khepera.body import KheperaBody, KheperaLab
from neurosim.lab.khepera.params import RADIUS, WHEEL_BASE, WHITE

EMPTY = Place()
IDEAL = KheperaParams.ideal()
LAG = 0.04
#: Its surface is at x = 0.
FAR_WALL = ((THICKNESS / 2, -1.0, THICKNESS / 2, 1.0),)


def body(params=IDEAL, place=EMPTY, pose=(0.0, 0.0, 0.0), seed=0):
    return KheperaBody(params, place, seed, pose)


def light(arena, pose, angle=0.0):
    return physics.reflected(np.array(pose, float), angle, arena.surfaces, arena.cylinders)


def read(params, arena, pose, drift=0.0):
    return physics.proximity(
        np.array(pose, float),
        params.angle,
        params.reach,
        params.threshold,
        params.offset,
        (0.0, 0.0),
        drift,
        arena.surfaces,
        arena.cylinders,
        WHITE,
        np.random.default_rng(0),
    )


def test_straight_on_it_goes_its_speed_less_the_lag():
    robot = body()
    robot.set_speeds(10, 10)
    robot.advance(2.0)
    np.testing.assert_allclose(robot.pose, [0.1 * (2.0 - LAG), 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(robot.counts(), 1960, atol=1)
    assert robot.speeds() == (10, 10)


def test_wheels_against_each_other_turn_it_on_the_spot():
    robot = body()
    robot.set_speeds(-5, 5)
    robot.advance(3.0)
    turned = 0.1 * (3.0 - LAG) / WHEEL_BASE
    np.testing.assert_allclose(robot.pose, [0.0, 0.0, turned], atol=1e-9)
    left, right = robot.counts()
    assert right == pytest.approx(1480, abs=1)
    assert left == pytest.approx(-1480, abs=1)


def test_a_slower_left_wheel_makes_an_arc_to_the_left():
    robot = body()
    robot.set_speeds(5, 10)
    robot.advance(20.0)
    # After the lag it is a circle of 1.5 wheel bases around a point to its left.
    x, y, theta = robot.pose
    radius = 1.5 * WHEEL_BASE
    np.testing.assert_allclose(theta, 0.05 * (20.0 - LAG) / WHEEL_BASE, rtol=1e-9)
    np.testing.assert_allclose(math.hypot(x, y - radius), radius, rtol=1e-3)


def test_gain_dead_band_and_wheel():
    params = KheperaParams.ideal(
        gain=np.array([1.1, 1.0]), dead_band=np.array([0.0, 0.012]), wheel=np.array([1.0, 2.0])
    )
    robot = body(params)
    robot.set_speeds(10, 1)
    robot.advance(1.0 + LAG)
    left, right = robot.counts()
    assert left == pytest.approx(1100, abs=1)
    assert right == 0
    robot.set_speeds(0, 10)
    robot.advance(9.0)
    robot.set_counts(0, 0)
    x, y, _ = robot.pose
    robot.advance(10.0)
    np.testing.assert_allclose(robot.counts(), (0, 880), atol=1)
    # One wheel stands; the other travels twice its nominal distance around it.
    assert 2 * 0.088 > math.dist(robot.pose[:2], (x, y)) > 0.0


def test_pieces_of_time_do_not_matter():
    params = KheperaParams.sampled(3)
    one, many = body(params), body(params)
    for robot in (one, many):
        robot.set_speeds(7, 9)
    one.advance(1.0)
    for time in np.linspace(0.0, 1.0, 137):
        many.advance(float(time))
    np.testing.assert_array_equal(one.pose, many.pose)


def test_positions_are_reached_and_held():
    robot = body(KheperaParams.sampled(2))
    robot.set_positions(1000, 500, (20, 20))
    robot.advance(6.0)
    np.testing.assert_allclose(robot.counts(), (1000, 500), atol=3)


def test_slip_has_its_spread():
    params = KheperaParams.ideal(slip=0.02)
    distances = []
    for seed in range(200):
        robot = body(params, seed=seed)
        robot.set_speeds(10, 10)
        robot.advance(4.0)
        distances.append(robot.pose[0])
    # A mean over T of a process with correlation time t has the variance 2 t / T of its own;
    # that of the robot is half a wheel's.
    assert np.std(distances) / 0.4 == pytest.approx(0.02 * math.sqrt(0.3 / 4.0), rel=0.2)


def test_against_a_wall_the_encoders_count_on():
    arena = Place(walls=((0.105, -1.0, 0.105, 1.0),))
    robot = body(place=arena)
    robot.set_speeds(10, 10)
    robot.advance(5.0)
    np.testing.assert_allclose(robot.pose, [0.1 - RADIUS, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(robot.counts(), 4960, atol=1)
    assert robot.state[physics.S.TOUCHES] > 1000


def test_along_a_wall_it_slides_and_friction_holds_it_back():
    distances = {}
    for friction in (0.0, 0.3):
        arena = Place(walls=((-5.0, 0.055, 5.0, 0.055),))
        robot = body(KheperaParams.ideal(friction=friction), arena, (0.0, 0.0, math.pi / 4))
        robot.set_speeds(10, 10)
        robot.advance(3.0)
        x, y, _ = robot.pose
        assert y == pytest.approx(0.05 - RADIUS, abs=1e-6)
        distances[friction] = x
    along = 0.1 * (3.0 - LAG) / math.sqrt(2.0)
    assert distances[0.0] == pytest.approx(along, rel=1e-3)
    assert distances[0.3] < 0.8 * along


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 1000),
    st.lists(st.tuples(st.integers(-127, 127), st.integers(-127, 127)), min_size=1, max_size=8),
)
def test_it_never_stands_in_anything(seed, commands):
    arena = paper_arena()
    robot = body(KheperaParams.sampled(seed), arena, (-0.22, 0.0, 0.3), seed)
    for index, (left, right) in enumerate(commands):
        robot.set_speeds(left, right)
        for part in range(10):
            robot.advance(0.5 * index + 0.05 * (part + 1))
            assert robot.depth(*robot.pose[:2]) <= 2e-9
            assert abs(robot.pose[0]) < 0.3
            assert abs(robot.pose[1]) < 0.175


def test_light_falls_with_the_square_of_the_way():
    wall = Place(walls=FAR_WALL)
    near = light(wall, (-0.05 - RADIUS + physics.DEPTH, 0.0, 0.0))
    far = light(wall, (-0.10 - RADIUS + physics.DEPTH, 0.0, 0.0))
    assert near / far == pytest.approx(4.0, rel=1e-6)


def test_light_of_a_wall_by_a_fine_sum():
    # cos^4 weights; a ray at angle a goes d / cos a and meets the wall at cos a.
    a = np.linspace(-physics.HALF_CONE, physics.HALF_CONE, 20001)
    weight = np.cos(a) ** 4
    expected = (weight * np.cos(a) * np.cos(a) ** 2 / 0.05**2).sum() / weight.sum()
    result = light(Place(walls=FAR_WALL), (-0.05 - RADIUS + physics.DEPTH, 0.0, 0.0))
    assert result == pytest.approx(expected, rel=0.01)


def test_a_round_obstacle_gives_less_than_a_wall_and_what_is_behind_does_not_count():
    pose = (-0.02 - RADIUS, 0.0, 0.0)
    wall = Place(walls=FAR_WALL)
    round_one = Place(obstacles=((0.0275, 0.0, 0.0275),))
    assert 0.3 < light(round_one, pose) / light(wall, pose) < 0.95
    both = Place(walls=((0.01, -1.0, 0.01, 1.0), (0.03, -1.0, 0.03, 1.0)))
    assert light(both, pose) == light(Place(walls=both.walls[:1]), pose)
    assert light(wall, pose, math.pi) == 0.0


def test_before_their_gains_left_and_right_sensors_are_alike():
    arena = Place((), FAR_WALL, ((-0.03, 0.06, 0.02), (-0.03, -0.06, 0.02)))
    values = read(IDEAL, arena, (-0.05, 0.0, 0.0))
    np.testing.assert_array_equal(values[:6], values[:6][::-1])
    assert values[6] == values[7]
    assert values[2] > values[1] > 0


def test_readings_have_the_range_and_reach_of_a_khepera():
    wall = Place(walls=FAR_WALL)
    front = [read(IDEAL, wall, (-RADIUS - d / 1000, 0.0, 0.0))[2] for d in (5, 15, 20, 30, 45)]
    assert front[0] >= 1020
    assert front[1] > 950
    assert 1000 > front[2] > 600
    assert 200 > front[3] > 20
    assert front[4] == 0


def test_a_lab_in_the_light_reads_less():
    pose = (-RADIUS - 0.022, 0.0, 0.0)
    assert (
        read(IDEAL, Place(walls=FAR_WALL), pose, drift=20.0)[2]
        < read(IDEAL, Place(walls=FAR_WALL), pose)[2]
    )


def test_robots_differ_and_the_same_number_is_the_same_robot():
    pose, arena = (-0.05, 0.0, 0.0), Place(walls=FAR_WALL)
    one, again, other = (read(KheperaParams.sampled(seed), arena, pose) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()


def test_noise_is_within_ten_bits_and_centred():
    robot = body(KheperaParams.sampled(1), Place(walls=FAR_WALL), (-RADIUS - 0.022, 0.0, 0.0))
    values = np.array([robot.proximity() for _ in range(2000)])
    assert values.min() >= 0
    assert values.max() <= 1023
    assert 2.0 < values[:, 0].std() < 60.0
    assert values[:, 2].std() > 5.0


def test_sensors_show_where_the_robot_was_at_the_last_scan():
    robot = body(place=Place(walls=FAR_WALL), pose=(-0.2, 0.0, 0.0))
    robot.set_speeds(100, 100)
    robot.advance(0.159)
    # The scan before was at 0.140 s.
    expected = -0.2 + 1.0 * (0.140 - LAG * (1 - math.exp(-0.140 / LAG)))
    np.testing.assert_array_equal(
        robot.proximity(), read(IDEAL, Place(walls=FAR_WALL), (expected, 0.0, 0.0))
    )


def test_ambient_light_drifts_within_its_spread():
    robot = body(KheperaParams.ideal(drift=8.0, drift_time=2.0))
    values = []
    for time in range(1, 2000):
        robot.advance(float(time))
        values.append(robot.ambient()[0])
    assert np.mean(values) == pytest.approx(480.0, abs=1.5)
    assert np.std(values) == pytest.approx(8.0, rel=0.15)


def test_lights_of_a_place_by_hand():
    """Sensor 2 looks at the light; sensors 6 and 7 look backwards."""
    turn = IDEAL.angle[2]
    far = 0.24  # twice the distance that halves a reading
    lamp = ((RADIUS + far) * math.cos(turn), (RADIUS + far) * math.sin(turn))
    read = body(place=Place(lights=(lamp,))).ambient()
    assert read[2] == round(480 / (1 + 0.25)) == 384
    assert read[6:] == [480, 480]
    assert read[2] < min(read[0], read[1], read[3], read[4], read[5])
    assert body(place=Place(lights=(lamp, lamp))).ambient()[2] == 320
    # The same from another pose, and nothing in the shadow of a wall.
    x, y = lamp
    turned = body(place=Place(lights=((-y, x),)), pose=(0.0, 0.0, math.pi / 2))
    assert turned.ambient() == read
    wall = (0.1, -0.3, 0.1, 0.3)
    assert body(place=Place(walls=(wall,), lights=(lamp,))).ambient() == [480] * 8


def test_a_robot_is_put_down_only_where_there_is_room():
    lab = KheperaLab(IDEAL, paper_arena(), start=(-0.22, 0.0, 0.0))
    with pytest.raises(UserError, match=r"x 0.0 cm, y 0.0 cm.*obstacle"):
        lab.place(0.0, 0.0, 0.0)
    lab.place(-0.271, 0.0, 1.0)
    assert lab.pose.tolist() == [-0.271, 0.0, 1.0]


def test_a_wall_inside_an_arena_is_a_board():
    room = Place.rectangle(1.0, 1.0)
    with_board = replace(room, walls=((0.0, -0.2, 0.0, 0.2),))
    assert (with_board.surfaces[:4] == room.surfaces).all()
    corners = with_board.surfaces[4:, :2]
    assert sorted(map(tuple, corners.round(9))) == [
        (-0.005, -0.2), (-0.005, 0.2), (0.005, -0.2), (0.005, 0.2),
    ]  # fmt: skip
    # A sensor that faces its end sees it; a wall without thickness has no end to see.
    before_its_end = (0.0001, 0.25, -math.pi / 2)
    thin, nothing = np.array([[0.0, -0.2, 0.0, 0.2]]), np.empty((0, 3))
    assert physics.reflected(np.array(before_its_end), 0.0, thin, nothing) < 0.001
    assert light(with_board, before_its_end) > 0.01
