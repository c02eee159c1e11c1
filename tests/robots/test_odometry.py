"""Dead reckoning over a line that changes digits, by the real driver."""

import pytest

from neurosim.base.errors import RobotError
from neurosim.lab import VirtualKheperaRig
from neurosim.robots.odometry import Odometry


@pytest.fixture
def rig():
    with VirtualKheperaRig(0) as rig, rig.robot:
        yield rig


def spoiled(robot, wrong):
    """Make the next answers of the counters wrong by these numbers of pulses."""
    plain, wrong = robot.read_counts, list(wrong)

    def read():
        left, right = plain()
        return left + (wrong.pop(0) if wrong else 0), right

    robot.read_counts = read


def test_counters_that_jump_are_garbage_and_no_motion(rig):
    robot, clock = rig.robot, rig.robot.clock
    odometry = Odometry(robot, (0.0, 0.0, 0.0))
    robot.set_speeds(5, 5)
    clock.sleep_until(clock.now() + 0.05)
    odometry.read()
    spoiled(robot, [100, -1000])
    x, _, theta = odometry.read()
    assert theta == pytest.approx(0.0, abs=0.02)
    assert 0.0 < x < 0.02


def test_a_robot_that_drives_at_full_speed_is_believed(rig):
    robot, clock = rig.robot, rig.robot.clock
    odometry = Odometry(robot, (0.0, 0.0, 0.0))
    robot.set_speeds(robot.full_speed, robot.full_speed)
    for pause in (0.01, 0.02, 0.05, 0.1, 1.0):
        clock.sleep_until(clock.now() + pause)
        odometry.read()
    assert 0.05 < odometry.pose[0] < 0.2


def test_counters_that_stay_wrong_are_said_to_be(rig):
    odometry = Odometry(rig.robot, (0.0, 0.0, 0.0))
    spoiled(rig.robot, [5000] * 9)
    with pytest.raises(RobotError, match="5000 pulses of a wheel, more than it can drive"):
        odometry.read()
