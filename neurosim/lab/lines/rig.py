"""A virtual robot behind the text-line protocol, with the roof camera over it."""

from __future__ import annotations

import math
from typing import Unpack

from neurosim.base.errors import UserError
from neurosim.lab.cable import SerialCable, address_of, serve_cable
from neurosim.lab.lines.bodies import TwoWheels
from neurosim.lab.lines.firmware import LinesFirmware
from neurosim.lab.lines.planar import KINDS, PlanarBody
from neurosim.lab.rig import BoardRig, OnBoard
from neurosim.robots.lines.driver import BAUD, Lines

#: The kinds of robots.
LINES_ROBOTS = ("wheels", *KINDS)
#: Bits that a byte takes on the line: a start bit, 8 data bits, a stop bit.
BITS = 10


class VirtualLinesRig(BoardRig):
    """A robot of the virtual lab that describes itself, behind its line.

    Args:
        robot_seed: number of robot and board; the same number gives the same robot.
        kind: wheels for the virtual NXT's motors and sensors, car, or omni for a base that drives
            in any direction.
        device: ``pty``, ``socket``, or None for the one that the system has.
        port: of the socket; 0 for any free one.
        baud: speed of the line, bits a second.
        real_time: whether the lab's time is the wall clock's (see
            :class:`neurosim.lab.nxt.world.Pacer`).
        **board: see :class:`neurosim.lab.rig.OnBoard`.

    Attributes:
        lab: the lab itself; no learner looks into it.
        robot: the driver, not connected yet, in the lab's own time.
        camera: the roof camera, or None.
        address: the driver's port.
    """

    def __init__(
        self,
        robot_seed: int,
        *,
        kind: str = "wheels",
        device: str | None = None,
        port: int = 0,
        baud: int = BAUD,
        real_time: bool = False,
        **board: Unpack[OnBoard],
    ):
        if kind not in LINES_ROBOTS:
            raise UserError(f"there is no robot {kind!r}; there are {', '.join(LINES_ROBOTS)}")
        body, _ = self._set_up(
            kind,
            0x11E5,
            lambda *seeds: None if kind == "wheels" else PlanarBody(kind, *seeds),
            robot_seed,
            **board,
        )
        hardware = TwoWheels(self.lab.body) if body is None else body
        self.firmware = LinesFirmware(hardware, hardware.greeting, self.lab.lock)
        self.lab.program = self.firmware
        self._cable = SerialCable(self.firmware, self.lab.clock, BITS / baud)
        self._server = serve_cable(self._cable, device, port)
        self.address = address_of(self._server)
        timeout = 2.0 if real_time else 10.0
        self.robot = Lines(self.address, baud=baud, timeout=timeout, clock=self.lab.clock)

    @property
    def standing(self) -> bool:
        """Whether no command runs."""
        return math.isinf(self.firmware.ends)

    def reboot(self) -> None:
        """Press the robot's reset button."""
        self._server.say(self.firmware.reboot())

    def switch_off(self) -> None:
        """Switch the radio off: nothing answers any more; a command ends by itself."""
        self._cable.silent = True
