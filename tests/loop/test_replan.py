"""Plans that are replanned after every command, and rollouts of robots that are moving."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from given_plans import EPISODE, GivenPlans
from ideal_simulator import IdealWheels, SlippingWheels
from motion_networks import random_motion_network
from simulators_of_tests import tables

from neurosim.base import se2
from neurosim.base.trajectory import Draws
from neurosim.controllers import Plan
from neurosim.loop.replan import Replanner, ReplanSettings
from neurosim.loop.stepped import SteppedRollouts
from neurosim.simulators.motion.excess import Excess
from neurosim.simulators.tables.reaction import Reaction
from neurosim.tasks.base import Interval, Records
from neurosim.tasks.go_to import GoTo
from neurosim.tasks.nine_rectangles import NineRectangles

TASK = GoTo(goals=((0.6, 0.2, 0.5),), tolerance=0.02, heading_tolerance=math.radians(3.0))
FAMILY = Plan(slots=5)
FADES = Excess(torch.full((3,), 0.5), torch.eye(3), torch.full((3,), 1e-3), torch.tensor([0.1]))
QUICK = ReplanSettings(generations=25, draws=8)


def simulators():
    """Return simulators by name, with compiled rollouts of plans."""
    form = {"members": 3, "units": 0, "size": 0.2}
    return {
        "drive model": random_motion_network(**form),
        "drive model, seen to slip": random_motion_network(excess=FADES, **form),
        "drive model, no noise": random_motion_network(noise=False, **form),
        "displacements": random_motion_network(drives=False, **form),
        "tables": replace(tables(), reaction=Reaction(answer=0.1, lag=(0.2, 0.3))),
    }


@pytest.mark.parametrize("name", simulators())
def test_a_robot_that_is_under_way_goes_on_from_there(name):
    sim = simulators()[name]
    rng = np.random.default_rng(0)
    fastest = 0.2 * sim.domain["left"][1]
    commands = rng.uniform((-fastest, -fastest, 0.5), (fastest, fastest, 2), (5, 4, 3))
    family = GivenPlans(commands, rng.random((5, 4)) < 0.8)
    moving = sim.step(sim.start(torch.zeros(1, 3)), torch.tensor([[fastest, -0.7 * fastest, 0.2]]))
    compiled, stepped = sim.rollouts(family, EPISODE), SteppedRollouts(sim, family, EPISODE)
    starts = 0.1 + rng.uniform(0.0, 0.05, (6, 3))
    if getattr(sim, "excess", None) is not None:
        slips = torch.tensor([[0.02, -0.03, 0.05]], dtype=torch.float64)
        moving = sim.seen(moving, sim.start(torch.zeros(1, 3)), slips, 0.2)
    standing = compiled.draw(starts, 3)
    for draws in (standing, Draws(starts)):
        under_way = replace(draws, state=moving[0].numpy())
        rolled_out = compiled.run(family.rows, under_way).poses
        np.testing.assert_allclose(rolled_out, stepped.run(family.rows, under_way).poses, atol=1e-6)
        # The earlier drive changes the path, but not where it begins.
        assert np.abs(rolled_out[:, :, 0] - starts).max() == 0.0
        assert np.abs(rolled_out - compiled.run(family.rows, draws).poses).max() > 1e-3


class Driven:
    """A robot on ideal wheels that slip by a few percent, seen exactly."""

    def __init__(self, seed, start=(0.0, 0.0, 0.0)):
        self.sim, self.generator = SlippingWheels(), torch.Generator().manual_seed(seed)
        self.state = self.sim.start(torch.tensor([start], dtype=torch.float64))

    @property
    def pose(self):
        return self.state[0, :3].numpy()

    def drive(self, command):
        given = torch.tensor([command], dtype=torch.float64)
        self.state = self.sim.step(self.state, given, self.generator)


def go(seed, push=(0.0, 0.0), commands=()):
    """Return the judgement of a drive with a push after the first command, and the replanner."""
    robot = Driven(seed)
    replanner = Replanner(SlippingWheels(), TASK, FAMILY, commands, QUICK, seed=seed)
    poses, given = [robot.pose], []
    for _ in range(replanner.steps):
        command = replanner.next(robot.pose)
        if command is None:
            break
        robot.drive(command)
        if not given:
            robot.state[0, :2] += torch.tensor(push)
        given.append(command)
        poses.append(robot.pose)
    away, turned = np.array(poses[-1]) - TASK.goals[0], poses[-1][2] - TASK.goals[0][2]
    off = abs(math.remainder(turned, 2 * math.pi))
    return math.hypot(*away[:2]), off, replanner, given


@pytest.mark.parametrize("push", [(0.0, 0.0), (-0.06, 0.08)])
@pytest.mark.slow
def test_a_robot_arrives_though_it_slips_and_is_pushed(push):
    there = [go(seed, push) for seed in range(2, 5)]
    assert all(away < 0.02 and off < math.radians(3.0) for away, off, *_ in there)
    replanner, given = there[0][2:]
    assert len(replanner.foreseen) == len(given) <= replanner.steps == 15
    # The last command is a stop, to look again; nothing moves the robot from its goal any more.
    assert given[-1] == (0.0, 0.0, QUICK.settle)
    again = go(2, push)[3]
    assert again == given


def test_a_robot_at_its_goal_stays_there():
    replanner = Replanner(SlippingWheels(), TASK, FAMILY, settings=QUICK)
    assert replanner.next(np.array(TASK.goals[0])) is None
    assert replanner.foreseen == []


def test_a_robot_that_may_be_outside_the_tolerance_moves_on():
    # Measured 0.1 degrees inside it, with an error of 0.5; this simulator itself has no errors.
    replanner = Replanner(IdealWheels(), TASK, FAMILY, settings=QUICK)
    pose = np.array(TASK.goals[0]) - (0.0, 0.0, math.radians(2.9))
    left, right, duration = replanner.next(pose)
    assert (right - left) * duration > 0.0
    assert replanner.foreseen[0].probability > 0.9


def test_what_was_seen_on_the_way_is_led_on_to_where_the_command_ends():
    replanner = Replanner(IdealWheels(), TASK, FAMILY, settings=QUICK)
    left, right, seconds = replanner.next(np.zeros(3))
    twist = np.array([(left + right) / 400, 0.0, (right - left) / 26])
    assert np.abs(twist).max() > 0.1
    # Not at the expected position, 0.2 s before the end, and with some whole turns added.
    seen = np.array([0.4, -0.3, 1.0])
    replanner.next(seen + np.array([0.0, 0.0, 4 * math.pi]), 0.2)
    wanted, result = se2.compose(seen, se2.exp(0.2 * twist)), np.array(replanner.foreseen[-1].pose)
    assert result[:2] == pytest.approx(wanted[:2])
    assert math.remainder(result[2] - wanted[2], 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    # Its heading continues from the one before: it never jumps by a whole turn.
    assert abs(result[2] - seconds * twist[2]) < math.pi


def test_a_simulated_drive_is_exact_where_nothing_is_uncertain():
    exact = ReplanSettings(generations=2, draws=4, placing=(0.0, 0.0))
    replanner = Replanner(IdealWheels(), TASK, Plan(slots=2), settings=exact)
    judged, driven = replanner.simulate((0.05, 0.0, 0.1))
    foreseen = replanner.foreseen
    np.testing.assert_allclose(driven.poses[:-2], [one.pose for one in foreseen], atol=1e-9)
    np.testing.assert_allclose(driven.poses[1:-1], [one.after for one in foreseen], atol=1e-9)
    assert driven.active.tolist() == [True] * len(foreseen) + [False]
    assert driven.commands[-1].tolist() == [0.0, 0.0, 0.5]
    x, y, _ = driven.poses[-1] - TASK.goals[0]
    assert judged.detail["distance"] == pytest.approx(math.hypot(x, y))
    # The next drive begins from the start.
    np.testing.assert_array_equal(replanner.simulate((0.05, 0.0, 0.1))[1].poses, driven.poses)


def test_simulated_drives_are_random_samples():
    few = ReplanSettings(generations=1, draws=2, placing=(0.0, 0.0), most=1)
    replanner = Replanner(SlippingWheels(), TASK, Plan(slots=2), settings=few)
    driven = [replanner.simulate(np.zeros(3), seed)[1] for seed in (1, 2, 1)]
    # The first command is the same in all, and the wheels slip by 3 %.
    assert len({tuple(each.commands[0]) for each in driven}) == 1
    first = [np.linalg.norm(each.poses[1] - driven[0].poses[1]) for each in driven]
    assert first[1] > 1e-4
    assert first[2] == 0.0
    assert all(len(each.commands) <= replanner.steps + 1 == 3 for each in driven)


class Clock:
    """Every look at it takes 0.1 s."""

    def __init__(self):
        self.time = 5.0

    def now(self):
        self.time += 0.1
        return self.time

    def sleep_until(self, time):
        self.time = max(self.time, time)


def test_a_search_ends_in_time_or_lasts_it_out():
    clock = Clock()
    slow = replace(QUICK, generations=1000, think=0.55)
    replanner = Replanner(SlippingWheels(), TASK, FAMILY, settings=slow, clock=clock)
    replanner.next(np.zeros(3))
    assert replanner.foreseen[0].generations == 6
    assert clock.time < 6.1
    before = clock.time
    quick = replace(QUICK, generations=1, think=3.0)
    Replanner(SlippingWheels(), TASK, FAMILY, settings=quick, clock=clock).next(np.zeros(3))
    assert clock.time == pytest.approx(before + 0.1 + 3.0)


def test_a_spin_is_judged_by_its_way_not_by_the_arc_between_its_ends():
    """After a turn by 6.46 rad on the spot, 2 cm aside, the drive of a course goes on."""
    task, turned = NineRectangles(), -6.46
    replanner = Replanner(IdealWheels(), task, Plan(slots=3), settings=QUICK)
    poses = np.array([task.start, (-0.8, 0.5, 1.2), (0.1, 0.36, 0.3), (0.12, 0.36, 0.3 + turned)])
    middles = ((poses[1:] + poses[:-1]) / 2)[:, None]
    commands = np.array([[30.0, 30.0, 2.0], [30.0, 30.0, 2.0], [20.0, -20.0, 2.5]])
    along_arcs = Records(task, poses[:1])
    for pose in poses[1:, None]:
        along_arcs.add(Interval(pose, 2.0))
    assert along_arcs.over().all()  # a circle of 26 cm, into the forbidden rectangle
    replanner.begin()
    replanner._onward.here(np.zeros(3), list(poses), list(middles), commands)
    assert not replanner._onward._earlier.over().any()
    middles[2, 0, 1] = 0.1  # it really was there
    replanner._onward.here(np.zeros(3), list(poses), list(middles), commands)
    assert replanner._onward._earlier.over().all()


def test_a_goal_beside_a_curve_is_not_passed():
    """A curve that leads around a goal, and ends where it was seen, 2 cm aside."""
    command, twist = (10.0, 30.0, 3.0), 3.0 * np.array([40 / 400, 0.0, 20 / 26])
    start, off = np.zeros(3), np.array([0.0, 0.02, 0.0])
    seen = se2.exp(twist) + off
    for inside, passed in ((0.5, 0), (0.95, 1)):
        middle = se2.exp(twist / 2)[:2]
        x, y = inside * middle + (1.0 - inside) * seen[:2] / 2
        task = GoTo(goals=((x, y, 0.0), (1.0, 0.5, 0.0)), within=0.03)
        replanner = Replanner(IdealWheels(), task, Plan(slots=2), settings=QUICK)
        replanner.begin()
        replanner._arrive(start, 0.0)
        replanner._commands[:] = [command]
        replanner._arrive(seen, 0.0)
        (amid,) = replanner._amid
        assert len(amid) == 11
        # As simulated, and moved aside in proportion to the time.
        for place in (3, 8):
            part = (place + 1) / 12
            wanted = se2.exp(twist * part) + part * off
            assert amid[place] == pytest.approx(wanted, abs=1e-6)
        assert replanner._poses[-1] == pytest.approx(seen)
        replanner._onward.here(seen, replanner._poses, replanner._amid, np.array([command]))
        assert replanner._onward._earlier.own[0, 4] == passed
