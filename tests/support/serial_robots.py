"""An e-puck2 and a Khepera IV in software: the answers of their published programs.

After Asercom2.c, e_motors.c, motors.h and battery_level.h of e-puck2_main-processor, and
kh4server.c and khepera4.h of K-Team's libkhepera. Their wheels turn as they are commanded, in a
clock's time.
"""

from __future__ import annotations

import re
import threading
from contextlib import contextmanager

from neurosim.lab.cable import SerialCable, serve_cable


class Quick:
    """A clock whose sleeps take no real time."""

    def __init__(self):
        self._time, self._lock = 0.0, threading.Lock()

    def now(self):
        return self._time

    def sleep_until(self, time):
        with self._lock:
            self._time = max(self._time, time)


class _Wheels:
    """Two wheels, and answers to lines."""

    limit: int
    per_second: float  # pulses of a counter at a speed of 1

    def __init__(self, clock):
        self.clock, self.heard, self._rest = clock, [], ""
        self.start()

    def start(self):
        """Restart."""
        self.speeds, self.lamp, self._counts, self._since = (0, 0), None, [0.0, 0.0], 0.0
        self._since = self.clock.now()

    def drive(self, left, right):
        self.counts()
        self.speeds = tuple(max(-self.limit, min(self.limit, each)) for each in (left, right))

    def counts(self):
        now = self.clock.now()
        for place, speed in enumerate(self.speeds):
            self._counts[place] += speed * self.per_second * (now - self._since)
        self._since = now
        return [int(each) for each in self._counts]

    def feed(self, data):
        answers, self._rest = "", self._rest + data.decode("latin-1")
        while (match := re.search(self.ends, self._rest)) is not None:
            line, self._rest = self._rest[: match.start()], self._rest[match.end() :]
            if line:
                self.heard.append(line)
                answers += self.answer(line)
        return answers.encode()


def _line(letter, numbers):
    return ",".join([letter, *map(str, numbers)]) + "\r\n"


class EPuck2(_Wheels):
    """The factory firmware of an e-puck2, its selector at 3 (Bluetooth) or 8 (USB)."""

    ends, limit, per_second = "[\r\n]", 1100, 1.0
    banner = (
        b"\f\aWELCOME to the SerCom protocol on e-Puck\r\n"
        b'the EPFL education robot type "H" for help\r\n'
    )
    proximity = (0, 12, 3, 0, 0, 4, 250, 4095)

    def answer(self, line):
        letter = line[0] if line[0] in "bg" else line[0].upper()
        if letter == "D":
            if result := re.match(r"D,(-?\d+),(-?\d+)", line):
                self.drive(int(result[1]), int(result[2]))
            return "d\r\n"
        if letter == "B":
            self.lamp = bool(int(line[2:]))
            return "b\r\n"
        return {
            "b": lambda: "b,3193 (62%)\r\n",
            "E": lambda: _line("e", self.speeds),
            "N": lambda: _line("n", self.proximity),
            "O": lambda: _line("o", range(900, 908)),
            "P": lambda: "p\r\n",  # e_set_steps_left and _right do nothing
            "Q": lambda: _line("q", self.counts()),
            "V": lambda: "v,Version 2.0 January 2018 GCtronic\r\nHW version: FFFF\r\n",
        }.get(letter, lambda: "z,Command not found\r\n")()


class Khepera4(_Wheels):
    """The program kh4server; its system hands it whole lines."""

    # A speed of 1 is 0.6781 mm/s, a pulse 0.006781 mm.
    ends, limit, per_second = "\n", 1500, 100.0
    proximity = (*range(100, 900, 100), 11, 12, 13, 14)

    def answer(self, line):
        letter, *words = line.partition("\r")[0].split(",")
        numbers = [int(word) for word in words]
        if letter == "D":
            self.drive(*numbers)
            return "d\r\n"
        if letter == "I":
            self._counts = [0.0, 0.0]
            return "i\r\n"
        if letter == "K" and len(numbers) == 9:
            self.lamp = any(numbers)
            return "k\r\n"
        return {
            "B": lambda: "b,B,1\r\n",
            "E": lambda: _line("e", self.speeds),
            "N": lambda: _line("n", self.proximity),
            "O": lambda: _line("o", range(900, 912)),
            "R": lambda: _line("r", self.counts()),
            "V": lambda: "v,7427\r\n" if numbers == [0] else "$\r\n",
        }.get(letter, lambda: "$\r\n")()


@contextmanager
def on_a_line(kind, device="pty"):
    """Serve such a robot on a pseudo-terminal or a socket; give the robot and its cable."""
    robot = kind(Quick())
    with serve_cable(SerialCable(robot, robot.clock, 10 / 115_200), device, 0) as cable:
        yield robot, cable
