"""A virtual Thymio II behind its line, with the roof camera over it."""

from __future__ import annotations

import math
from typing import Unpack

import numpy as np

from neurosim.base import se2
from neurosim.base.place import Place
from neurosim.lab.cable import SerialCable, address_of, serve_cable
from neurosim.lab.contact import distances
from neurosim.lab.lines.planar import PlanarBody
from neurosim.lab.nxt.body import ground_light
from neurosim.lab.rig import BoardRig, OnBoard
from neurosim.lab.thymio.firmware import ThymioFirmware
from neurosim.robots.thymio.driver import BODY, FULL, FULL_SPEED, GROUND, Thymio

#: Time of a byte, s: an answer takes a few milliseconds, as one over USB does.
BYTE = 10 / 115_200
#: The seven proximity sensors: m ahead of the axle, to the left, and rad where they look; and the
#: law of what one reads, m / (1 + (d / w)^2) at a distance d up to the greatest (m), with its noise
#: (standard deviation): as in Enki, the simulator of the robot's makers (Thymio2.cpp).
PROXIMITY = np.array([
    (0.062, 0.0485, 0.69813), (0.075, 0.0255, 0.34907), (0.0795, 0.0, 0.0),
    (0.075, -0.0255, -0.34907), (0.062, -0.0485, -0.69813),
    (-0.0295, 0.0295, math.pi), (-0.0295, -0.0295, math.pi),
])  # fmt: skip
MOST, WIDTH, REACH, FLICKER = 4505.0, 0.0854, 0.14, 2.87
#: Radius of what a ground sensor sees, m, and the standard deviation of its noise, of 1000.
SPOT, NOISE = 0.008, 5.0


class ThymioBody(PlanarBody):
    """Two wheels, what looks around and what looks at the ground.

    Its drives are those of the lab's planar bodies: one forward, one for turning.

    Args:
        robot_seed: which robot: the same number is the same one.
        seed: of its slip and noise.
    """

    def __init__(self, robot_seed: int, seed: int):
        super().__init__("omni", robot_seed, seed)
        self._noise = np.random.default_rng([seed, 0x7471])
        self.around = Place()
        self._targets = (0, 0)

    def drive(self, left: int, right: int) -> None:
        """Regulate both wheels' speeds, 500 at full speed."""
        if (left, right) == self._targets:
            return
        self._targets = (left, right)
        slow, fast = (min(max(value, -FULL), FULL) * FULL_SPEED / FULL for value in (left, right))
        self.move(((slow + fast) / 2, 0.0, (fast - slow) / BODY.wheel_base))

    def speeds(self) -> tuple[int, int]:
        """Return both wheels' speeds as they are measured."""
        forward, aside = self._state[4], self._state[6] * BODY.wheel_base / 2
        noise = 4.0 * self._noise.standard_normal(2) if forward or aside else np.zeros(2)
        left, right = np.array([forward - aside, forward + aside]) * FULL / FULL_SPEED + noise
        return round(left), round(right)

    def proximity(self) -> list[int]:
        """Return the readings of the seven sensors; 0 without anything near."""
        if not self.around.solid:
            return [0] * 7
        seen = se2.compose(self.pose, PROXIMITY)
        far = distances(seen[:, :2], seen[:, 2], self.around.surfaces, self.around.cylinders)
        noisy = MOST / (1 + (far / WIDTH) ** 2) + FLICKER * self._noise.standard_normal(7)
        return np.where(far <= REACH, np.clip(np.rint(noisy), 0, 4600), 0).astype(int).tolist()

    def ground(self) -> list[int]:
        """Return the readings of the two ground sensors, of 1000."""
        x, y, theta = self.pose
        cos, sin = math.cos(theta), math.sin(theta)
        lights = [
            1000
            * ground_light(
                x + cos * ahead - sin * aside, y + sin * ahead + cos * aside, SPOT, self.around
            )
            for ahead, aside in GROUND.values()
        ]
        noisy = np.array(lights) + NOISE * self._noise.standard_normal(2)
        return np.clip(np.rint(noisy), 0, 1023).astype(int).tolist()


class VirtualThymioRig(BoardRig):
    """A Thymio II of the virtual lab, behind its line.

    Args:
        robot_seed: which robot and which board; the same number is the same robot.
        device: ``pty``, ``socket``, or None for whichever the system has.
        port: of the socket; 0 for any free one.
        real_time: the lab's time will be the wall clock's (see
            :class:`neurosim.lab.nxt.world.Pacer`).
        **board: as :class:`neurosim.lab.rig.OnBoard` has them.

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
        body.proximity()  # compiled before anybody waits for an answer
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
