"""Abilities of robots, each as a protocol, and a robot's clock.

A driver is one file. It follows :class:`Robot` and as many of the capabilities as its robot has;
code asks for an ability, ``isinstance(robot, Lamp)``, never for a driver. A driver from
another package is added by an entry point in the group ``neurosim.robots``: its name is what
``--robot`` takes, its value a function that takes the options as keywords and returns a robot that
is not connected yet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from neurosim.base.commands import Commands

#: An NXT's light sensors are so far ahead of the axle and to either side of its middle, m, unless
#: its driver is given other places.
LIGHT_AHEAD, LIGHT_ASIDE = 0.06, 0.09


class Clock(Protocol):
    """Seconds since some beginning; the virtual lab's runs as fast as it is asked to."""

    def now(self) -> float:
        """Return the time in seconds; it never goes backwards."""
        ...

    def sleep_until(self, time: float) -> None:
        """Return when :meth:`now` is at least ``time``; at once if it is already."""
        ...


class SystemClock:
    """This computer's monotonic clock, zero when it is made."""

    def __init__(self) -> None:
        self._zero = time.perf_counter()

    def now(self) -> float:
        """Return seconds since this clock was made."""
        return time.perf_counter() - self._zero

    def sleep_until(self, time_: float) -> None:
        """Sleep in slices short enough that Ctrl-C is answered at once."""
        while (left := time_ - self.now()) > 0:
            time.sleep(min(left, 0.05))


@runtime_checkable
class Robot(Protocol):
    """A robot that takes commands; all else is a capability.

    Drivers raise :class:`neurosim.base.errors.RobotError` for whatever a user can put right
    (nothing on the port, the wrong thing on it) and
    :class:`neurosim.base.errors.LinkLost` once a robot that was there stops answering.
    Used as a context manager, a robot is connected inside and its motors are stopped and the
    line closed on the way out, whatever happened.
    """

    clock: Clock

    def connect(self) -> None:
        """Open the line and make sure that the expected robot answers."""
        ...

    def close(self) -> None:
        """Stop the motors if the line still stands, and close it. Never raises."""
        ...

    @property
    def commands(self) -> Commands:
        """The numbers of the robot's command; known once it is connected, at the latest."""
        ...

    def drive(self, command: Sequence[float]) -> None:
        """Set all numbers of a command, in the robot's units; they hold until the next.

        Returns when the robot has acknowledged it. Motors go straight from one speed into the
        next, with speed regulation where the robot has it.
        """
        ...

    def stop(self) -> None:
        """Stop, actively braked where the robot can."""
        ...

    def describe(self) -> dict[str, Any]:
        """Describe this robot for a recording: its kind, name, ports, versions.

        ``kind`` is what ``--robot`` takes. It has the meaning of a command (ports, dialect, full
        speed), so that recordings of different robots differ. Ready for JSON. ``virtual``, once
        connected, says whether the robot is one of the virtual lab, as far as the robot itself
        tells.
        """
        ...

    def __enter__(self) -> Robot: ...

    def __exit__(self, *error: object) -> None: ...


@runtime_checkable
class Lamp(Protocol):
    """Has a lamp that a camera sees; its flashes join the camera's clock and the robot's.

    A driver that may or may not have one gives the attribute to those robots that do.
    """

    @property
    def lamp(self) -> Callable[[bool], None]:
        """Switch the lamp: ``robot.lamp(True)``."""
        ...


@runtime_checkable
class Battery(Protocol):
    """Knows the voltage of its battery."""

    def battery(self) -> float:
        """Return the battery's voltage in volts."""
        ...


@runtime_checkable
class Sensors(Protocol):
    """Has sensors that a controller may read.

    Attributes:
        sensor_names: as simulators and controllers name them: ``line_left``, ``line_right`` for
            light reflected by the ground, ``sensor_0``, ``sensor_1``, ... for a ring of proximity
            sensors.
    """

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Return the names; see the class."""
        ...

    def read_sensors(self) -> dict[str, float]:
        """Read all sensors, by name in the order of ``sensor_names``, each in 0..1."""
        ...


@runtime_checkable
class SelfStopping(Protocol):
    """Stops by itself some time after a command, if no other follows.

    Nothing on the computer can stop a robot once its program was killed, the computer sleeps or
    the line is cut; a robot that has this does it alone.
    """

    def drive_for(self, command: Sequence[float], seconds: float) -> None:
        """Set a command as ``drive`` does; it is to last so long (s).

        It holds for at least that long; how much longer, without another command, the driver says.
        """
        ...


def drive_for(robot: Robot, command: Sequence[float], seconds: float) -> None:
    """Set a command that is to last ``seconds``.

    A robot that can stops by itself some time later, if no other command comes; the others go on.
    """
    if isinstance(robot, SelfStopping):
        robot.drive_for(command, seconds)
    else:
        robot.drive(command)


@dataclass(frozen=True)
class Geometry:
    """A body on two wheels: the radius of the circle around it, and between its wheels (m)."""

    radius: float
    wheel_base: float


@runtime_checkable
class Counters(Protocol):
    """Counts how far its wheels turned.

    Attributes:
        pulses_per_metre: of the counters, along the ground.
        geometry: of the body.
    """

    @property
    def pulses_per_metre(self) -> float:
        """Return the pulses; see the class."""
        ...

    @property
    def geometry(self) -> Geometry:
        """Return the geometry."""
        ...

    def read_counts(self) -> tuple[int, int]:
        """Read both counters, left and right, in pulses; forward counts up."""
        ...

    def set_counts(self, left: int, right: int) -> None:
        """Set both counters, in pulses."""
        ...


@runtime_checkable
class Proximity(Sensors, Protocol):
    """Has a ring of sensors that see what is near, ``sensor_0``, ``sensor_1``, ...

    Attributes:
        angles: where they look, [S] rad counter-clockwise from straight ahead.
        scan: in which the robot reads all of them in turn, s; 0 where that is not known.
    """

    @property
    def angles(self) -> NDArray[np.float64]:
        """Return the angles; see the class."""
        ...

    @property
    def scan(self) -> float:
        """Return the time; see the class."""
        ...

    def activations(self) -> NDArray[np.float64]:
        """Read all sensors, [S] in 0..1, 1 where something is near."""
        ...


@runtime_checkable
class LightSensors(Proximity, Protocol):
    """Measures ambient light with its ring of sensors, too.

    These readings are named ``light_0``, ``light_1``, ... They are read apart from the others, and
    only where they are wanted, because that takes time.
    """

    def lights(self) -> NDArray[np.float64]:
        """Measure the light at all sensors, [S] in 0 (dark) to 1."""
        ...


def sensors_read_with(robot: Robot, wanted: Collection[str] | None = None) -> tuple[str, ...]:
    """Return the names of the sensors that are read if some are wanted; None: of all sensors."""
    near = robot.sensor_names if isinstance(robot, Sensors) else ()
    count = len(robot.angles) if isinstance(robot, LightSensors) else 0
    light = tuple(f"light_{index}" for index in range(count))
    groups = [names for names in (near, light) if wanted is None or set(names) & set(wanted)]
    return tuple(name for names in groups for name in names)


def read_sensors(robot: Robot, wanted: Collection[str]) -> dict[str, float]:
    """Read the sensors that :func:`sensors_read_with` names, by name, each in 0..1."""
    names, readings = sensors_read_with(robot, wanted), dict[str, float]()
    if isinstance(robot, Sensors) and set(names) & set(robot.sensor_names):
        readings = dict(robot.read_sensors())
    if isinstance(robot, LightSensors) and len(names) > len(readings):
        readings |= zip(names[len(readings) :], map(float, robot.lights()), strict=True)
    return readings


@runtime_checkable
class WholeSpeeds(Protocol):
    """Takes whole numbers for its wheels' speeds.

    Attributes:
        full_speed: the number that 100 % is.
        speed_unit: the wheel speed that 1 stands for, m/s.
    """

    @property
    def full_speed(self) -> int:
        """Return the number; see the class."""
        ...

    @property
    def speed_unit(self) -> float:
        """Return the unit; see the class."""
        ...

    def set_speeds(self, left: int, right: int) -> None:
        """Set both wheels' speeds."""
        ...
