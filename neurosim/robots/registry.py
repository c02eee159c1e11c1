"""Drivers of robots by name: neurosim's own, those of other packages, and a script's."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature

from neurosim.base.errors import UserError
from neurosim.base.registry import Registry
from neurosim.robots.base import Robot

#: Functions by their name for ``--robot``, which take the options as keywords and return a robot
#: that is not connected yet.
ROBOTS = Registry(
    "robot",
    "neurosim.robots",
    {
        "nxt": "neurosim.robots.nxt.driver:NXT",
        "khepera": "neurosim.robots.khepera.driver:Khepera",
        "lines": "neurosim.robots.lines.driver:Lines",
        "thymio": "neurosim.robots.thymio.driver:Thymio",
        "ros": "neurosim.robots.ros.driver:Ros",
    },
)


def robot_factory(name: str) -> Callable[..., Robot]:
    """Return the function that makes a robot of this name from keyword options.

    Raises:
        UserError: if no driver has this name, or its package cannot be imported.
    """
    return ROBOTS.get(name)


def open_robot(name: str, **options: object) -> Robot:
    """Make a robot by its driver's name and options, and connect it.

    Raises:
        UserError: for an unknown name or an option that its driver does not have.
        RobotError: if it cannot be reached.
    """
    factory = robot_factory(name)
    try:
        signature(factory).bind(**options)
    except TypeError as error:
        raise UserError(f"robot {name!r} does not take these options: {error}") from None
    robot = factory(**options)
    robot.connect()
    return robot
