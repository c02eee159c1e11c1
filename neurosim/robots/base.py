"""The protocol that every robot driver follows, and the clock it owns.

A driver is one file. One from outside the package is added by an entry point in the group
``neurosim.robots``: its name is what ``--robot`` takes, its value a function that takes the
options as keywords and returns a :class:`Robot`.
"""

from __future__ import annotations

import time
from typing import Any, Protocol, runtime_checkable


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
    """A wheeled robot that takes motor commands.

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

    def drive(self, left: float, right: float) -> None:
        """Set both motors, in percent of full speed, -100 to 100; they hold it until the next.

        Returns when the robot has acknowledged it. Motors go straight from one speed into the
        next, with speed regulation where the robot has it.
        """
        ...

    def stop(self) -> None:
        """Stop both motors, actively braked where the robot can."""
        ...

    def read_sensors(self) -> dict[str, float]:
        """Read the sensors, by name; ``line_left``, ``line_right``: reflected light in 0..1."""
        ...

    def lamp(self, on: bool) -> None:
        """Switch the lamp that the camera sees."""
        ...

    def battery(self) -> float:
        """Return the battery's voltage in volts."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return what a recording should say of this robot: its kind, name, ports, versions.

        ``virtual``, once connected, says whether the robot is one of the virtual lab, as far as
        the robot itself tells.
        """
        ...

    def __enter__(self) -> Robot: ...

    def __exit__(self, *error: object) -> None: ...
