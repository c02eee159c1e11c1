"""A virtual Khepera behind its serial line, and the real driver in front of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neurosim.base.place import THICKNESS, Place, paper_arena
from neurosim.lab.cable import SerialCable, address_of, serve_cable
from neurosim.lab.khepera.body import KheperaLab
from neurosim.lab.khepera.camera import KheperaCamera
from neurosim.lab.khepera.firmware import KheperaFirmware
from neurosim.lab.khepera.params import RADIUS, KheperaParams
from neurosim.lab.nxt.params import CameraParams
from neurosim.lab.server import Served
from neurosim.robots.khepera.driver import Khepera
from neurosim.simulators.tables.sensor_table import LIGHT, OBJECTS, WALL, radius_of

#: First pose of the robot in the paper's arena (m, m, rad).
START = (-0.22, 0.0, 0.0)
#: Bits that a byte takes on the line: a start bit, 8 data bits, 2 stop bits.
BITS = 11


def sampling_places(
    kinds: Sequence[str] = OBJECTS,
    radius: float = RADIUS,
) -> tuple[Place, dict[str, tuple[float, float, float]]]:
    """Return a lab for sampling, and the robot's poses in it (m, m, rad).

    It faces an object of each kind, a long wall, round obstacles or a light, and almost touches it;
    ``open`` is open floor.

    Args:
        kinds: names of the kinds, see :mod:`neurosim.simulators.tables.sensor_table`.
        radius: of the robot, m.
    """
    touching, middle = -radius - 0.0002, THICKNESS / 2
    poses = {WALL: (touching, 0.0, 0.0), "open": (-2.0, 1.5, 0.0)}
    obstacles, lights = [], []
    for kind in kinds:
        if kind == LIGHT:
            poses[kind] = (touching, -3.0, 0.0)
            lights.append((0.0, -3.0))
        elif kind != WALL:
            poses[kind] = (touching, 3.0 + 2.0 * len(obstacles), 0.0)
            obstacles.append((radius_of(kind), poses[kind][1], radius_of(kind)))
    walls = ((middle, -1.0, middle, 1.0),)
    return Place(walls=walls, obstacles=tuple(obstacles), lights=tuple(lights)), poses


class VirtualKheperaRig(Served):
    """A Khepera of the virtual lab, behind its line.

    Args:
        robot_seed: which robot; the same number has the same motors and sensors.
        noise_seed: of everything that differs from one session to the next.
        place: the objects in the lab; by default the arena of Lund and Miglino 1996.
        start: first pose of the robot (m, m, rad).
        device: ``pty``, ``socket``, or None for the one that the system has.
        port: of the socket; 0 for any free one.
        baud: speed of the line, bits a second.
        real_time: whether the lab's time is the wall clock's (see
            :class:`neurosim.lab.nxt.world.Pacer`).
        params: a robot that replaces the random one.
        camera: a camera above the robot's start, in the terms of the roof camera (see
            :class:`neurosim.lab.khepera.camera.KheperaCamera`); none by default.

    Attributes:
        lab: the lab itself; no learner looks into it.
        camera: the camera, or None.
        robot: the driver, not connected yet, in the lab's own time.
        address: the driver's port.
    """

    def __init__(
        self,
        robot_seed: int,
        *,
        noise_seed: int = 0,
        place: Place | None = None,
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
            KheperaParams.sampled(robot_seed) if params is None else params,
            paper_arena() if place is None else place,
            int(rng.integers(2**31)),
            start,
        )
        if camera is not None:
            self.lab.camera = KheperaCamera(
                camera, robot_seed, self.lab.clock.now, (start[0], start[1])
            )
        self.camera = self.lab.camera
        # Compiled before a client waits for an answer.
        self.lab.body.proximity()
        self.lab.body.advance(0.01)
        self.firmware = KheperaFirmware(self.lab.body, lock=self.lab.lock)
        self._cable = SerialCable(self.firmware, self.lab.clock, BITS / baud)
        self._server = serve_cable(self._cable, device, port)
        self.address = address_of(self._server)
        timeout = 2.0 if real_time else 10.0
        self.robot = Khepera(self.address, baud=baud, timeout=timeout, clock=self.lab.clock)

    def describe(self) -> dict[str, Any]:
        """Return settings from which the same lab can be made again."""
        return dict(self._seeds)

    def reboot(self) -> None:
        """Press the robot's reset button: it sends its banner at once."""
        self._server.say(self.firmware.reboot())

    def switch_off(self) -> None:
        """Switch the robot off: nothing answers any more."""
        self._cable.silent = True
        with self.lab.lock:
            self.lab.body.set_speeds(0, 0)
