"""Drivers of real robots, one protocol for all: :class:`neurosim.robots.base.Robot`.

A driver from outside the package registers an entry point in the group ``neurosim.robots``:
its name is what ``--robot`` takes, its value a function that takes the options as keywords
and returns a robot that is not connected yet.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from inspect import signature

from neurosim.base.errors import RobotError, UserError
from neurosim.robots.base import Clock, Robot, SystemClock
from neurosim.robots.khepera.driver import Khepera
from neurosim.robots.nxt.driver import NXT

#: The entry points' group.
GROUP = "neurosim.robots"

_OURS: dict[str, Callable[..., Robot]] = {"khepera": Khepera, "nxt": NXT}


def robot_names() -> list[str]:
    """Return the names that :func:`robot_factory` knows, in the order of the alphabet."""
    return sorted({*_OURS, *_registered()})


def robot_factory(name: str) -> Callable[..., Robot]:
    """Return the function that makes a robot of this name from options given as keywords.

    Raises:
        UserError: if no driver has this name.
        RobotError: if its package cannot be imported.
    """
    if name in _OURS:
        return _OURS[name]
    point = _registered().get(name)
    if point is None:
        raise UserError(f"no driver for a robot {name!r}; there are {', '.join(robot_names())}")
    try:
        return point.load()
    except Exception as error:
        raise RobotError(f"the driver of {name!r} ({point.value}) does not load: {error}") from None


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


def _registered() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


__all__ = [
    "Clock",
    "Robot",
    "SystemClock",
    "Khepera",
    "NXT",
    "GROUP",
    "robot_names",
    "robot_factory",
    "open_robot",
]
