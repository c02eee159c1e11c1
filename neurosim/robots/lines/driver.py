"""Driver of any robot that speaks the text-line protocol of docs/lines.md."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from neurosim.base.commands import Commands
from neurosim.base.declared import Baud, Seconds, checks
from neurosim.base.errors import RobotError, UserError
from neurosim.robots.base import Clock, Geometry, SystemClock
from neurosim.robots.lines.protocol import Greeting, GreetingError, decimal, decode, encode
from neurosim.robots.serial_line import SerialDriver, SerialLine

#: Number of times that a request is sent before the robot counts as lost.
TRIES = 3
#: Longest time until a board answers that is reset by opening its port, s.
BOOT = 4.0
#: Extra time of a command, s, because the next one may be a little late.
LATE = 0.3
#: Requests are numbered from 1 up to this, and from 1 again.
LAST_NUMBER = 999
#: Pulses per metre are those of Arduinos' usual rate.
BAUD = 115_200
#: Radius of a body that does not give its own, m.
RADIUS = 0.1


class Lines(SerialDriver):
    """A robot that describes its commands, on any serial port, URL of pyserial or LEGO hub.

    Follows :class:`neurosim.robots.base.Robot`, ``Sensors`` and ``SelfStopping`` and, if the robot
    has them, ``Counters``, ``Proximity``, ``Lamp`` and ``Battery``, which are known after
    connecting. Each command contains its duration, so the robot stops by itself if the computer or
    the line fails. Requests without a good answer are sent again. A restart is noticed by the
    robot's first line: its counters then continue from their last values, and :attr:`reboots`
    counts it.

    Args:
        port: Serial port, such as ``/dev/ttyACM0`` or COM3, a URL such as socket://host:port, or
            pybricks://name for a LEGO hub.
        baud: Speed of the serial line.
        timeout: Wall-clock seconds that an answer may take, at each attempt.
        clock: the robot's clock; the virtual lab gives its own.

    Attributes:
        greeting: the robot's description of itself; None before it is connected.
        reboots: number of observed restarts of the robot.
        stamp: the robot's own time at its last answer, s since it was switched on.
    """

    @checks
    def __init__(
        self,
        port: str,
        *,
        baud: Baud = BAUD,
        timeout: Seconds = 0.35,
        clock: Clock | None = None,
    ):
        self.clock: Clock = SystemClock() if clock is None else clock
        self.greeting: Greeting | None = None
        self.reboots = 0
        self.stamp = 0.0
        self._timeout = timeout
        # A line end first, so that half a request does not precede the stop.
        self._line = SerialLine(port, baud=baud, farewell=b"\nstop\n")
        self._number = 0
        self._stamp_ms: int | None = None
        self._zeros: list[int] = []
        self._counts: list[int] = []

    def _greet(self) -> None:
        """Ask for the robot's description, which stops it."""
        self.greeting = self._first_answer()
        self._has(self.greeting)

    @property
    def commands(self) -> Commands:
        """The numbers of the robot's command."""
        return self._known().commands

    def drive(self, command: Sequence[float]) -> None:
        """Set a command's numbers, in the robot's own units, for the longest possible duration.

        Raises:
            UserError: if a number is beyond the robot's limits.
            LinkLost: if the robot does not acknowledge it.
        """
        self._send_command(command, self._known().longest)

    def drive_for(self, command: Sequence[float], seconds: float) -> None:
        """Set a command's numbers, like :meth:`drive`, for a duration (s).

        Without another command the robot stops by itself :data:`LATE` later.

        Raises:
            UserError, LinkLost: as :meth:`drive`, and for a duration beyond the robot's limit.
        """
        longest = self._known().longest
        if not 0 < seconds <= longest:
            raise UserError(
                f"a command of {seconds:g} s is too long for this robot: a command lasts up to "
                f"{longest:g} s"
            )
        self._send_command(command, min(seconds + LATE, longest))

    def _send_command(self, command: Sequence[float], seconds: float) -> None:
        numbers = " ".join(map(decimal, self.commands.check(command)))
        self._ask(f"drive {max(round(1000 * seconds), 1)} {numbers}")

    def stop(self) -> None:
        """Stop the robot."""
        self._ask("stop")

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors, in the robot's order."""
        return () if self.greeting is None else tuple(one.name for one in self.greeting.sensors)

    def read_sensors(self) -> dict[str, float]:
        """Read all sensors, each from 0 to 1 of its range, by name."""
        sensors = self._known().sensors
        values = self._read()[: len(sensors)] if sensors else []
        return {
            one.name: min(max(value / one.full, 0.0), 1.0)
            for one, value in zip(sensors, values, strict=True)
        }

    def describe(self) -> dict[str, Any]:
        """Describe this robot for a recording."""
        greeting = self.greeting
        about: dict[str, Any] = {"kind": "lines", "port": self._line.port, "baud": self._line.baud}
        if greeting is not None:
            about |= {
                "name": greeting.name,
                "firmware": greeting.firmware,
                "virtual": greeting.virtual,
                "longest": greeting.longest,
                "reboots": self.reboots,
            }
            seen = {
                one.name: [one.place["x"], one.place["y"]]
                for one in greeting.sensors
                if {"x", "y"} <= set(one.place)
            }
            about |= {"light_sensors": seen} if seen else {}
        return about

    def _has(self, greeting: Greeting) -> None:
        """Add the robot's abilities to this object."""
        self._zeros = [0] * len(greeting.counters)
        self._counts = [0] * len(greeting.counters)
        if greeting.lamp:
            self.lamp = self._switch_lamp
        if greeting.battery:
            self.battery = self._battery
        angles = [one.place.get("angle") for one in greeting.sensors]
        if angles and None not in angles:
            self.angles, self.scan = np.radians(np.array(angles, float)), 0.0
            self.activations = self._activations
        rates = {one.per_metre for one in greeting.counters}
        names = [one.name for one in greeting.counters]
        body = greeting.commands
        if body.body == "wheels" and names == ["left", "right"] and len(rates) == 1:
            self.pulses_per_metre = rates.pop()
            radius = body.measures.get("radius", RADIUS)
            self.geometry = Geometry(radius, body.measures["track"])
            self.read_counts, self.set_counts = self._read_counts, self._set_counts

    def _switch_lamp(self, on: bool) -> None:
        """Switch the robot's lamp."""
        self._ask(f"lamp {int(on)}")

    def _battery(self) -> float:
        """Return the battery's voltage in volts."""
        return self._read()[-1] / 1000

    def _activations(self) -> np.ndarray:
        """Read all sensors, [S] in 0..1 of their ranges."""
        return np.array(list(self.read_sensors().values()))

    def _read_counts(self) -> tuple[int, int]:
        """Read both counters, left and right, in pulses."""
        begin = len(self._known().sensors)
        raw = self._read()[begin : begin + 2]
        self._counts = [value - zero for value, zero in zip(raw, self._zeros, strict=True)]
        return self._counts[0], self._counts[1]

    def _set_counts(self, left: int, right: int) -> None:
        """Set both counters, in pulses; the robot's own are not changed."""
        counts = self._read_counts()
        for place, value in enumerate((int(left), int(right))):
            self._zeros[place] += counts[place] - value
            self._counts[place] = value

    def _known(self) -> Greeting:
        if self.greeting is None:
            raise RobotError(f"the robot on {self._line.port} is not connected: connect first")
        return self.greeting

    def _read(self) -> list[int]:
        """Return sensors, counters and battery (mV) in the robot's form."""
        count = self._known().values
        answer = self._ask("read", count + 2)
        return [int(word) for word in answer[1:]]

    def _ask(self, request: str, count: int = 1) -> list[str]:
        """Send a request, repeatedly if necessary; return the words after the time in its answer.

        Args:
            request: without its number.
            count: number of words of the answer with the time, without the first word.
        """
        refused = ""
        for _ in range(TRIES):
            for line in self._line.waiting():
                self._notice_reboot(decode(line))
            number = self._send(request)
            words, refused = self._answer(number, count)
            if words is not None:
                return words
        if refused:
            raise RobotError(
                f"the robot on {self._line.port} does not carry out {request!r}: {refused[:60]}"
            )
        raise self._line.lose(
            f"the robot on {self._line.port} stopped answering: no good reply to {request!r} "
            f"within {self._timeout:g} s, {TRIES} times; is it on and its cable whole?"
        )

    def _send(self, request: str) -> str:
        self._number = self._number % LAST_NUMBER + 1
        # A line end first, so that the rest of a cut line is a separate line.
        self._line.write(b"\n" + encode(f"{self._number} {request}"))
        return str(self._number)

    def _answer(self, number: str, count: int) -> tuple[list[str] | None, str]:
        """Return the numbers after an answer's time, or None and the reason of its rejection."""
        end = time.monotonic() + self._timeout
        seconds = self._timeout
        while (line := self._line.read_line(seconds)) is not None:
            words = decode(line)
            if self._notice_reboot(words):
                return None, "it restarted"
            if words and len(words) > 1 and words[1] == "error" and words[0] in (number, "0"):
                if words[2:] == ["checksum"]:  # it received another text than was sent
                    return None, ""
                return None, "it answers " + " ".join(words[2:])
            if words and words[0] == number and words[1:2] in (["ok"], ["read"]):
                numbers = words[2:]
                if len(numbers) == count and all(word.lstrip("-").isdigit() for word in numbers):
                    self._take_stamp(int(numbers[0]))
                    return numbers[1:], ""
            seconds = max(end - time.monotonic(), 0.0)
        return None, ""

    def _take_stamp(self, milliseconds: int) -> None:
        # The robot's 32-bit time wraps after 49 days.
        if self._stamp_ms is None:
            self.stamp = milliseconds / 1000
        else:
            self.stamp += ((milliseconds - self._stamp_ms) % 2**32) / 1000
        self._stamp_ms = milliseconds

    def _notice_reboot(self, words: list[str] | None) -> bool:
        """Return whether these are the first words of a robot that restarts."""
        if not words or words[:2] != ["0", "robot"]:
            return False
        self.reboots += 1
        self._stamp_ms = None
        self._zeros = [-count for count in self._counts]
        return True

    def _first_answer(self) -> Greeting:
        """Return the robot's greeting; wait for a board that is being reset."""
        heard: list[bytes] = []
        end = time.monotonic() + max(BOOT, TRIES * self._timeout)
        while time.monotonic() < end:
            number = self._send("hello")
            lines = self._greeting(number, heard)
            if lines is not None:
                try:
                    return Greeting.read(lines)
                except GreetingError as error:
                    raise RobotError(
                        f"the robot on {self._line.port} describes itself in a wrong way: {error}"
                    ) from None
        where = self._line.place
        if not heard:
            raise RobotError(
                f"nothing answers on {where}: is the robot on, its program running and set to this "
                "speed, or does another program hold the line?"
            )
        last = heard[-1].decode("ascii", "replace")[:40]
        raise RobotError(
            f"the device on {where} does not speak neurosim's lines ({last!r}): check the port, "
            "the speed and the robot's program"
        )

    def _greeting(self, number: str, heard: list[bytes]) -> list[list[str]] | None:
        """Return the words of all lines of the greeting, or None if one is missing."""
        end = time.monotonic() + self._timeout
        lines: list[list[str]] = []
        while (line := self._line.read_line(max(end - time.monotonic(), 0.0))) is not None:
            words = decode(line)
            if words and words[0] == number and len(words) > 1:
                if words[1] == "ok" and len(words) == 4 and words[2].isdigit():
                    self._take_stamp(int(words[2]))
                    # It contains the number of lines: none may be missing.
                    return lines if words[3] == str(len(lines)) else None
                lines.append(words[1:])
                end = time.monotonic() + self._timeout
            elif not words:
                heard.append(line)
        return None
