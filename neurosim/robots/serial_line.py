"""Lines of text over a serial port, or any URL of pyserial, with errors for people.

A line ends in CR, LF or both.
"""

from __future__ import annotations

import errno
import re
import time
from collections.abc import Callable
from contextlib import suppress

import serial

from neurosim.base.errors import LinkLost, RobotError
from neurosim.robots.base import Driver
from neurosim.robots.pybricks import SCHEME, PybricksPort

#: Seconds that a single read waits; deadlines are kept by the caller.
_SLICE = 0.1
#: Largest number of reads of waiting bytes.
_AT_MOST = 64
#: Number of times that the farewell is sent, and the seconds between them.
FAREWELLS, FAREWELL_EVERY = 4, 0.03
#: Longest answer (an e-puck's help comes in lines); longer ones are garbage.
LONGEST = 512

_NO_RIGHT = "you may not open it; on Linux, join its group (dialout) or use sudo"
_WHY = {
    errno.ENOENT: "there is no such port",
    errno.EACCES: _NO_RIGHT,
    errno.EPERM: _NO_RIGHT,
    errno.EBUSY: "it is busy; another program may hold the line",
    errno.EAGAIN: "it is busy; another program may hold the line",
    errno.EIO: "nothing is behind it any more",
    errno.ENOTTY: "it is not a serial port",
    errno.EISDIR: "it is a folder, not a serial port",
    errno.ECONNREFUSED: "nothing listens there",
}
#: Words in Windows' errors, instead of other systems' numbers.
_WORDS = {
    "FileNotFoundError": errno.ENOENT,
    "PermissionError": errno.EBUSY,
    "Connection refused": errno.ECONNREFUSED,
}


class SerialLine:
    """A serial port that is read line by line.

    Args:
        port: a device (``/dev/ttyUSB0``, ``COM3``) or a URL of pyserial (``socket://host:port``,
            ``rfc2217://host:port``), but not ``spy://``, which overwrites the file that it names;
            or ``pybricks://name`` for the program on a hub, by Bluetooth.
        baud: bits per second.
        stop_bits: 1 or 2.
        farewell: bytes that are sent when the line is given up, several times, because not all of
            them are lost; without waiting for an answer.

    Attributes:
        farewell: the given bytes; it can be set again after the robot's first answer.
    """

    def __init__(self, port: str, *, baud: int, stop_bits: int = 1, farewell: bytes = b""):
        self.port = port
        self.baud = baud
        self._stop_bits = stop_bits
        self.farewell = farewell
        self._serial: serial.SerialBase | PybricksPort | None = None
        self._gone: str | None = None
        self._buffer = b""

    @property
    def is_open(self) -> bool:
        """Whether the line is open."""
        return self._serial is not None

    @property
    def place(self) -> str:
        """The port and, where it has one, its speed, for messages."""
        return self.port if self.port.startswith(SCHEME) else f"{self.port} at {self.baud} baud"

    def open(self) -> None:
        """Open the port, for this program alone if the system supports it.

        Raises:
            RobotError: if it cannot be opened, with the reason.
        """
        if self.port.strip().lower().startswith("spy:"):
            raise RobotError(
                f"cannot open the serial port {self.port}: spy:// is not allowed, because it "
                "overwrites a file; give the port alone"
            )
        try:
            if self.port.startswith(SCHEME):
                self._serial = PybricksPort(self.port.removeprefix(SCHEME), timeout=_SLICE)
            else:
                self._serial = serial.serial_for_url(
                    self.port,
                    baudrate=self.baud,
                    stopbits=self._stop_bits,
                    timeout=_SLICE,
                    write_timeout=5.0,
                    exclusive=True,
                )
        except (OSError, ValueError, AttributeError, ImportError) as error:
            raise RobotError(f"cannot open the serial port {self.port}: {_reason(error)}") from None
        self._gone, self._buffer = None, b""

    def connect(self, greet: Callable[[], object]) -> None:
        """Open the port and greet the robot; close it if this fails.

        Args:
            greet: checks that the right robot answers, and stops it.

        Raises:
            RobotError: if the port cannot be opened; also all errors of ``greet``.
        """
        self.open()
        try:
            greet()
        except BaseException:
            self.close()
            raise

    def hang_up(self, stop: Callable[[], object]) -> None:
        """Stop the robot if the line is still open, and close it; raises only Ctrl-C.

        Args:
            stop: stops the robot.
        """
        try:
            if self.is_open:
                with suppress(Exception):
                    stop()
        except BaseException:
            self.say_farewell()
            raise
        finally:
            self.close()

    def close(self) -> None:
        """Close the port; never raises."""
        if self._serial is not None:
            with suppress(Exception):
                self._serial.close()
            self._serial = None

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises:
            LinkLost: if the line accepts no more bytes.
        """
        try:
            self._connected().write(data)
        except (OSError, TypeError, ValueError) as error:
            raise self._lost(error) from None

    def waiting(self) -> list[bytes]:
        """Return the complete lines received so far; a rest without an end is dropped."""
        port, lines = self._connected(), []
        try:
            # Bounded, so that a flood of bytes cannot block this thread.
            for _ in range(_AT_MOST):
                if not (count := port.in_waiting):
                    break
                self._buffer += port.read(count).replace(b"\r", b"\n")
                while (line := self._cut()) is not None:
                    lines.append(line)
        except (OSError, TypeError, ValueError) as error:
            raise self._lost(error) from None
        while (line := self._cut()) is not None:
            lines.append(line)
        self._buffer = b""
        return lines

    def read_line(self, seconds: float) -> bytes | None:
        """Return the next line without its end, or None if none is complete in time.

        Args:
            seconds: wall-clock time that it may take.

        Raises:
            LinkLost: if the line is gone.
        """
        port = self._connected()
        end = None
        while (line := self._cut()) is None:
            now = time.monotonic()
            end = now + seconds if end is None else end
            if now >= end:
                return None
            try:
                data = port.read(1)
                if data and (more := port.in_waiting):
                    data += port.read(more)
            except (OSError, TypeError, ValueError) as error:
                raise self._lost(error) from None
            self._buffer += data.replace(b"\r", b"\n")
        return line

    def read_some(self, seconds: float) -> bytes:
        """Return received bytes of a protocol without lines; empty if none come in time.

        Args:
            seconds: wall-clock time that the first may take; 0: only waiting bytes.

        Raises:
            LinkLost: if the line is gone.
        """
        port, end = self._connected(), time.monotonic() + seconds
        try:
            while True:
                count = port.in_waiting
                if data := port.read(count or 1) if count or seconds > 0 else b"":
                    return bytes(data)
                if time.monotonic() >= end:
                    return b""
        except (OSError, TypeError, ValueError) as error:
            raise self._lost(error) from None

    def _cut(self) -> bytes | None:
        """Take the next non-empty line from the received bytes."""
        while self._buffer:
            line, ending, rest = self._buffer.partition(b"\n")
            if not ending:
                if len(line) <= LONGEST:
                    return None
                line, rest = line[:LONGEST], b""
            self._buffer = rest
            line = line.strip(b"\0\f\a ")
            if line:
                return line
        return None

    def _connected(self) -> serial.SerialBase | PybricksPort:
        if self._gone is not None:
            raise LinkLost(self._gone)
        if self._serial is None:
            raise RobotError(f"the serial port {self.port} is not open: connect first")
        return self._serial

    def _lost(self, error: Exception) -> LinkLost:
        return self.lose(f"the line {self.port} is gone: {_reason(error)}")

    def say_farewell(self) -> None:
        """Send the farewell, several times, if the line is open; never raises."""
        port = self._serial
        if port is not None and self.farewell:
            with suppress(Exception):
                port.write_timeout = FAREWELL_EVERY
                for _ in range(FAREWELLS):
                    port.write(self.farewell)
                    time.sleep(FAREWELL_EVERY)

    def lose(self, why: str) -> LinkLost:
        """Close the line for good and return the error, which later calls raise again.

        First the farewell is sent: it may arrive even if no answer comes back.
        """
        self.say_farewell()
        self.close()
        self._gone = why
        return LinkLost(why)


class SerialDriver(Driver):
    """The base of drivers of robots on a serial line, which have ``_greet`` and ``stop``."""

    _line: SerialLine

    def connect(self) -> None:
        """Open the line, check that the expected robot answers, and stop it.

        Raises:
            RobotError: if the port cannot be opened, nothing answers, or something else does.
        """
        if not self._line.is_open:
            self._line.connect(self._greet)

    def close(self) -> None:
        """Stop the robot if the line is still open, and close it; raises only Ctrl-C."""
        self._line.hang_up(self.stop)


def _reason(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code is None:
        code = next((code for words, code in _WORDS.items() if words in str(error)), None)
        if code is None and (number := re.search(r"\[Errno (\d+)\]|\((\d+), '", str(error))):
            code = int(number[1] or number[2])
    return _WHY.get(code) or " ".join(str(error).split()) or type(error).__name__
