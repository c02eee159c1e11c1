"""The virtual Khepera's hardware, as its firmware sees it, and its lab."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.lab.contact import distances
from neurosim.lab.khepera import physics
from neurosim.lab.khepera.camera import KheperaCamera
from neurosim.lab.khepera.params import (
    PULSES_PER_METRE,
    RADIUS,
    SPEED_UNIT,
    WHITE,
    KheperaParams,
)
from neurosim.lab.khepera.physics import S, U
from neurosim.lab.nxt.world import LabTime

#: Distance of a light that is as bright as all others together, m.
HALVED = 0.12


class KheperaBody:
    """Two motors with encoders and eight infra-red sensors, on top of the physics.

    Args:
        params: the robot.
        place: the place around it.
        seed: of every random draw.
        pose: its first pose (m, m, rad).
    """

    def __init__(
        self,
        params: KheperaParams,
        place: Place,
        seed: int,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ):
        self.params = params
        self.state = physics.new_state(*pose)
        self._inputs = physics.new_inputs()
        self._motor = params.motor_row()
        self._walls, self._cylinders = place.surfaces, place.cylinders
        self._lights = np.array(place.lights, float).reshape(-1, 2)
        self._rng = np.random.default_rng([seed, 0x6B48])
        self._noises = (params.noise, params.light_noise)
        self._zeros = [0, 0]
        self._time = 0.0

    @property
    def time(self) -> float:
        """The time in seconds."""
        return self._time

    @property
    def pose(self) -> NDArray[np.float64]:
        """The true pose, [3] (m, m, rad unwrapped)."""
        return self.state[S.X : S.X + 3].copy()

    def depth(self, x: float, y: float) -> float:
        """Return its depth in a surface at (x, y), m; below 0 where it is free."""
        return float(physics.penetration(x, y, self._walls, self._cylinders))

    def place(self, x: float, y: float, theta: float) -> None:
        """Lift the robot and place it at a pose (m, m, rad)."""
        self.state[S.X : S.X + 3] = x, y, theta
        self.state[S.SCAN : S.SCAN + 3] = x, y, theta

    def advance(self, until: float) -> None:
        """Drive on to the time ``until`` (s); earlier times change nothing."""
        if until <= self._time:
            return
        self._time = until
        ticks = math.floor(until / physics.TICK + 1e-9)
        if ticks > self.state[S.TICKS]:
            physics.advance(
                self.state,
                self._inputs,
                self._motor,
                self._walls,
                self._cylinders,
                self._rng,
                float(ticks),
            )

    def set_speeds(self, left: int, right: int) -> None:
        """Regulate both wheels' speeds, in pulses in 10 ms."""
        self._inputs[U.TARGET : U.TARGET + 2] = left * SPEED_UNIT, right * SPEED_UNIT
        self._inputs[U.POSITION : U.POSITION + 2] = 0.0

    def set_positions(self, left: int, right: int, limits: tuple[int, int]) -> None:
        """Turn both wheels to counter positions, no faster than ``limits`` (pulses in 10 ms)."""
        for wheel, count in enumerate((left, right)):
            distance = (count + self._zeros[wheel]) / PULSES_PER_METRE
            self._inputs[U.TARGET + wheel] = distance
            self._inputs[U.LIMIT + wheel] = limits[wheel] * SPEED_UNIT
        self._inputs[U.POSITION : U.POSITION + 2] = 1.0

    def speeds(self) -> tuple[int, int]:
        """Return both wheels' speeds as the encoders see them, in pulses in 10 ms."""
        left, right = self.state[S.SPEED : S.SPEED + 2] / SPEED_UNIT
        return round(left), round(right)

    def counts(self) -> tuple[int, int]:
        """Return both position counters."""
        left, right = self._pulses()
        return left - self._zeros[0], right - self._zeros[1]

    def set_counts(self, left: int, right: int) -> None:
        """Set both position counters."""
        pulses = self._pulses()
        self._zeros = [pulses[0] - left, pulses[1] - right]

    def proximity(self) -> list[int]:
        """Return the readings of the last scan, 8 numbers of 0..1023."""
        params = self.params
        return physics.proximity(
            self.state[S.SCAN : S.SCAN + 3],
            params.angle,
            params.reach,
            params.threshold,
            params.offset,
            self._noises,
            float(self.state[S.DRIFT]),
            self._walls,
            self._cylinders,
            WHITE,
            self._rng,
        ).tolist()

    def ambient(self) -> list[int]:
        """Return the ambient light, 8 numbers of 0..1023, fewer for more light.

        A light :data:`HALVED` straight ahead of a sensor halves its number. The light falls with
        the square of the distance and the cosine of the angle; objects in between cast shadows.
        """
        x, y, theta = self.state[S.SCAN : S.SCAN + 3]
        looks = theta + self.params.angle
        rims = np.column_stack([x + RADIUS * np.cos(looks), y + RADIUS * np.sin(looks)])
        lit = np.zeros(8)
        for light in self._lights:
            dx, dy = (light - rims).T
            far, towards = np.hypot(dx, dy), np.arctan2(dy, dx)
            free = distances(rims, towards, self._walls, self._cylinders) > far
            facing = np.maximum(np.cos(towards - looks), 0.0)
            lit += free * facing * (HALVED / np.maximum(far, 0.001)) ** 2
        noise = self.params.noise * self._rng.standard_normal(8)
        counts = (self.params.ambient - self.state[S.DRIFT]) / (1.0 + lit) + noise
        return np.clip(np.rint(counts), 0, 1023).astype(int).tolist()

    def _pulses(self) -> tuple[int, int]:
        left, right = self.state[S.DISTANCE : S.DISTANCE + 2] * PULSES_PER_METRE
        return math.floor(left), math.floor(right)


class KheperaLab(LabTime):
    """A place with a Khepera in it; its time advances only on request.

    Args:
        params: the robot.
        place: the place around it.
        seed: of every random draw.
        start: its first pose (m, m, rad).

    Attributes:
        camera: a camera above it, or None.

    Raises:
        UserError: if the start is not free.
    """

    def __init__(
        self,
        params: KheperaParams,
        place: Place,
        seed: int = 0,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ):
        super().__init__()
        self.camera: KheperaCamera | None = None
        self.body = KheperaBody(params, place, seed, start)
        self.place(*start)

    @property
    def time(self) -> float:
        """Seconds since the lab was made."""
        return self.body.time

    @property
    def pose(self) -> NDArray[np.float64]:
        """The robot's true pose, [3] (m, m, rad unwrapped)."""
        with self.lock:
            return self.body.pose

    def place(self, x: float, y: float, theta: float) -> None:
        """Place the robot at a pose (m, m, rad).

        Raises:
            UserError: if it would stand in a wall or an obstacle there.
        """
        with self.lock:
            if self.body.depth(x, y) > 0.0:
                raise UserError(
                    f"the robot cannot be placed at x {100 * x:.1f} cm, y {100 * y:.1f} cm: it "
                    "would stand in a wall or an obstacle"
                )
            self.body.place(x, y, theta)

    def _advance(self, time: float) -> None:
        # Pictures that become due meanwhile go to the object that started the camera.
        while self.camera is not None and self.camera.due <= time:
            self.body.advance(self.camera.due)
            self.camera.look(self.body.pose, 0.0)
        self.body.advance(time)
