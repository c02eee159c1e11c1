"""The virtual Thymio II's hardware, as its firmware uses it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.place import Place
from neurosim.lab.contact import distances
from neurosim.lab.lines.planar import PlanarBody
from neurosim.lab.nxt.body import ground_light
from neurosim.robots.thymio.driver import BODY, FULL, FULL_SPEED, GROUND, PROXIMITY, REACH

#: Contribution of one ray of a proximity sensor, m (c - x0^2) / (d^2 - 2 x0 d + c) at a distance d
#: up to :data:`REACH` (m; x0 in m, c in m^2), and the noise of a reading (standard deviation), as
#: in Enki, the simulator of the robot's makers (Thymio2.cpp, IRSensor.cpp).
MOST, NEAREST, WIDTH, FLICKER = 4505.0, 0.0003, 0.0073, 2.87
#: Angle between the three rays of a sensor (rad). If a surface is perpendicular to the middle ray,
#: the reading is this ray's contribution alone.
APART = math.radians(15.0)
#: Differences between robots (standard deviations): the sensors' directions (rad), and their
#: brightness (a fraction).
CROOKED, UNEVEN = math.radians(2.0), 0.1
#: Error of a wheel's measured speed (a fraction; standard deviation between robots), and the speed
#: below which a wheel does not turn, m/s.
UNEQUAL, DEAD = 0.02, 0.004
#: Radius of a ground sensor's spot, m, and the standard deviation of its noise, of 1000.
SPOT, NOISE = 0.008, 5.0


class ThymioBody(PlanarBody):
    """Two wheels, proximity sensors and ground sensors.

    Its drives are those of the lab's planar bodies: one forward, one for turning.

    Args:
        robot_seed: number of the robot; the same number gives the same robot.
        seed: of its slip and noise.

    Attributes:
        radius: of the disc that meets walls and obstacles, m.
        sensors: [7, 3] positions and directions of its proximity sensors, m, m, rad.
        brightness: [7] of these, relative to a typical one.
        wheels: speeds of the left and of the right wheel over the measured ones.
    """

    radius = BODY.radius

    def __init__(self, robot_seed: int, seed: int):
        super().__init__("omni", robot_seed, seed)
        self._noise = np.random.default_rng([seed, 0x7471])
        own = np.random.default_rng([robot_seed, 0x7472])
        self.sensors = PROXIMITY.copy()
        self.sensors[:, 2] += CROOKED * own.standard_normal(len(PROXIMITY))
        self.brightness = np.exp(UNEVEN * own.standard_normal(len(PROXIMITY)))
        self.wheels = 1.0 + UNEQUAL * own.standard_normal(2)
        self._drives[:, 2] = 0.0  # its wheels have dead bands, not the sum of them
        self.around = Place()
        self._targets = (0, 0)

    def drive(self, left: int, right: int) -> None:
        """Regulate both wheels' speeds, 500 at full speed."""
        if (left, right) == self._targets:
            return
        self._targets = (left, right)
        wanted = np.clip([left, right], -FULL, FULL) * FULL_SPEED / FULL
        slow, fast = (np.where(np.abs(wanted) < DEAD, 0.0, wanted) * self.wheels).tolist()
        self.move(((slow + fast) / 2, 0.0, (fast - slow) / BODY.wheel_base))

    def speeds(self) -> tuple[int, int]:
        """Return both wheels' speeds as they are measured."""
        forward, aside = self._state[4], self._state[6] * BODY.wheel_base / 2
        noise = 4.0 * self._noise.standard_normal(2) if forward or aside else np.zeros(2)
        turning = np.array([forward - aside, forward + aside]) / self.wheels
        left, right = turning * FULL / FULL_SPEED + noise
        return round(left), round(right)

    def proximity(self) -> list[int]:
        """Return the readings of the seven sensors."""
        read = np.zeros(len(PROXIMITY))
        if self.around.solid:
            seen = se2.compose(self.pose, self.sensors)
            rays = (seen[:, 2:] + (-APART, 0.0, APART)).ravel()
            from_ = np.repeat(seen[:, :2], 3, axis=0)
            far = distances(from_, rays, self.around.surfaces, self.around.cylinders).reshape(-1, 3)
            slanted = _answer(far[:, 1] / math.cos(APART))
            read = self.brightness * (_answer(far).sum(axis=1) - 2.0 * slanted)
        noisy = read + FLICKER * self._noise.standard_normal(len(PROXIMITY))
        return np.clip(np.rint(noisy), 0, MOST).astype(int).tolist()

    def ground(self) -> list[int]:
        """Return the readings of the two ground sensors, of 1000, without ambient light."""
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


def _answer(far: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the contributions of rays that end at distances (m); see :data:`MOST`."""
    d = np.clip(far, NEAREST, REACH)
    answer = MOST * (WIDTH - NEAREST**2) / (d**2 - 2.0 * NEAREST * d + WIDTH)
    return np.where(far <= REACH, answer, 0.0)
