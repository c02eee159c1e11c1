"""The virtual Khepera's firmware: K-Team's ASCII protocol, letter by letter.

After K-Team's Khepera User Manual 5.02 (1999), appendix A, "Communication protocol": a command is
an upper-case letter, numbers behind commas, and CR or LF; the answer is the letter in lower case,
numbers behind commas, CR LF. Unknown commands are answered by ``z,Command not found``, wrong
numbers by ``z,Protocol error``; the manual does not have these two, but clients of the real robot
expect them. ``restart`` restarts the robot.

The version of the protocol tells clients that the robot is virtual.

Not modelled: the constants of the controllers (A, F) and the acceleration (J) are accepted and have
no effect; the extension bus, the converter's inputs and the turret's socket are empty.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager

from neurosim.lab.khepera.body import KheperaBody
from neurosim.robots.khepera.driver import VIRTUAL

BANNER = (
    b"\r\nROM of minirobot KHEPERA, neurosim virtual lab\r\nSerial communication protocol ready\r\n"
)
BIOS, PROTOCOL = "5.02", f"5.02-{VIRTUAL}"
NOT_FOUND, WRONG = b"z,Command not found\r\n", b"z,Protocol error\r\n"
#: Longest command, in bytes; the rest of a longer line is dropped.
LONGEST = 80
LARGEST_SPEED, LARGEST_PWM = 127, 255
LARGEST_COUNT = 2**31

_NUMBER = re.compile(r"\s*[+-]?\d{1,10}\s*\Z")


class KheperaFirmware:
    """Takes bytes, moves a body, and answers with bytes.

    Args:
        hardware: the body; all calls take effect at the lab's current time.
        lock: held while the body is used.

    Attributes:
        leds: the two light-emitting diodes.
    """

    def __init__(self, hardware: KheperaBody, lock: AbstractContextManager | None = None):
        self._hardware = hardware
        self._lock = threading.RLock() if lock is None else lock
        self._line = bytearray()
        self._long = False
        self._commands: dict[str, tuple[int, Callable[..., str | None]]] = {
            "A": (3, lambda *constants: "a"),
            "B": (0, lambda: f"b,{BIOS},{PROTOCOL}"),
            "C": (2, self._go),
            "D": (2, self._drive),
            "E": (0, lambda: _answer("e", hardware.speeds())),
            "F": (3, lambda *constants: "f"),
            "G": (2, self._set_counts),
            "H": (0, lambda: _answer("h", hardware.counts())),
            "I": (1, lambda channel: "i,0" if 0 <= channel <= 5 else None),
            "J": (4, self._profile),
            "K": (0, self._status),
            "L": (2, self._light),
            "N": (0, lambda: _answer("n", hardware.proximity())),
            "O": (0, lambda: _answer("o", hardware.ambient())),
            "P": (2, self._power),
            "R": (1, lambda address: "r,255" if 0 <= address <= 63 else None),
            "W": (2, lambda data, to: "w" if 0 <= data <= 255 and 0 <= to <= 63 else None),
        }
        self._reset()

    def feed(self, data: bytes) -> bytes:
        """Take bytes in pieces of any size; return the robot's answers to complete commands."""
        answers = b""
        for byte in data:
            if byte in b"\r\n":
                line, too_long = bytes(self._line), self._long
                self._line.clear()
                self._long = False
                if too_long:
                    answers += WRONG
                elif line:
                    answers += self._carry_out(line)
            elif len(self._line) < LONGEST:
                self._line.append(byte)
            else:
                self._long = True
        return answers

    def reboot(self) -> bytes:
        """Start again, as after the reset button: motors off, counters 0; return its message."""
        self._line.clear()
        self._long = False
        with self._lock:
            self._reset()
        return BANNER

    def _reset(self) -> None:
        self.leds = [False, False]
        self._limits = (20, 20)
        self._goal: tuple[int, int] | None = None
        self._hardware.set_speeds(0, 0)
        self._hardware.set_counts(0, 0)
        self._speeds = (0, 0)

    def _carry_out(self, line: bytes) -> bytes:
        text = line.decode("latin-1").strip()
        if not text:
            return b""
        if text == "restart":
            return self.reboot()
        letter, *words = text.split(",")
        if letter == "T":
            # No turret is plugged in.
            return WRONG
        if letter not in self._commands:
            return NOT_FOUND
        count, answer = self._commands[letter]
        if len(words) != count or not all(_NUMBER.match(word) for word in words):
            return WRONG
        with self._lock:
            reply = answer(*(int(word) for word in words))
        return WRONG if reply is None else reply.encode("ascii") + b"\r\n"

    def _drive(self, left: int, right: int) -> str:
        self._goal = None
        self._speeds = (_within(left, LARGEST_SPEED), _within(right, LARGEST_SPEED))
        self._hardware.set_speeds(*self._speeds)
        return "d"

    def _power(self, left: int, right: int) -> str:
        self._goal = None
        self._speeds = tuple(
            round(_within(value, LARGEST_PWM) / LARGEST_PWM * 100) for value in (left, right)
        )
        self._hardware.set_speeds(*self._speeds)
        return "p"

    def _go(self, left: int, right: int) -> str | None:
        if not (_counts(left) and _counts(right)):
            return None
        self._goal = (left, right)
        self._hardware.set_positions(left, right, self._limits)
        return "c"

    def _set_counts(self, left: int, right: int) -> str | None:
        if not (_counts(left) and _counts(right)):
            return None
        self._hardware.set_counts(left, right)
        return "g"

    def _profile(self, left: int, _left_rise: int, right: int, _right_rise: int) -> str | None:
        if not (0 < left <= LARGEST_SPEED and 0 < right <= LARGEST_SPEED):
            return None
        self._limits = (left, right)
        return "j"

    def _status(self) -> str:
        """Return T (on its target), M (0 position, 1 speed) and E (error), left then right."""
        by_speed = self._goal is None
        wanted = self._speeds if by_speed else self._goal
        present = self._hardware.speeds() if by_speed else self._hardware.counts()
        errors = [target - value for target, value in zip(wanted, present, strict=True)]
        fields = [(int(abs(error) <= 2), int(by_speed), error) for error in errors]
        return _answer("k", (*fields[0], *fields[1]))

    def _light(self, number: int, action: int) -> str | None:
        if number not in (0, 1) or action not in (0, 1, 2):
            return None
        self.leds[number] = not self.leds[number] if action == 2 else bool(action)
        return "l"


def _answer(letter: str, values: tuple[int, ...] | list[int]) -> str:
    return ",".join([letter, *(str(value) for value in values)])


def _within(value: int, largest: int) -> int:
    return max(-largest, min(largest, value))


def _counts(value: int) -> bool:
    return -LARGEST_COUNT <= value < LARGEST_COUNT
