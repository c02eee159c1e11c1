"""Drivers by name, ours and those of other packages."""

from importlib.metadata import EntryPoint

import pytest
from brick_body import Body, LabClock

from neurosim import robots
from neurosim.base.errors import RobotError, UserError
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.lab.nxt.serve import Radio, SocketServer


class Turtle:
    def __init__(self, speed=1):
        self.speed, self.connected = speed, False

    def connect(self):
        self.connected = True


@pytest.fixture
def others(monkeypatch):
    points = [
        EntryPoint("turtle", f"{__name__}:Turtle", robots.GROUP),
        EntryPoint("broken", "no_such_package.robot:Robot", robots.GROUP),
    ]
    monkeypatch.setattr(robots, "entry_points", lambda group: points)


def test_names(others):
    assert robots.robot_names() == ["broken", "khepera", "nxt", "turtle"]


def test_a_driver_of_another_package(others):
    robot = robots.open_robot("turtle", speed=3)
    assert (type(robot).__name__, robot.speed, robot.connected) == ("Turtle", 3, True)


def test_ours():
    assert robots.robot_factory("nxt") is robots.NXT
    clock = LabClock()
    with SocketServer(Radio(VirtualBrick(Body()), clock, jitter=0.0)) as server:
        robot = robots.open_robot("nxt", server_port=server.address[1], clock=clock)
        assert robot.battery() == 7.9
        robot.close()


def test_what_can_be_wrong(others):
    with pytest.raises(UserError, match="no driver for a robot 'roomba'; there are broken"):
        robots.robot_factory("roomba")
    with pytest.raises(RobotError, match=r"'broken' \(no_such_package.robot:Robot\)"):
        robots.robot_factory("broken")
    with pytest.raises(UserError, match="'turtle' does not take these options"):
        robots.open_robot("turtle", wings=2)
