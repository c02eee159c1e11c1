"""The text-line protocol of docs/lines.md: checksums, and a robot's description of itself."""

from __future__ import annotations

import math
from binascii import crc_hqx
from collections.abc import Mapping
from dataclasses import dataclass, field

from neurosim.base.commands import BODIES, Commands, Number

#: Version of the protocol.
VERSION = "1"
#: Longest request, including its checksum.
LONGEST = 96
#: Largest number of numbers of a command.
MOST = 6
#: A word in a virtual robot's first line.
VIRTUAL = "virtual"


class GreetingError(ValueError):
    """A greeting that does not follow the protocol; the text names the line."""


def checksum(text: bytes) -> int:
    """Return the checksum of a line: CRC-16/CCITT-FALSE, as ``*`` and 4 hexadecimal digits."""
    return crc_hqx(text, 0xFFFF)


def encode(text: str) -> bytes:
    """Return a line with its checksum and its end."""
    raw = text.encode("ascii")
    return raw + b"*%04X\n" % checksum(raw)


def decimal(value: float) -> str:
    """Return a number as text for requests: at most 4 decimals, no exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


def decode(line: bytes) -> list[str] | None:
    """Return the words of a line without its end; None if its checksum is missing or wrong."""
    text, star, digits = line.rpartition(b"*")
    if not star or digits.upper() != b"%04X" % checksum(text) or not text.isascii():
        return None
    return text.decode("ascii").split()


@dataclass(frozen=True)
class Sensor:
    """A sensor: readings are whole numbers from 0 to ``full``.

    Attributes:
        name: its name for controllers.
        full: largest reading.
        place: position and direction, if the robot gives them: x, y (m, robot's frame), angle
            (degrees to the left of straight ahead).
    """

    name: str
    full: int
    place: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Counter:
    """A counter of a wheel: pulses per metre along the ground."""

    name: str
    per_metre: float


@dataclass(frozen=True)
class Greeting:
    """A robot's description of itself.

    Attributes:
        name: of the robot, one word.
        firmware: of its program, one word.
        commands: its commands.
        longest: longest duration of a command, s.
        sensors: in the order of readings.
        counters: in their order.
        lamp: whether it has a lamp.
        battery: whether it knows its voltage.
        virtual: whether it is one of the virtual lab.
    """

    name: str
    firmware: str
    commands: Commands
    longest: float
    sensors: tuple[Sensor, ...] = ()
    counters: tuple[Counter, ...] = ()
    lamp: bool = False
    battery: bool = False
    virtual: bool = False

    @property
    def values(self) -> int:
        """Number of numbers after the time and the rest in the answer to ``read``."""
        return len(self.sensors) + len(self.counters) + self.battery

    def lines(self) -> list[str]:
        """Return the greeting's lines, without numbers and checksums."""
        last = [VIRTUAL] if self.virtual else []
        lines = [" ".join(["robot", "neurosim-lines", VERSION, self.name, self.firmware, *last])]
        for one in self.commands.numbers:
            kind = "speed" if one.speed else "angle"
            lines.append(f"command {one.name} {one.unit} {one.low:g} {one.high:g} {kind}")
        lines.append(f"longest {round(1000 * self.longest)}")
        if self.commands.body:
            lines.append(" ".join(["body", self.commands.body, *_pairs(self.commands.measures)]))
        for sensor in self.sensors:
            lines.append(" ".join(["sensor", sensor.name, str(sensor.full), *_pairs(sensor.place)]))
        lines += [f"counter {one.name} {one.per_metre:.8g}" for one in self.counters]
        lines += ["lamp"] if self.lamp else []
        lines += ["battery"] if self.battery else []
        return lines

    @classmethod
    def read(cls, lines: list[list[str]]) -> Greeting:
        """Return a greeting from its lines, split into words; other lines are ignored.

        Raises:
            GreetingError: naming the wrong line.
        """
        parts = _GreetingParts()
        for words in lines:
            try:
                parts.take(words)
            except (ValueError, IndexError) as error:
                what = error if isinstance(error, GreetingError) else "it has other words"
                raise GreetingError(f"{' '.join(words)!r}: {what}") from None
        return parts.greeting()


class _GreetingParts:
    """The part of a greeting that was read so far."""

    def __init__(self) -> None:
        self.first: list[str] | None = None
        self.longest = 0.0
        self.body, self.measures = "", dict[str, float]()
        self.commands: list[Number] = []
        self.sensors: list[Sensor] = []
        self.counters: list[Counter] = []
        self.flags: set[str] = set()

    def take(self, words: list[str]) -> None:
        kind, *rest = words
        if kind == "robot":
            if rest[0] != "neurosim-lines":
                raise GreetingError("it speaks another protocol than neurosim-lines")
            if rest[1] != VERSION:
                raise GreetingError(f"it speaks version {rest[1]}, this program version {VERSION}")
            self.first = [rest[2], rest[3], *rest[4:]]
        elif kind == "command":
            name, unit, low, high, how = rest
            if not _number(low) < _number(high) or how not in ("speed", "angle"):
                raise GreetingError(
                    "a command has a least and a greatest value, and is speed or angle"
                )
            self.commands.append(Number(name, unit, float(low), float(high), how == "speed"))
        elif kind == "longest":
            self.longest = int(rest[0]) / 1000
        elif kind == "body":
            self.body, self.measures = rest[0], _measures(rest[1:])
            missing = [
                name for name in BODIES.get(self.body, ()) if self.measures.get(name, 0) <= 0
            ]
            if missing:
                raise GreetingError(f"it lacks {missing[0]}=")
        elif kind == "sensor":
            if int(rest[1]) < 1:
                raise GreetingError("its largest reading must be above 0")
            self.sensors.append(Sensor(rest[0], int(rest[1]), _measures(rest[2:])))
        elif kind == "counter":
            if _number(rest[1]) <= 0:
                raise GreetingError("its pulses per metre must be above 0")
            self.counters.append(Counter(rest[0], float(rest[1])))
        elif kind in ("lamp", "battery"):
            self.flags.add(kind)

    def _commands(self) -> Commands:
        try:
            return Commands(tuple(self.commands), self.body, self.measures)
        except ValueError as error:
            raise GreetingError(str(error)) from None

    def greeting(self) -> Greeting:
        if self.first is None:
            raise GreetingError("it does not begin with its robot line")
        if not 1 <= len(self.commands) <= MOST:
            raise GreetingError(f"a command has 1 to {MOST} numbers, not {len(self.commands)}")
        if self.longest <= 0:
            raise GreetingError("it does not give the longest duration of a command (longest)")
        return Greeting(
            self.first[0],
            self.first[1],
            self._commands(),
            self.longest,
            tuple(self.sensors),
            tuple(self.counters),
            "lamp" in self.flags,
            "battery" in self.flags,
            VIRTUAL in self.first[2:],
        )


def _pairs(measures: Mapping[str, float]) -> list[str]:
    return [f"{name}={value:g}" for name, value in measures.items()]


def _measures(words: list[str]) -> dict[str, float]:
    pairs = [word.partition("=") for word in words]
    return {name: _number(value) for name, _, value in pairs}


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise GreetingError(f"{text} is not a number")
    return value
