"""The domain of the rows: ranges, gaps, and the warnings about commands outside of both."""

import json

import numpy as np
import pytest
from motion_networks import random_motion_network
from synthetic_robot import random_commands

from neurosim.base.errors import FileError, UserError
from neurosim.controllers import Plan, make_controller
from neurosim.loop.evaluate import evaluate
from neurosim.simulators.base import check_commands
from neurosim.simulators.motion.domain import Domain
from neurosim.simulators.motion.files import read_motion, write_motion
from neurosim.tasks.nine_rectangles import NineRectangles

NAMES = ("left", "right", "duration")


def in_hole(commands):
    return ((commands[:, :2] > 20.0) & (commands[:, :2] < 40.0)).all(1)


def without_hole(rng, count):
    commands = random_commands(rng, 2 * count)
    return commands[~in_hole(commands)][:count]


@pytest.mark.parametrize("begins", [False, True])
@pytest.mark.parametrize(("count", "repeats"), [(30, 20), (400, 4), (5000, 1)])
def test_fresh_commands_of_the_same_kind_are_supported(count, repeats, begins):
    flagged = []
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        domain = Domain.of(NAMES, random_commands(rng, count), begins=begins)
        flagged.append(~domain.supported(random_commands(rng, 1000)))
    assert np.mean(flagged) < 0.02


@pytest.mark.parametrize("begins", [False, True])
@pytest.mark.parametrize(("count", "least"), [(400, 0.5), (5000, 1.0)])
def test_a_hole_is_told_from_gaps_between_rows(count, least, begins):
    rng = np.random.default_rng(3)
    domain = Domain.of(NAMES, without_hole(rng, count), begins=begins)
    middle = np.column_stack([rng.uniform(27, 33, (500, 2)), rng.uniform(0.5, 3.0, 500)])
    assert np.mean(~domain.supported(middle)) >= least
    around = without_hole(rng, 1000)
    assert np.mean(~domain.supported(around)) < 0.02


def test_short_commands_are_supported_where_beginnings_were_learned():
    rows = random_commands(np.random.default_rng(0), 400)
    short = np.array([[30.0, 30.0, 0.1], [0.0, 0.0, 0.05]])
    whole, begun = Domain.of(NAMES, rows), Domain.of(NAMES, rows, begins=True)
    assert not whole.supported(short).any()
    assert begun.supported(short).all()
    assert begun.ranges["duration"][0] == 0.0
    assert whole.ranges["duration"][0] == rows[:, 2].min()


def test_what_is_not_a_number_or_far_away_is_not_supported():
    domain = Domain.of(NAMES, random_commands(np.random.default_rng(0), 400))
    wrong = [[np.nan, 0, 1], [0, np.inf, 1], [-80, 0, 1], [0, 0, 9], [1e300, 0, 1]]
    assert not domain.supported(np.array(wrong)).any()
    assert domain.supported(np.tile([0.0, 0.0, 1.0], (2, 3, 1))).all()


def test_few_or_equal_commands_have_a_domain():
    one = Domain.of(("v", "duration"), np.tile([0.2, 0.1], (30, 1)))
    assert one.supported(np.array([0.2, 0.1]))
    assert not one.supported(np.array([[0.4, 0.1], [0.2, 0.2]])).any()
    assert Domain.of(("v",), np.zeros((1, 1))).supported(np.zeros(1))
    levels = np.random.default_rng(0).integers(-5, 6, (5000, 2)) * 10.0
    grid = Domain.of(("left", "right"), levels)
    assert grid.supported(levels).all()
    many = Domain.of(tuple("abcde"), np.random.default_rng(0).normal(size=(300, 5)))
    assert many.seen.size <= 2**15
    with pytest.raises(ValueError, match="at least one"):
        Domain.of(NAMES, np.zeros((0, 3)))


def with_domain(**changes):
    simulator = random_motion_network(**changes)
    simulator.known = Domain.of(NAMES, without_hole(np.random.default_rng(0), 2000))
    return simulator


def test_files_keep_it_and_older_ones_do_without(tmp_path):
    simulator = with_domain()
    write_motion(simulator, tmp_path)
    read = read_motion(tmp_path)
    commands = random_commands(np.random.default_rng(1), 500)
    assert read.knows_gaps
    assert read.domain == simulator.domain
    assert (read.supported(commands) == simulator.supported(commands)).all()
    assert "domain" not in read.meta
    path = tmp_path / "simulator.json"
    content = json.loads(path.read_text())
    assert content["domain"]["commands"]["left"] == list(simulator.domain["left"])
    for wrong in (
        [],
        {},
        {**content["domain"], "rows": 0},
        {**content["domain"], "reach": -1},
        {**content["domain"], "commands": {"left": [-1, 1]}},
        {**content["domain"], "commands": {name: [1, -1] for name in NAMES}},
    ):
        path.write_text(json.dumps({**content, "domain": wrong}))
        with pytest.raises(FileError, match="domain"):
            read_motion(tmp_path)
    del content["domain"]
    path.write_text(json.dumps(content))
    older = read_motion(tmp_path)
    assert not older.knows_gaps
    assert older.domain == {"left": (-50, 50), "right": (-50, 50), "duration": (0, 3)}
    assert older.supported(np.array([30.0, 30.0, 1.0]))
    assert not older.supported(np.array([80.0, 30.0, 1.0]))


def test_commands_outside_of_ranges_are_refused_those_in_gaps_are_not():
    simulator = with_domain()
    gap = np.array([[30.0, 30.0, 1.0]])
    check_commands(simulator, gap)
    assert not simulator.supported(gap).any()
    with pytest.raises(UserError, match="left = 80 lies outside"):
        check_commands(simulator, np.array([[80.0, 0.0, 1.0]]))
    with pytest.raises(UserError, match=r"duration = 0\.1 lies outside"):
        check_commands(simulator, np.array([[10.0, 0.0, 0.1]]))


def test_plans_keep_within_the_ranges_of_their_simulator():
    simulator = random_motion_network()
    assert make_controller("plan", simulator).max_speed == 50.0
    rows = random_commands(np.random.default_rng(0), 500) * [0.4, 0.4, 0.5]
    simulator.known = Domain.of(NAMES, rows)
    plan = make_controller("plan", simulator)
    assert plan.max_speed == pytest.approx(20.0, abs=0.5)
    assert plan.durations[0] == 0.5
    assert plan.durations[1] == pytest.approx(1.5, abs=0.05)
    assert make_controller("plan", simulator, max_speed=40.0).max_speed == 40.0


@pytest.mark.parametrize("unit", ["", "m/s"])
def test_plans_of_wheels_in_another_unit_have_the_limits_of_their_simulator(unit):
    simulator = random_motion_network()
    for one in simulator.inputs[:-1]:
        one["unit"] = unit
    rows = random_commands(np.random.default_rng(0), 500) * [0.004, 5.0, 1.0]
    simulator.known = Domain.of(NAMES, rows)
    plan = make_controller("plan", simulator)
    assert plan.units == (unit or "1",) * 2
    assert plan.limits == (simulator.domain["left"], simulator.domain["right"])
    commands, _ = plan.commands(np.random.default_rng(1).random((50, plan.genes)), 0.0)
    assert len(np.unique(commands[..., 0])) > 100  # not whole percents
    if unit:
        task = NineRectangles()
        with pytest.raises(UserError, match="gives left in %, but this simulator takes it in m/s"):
            evaluate(simulator, task, make_controller("plan"))
        evaluate(simulator, task, Plan(units=("1", "1")))  # a file that names no unit
