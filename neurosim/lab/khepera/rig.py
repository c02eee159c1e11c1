"""A virtual Khepera behind its serial line, and the real driver in front of it."""

from __future__ import annotations

import os
import socket
from typing import Any

import numpy as np

from neurosim.base.errors import RobotError
from neurosim.lab.khepera.body import KheperaLab
from neurosim.lab.khepera.camera import KheperaCamera
from neurosim.lab.khepera.firmware import KheperaFirmware
from neurosim.lab.khepera.params import RADIUS, KheperaParams, LabArena
from neurosim.lab.nxt.params import CameraParams
from neurosim.lab.server import PtyEnd, SocketEnd, receive, send
from neurosim.robots.base import Clock
from neurosim.robots.khepera.driver import Khepera

#: Where the robot stands at first in the paper's arena (m, m, rad).
START = (-0.22, 0.0, 0.0)
#: Bits that a byte takes on the line: a start bit, 8 data bits, 2 stop bits.
BITS = 11


def sampling_places() -> tuple[LabArena, dict[str, tuple[float, float, float]]]:
    """Return a lab to sample in, and where the robot is put down there (m, m, rad).

    It faces a long ``wall`` and a ``cylinder`` of the paper's size and all but touches them;
    ``open`` is open floor.
    """
    touching = -RADIUS - 0.0002
    arena = LabArena(((0.0, -1.0, 0.0, 1.0),), ((0.0275, 3.0, 0.0275),))
    places = {
        "wall": (touching, 0.0, 0.0),
        "cylinder": (touching, 3.0, 0.0),
        "open": (-2.0, 1.5, 0.0),
    }
    return arena, places


class SerialCable:
    """Carries bytes to the firmware and back, in the time of the lab that the line takes.

    One direction at a time: an answer leaves when its command has come, the next command is
    taken when the answer has left.

    Args:
        firmware: what answers.
        clock: the lab's.
        baud: bits per second.
    """

    def __init__(self, firmware: KheperaFirmware, clock: Clock, baud: int):
        self.firmware, self._clock = firmware, clock
        self._byte = BITS / baud
        self.silent = False

    def exchange(self, data: bytes) -> bytes:
        """Return all answers to what came, once the clock has reached their end."""
        answers = b""
        for command in _commands(data):
            self._clock.sleep_until(self._clock.now() + len(command) * self._byte)
            answer = b"" if self.silent else self.firmware.feed(command)
            if answer:
                self._clock.sleep_until(self._clock.now() + len(answer) * self._byte)
                answers += answer
        return answers


class _PtyCable(PtyEnd):
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
        """Send bytes to whoever is on the line."""
        if data:
            self._write(data)


class _SocketCable(SocketEnd):
    def __init__(self, cable: SerialCable, port: int):
        self.cable = cable
        self._client: socket.socket | None = None
        super().__init__(port=port)

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
        """Send bytes to whoever is on the line."""
        if self._client is not None:
            send(self._client, data)


class VirtualKheperaRig:
    """A Khepera of the virtual lab, behind its line.

    Args:
        robot_seed: which robot; the same number has the same motors and sensors.
        noise_seed: of everything that differs from one session to the next.
        arena: what stands in the lab; by default the arena of Lund and Miglino 1996.
        start: where the robot stands at first (m, m, rad).
        device: ``pty``, ``socket``, or None for whichever the system has.
        port: of the socket; 0 for any free one.
        baud: of the line; it takes its time.
        real_time: the lab's time will be the wall clock's (see
            :class:`neurosim.lab.nxt.world.Pacer`).
        params: a robot in place of the drawn one.
        camera: a camera above the place where the robot stands at first, in the terms of the
            roof camera (see :class:`neurosim.lab.khepera.camera.KheperaCamera`); none by default.

    Attributes:
        lab: the lab itself; no learner looks into it.
        camera: the camera, or None.
        robot: the driver, not connected yet, in the lab's own time.
        address: what the driver takes as port.
    """

    def __init__(
        self,
        robot_seed: int,
        *,
        noise_seed: int = 0,
        arena: LabArena | None = None,
        start: tuple[float, float, float] = START,
        device: str | None = None,
        port: int = 0,
        baud: int = 9600,
        real_time: bool = False,
        params: KheperaParams | None = None,
        camera: CameraParams | None = None,
    ):
        self._seeds = {"robot_seed": robot_seed, "noise_seed": noise_seed}
        rng = np.random.default_rng([noise_seed, robot_seed, 0x6B52])
        self.lab = KheperaLab(
            KheperaParams.drawn(robot_seed) if params is None else params,
            LabArena.paper() if arena is None else arena,
            int(rng.integers(2**31)),
            start,
        )
        if camera is not None:
            self.lab.camera = KheperaCamera(
                camera, robot_seed, self.lab.clock.now, (start[0], start[1])
            )
        self.camera = self.lab.camera
        # Compiled before anybody waits for an answer.
        self.lab.body.proximity()
        self.lab.body.advance(0.01)
        self.firmware = KheperaFirmware(self.lab.body, lock=self.lab.lock)
        self._cable = SerialCable(self.firmware, self.lab.clock, baud)
        self._server = _serve(self._cable, device, port)
        self.address = _address(self._server)
        timeout = 2.0 if real_time else 10.0
        self.robot = Khepera(self.address, baud=baud, timeout=timeout, clock=self.lab.clock)

    @property
    def alive(self) -> bool:
        """Whether the line still stands."""
        return self._server.error is None

    def describe(self) -> dict[str, Any]:
        """Return what makes the same lab again."""
        return dict(self._seeds)

    def reboot(self) -> None:
        """Press the robot's reset button: it says its banner, in the middle of whatever goes on."""
        self._server.say(self.firmware.reboot())

    def switch_off(self) -> None:
        """Switch the robot off: nothing answers any more."""
        self._cable.silent = True
        with self.lab.lock:
            self.lab.body.set_speeds(0, 0)

    def close(self) -> None:
        """Take the line down."""
        self._server.stop()

    def __enter__(self) -> VirtualKheperaRig:
        return self

    def __exit__(self, *error: object) -> None:
        """Close; what went wrong inside the lab is told rather than a lost link."""
        self.close()
        if self._server.error is not None:
            raise self._server.error


def _serve(cable: SerialCable, device: str | None, port: int) -> _PtyCable | _SocketCable:
    if device != "socket":
        try:
            return _PtyCable(cable)
        except RobotError:
            if device == "pty":
                raise
    return _SocketCable(cable, port)


def _address(server: _PtyCable | _SocketCable) -> str:
    if isinstance(server, _PtyCable):
        return server.path
    host, port = server.address
    return f"socket://{host}:{port}"


def _commands(data: bytes) -> list[bytes]:
    """Cut bytes behind every CR and LF."""
    pieces, begin = [], 0
    for place, byte in enumerate(data):
        if byte in b"\r\n":
            pieces.append(data[begin : place + 1])
            begin = place + 1
    return [*pieces, data[begin:]] if begin < len(data) else pieces
