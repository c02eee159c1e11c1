"""Driver of a Khepera (I to IV), an e-puck or an e-puck2 on a serial line, by lines of text."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from neurosim.base.commands import TWO_WHEELS, Commands
from neurosim.base.declared import Baud, Count, Seconds, checks
from neurosim.base.errors import RobotError, UserError
from neurosim.robots.base import Clock, Geometry, SystemClock
from neurosim.robots.khepera.dialects import Dialect, dialect_named
from neurosim.robots.serial_line import SerialDriver, SerialLine

#: Number of times that a command is sent before the robot counts as lost; all may be repeated.
TRIES = 3
#: Text in the version of a robot of the virtual lab.
VIRTUAL = "virtual"


class Khepera(SerialDriver):
    """A small round robot with a ring of infra-red sensors and two wheels.

    Follows :class:`neurosim.robots.base.Robot`, ``LightSensors``, ``Counters``, ``WholeSpeeds``
    and, if the dialect has them, ``Lamp`` and ``Battery``. Bytes that are not an answer are
    ignored, and commands without a good answer are sent again. A reboot is noticed by its text: the
    robot gets its former speeds, its counters the last values, and :attr:`reboots` counts it. A
    robot that no longer answers gets a stop, several times, before the line is closed. It does not
    stop by itself.

    Args:
        port: Serial port, such as ``/dev/ttyUSB0`` or COM3, or a URL such as socket://host:port.
        dialect: Protocol: khepera (I and II), khepera3, khepera4, epuck or epuck2.
        baud: Speed of the serial line; by default the dialect's own (a Khepera's is set by
            jumpers).
        full_speed: Speed at 100 % in the robot's own units; by default the dialect's, which for a
            Khepera is 10, 100 mm/s.
        pulses_per_metre: Pulses of the position counters per metre; by default the dialect's.
        timeout: Wall-clock seconds that an answer may take, at each attempt; a lost robot drives
            unguarded meanwhile.
        clock: the robot's clock; the virtual lab gives its own.

    Attributes:
        geometry: radius and wheel base, m.
        pulses_per_metre: of the position counters.
        speed_unit: the wheel speed of the number 1, m/s.
        angles: directions of the sensors, [S] rad counter-clockwise from straight ahead, in the
            order of :meth:`read_proximity`.
        reboots: number of observed restarts of the robot.

    Raises:
        UserError: for a dialect, a baud rate or a full speed that does not exist.
    """

    @checks
    def __init__(
        self,
        port: str,
        *,
        dialect: str = "khepera",
        baud: Baud | None = None,
        full_speed: Count | None = None,
        pulses_per_metre: Annotated[float, Meta(ge=1, le=1e9)] | None = None,
        timeout: Seconds = 0.35,
        clock: Clock | None = None,
    ):
        self.dialect: Dialect = dialect_named(dialect)
        self.clock: Clock = SystemClock() if clock is None else clock
        self.full_speed = self.dialect.full_speed if full_speed is None else full_speed
        if not 1 <= self.full_speed <= self.dialect.max_speed:
            raise UserError(
                f"full speed {self.full_speed} is not one of the {self.dialect.robot}'s: use 1 to "
                f"{self.dialect.max_speed}"
            )
        self.geometry: Geometry = self.dialect.geometry
        self.pulses_per_metre = float(pulses_per_metre or self.dialect.pulses_per_metre)
        # A speed is a number of pulses in a time, so it depends on the size of a pulse.
        self.speed_unit = (
            self.dialect.speed_unit * self.dialect.pulses_per_metre / self.pulses_per_metre
        )
        self.angles = np.radians(self.dialect.angles)
        if self.dialect.lamp is not None:
            self.lamp = self._switch_lamp
        if self.dialect.battery is not None:
            self.battery = self._battery
        self.reboots = 0
        self._timeout = timeout
        # A line end first, so that half a command does not precede the stop.
        self._end = self.dialect.end.encode()
        self._line = SerialLine(
            port,
            baud=baud or self.dialect.baud,
            stop_bits=self.dialect.stop_bits,
            farewell=self._end + self._set("D", (0, 0)).encode() + self._end,
        )
        self._speeds = (0, 0)
        self._counts: tuple[int, int] | None = None
        self._zeros = (0, 0)
        self._version = ""
        self._restoring = False

    def _greet(self) -> None:
        """Check that a robot of this kind answers, and stop it."""
        # Half a command of an earlier program must not precede the first one.
        self._line.write(self._end)
        self._version = self._first_answer()
        if (other := self.dialect.not_this) is not None and other[0] in self._version:
            raise RobotError(
                f"the robot on {self._line.port} is not an {self.dialect.robot} "
                f"({self._version!r}): give the dialect {other[1]}"
            )
        self.set_speeds(0, 0)

    @property
    def commands(self) -> Commands:
        """Both wheels, in percent of full speed."""
        full = self.full_speed * self.speed_unit
        return TWO_WHEELS.measured(
            full=full, track=self.geometry.wheel_base, radius=self.geometry.radius
        )

    def drive(self, command: Sequence[float]) -> None:
        """Set both motors, in percent of full speed, -100 to 100, until the next command.

        The robot takes whole speeds only; others are rounded.

        Raises:
            UserError: if it is not a speed.
            LinkLost: if the robot does not acknowledge it.
        """
        self.set_speeds(*self._units(*command))

    def set_speeds(self, left: int, right: int) -> None:
        """Set both wheels' speeds in the robot's own units (a Khepera's are pulses in 10 ms).

        Raises:
            UserError: if one is beyond the robot's limits.
            LinkLost: if the robot does not acknowledge it.
        """
        self._ask(self._speed_command(left, right), 0)

    def stop(self) -> None:
        """Stop both motors; their speed regulation holds them."""
        self.set_speeds(0, 0)

    def read_proximity(self) -> np.ndarray:
        """Read reflected light, [8] int, larger near an object.

        The robot's own order and range are kept: a Khepera's sensors from left to right in front (0
        to 5), behind to the right (6) and to the left (7), 0..1023; see the dialect's ``angles``.
        """
        return self._sensors("N")

    def read_ambient(self) -> np.ndarray:
        """Read ambient light, [8] int in the robot's own range; a Khepera's falls with light."""
        return self._sensors("O")

    def activations(self) -> np.ndarray:
        """Read reflected light, [8] in 0..1 of the sensors' range."""
        return self._scaled(self._ask("N", self.dialect.values))

    def lights(self) -> np.ndarray:
        """Read ambient light, [8] in 0 (dark) to 1."""
        return np.clip(1.0 - self.read_ambient() / self.dialect.dark, 0.0, 1.0)

    def read_counts(self) -> tuple[int, int]:
        """Read the position counters, left and right, in pulses."""
        left, right = self._ask(self.dialect.read_counts, 2)
        self._counts = (left - self._zeros[0], right - self._zeros[1])
        return self._counts

    def set_counts(self, left: int, right: int) -> None:
        """Set the position counters, in pulses."""
        wanted = (int(left), int(right))
        if self.dialect.set_counts is None:
            there = self._ask(self.dialect.read_counts, 2)
            self._zeros = (there[0] - wanted[0], there[1] - wanted[1])
        else:
            self._ask(self._set(self.dialect.set_counts, wanted), 0)
        self._counts = wanted

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """``sensor_0`` to ``sensor_7``, in the order of :meth:`read_proximity`."""
        return tuple(f"sensor_{index}" for index in range(len(self.dialect.sensors)))

    @property
    def scan(self) -> float:
        """Duration of reading all sensors in turn, s; 0 if unknown."""
        return self.dialect.scan

    def read_sensors(self) -> dict[str, float]:
        """Read reflected light, 0 (nothing) to 1 (near), by the sensors' names."""
        return dict(zip(self.sensor_names, map(float, self.activations()), strict=True))

    def describe(self) -> dict[str, Any]:
        """Describe this robot for a recording."""
        return {
            "kind": "khepera",
            "dialect": self.dialect.name,
            "port": self._line.port,
            "baud": self._line.baud,
            "version": self._version,
            **({"virtual": VIRTUAL in self._version} if self._version else {}),
            "full_speed": self.full_speed,
            "speed_unit": self.speed_unit,
            "pulses_per_metre": self.pulses_per_metre,
            "reboots": self.reboots,
        }

    def _switch_lamp(self, on: bool) -> None:
        """Switch the lights on the robot's top, or in its body."""
        assert self.dialect.lamp is not None
        self._ask(self.dialect.lamp[0 if on else 1], 0)

    def _battery(self) -> float:
        """Return the battery's voltage in volts."""
        assert self.dialect.battery is not None
        return self._ask(self.dialect.battery, 1)[0] * self.dialect.battery_unit

    def _set(self, letter: str, values: tuple[int, int]) -> str:
        return letter + "".join(f",{self.dialect.long}{value}" for value in values)

    def _units(self, left: float, right: float) -> tuple[int, int]:
        for value, side in ((left, "left"), (right, "right")):
            if not math.isfinite(value) or abs(value) > 100:
                raise UserError(f"{side} motor: {value} is not a speed; use -100 to 100 percent")
        return round(left / 100 * self.full_speed), round(right / 100 * self.full_speed)

    def _speed_command(self, left: int, right: int) -> str:
        for value, side in ((left, "left"), (right, "right")):
            if value != int(value) or abs(value) > self.dialect.max_speed:
                raise UserError(
                    f"{side} wheel: {value} is not a speed of the {self.dialect.robot}; use whole "
                    f"numbers up to {self.dialect.max_speed}"
                )
        self._speeds = (int(left), int(right))
        return self._set("D", self._speeds)

    def _scaled(self, values: list[int]) -> np.ndarray:
        readings = np.array([values[place] for place in self.dialect.sensors], float)
        return np.clip(readings / self.dialect.full_scale, 0.0, 1.0)

    def _sensors(self, letter: str) -> np.ndarray:
        values = self._ask(letter, self.dialect.values)
        return np.array([values[place] for place in self.dialect.sensors])

    def _first_answer(self) -> str:
        """Return the robot's version."""
        letter, heard = self.dialect.version, []
        for _ in range(TRIES):
            self._line.write(letter.encode() + self._end)
            end = time.monotonic() + self._timeout
            while (line := self._line.read_line(max(end - time.monotonic(), 0.0))) is not None:
                text = line.decode("ascii", "replace")
                if text.startswith(letter.lower() + ","):
                    return text[2:].strip()
                heard.append(text.strip())
        where = self._line.place
        if not heard:
            raise RobotError(
                f"nothing answers on {where}: is the {self.dialect.robot} on, in its serial mode "
                "and set to this speed, or does another program hold the line?"
            )
        if letter in heard:
            raise RobotError(
                f"{where} sends back its own input like a terminal, so it is not a robot"
            )
        raise RobotError(
            f"the device on {where} does not answer as a {self.dialect.robot} "
            f"({heard[-1][:40]!r}): check the dialect and the speed"
        )

    def _ask(self, command: str, count: int) -> list[int]:
        """Send a command, repeatedly if necessary, and return the numbers of its answer."""
        reason = ""
        for _ in range(TRIES):
            self._hear_reboots()
            self._line.write(command.encode() + self._end)
            values, reason = self._answer(command[0].lower(), count)
            if values is not None:
                return values
        if reason:
            raise RobotError(
                f"the {self.dialect.robot} on {self._line.port} does not carry out {command!r}: "
                f"it answers {reason[:60]!r}"
            )
        raise self._line.lose(
            f"the {self.dialect.robot} on {self._line.port} stopped answering: no reply to "
            f"{command!r} within {self._timeout:g} s, {TRIES} times; is it on and its cable whole?"
        )

    def _answer(self, letter: str, count: int) -> tuple[list[int] | None, str]:
        """Return an answer's numbers, or None and the received text."""
        end = time.monotonic() + self._timeout
        seconds = self._timeout
        while (line := self._line.read_line(seconds)) is not None:
            text = line.decode("ascii", "replace")
            values = _numbers(text, letter)
            if values is not None and len(values) == count:
                return values, ""
            if self._notice_reboot(line):
                return None, text
            if text[0] in (letter, self.dialect.error):
                # Half an answer, or a command that reached the robot in pieces.
                return None, text
            seconds = max(end - time.monotonic(), 0.0)
        return None, ""

    def _hear_reboots(self) -> None:
        for line in self._line.waiting():
            self._notice_reboot(line)

    def _notice_reboot(self, line: bytes) -> bool:
        """Restore the state of a robot that restarts; return whether it did."""
        text = line.decode("ascii", "replace")
        if not any(banner in text for banner in self.dialect.banners):
            return False
        self.reboots += 1
        if not self._restoring:
            self._restoring = True
            try:
                if self._counts is not None and self.dialect.set_counts is None:
                    self._zeros = (-self._counts[0], -self._counts[1])  # they restart at 0
                elif self._counts is not None:
                    self._ask(self._set(self.dialect.set_counts, self._counts), 0)
                self._ask(self._set("D", self._speeds), 0)
            finally:
                self._restoring = False
        return True


def _numbers(text: str, letter: str) -> list[int] | None:
    """Return the numbers of an answer, or None if it is not one to this letter."""
    name, *values = text.split(",")
    if name != letter:
        return None
    try:
        # The Khepera III may put d or l before a number, as in commands; an e-puck2 adds percents
        # in brackets to its battery's.
        return [int(value.partition("(")[0].strip().lstrip("dl")) for value in values]
    except ValueError:
        return None
