"""A check over its line that a robot follows docs/lines.md.

The robot drives for short times, at up to a quarter of its limits: give it free space, or lift its
wheels. Wrong and cut lines are tried byte by byte.
"""

from __future__ import annotations

import random
import time

from neurosim.robots.base import Clock, SystemClock
from neurosim.robots.lines.driver import BAUD, BOOT, Lines
from neurosim.robots.lines.protocol import LONGEST, Greeting, decode, encode
from neurosim.robots.serial_line import SerialLine

#: Longest time of an answer, wall-clock s.
PATIENCE = 2.0
#: Time after which a stopped robot is at rest, s.
COASTS = 0.8
#: Largest excess of a command's duration, s.
OVER = 0.15


def check_lines(port: str, *, baud: int = BAUD, clock: Clock | None = None) -> Greeting:
    """Check the robot behind a port against the protocol.

    Args:
        port: port for the driver.
        baud: speed of the line.
        clock: a clock in the robot's time; by default this computer's.

    Returns:
        Its greeting.

    Raises:
        AssertionError: with one sentence about the first deviation.
        RobotError: if nothing answers, or the greeting is wrong.
    """
    driver = Lines(port, baud=baud, timeout=PATIENCE)
    with driver:
        assert driver.greeting is not None
        greeting = driver.greeting
    line = SerialLine(port, baud=baud, farewell=b"\nstop\n")
    line.open()
    try:
        _Check(line, clock or SystemClock(), greeting).all()
    finally:
        line.say_farewell()
        line.close()
    return greeting


class _Check:
    def __init__(self, line: SerialLine, clock: Clock, greeting: Greeting):
        self._line, self._clock, self._greeting = line, clock, greeting
        self._number = 0
        gentle = [
            f"{0.25 * (one.high if one.speed else 0.0):g}" for one in greeting.commands.numbers
        ]
        self._gentle = " ".join(gentle)

    def all(self) -> None:
        """Run all checks; the first deviation is reported."""
        self._settle()
        self._by_hand()
        self._times()
        self._drives()
        self._refusals()
        self._endings()
        self._cuts()
        self._cuts_while_driving()
        self._garbage()
        if self._greeting.lamp:
            for on in (1, 0):
                _require(self._ask(f"lamp {on}")[0] == "ok", f"'lamp {on}' must be answered by ok")

    def _settle(self) -> None:
        """Wait until the robot answers: opening the port may reset a board."""
        end = time.monotonic() + BOOT
        while time.monotonic() < end:
            number = self._send("stop")
            if self._wait(number, 0.3) is not None:
                return
        _require(False, "it does not answer 'stop'")

    def _by_hand(self) -> None:
        """Requests of a person at a terminal have neither number nor checksum."""
        for word in ("hello", "read", "stop"):
            self._write(word.encode() + b"\r\n")
            words = self._wait("0", PATIENCE)
            _require(words is not None, f"{word!r} alone, as a person writes it, is not answered")
        self._drain()

    def _times(self) -> None:
        before, begin = self._read()[0], self._clock.now()
        self._sleep(0.5)
        after, took = self._read()[0], self._clock.now() - begin
        passed = (after - before) / 1000
        _require(
            abs(passed - took) < 0.1 + 0.05 * took,
            f"its time must be in milliseconds: {passed:g} s passed in {took:.2f} s",
        )

    def _drives(self) -> None:
        counts = self._counts()
        self._drive(300)
        rest = self._rest()
        _require(0 < rest <= 300, f"of a command of 300 ms, {rest} ms cannot be left just after it")
        self._sleep(0.3 + OVER)
        self._stands("a command of 300 ms, with nothing sent after it,")
        if counts:
            _require(self._counts() != counts, "it counts nothing while it drives")
        self._drive(5000)
        self._drive(200)
        rest = self._rest()
        _require(rest <= 200, f"a command must replace the one before, but {rest} ms are left")
        for word in (f"{self._next()} stop", "stop", "hello"):
            self._drive(2000)
            self._write(b"\n" + (encode(word) if word[0].isdigit() else word.encode() + b"\n"))
            self._sleep(0.05)
            self._drain()
            _require(self._rest() == 0, f"{word!r} must stop it")

    def _refusals(self) -> None:
        longest = round(1000 * self._greeting.longest)
        for text in (
            "drive",
            "drive 300",
            f"drive 300 {self._gentle} 0",
            f"drive 300 {self._gentle}x",
            f"drive 300x {self._gentle}",
            f"drive 0 {self._gentle}",
            f"drive -300 {self._gentle}",
            f"drive {longest + 1} {self._gentle}",
            f"drive 99999999999 {self._gentle}",
            f"drive nan {self._gentle}",
            f"sing {self._gentle}",
            *(f"drive 300 {one}" for one in self._beyond()),
        ):
            answer = self._ask(text)
            _require(answer[0] == "error", f"{text!r} must be answered by error, not {answer}")
            _require(self._rest() == 0, f"{text!r} must not move it")
        whole = encode(f"{self._next()} drive 300 {self._gentle}")
        wrong = whole[:-2] + (b"1" if whole[-2:-1] != b"1" else b"2") + b"\n"
        bare = whole.partition(b"*")[0] + b"\n"
        long = encode(f"{self._next()} drive 300 {self._gentle}" + " " * LONGEST)
        for data, what in ((wrong, "a wrong checksum"), (bare, "no checksum"), (long, "too long")):
            self._write(b"\n" + data)
            self._sleep(0.05)
            self._drain()
            _require(self._rest() == 0, f"a command with {what} must not move it: {data!r}")
        self._drive(400)
        self._write(b"\n" + wrong)
        self._sleep(0.4 + OVER)
        self._drain()
        self._stands("a command that was followed by a line with a wrong checksum")

    def _beyond(self) -> list[str]:
        """Return commands with one number beyond its limits, or without numbers."""
        beyond = []
        for place, one in enumerate(self._greeting.commands.numbers):
            span = one.high - one.low
            for value in (f"{one.high + span:g}", f"{one.low - span:g}", "nan", "inf", "-inf", "x"):
                words = self._gentle.split()
                words[place] = value
                beyond.append(" ".join(words))
        return beyond

    def _endings(self) -> None:
        for end in (b"\n", b"\r", b"\r\n"):
            number = self._next()
            self._write(encode(f"{number} read").rstrip(b"\n") + end)
            _require(self._wait(str(number), PATIENCE) is not None, f"a line may end in {end!r}")

    def _cuts(self) -> None:
        """A command that is cut after any byte moves nothing, with any text after it."""
        whole = encode(f"{self._next()} drive 2000 {self._gentle}")
        for cut in range(len(whole) - 1):
            self._write(whole[:cut] + b"\n")
            rest = self._rest()
            _require(rest == 0, f"it drives for {rest} ms after {whole[:cut]!r} and a line end")
            # The next line follows the cut one, and both form one line.
            self._write(whole[:cut] + encode(f"{self._next()} read"))
            rest = self._rest()
            _require(rest == 0, f"it drives for {rest} ms after {whole[:cut]!r} and another line")

    def _cuts_while_driving(self) -> None:
        """A cut command does not prolong the previous one."""
        whole = encode(f"{self._next()} drive 5000 {self._gentle}")
        for cut in (1, len(whole) // 2, len(whole) - 6, len(whole) - 2):
            self._drive(300)
            self._write(whole[:cut])
            self._sleep(0.3 + OVER)
            self._stands(f"a command of 300 ms, with {whole[:cut]!r} behind it,")

    def _garbage(self) -> None:
        rng = random.Random(0)
        self._drive(300)
        self._write(bytes(rng.choice(range(128, 256)) for _ in range(300)))
        self._sleep(0.3 + OVER)
        self._stands("a command that was followed by garbage")

    # Requests

    def _stands(self, what: str) -> None:
        rest = self._rest()
        _require(rest == 0, f"{what} must be over, but {rest} ms are left")
        self._sleep(COASTS)
        before = self._counts()
        self._sleep(0.2)
        after = self._counts()
        _require(
            before == after, f"{what} is over, but its counters continue: {before}, then {after}"
        )

    def _drive(self, milliseconds: int) -> None:
        answer = self._ask(f"drive {milliseconds} {self._gentle}")
        _require(answer[0] == "ok", f"a command of {milliseconds} ms is answered by {answer}")

    def _rest(self) -> int:
        return self._read()[1]

    def _counts(self) -> list[int]:
        begin = 2 + len(self._greeting.sensors)
        return self._read()[begin : begin + len(self._greeting.counters)]

    def _read(self) -> list[int]:
        answer = self._ask("read")
        expected = self._greeting.values + 2
        numbers = [int(word) for word in answer[1:] if word.lstrip("-").isdigit()]
        _require(
            answer[0] == "read" and len(numbers) == len(answer) - 1 == expected,
            f"'read' must be answered by {expected} whole numbers, not {answer}",
        )
        for sensor, value in zip(self._greeting.sensors, numbers[2:], strict=False):
            _require(
                0 <= value <= sensor.full, f"{sensor.name} reads {value}, beyond 0 to {sensor.full}"
            )
        return numbers

    def _ask(self, request: str) -> list[str]:
        number = self._send(request)
        words = self._wait(number, PATIENCE)
        _require(words is not None, f"{request!r} is not answered")
        assert words is not None
        return words

    def _send(self, request: str) -> str:
        number = self._next()
        self._write(b"\n" + encode(f"{number} {request}"))
        return str(number)

    def _wait(self, number: str, seconds: float) -> list[str] | None:
        end = time.monotonic() + seconds
        while (line := self._line.read_line(max(end - time.monotonic(), 0.0))) is not None:
            words = decode(line)
            _require(words is not None, f"an answer has no right checksum: {line!r}")
            if words and words[0] == number:
                return words[1:]
        return None

    def _write(self, data: bytes) -> None:
        self._line.write(data)

    def _drain(self) -> None:
        while self._line.read_line(0.05) is not None:
            pass

    def _sleep(self, seconds: float) -> None:
        self._clock.sleep_until(self._clock.now() + seconds)

    def _next(self) -> int:
        self._number = self._number % 999 + 1
        return self._number


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)
