"""A virtual Thymio II behind its line, with the roof camera over it."""

from __future__ import annotations

from typing import Unpack

from neurosim.lab.cable import SerialCable, address_of, serve_cable
from neurosim.lab.rig import BoardRig, OnBoard
from neurosim.lab.thymio.body import ThymioBody
from neurosim.lab.thymio.firmware import ThymioFirmware
from neurosim.robots.thymio.driver import Thymio

#: Time of a byte, s: an answer takes a few milliseconds, as one over USB does.
BYTE = 10 / 115_200


class VirtualThymioRig(BoardRig):
    """A Thymio II of the virtual lab, behind its line.

    Args:
        robot_seed: number of robot and board; the same number gives the same robot.
        device: ``pty``, ``socket``, or None for the one that the system has.
        port: of the socket; 0 for any free one.
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
        device: str | None = None,
        port: int = 0,
        real_time: bool = False,
        **board: Unpack[OnBoard],
    ):
        body, _ = self._set_up(
            "thymio",
            0x7470,
            ThymioBody,
            robot_seed,
            **board,
        )
        body.proximity()  # compiled before a client waits for an answer
        self.firmware = ThymioFirmware(body, self.lab.lock)
        self.lab.program = self.firmware
        self.cable = SerialCable(self.firmware, self.lab.clock, BYTE)
        self._server = serve_cable(self.cable, device, port)
        self.address = address_of(self._server)
        timeout = 2.0 if real_time else 10.0
        self.robot = Thymio(self.address, timeout=timeout, clock=self.lab.clock)

    @property
    def standing(self) -> bool:
        """Whether the robot is commanded to stand."""
        return not any(self.firmware.targets)

    def switch_off(self) -> None:
        """Switch the radio off: nothing answers any more; a command ends by itself."""
        self.cable.silent = True
