"""The connections to an NXT brick, each through a back end of nxt-python, and a guard on the line.

nxt-python waits for ever for a silent brick. The guard gives every reply a deadline, and turns
silence, a closed line and wrong bytes into one sentence.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import nxt.brick

from neurosim.base.errors import LinkLost, RobotError
from neurosim.robots.nxt import bluetooth

T = TypeVar("T")

#: Longest telegram of a brick.
LONGEST_REPLY = 128
#: Seconds that the opening of a device file may take; over Bluetooth it pages the brick.
OPEN_WITHIN = 30.0
#: Seconds that sending a telegram may take over a line that was given up.
POST_WITHIN = 0.25
#: Reason for giving up a line with wrong bytes.
GARBAGE = "it does not send LEGO's protocol"
_REPLY, _NO_REPLY = 0x02, 0x80

_CONNECTIONS = (
    "a brick is reached by USB, by Bluetooth (its address, 00:16:53:..), by a device file "
    "(/dev/rfcomm0, or a serial port on macOS) or through nxt-server (host and port)"
)


class Guard:
    """Replaces nxt-python's socket object: gives complete replies within a deadline, or LinkLost.

    Args:
        sock: nxt-python's object, connected.
        place: words for the connection in an error: "on /dev/rfcomm0".
        deadline: wall-clock seconds that a reply, or the sending of a telegram, may take.

    Attributes:
        lost: reason why the line was given up, or None while it works.
    """

    def __init__(self, sock: Any, place: str, deadline: float):
        self._sock = sock
        self.place = place
        self.bsize = sock.bsize
        self.type = sock.type
        self._deadline = deadline
        self.lost: str | None = None
        self._owed = 0
        self._buffer = b""
        self._device = getattr(sock, "_device", None)
        self._stream = getattr(sock, "_sock", None)
        self._framed = self._device is not None or isinstance(sock, bluetooth.BluetoothSock)

    def __str__(self) -> str:
        return str(self._sock)

    def send(self, data: bytes) -> None:
        """Send one telegram.

        Before a telegram that asks for a reply, a pending reply of an interrupted call (Ctrl-C) is
        read and dropped.

        Raises:
            LinkLost: if the line accepts no more bytes, or has failed before.
        """
        asks = not data[0] & _NO_REPLY
        while asks and self._owed:
            self.recv()
        self._check()
        try:
            self._put(data)
        except OSError as error:
            raise self.lose(_reason(error, self._deadline)) from None
        self._owed += asks

    def recv(self) -> bytes:
        """Return the next reply.

        Raises:
            LinkLost: if none comes within the deadline, the line closes, or the bytes are not a
                reply.
        """
        self._check()
        try:
            reply = self._read_frame() if self._framed else self._read_packet()
        except OSError as error:
            raise self.lose(_reason(error, self._deadline)) from None
        if len(reply) < 3 or reply[0] != _REPLY:
            echo = len(reply) > 1 and reply[0] in (0x00, 0x01)
            raise self.lose("it sends back its own input, as a terminal does" if echo else GARBAGE)
        self._owed = max(self._owed - 1, 0)
        return reply

    def post(self, data: bytes) -> None:
        """Send a telegram that asks for no reply, in any state of the line; never raises.

        Only a stop is sent like this: the brick may still receive it, even if its replies are
        missing or wrong.
        """
        deadline, self._deadline = self._deadline, min(self._deadline, POST_WITHIN)
        try:
            with suppress(Exception):
                self._put(data)
        finally:
            self._deadline = deadline

    def close(self) -> None:
        """Close the line; never raises."""
        for part in (self._sock, self._device, self._stream):
            if part is not None:
                with suppress(Exception):
                    part.close()

    def lose(self, why: str) -> LinkLost:
        """Mark the line as failed and return the error to raise."""
        self.lost = why
        return LinkLost(f"the brick {self.place} stopped answering: {why}")

    def _put(self, data: bytes) -> None:
        if self._device is not None:
            self._write(struct.pack("<H", len(data)) + data)
        else:
            if self._stream is not None:
                self._stream.settimeout(self._deadline)
            self._sock.send(data)

    def _check(self) -> None:
        if self.lost is not None:
            raise self.lose(self.lost)

    def _read_packet(self) -> bytes:
        data = self._sock.recv()
        if not data:
            raise ConnectionError
        return data

    def _read_frame(self) -> bytes:
        end = time.monotonic() + self._deadline
        self._fill(2, end)
        (length,) = struct.unpack_from("<H", self._buffer)
        if not 0 < length <= LONGEST_REPLY:
            return b""
        self._fill(2 + length, end)
        frame, self._buffer = self._buffer[2 : 2 + length], self._buffer[2 + length :]
        return frame

    def _fill(self, count: int, end: float) -> None:
        while len(self._buffer) < count:
            piece = self._read_some(count - len(self._buffer), max(end - time.monotonic(), 0.0))
            if not piece:
                raise ConnectionError
            self._buffer += piece

    def _read_some(self, count: int, seconds: float) -> bytes:
        if self._device is None:
            self._stream.settimeout(max(seconds, 1e-3))
            return self._stream.recv(count)
        if not select.select([self._device], [], [], seconds)[0]:
            raise TimeoutError
        return os.read(self._device.fileno(), count)

    def _write(self, data: bytes) -> None:
        end = time.monotonic() + self._deadline
        while data:
            if not select.select([], [self._device], [], max(end - time.monotonic(), 0.0))[1]:
                raise TimeoutError
            data = data[os.write(self._device.fileno(), data) :]


def open_brick(
    *,
    host: str | None = None,
    filename: str | None = None,
    server_host: str | None = None,
    server_port: int | None = None,
    deadline: float = 3.0,
) -> nxt.brick.Brick:
    """Open the line to a brick, by USB unless an argument names another way.

    Args:
        host: the brick's Bluetooth address.
        filename: a device file that leads to the brick.
        server_host: a computer on which nxt-server runs, localhost if only the port is given.
        server_port: its port, 2727 if only the host is given.
        deadline: seconds that any reply may take.

    Returns:
        nxt-python's brick, with its ``_sock`` behind a :class:`Guard`. It was not asked yet, so it
        may be another device.

    Raises:
        RobotError: if the line cannot be opened.
    """
    server = server_host is not None or server_port is not None
    if sum([host is not None, filename is not None, server]) > 1:
        raise RobotError(
            "give one way to the brick only: a Bluetooth address, a device file or a server"
        )
    if host is not None:
        brick = next(bluetooth.get_backend().find(host=host))
        place = f"at {host} (Bluetooth)"
    elif filename is not None:
        brick, place = _open_device(filename), f"on {filename}"
    elif server:
        address = (server_host or "localhost", 2727 if server_port is None else server_port)
        brick, place = _open_server(*address, deadline), "at {}:{}".format(*address)
    else:
        brick, place = _open_usb(), "on USB"
    brick._sock = Guard(brick._sock, place, deadline)
    return brick


def _open_device(filename: str) -> nxt.brick.Brick:
    try:
        import termios

        from nxt.backend.devfile import DevFileSock
    except ImportError:
        raise RobotError(
            f"{filename}: this system has no device files for serial lines; {_CONNECTIONS}"
        ) from None
    sock = DevFileSock(filename)
    sock._device = None

    try:
        brick = _within(OPEN_WITHIN, lambda: _connect(sock))
        # Unread bytes of an earlier program would be mistaken for the first reply.
        termios.tcflush(sock._device, termios.TCIOFLUSH)
    except TimeoutError:
        raise RobotError(
            f"cannot open {filename}: nothing on that line within {OPEN_WITHIN:g} s; is the "
            "brick on and in range?"
        ) from None
    except termios.error:
        sock.close()
        raise RobotError(
            f"{filename} is not a serial line, so no brick can be behind it; {_CONNECTIONS}"
        ) from None
    except OSError as error:
        sock.close()
        why = {
            errno.ENOENT: f"there is no such file; {_CONNECTIONS}",
            errno.EACCES: "you may not open it; on Linux, join its group (dialout) or use sudo",
            errno.EPERM: "you may not open it; on Linux, join its group (dialout) or use sudo",
            errno.EBUSY: "it is busy; another program may hold the line",
            errno.EAGAIN: "it is busy; another program holds the line",
            errno.EISDIR: "it is a folder, not a device file",
            errno.EHOSTDOWN: "the brick does not answer; is it on and in range?",
        }.get(error.errno, os.strerror(error.errno) if error.errno else str(error))
        raise RobotError(f"cannot open {filename}: {why}") from None
    return brick


def _connect(sock: Any) -> nxt.brick.Brick:
    """Open like the device-file socket's own connect, but never as controlling terminal.

    Otherwise a session leader (a notebook's kernel, a service) would get a hang-up when the line
    closes.
    """
    import fcntl
    import tty

    def opener(path: str, flags: int) -> int:
        return os.open(path, flags | os.O_NOCTTY)

    sock._device = open(sock._filename, "r+b", buffering=0, opener=opener)  # noqa: SIM115
    # For this program alone, like pyserial: two programs must not drive one robot.
    fcntl.flock(sock._device, fcntl.LOCK_EX | fcntl.LOCK_NB)
    tty.setraw(sock._device)
    return nxt.brick.Brick(sock)


def _within(seconds: float, function: Callable[[], T]) -> T:
    """Call a function that may block for ever, such as opening a line without a carrier.

    Raises:
        TimeoutError: if it has not returned in time; it continues in its thread.
    """
    outcome: list[tuple[T | None, BaseException | None]] = []

    def call() -> None:
        try:
            outcome.append((function(), None))
        except BaseException as error:
            outcome.append((None, error))

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(seconds)
    if not outcome:
        raise TimeoutError
    value, error = outcome[0]
    if error is not None:
        raise error
    return value


def _open_server(host: str, port: int, deadline: float) -> nxt.brick.Brick:
    from nxt.backend.socket import SocketSock

    sock = SocketSock(host, port)
    try:
        # Like SocketSock.connect, with a deadline.
        sock._sock = socket.create_connection((host, port), timeout=deadline)
        sock._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.send(b"\x98")
        kind = sock.recv()
    except (OSError, OverflowError) as error:
        _quietly_close(sock)
        why = _reason(error, deadline) if isinstance(error, TimeoutError) else str(error)
        raise RobotError(f"no nxt-server reached at {host}:{port}: {why}") from None
    if kind not in (b"usb", b"bluetooth"):
        _quietly_close(sock)
        raise RobotError(f"the server at {host}:{port} is not nxt-server; {_CONNECTIONS}")
    sock.type = "ip" + kind.decode("ascii")
    return nxt.brick.Brick(sock)


def _open_usb() -> nxt.brick.Brick:
    try:
        import usb.core
        from nxt.backend.usb import get_backend
    except ImportError:
        raise RobotError(f"USB needs pyusb (pip install pyusb); {_CONNECTIONS}") from None
    try:
        brick = next(get_backend().find(), None)
    except usb.core.NoBackendError:
        raise RobotError(
            f"USB needs the library libusb 1.0, which is not here; {_CONNECTIONS}"
        ) from None
    except (usb.core.USBError, NotImplementedError) as error:
        if getattr(error, "errno", None) in (errno.EACCES, errno.EPERM):
            raise RobotError(
                "you may not use the brick on USB: on Linux, add a udev rule for LEGO's vendor "
                "number 0694; on Windows, install the WinUSB driver"
            ) from None
        raise RobotError(f"the brick on USB cannot be opened: {error}") from None
    if brick is None:
        raise RobotError(f"no brick found on USB: plug it in and switch it on; {_CONNECTIONS}")
    return brick


def _quietly_close(sock: Any) -> None:
    stream, sock._sock = sock._sock, None
    if stream is not None:
        stream.close()


def _reason(error: Exception, deadline: float) -> str:
    if isinstance(error, TimeoutError) or getattr(error, "errno", None) == errno.ETIMEDOUT:
        return f"no reply within {deadline:g} s; is it on, in range, and its battery charged?"
    if isinstance(error, ConnectionError) or getattr(error, "errno", None) == errno.EIO:
        return "the line was closed; is it on, in range, and its battery charged?"
    return f"{error}"
