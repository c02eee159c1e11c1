"""Drivers by name, ours and those of other packages."""

from importlib.metadata import EntryPoint

import pytest
from brick_body import Body, LabClock

from neurosim.base import registry
from neurosim.base.errors import UserError
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.lab.nxt.serve import Radio, SocketServer
from neurosim.robots import ROBOTS, open_robot, robot_factory
from neurosim.robots.khepera.driver import Khepera
from neurosim.robots.nxt.driver import NXT


class Turtle:
    def __init__(self, speed=1):
        self.speed, self.connected = speed, False

    def connect(self):
        self.connected = True


@pytest.fixture
def others(monkeypatch):
    points = [
        EntryPoint("turtle", f"{__name__}:Turtle", ROBOTS.group),
        EntryPoint("broken", "no_such_package.robot:Robot", ROBOTS.group),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)


def test_names(others):
    assert ROBOTS.names() == ["nxt", "khepera", "lines", "thymio", "ros", "broken", "turtle"]


def test_a_driver_of_another_package(others):
    robot = open_robot("turtle", speed=3)
    assert (type(robot).__name__, robot.speed, robot.connected) == ("Turtle", 3, True)


def test_a_driver_of_a_script(monkeypatch):
    monkeypatch.setattr(ROBOTS, "_registered", {})
    ROBOTS.register("mine", Turtle)
    assert open_robot("mine", speed=2).speed == 2
    with pytest.raises(UserError, match="taken by neurosim's own robot"):
        ROBOTS.register("nxt", Turtle)


def test_ours():
    assert robot_factory("nxt") is NXT
    assert robot_factory("khepera") is Khepera
    clock = LabClock()
    with SocketServer(Radio(VirtualBrick(Body()), clock, jitter=0.0)) as server:
        robot = open_robot("nxt", server_port=server.address[1], clock=clock)
        assert robot.battery() == 7.9
        robot.close()


def test_what_can_be_wrong(others):
    with pytest.raises(
        UserError,
        match="no robot 'roomba'; choose from nxt, khepera, lines, thymio, r",
    ):
        robot_factory("roomba")
    with pytest.raises(UserError, match=r"'broken' \(no_such_package.robot:Robot\)"):
        robot_factory("broken")
    with pytest.raises(UserError, match="'turtle' does not take these options"):
        open_robot("turtle", wings=2)
