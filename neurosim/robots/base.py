"""Abilities of robots, each as a protocol, and a robot's clock.

A driver is one file. It implements :class:`Robot` and the abilities of its robot; code checks for
an ability, ``isinstance(robot, Lamp)``, never for a driver. An entry point in the group
``neurosim.robots`` adds a driver from another package: its name is the one for ``--robot``, its
value a function that takes the options as keywords and returns a robot that is not connected yet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from neurosim.base.commands import Commands

#: Default position of an NXT's light sensors, ahead of the axle and to either side of its middle,
#: m.
LIGHT_AHEAD, LIGHT_ASIDE = 0.06, 0.09


class Clock(Protocol):
    """A clock in seconds since some beginning; the virtual lab's advances on request."""

    def now(self) -> float:
        """Return the time in seconds; it never goes backwards."""
        ...

    def sleep_until(self, time: float) -> None:
        """Wait until :meth:`now` is at least ``time``; return at once if it is later."""
        ...


class SystemClock:
    """This computer's monotonic clock, zero when it is made."""

    def __init__(self) -> None:
        self._zero = time.perf_counter()

    def now(self) -> float:
        """Return seconds since this clock was made."""
        return time.perf_counter() - self._zero

    def sleep_until(self, time_: float) -> None:
        """Sleep in short slices, so that Ctrl-C is handled at once."""
        while (left := time_ - self.now()) > 0:
            time.sleep(min(left, 0.05))


@runtime_checkable
class Robot(Protocol):
    """A robot that takes commands; all other abilities are optional.

    Drivers raise :class:`neurosim.base.errors.RobotError` for problems that a user can correct (no
    device or a wrong one on the port), and :class:`neurosim.base.errors.LinkLost` when a connected
    robot stops answering. As a context manager, a robot is connected inside; at the end its motors
    are always stopped and the line is closed.
    """

    clock: Clock

    def connect(self) -> None:
        """Open the line and make sure that the expected robot answers."""
        ...

    def close(self) -> None:
        """Stop the motors if the line is still open, and close it. Never raises."""
        ...

    @property
    def commands(self) -> Commands:
        """The numbers of the robot's command; known at the latest after connecting."""
        ...

    def drive(self, command: Sequence[float]) -> None:
        """Set all numbers of a command, in the robot's units; they hold until the next.

        Returns when the robot has acknowledged it. The motors change their speed without a stop,
        with speed regulation if the robot has it.
        """
        ...

    def stop(self) -> None:
        """Stop, with active braking if the robot has it."""
        ...

    def describe(self) -> dict[str, Any]:
        """Describe this robot for a recording: its kind, name, ports, versions.

        The result is ready for JSON. ``kind`` is the name for ``--robot``. It also has the settings
        that define a command (ports, dialect, full speed), so that recordings of different robots
        differ. After connecting, ``virtual`` tells whether the robot reports that it is from the
        virtual lab.
        """
        ...

    def __enter__(self) -> Robot: ...

    def __exit__(self, *error: object) -> None: ...


R = TypeVar("R", bound=Robot)


class Driver:
    """The base of drivers: in a ``with`` block the robot is connected, at its end closed."""

    def __enter__(self: R) -> R:
        self.connect()
        return self

    def __exit__(self: Robot, *error: object) -> None:
        self.close()


@runtime_checkable
class Lamp(Protocol):
    """Has a lamp that a camera sees; its flashes align the camera's clock with the robot's.

    If only some of a driver's robots have a lamp, only these get the attribute.
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
        sensor_names: names for simulators and controllers: ``line_left``, ``line_right`` for light
            reflected by the ground, ``sensor_0``, ``sensor_1``, ... for a ring of proximity
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
class SeparateSensors(Sensors, Protocol):
    """Has sensors of which each takes a round trip of its own."""

    def read_sensor(self, name: str) -> float:
        """Read one sensor, 0..1, by its name in ``sensor_names``."""
        ...


@runtime_checkable
class SelfStopping(Protocol):
    """Stops by itself some time after a command, if no other follows.

    The computer cannot stop a robot after its program was killed, while it sleeps, or when the line
    is cut; such a robot stops without it.
    """

    def drive_for(self, command: Sequence[float], seconds: float) -> None:
        """Set a command, like ``drive``, for a duration (s).

        It lasts at least that long; the driver defines how much longer, without another command.
        """
        ...


def drive_for(robot: Robot, command: Sequence[float], seconds: float) -> None:
    """Set a command with the duration ``seconds``.

    A SelfStopping robot stops some time later, if no other command comes; others continue.
    """
    if isinstance(robot, SelfStopping):
        robot.drive_for(command, seconds)
    else:
        robot.drive(command)


@dataclass(frozen=True)
class Geometry:
    """A body on two wheels: the radius of the circle around it, and the wheel base (m)."""

    radius: float
    wheel_base: float


@runtime_checkable
class Counters(Protocol):
    """Has counters of its wheels' rotation.

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
    """Has a ring of sensors that see near objects, ``sensor_0``, ``sensor_1``, ...

    Attributes:
        angles: directions of the sensors, [S] rad counter-clockwise from straight ahead.
        scan: duration of reading all of them in turn, s; 0 if unknown.
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
        """Read all sensors, [S] in 0..1, 1 if something is near."""
        ...


@runtime_checkable
class LightSensors(Proximity, Protocol):
    """Measures ambient light with its ring of sensors, too.

    These readings are named ``light_0``, ``light_1``, ... They are read separately, and only if
    they are needed, because that takes time.
    """

    def lights(self) -> NDArray[np.float64]:
        """Measure the light at all sensors, [S] in 0 (dark) to 1."""
        ...


def sensors_read_with(robot: Robot, wanted: Collection[str] | None = None) -> tuple[str, ...]:
    """Return the names of the sensors that are read for the wanted ones; None: all sensors."""
    near = robot.sensor_names if isinstance(robot, Sensors) else ()
    if wanted is not None and isinstance(robot, SeparateSensors):
        near = tuple(name for name in near if name in wanted)
    count = len(robot.angles) if isinstance(robot, LightSensors) else 0
    light = tuple(f"light_{index}" for index in range(count))
    groups = [names for names in (near, light) if wanted is None or set(names) & set(wanted)]
    return tuple(name for names in groups for name in names)


def read_sensors(robot: Robot, wanted: Collection[str]) -> dict[str, float]:
    """Read the sensors that :func:`sensors_read_with` names, by name, each in 0..1."""
    names, readings = sensors_read_with(robot, wanted), dict[str, float]()
    if isinstance(robot, SeparateSensors):
        readings = {name: robot.read_sensor(name) for name in robot.sensor_names if name in names}
    elif isinstance(robot, Sensors) and set(names) & set(robot.sensor_names):
        readings = dict(robot.read_sensors())
    if isinstance(robot, LightSensors) and len(names) > len(readings):
        readings |= zip(names[len(readings) :], map(float, robot.lights()), strict=True)
    return readings


@runtime_checkable
class WholeSpeeds(Protocol):
    """Takes whole numbers as its wheels' speeds.

    Attributes:
        full_speed: the number for 100 %.
        speed_unit: the wheel speed of the number 1, m/s.
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
