"""A virtual robot's program: the text-line protocol of docs/lines.md in front of a body.

It shares no code with the programs in ``firmware/``, so that each checks the others.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from typing import Protocol

from neurosim.robots.lines.protocol import LONGEST, Greeting, decode, encode


class Hardware(Protocol):
    """The body behind the program; all calls take effect at the lab's current time."""

    @property
    def time(self) -> float:
        """Seconds since it was switched on."""
        ...

    def move(self, command: tuple[float, ...]) -> None:
        """Carry out a command from now on."""
        ...

    def halt(self) -> None:
        """Stop."""
        ...

    def values(self) -> list[int]:
        """Return the answer to ``read``: sensors, counters, battery (mV)."""
        ...

    def lamp(self, on: bool) -> None:
        """Switch the lamp."""
        ...


class LinesFirmware:
    """Takes bytes, moves a body, and answers with bytes.

    Args:
        hardware: the body.
        greeting: the robot's description of itself.
        lock: held while the body is used.

    Attributes:
        ends: end of the running command, s of the body's time; infinity: no command runs. The
            object that advances the time calls :meth:`end` then.
    """

    def __init__(self, hardware: Hardware, greeting: Greeting, lock: AbstractContextManager):
        self.hardware, self.greeting = hardware, greeting
        self.ends = math.inf
        self._lock = lock
        self._line = bytearray()

    def feed(self, data: bytes) -> bytes:
        """Take bytes in pieces of any size; return the robot's answers to complete lines."""
        answers = b""
        for byte in data:
            if byte in b"\r\n":
                line, answer = bytes(self._line), b""
                self._line.clear()
                if len(line) > LONGEST:
                    answer = self._say("0", "error too long")
                elif line.strip():
                    with self._lock:
                        answer = self._carry_out(line)
                answers += answer
            elif len(self._line) <= LONGEST:
                self._line.append(byte)
        return answers

    def end(self) -> None:
        """Stop, because the command has ended."""
        self.ends = math.inf
        self.hardware.halt()

    def reboot(self) -> bytes:
        """Start again, as after the reset button; return its message."""
        with self._lock:
            self._line.clear()
            self.end()
        return self._say("0", self.greeting.lines()[0])

    def _carry_out(self, line: bytes) -> bytes:
        words = decode(line)
        summed = words is not None
        if words is None:
            if b"*" in line:
                return self._say("0", "error checksum")
            words = line.decode("latin-1").split()
        number = words.pop(0) if words and words[0].isdigit() else "0"
        if not words:
            return self._say(number, "error no request")
        request, *rest = words
        if request in ("drive", "lamp") and not summed:
            return self._say(number, "error checksum")
        if request == "hello" and not rest:
            self.end()
            lines = self.greeting.lines()
            answers = b"".join(self._say(number, one) for one in lines)
            return answers + self._say(number, f"ok {self._now()} {len(lines)}")
        if request == "read" and not rest:
            left = 0 if math.isinf(self.ends) else max(self.ends - self.hardware.time, 0.0)
            values = [self._now(), math.ceil(1000 * left), *self.hardware.values()]
            return self._say(number, " ".join(["read", *map(str, values)]))
        if request == "stop" and not rest:
            self.end()
        elif request == "lamp" and rest in (["0"], ["1"]) and self.greeting.lamp:
            self.hardware.lamp(rest == ["1"])
        elif request == "drive":
            if not self._drive(rest):
                return self._say(number, "error numbers")
        else:
            return self._say(number, "error request")
        return self._say(number, f"ok {self._now()}")

    def _drive(self, words: list[str]) -> bool:
        """Carry out a command; return whether it was valid."""
        try:
            milliseconds, command = int(words[0]), tuple(map(float, words[1:]))
        except (ValueError, IndexError):
            return False
        limits = self.greeting.commands.numbers
        if not 1 <= milliseconds <= 1000 * self.greeting.longest or len(command) != len(limits):
            return False
        if not all(
            one.low <= value <= one.high for one, value in zip(limits, command, strict=True)
        ):
            return False
        self.ends = self.hardware.time + milliseconds / 1000
        self.hardware.move(command)
        return True

    def _now(self) -> int:
        return int(1000 * self.hardware.time) % 2**32

    def _say(self, number: str, text: str) -> bytes:
        return encode(f"{number} {text}")
