"""A serial cable to a virtual robot, and the pseudo-terminal or the socket at its end."""

from __future__ import annotations

import os
import socket
from typing import Protocol

from neurosim.base.errors import RobotError
from neurosim.lab.server import PtyEnd, SocketEnd, receive, send
from neurosim.robots.base import Clock


class Firmware(Protocol):
    """Takes bytes in pieces of any size, and gives the robot's answers."""

    def feed(self, data: bytes) -> bytes:
        """Take bytes; return the answers to complete commands."""
        ...


class SerialCable:
    """Carries bytes to the firmware and back, in the lab's time as slowly as a serial line.

    One direction at a time: an answer leaves after its command has arrived; the next command is
    taken after the answer has left.

    Args:
        firmware: the answering object.
        clock: the lab's clock.
        byte: time that a byte takes, s.
    """

    def __init__(self, firmware: Firmware, clock: Clock, byte: float):
        self.firmware, self._clock = firmware, clock
        self._byte = byte
        self.silent = False

    def exchange(self, data: bytes) -> bytes:
        """Return all answers to the received bytes after the clock has reached their end."""
        answers = b""
        for command in _commands(data):
            self._clock.sleep_until(self._clock.now() + len(command) * self._byte)
            answer = b"" if self.silent else self.firmware.feed(command)
            if answer:
                self._clock.sleep_until(self._clock.now() + len(answer) * self._byte)
                answers += answer
        return answers


class PtyCable(PtyEnd):
    """A pseudo-terminal at the end of a cable."""

    def __init__(self, cable: SerialCable):
        self.cable = cable
        super().__init__()

    def _serve(self) -> None:
        while not self._stopping:
            if not self._wait(self._master, None):
                continue
            try:
                data = os.read(self._master, 4096)
            except OSError:
                return
            self.say(self.cable.exchange(data))

    def say(self, data: bytes) -> None:
        """Send bytes to the client on the line."""
        if data:
            self._write(data)


class SocketCable(SocketEnd):
    """A socket at the end of a cable, one client at a time."""

    def __init__(self, cable: SerialCable, port: int):
        self.cable = cable
        self._client: socket.socket | None = None
        super().__init__(port)

    def _serve_client(self, client: socket.socket) -> None:
        self._client = client
        try:
            while not self._stopping:
                if not self._wait(client, None):
                    continue
                data = receive(client)
                if not data or not send(client, self.cable.exchange(data)):
                    return
        finally:
            self._client = None

    def say(self, data: bytes) -> None:
        """Send bytes to the client on the line."""
        if self._client is not None:
            send(self._client, data)


def serve_cable(cable: SerialCable, device: str | None, port: int) -> PtyCable | SocketCable:
    """Return the server of a robot: a pseudo-terminal, or a socket if the system has none.

    Args:
        cable: to the robot.
        device: ``pty``, ``socket``, or None for the one that the system has.
        port: of the socket; 0 for any free one.
    """
    if device != "socket":
        try:
            return PtyCable(cable)
        except RobotError:
            if device == "pty":
                raise
    return SocketCable(cable, port)


def address_of(server: PtyCable | SocketCable) -> str:
    """Return the port for a driver."""
    if isinstance(server, PtyCable):
        return server.path
    host, port = server.address
    return f"socket://{host}:{port}"


def _commands(data: bytes) -> list[bytes]:
    """Cut bytes after every CR and LF."""
    pieces, begin = [], 0
    for place, byte in enumerate(data):
        if byte in b"\r\n":
            pieces.append(data[begin : place + 1])
            begin = place + 1
    return [*pieces, data[begin:]] if begin < len(data) else pieces
