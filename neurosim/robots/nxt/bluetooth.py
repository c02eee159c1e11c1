"""Bluetooth for nxt-python by Python's own sockets, because its PyBluez is no longer maintained.

Use it as any back end of nxt-python::

    nxt.locator.find(backends=[bluetooth.Backend()], host="00:16:53:01:02:03")
"""

from __future__ import annotations

import errno
import os
import re
import socket
import struct
from collections.abc import Iterator
from typing import Any

import nxt.brick

from neurosim.base.errors import RobotError

#: The NXT's RFCOMM channel.
CHANNEL = 1
#: Seconds for the radio to find a brick and connect.
CONNECT_WITHIN = 20.0

_WHY = {
    errno.EHOSTDOWN: "it does not answer; is it on, in range and its Bluetooth visible?",
    errno.ETIMEDOUT: "it does not answer; is it on, in range and its Bluetooth visible?",
    errno.ECONNREFUSED: "it refuses; pair it with this computer first (passkey 1234)",
    errno.EACCES: "not permitted; pair it with this computer first (passkey 1234)",
    errno.EBUSY: "it is busy; another program may hold the connection",
    errno.ENODEV: "this computer has no Bluetooth adapter that is switched on",
    errno.ENETUNREACH: "this computer has no Bluetooth adapter that is switched on",
    errno.EAFNOSUPPORT: "this computer has no Bluetooth adapter that is switched on",
    errno.EPROTONOSUPPORT: "this system has no RFCOMM; load its kernel module (rfcomm)",
}


class BluetoothSock:
    """A brick's serial port over RFCOMM: telegrams after their length, 2 bytes, low first."""

    #: Block size, as nxt-python's own.
    bsize = 118
    #: Connection type, from which nxt-python takes the latency.
    type = "bluetooth"

    def __init__(self, host: str):
        self._host = host
        self._sock: socket.socket | None = None

    def __str__(self) -> str:
        return f"Bluetooth ({self._host})"

    def connect(self) -> nxt.brick.Brick:
        """Connect and return the brick.

        Raises:
            RobotError: if this computer has no Bluetooth, or the brick does not answer.
        """
        family = getattr(socket, "AF_BLUETOOTH", None)
        protocol = getattr(socket, "BTPROTO_RFCOMM", None)
        if family is None or protocol is None:
            raise RobotError(
                "this Python was built without Bluetooth sockets: reach the brick by a device file "
                "(/dev/rfcomm0, or a serial port on macOS), by USB, or through nxt-server on "
                "another computer"
            )
        sock = None
        try:
            sock = socket.socket(family, socket.SOCK_STREAM, protocol)
            sock.settimeout(CONNECT_WITHIN)
            sock.connect((self._host, CHANNEL))
            sock.settimeout(None)
        except OSError as error:
            if sock is not None:
                sock.close()
            code = errno.ETIMEDOUT if isinstance(error, TimeoutError) else error.errno
            why = _WHY.get(code) or (os.strerror(code) if code else str(error))
            raise RobotError(f"no brick reached over Bluetooth at {self._host}: {why}") from None
        self._sock = sock
        return nxt.brick.Brick(self)

    def close(self) -> None:
        """Close the connection."""
        if self._sock is not None:
            self._sock.close()
            self._sock = None

    def send(self, data: bytes) -> None:
        """Send one telegram."""
        self._sock.sendall(struct.pack("<H", len(data)) + data)

    def recv(self) -> bytes:
        """Receive one telegram, in any number of pieces.

        Raises:
            ConnectionError: if the connection ends before the telegram does.
        """
        (length,) = struct.unpack("<H", self._exactly(2))
        return self._exactly(length)

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self._sock.recv(count - len(data))
            if not piece:
                raise ConnectionError(f"the Bluetooth connection to {self._host} ended")
            data += piece
        return data


class Backend:
    """nxt-python's back end interface: finds the brick of a given address."""

    def find(
        self, host: str | None = None, name: str | None = None, **filters: Any
    ) -> Iterator[nxt.brick.Brick]:
        """Yield the brick at a Bluetooth address; other parameters are ignored.

        Python's sockets cannot search for devices, so the address must be given. The brick
        shows it under Settings, NXT Version.

        Raises:
            RobotError: without an address, or if nothing answers there.
        """
        if host is None:
            raise RobotError(
                "Python's own Bluetooth sockets cannot search for bricks: give the brick's "
                "address (00:16:53:..; it stands under Settings, NXT Version)"
            )
        if not re.fullmatch(r"(?:[0-9A-Fa-f]{2}:){5}[0-9A-Fa-f]{2}", host):
            raise RobotError(
                f"{host!r} is not a Bluetooth address: expected six pairs of hexadecimal digits "
                "such as 00:16:53:01:02:03"
            )
        yield BluetoothSock(host).connect()


def get_backend() -> Backend:
    """Return the back end for nxt-python's locator."""
    return Backend()
