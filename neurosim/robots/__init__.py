"""Drivers of real robots, by their abilities; see :mod:`neurosim.robots.base`."""

from __future__ import annotations

from neurosim.robots.base import Battery, Clock, Counters, Lamp, Robot, Sensors, SystemClock
from neurosim.robots.registry import ROBOTS, open_robot, robot_factory

__all__ = [
    "Battery",
    "Clock",
    "Counters",
    "Lamp",
    "ROBOTS",
    "Robot",
    "Sensors",
    "SystemClock",
    "open_robot",
    "robot_factory",
]
