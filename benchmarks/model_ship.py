"""A free-running model ship of the MMG standard method, tried as in a towing tank.

Yasukawa and Yoshimura (2015), Introduction of MMG standard method for ship maneuvering predictions,
J. Mar. Sci. Technol. 20: hull (eq. 8), propeller (eqs. 9-12), rudder (eqs. 14-24), and the numbers
of the model KVLCC2 of 7 m. A model of another length has those of Froude's law. Ships differ by up
to 15 % in each number of the hull, in masses and in the rudder.

It obeys orders of the propeller (% of its largest speed) and of the rudder (deg), and feels a
little wind. Axes of the paper, x ahead and y to starboard, are turned to REP 103.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Orders [2] at a time (s), at a heading to starboard (rad); None: the end.
Orders = Callable[[float, float], "tuple[float, float] | None"]

ORDERS = ("propeller", "rudder")
#: Time between poses, its parts in the integration, and standard deviations of a pose, m, m, rad.
POSES, PARTS, SEEN = 0.1, 5, (0.003, 0.003, 0.001)
#: Water, kg/m^3; propeller, 1/s, and rudder at most, deg, deg/s; their lags, s.
_RHO, _FASTEST, _HARD, _RATE, _ANSWER = 1000.0, 16.0, 35.0, 15.8, (0.3, 0.1)
_X = {"0": -0.022, "vv": -0.040, "vr": 0.002, "rr": 0.011, "vvvv": 0.771}
_Y = {"v": -0.315, "r": 0.083, "vvv": -1.607, "vvr": 0.379, "vrr": -0.391, "rrr": 0.008}
_N = {"v": -0.137, "r": -0.049, "vvv": -0.030, "vvr": -0.294, "vrr": 0.055, "rrr": -0.013}
#: Random accelerations by wind, m, m, rad per s^1.5.
_WIND = np.array([0.0003, 0.0003, 0.0004])
#: Time before a trial begins, s, at the speed of its propeller.
STEADY = 5.0


class ModelShip:
    """A model ship; its state is u, v (m/s), r (rad/s), rudder (rad) and propeller (1/s)."""

    def __init__(self, length: float, seed: int):
        """Make a ship of this length, m."""
        size, differ = length / 7.0, np.random.default_rng(seed).uniform(0.85, 1.15, (4, 6))
        self.length, self.draught, self.diameter = length, 0.46 * size, 0.216 * size
        self.ahead = 0.25 * size  # the centre of gravity
        self.span, self.area = 0.345 * size, 0.0539 * size**2
        self.hull = [
            {key: value * by for (key, value), by in zip(part.items(), own, strict=False)}
            for part, own in zip((_X, _Y, _N), differ, strict=False)
        ]
        added_x, added_y, hull_rudder, lift = (
            0.022,
            *np.array([0.223, 0.312, 2.747]) * differ[3, :3],
        )
        self.rudder, self.lift = hull_rudder, lift
        water = 0.5 * _RHO * length**2 * self.draught
        self.mass = _RHO * 3.27 * size**3
        self.with_x, self.with_y = self.mass + added_x * water, self.mass + added_y * water
        inertia = self.mass * (0.25**2 * length**2 + self.ahead**2) + 0.011 * water * length**2
        across = self.ahead * self.mass
        self.inverse = np.linalg.inv([[self.with_y, across], [across, inertia]])
        self.rest = 1.0 / math.sqrt(size)  # of a propeller's speed

    def rate(self, state: Array, orders: tuple[float, float]) -> Array:
        """Return the state's rate of change, [5]."""
        u, v, r, rudder, turns = state
        order = math.radians(min(max(orders[1], -_HARD), _HARD))
        limit = math.radians(_RATE) * self.rest
        rudder_rate = min(max((order - rudder) / _ANSWER[1], -limit), limit)
        turns_rate = (orders[0] / 100.0 * _FASTEST * self.rest - turns) / _ANSWER[0]
        u_, turns_ = max(u, 0.02), max(turns, 0.05)
        speed = math.hypot(u_, v)
        drift, sway, yaw = math.atan2(-v, u_), v / speed, r * self.length / speed
        terms = {"0": 1.0, "v": sway, "r": yaw, "vv": sway**2, "vr": sway * yaw, "rr": yaw**2}
        terms |= {"vvv": sway**3, "vvr": sway**2 * yaw, "vrr": sway * yaw**2, "rrr": yaw**3}
        terms["vvvv"] = sway**4
        pressure = 0.5 * _RHO * self.length * self.draught * speed**2
        x, y, n = (pressure * sum(k * terms[at] for at, k in part.items()) for part in self.hull)
        n *= self.length
        # The wake grows with the drift at the propeller.
        there = drift + 0.48 * yaw
        more = 1.0 + (1.0 - math.exp(-2.0 * abs(there))) * ((1.6 if there > 0.0 else 1.1) - 1.0)
        into = u_ * min(0.6 * more, 1.0)
        advance = into / (turns_ * self.diameter)
        thrust = 0.2931 - 0.2753 * advance - 0.1385 * advance**2
        x += (1.0 - 0.22) * _RHO * turns_**2 * self.diameter**4 * thrust
        # The rudder stands in the propeller's jet.
        at_rudder = drift + 0.71 * yaw
        aside = speed * (0.640 if at_rudder > 0.0 else 0.395) * at_rudder
        part = self.diameter / self.span
        jet = math.sqrt(1.0 + 8.0 * max(thrust, 0.0) / (math.pi * max(advance, 0.05) ** 2))
        along = 1.09 * into * math.sqrt(part * (1.0 + 0.5 * (jet - 1.0)) ** 2 + 1.0 - part)
        angle = rudder - math.atan2(aside, along)
        force = 0.5 * _RHO * self.area * (along**2 + aside**2) * self.lift * math.sin(angle)
        x -= (1.0 - 0.387) * force * math.sin(rudder)
        y -= (1.0 + self.rudder) * force * math.cos(rudder)
        n -= (-0.5 - 0.464 * self.rudder) * self.length * force * math.cos(rudder)
        u_rate = (x + self.with_y * v * r + self.ahead * self.mass * r**2) / self.with_x
        turning = np.array([y - self.with_x * u * r, n - self.ahead * self.mass * u * r])
        return np.array([u_rate, *(self.inverse @ turning), rudder_rate, turns_rate])

    def drive(self, orders: Orders, seed: int) -> tuple[Array, Array, Array]:
        """Return times [T] s, orders [T, 2] and poses [T, 3] as they were seen (m, m, rad)."""
        rng, first = np.random.default_rng(seed), orders(0.0, 0.0)
        assert first is not None
        state = np.zeros(5)
        for _ in range(round(200.0 / POSES)):  # until its speed is that of its propeller
            state = state + POSES * self.rate(state, (first[0], 0.0))
        pose, given, poses = np.zeros(3), [], [np.zeros(3)]
        while (now := orders(POSES * len(given), pose[2])) is not None:
            for _ in range(PARTS):
                h = POSES / PARTS
                state = state + h * self.rate(state, now)
                middle = pose[2] + 0.5 * h * state[2]
                cos, sin = math.cos(middle), math.sin(middle)
                u, v, r = state[:3]
                pose = pose + h * np.array([u * cos - v * sin, u * sin + v * cos, r])
            state[:3] += _WIND * math.sqrt(POSES) * rng.standard_normal(3)
            given.append(now)
            poses.append(pose)
        seen = np.array(poses) * [1.0, -1.0, -1.0] + rng.normal(0.0, SEEN, (len(poses), 3))
        return POSES * np.arange(len(poses)), np.array([*given, given[-1]]), seen


def zigzag(propeller: float, angle: float, lasts: float) -> Orders:
    """Return orders of a zigzag trial: the rudder to one side until the heading is as far there."""
    side = [math.copysign(1.0, angle)]

    def order(time: float, heading: float) -> tuple[float, float] | None:
        if side[0] * heading >= math.radians(abs(angle)):
            side[0] = -side[0]
        now = propeller, side[0] * abs(angle) if time >= STEADY else 0.0
        return now if time < lasts else None

    return order


def circle(propeller: float, rudder: float, lasts: float) -> Orders:
    """Return orders of a turning trial."""
    return lambda time, _: None if time >= lasts else (propeller, rudder if time >= STEADY else 0.0)


def at_random(rng: np.random.Generator, lasts: float) -> Orders:
    """Return random orders, each for 2 to 8 s."""
    until, now = [0.0], [(0.0, 0.0)]

    def order(time: float, _: float) -> tuple[float, float] | None:
        if time >= until[0]:
            until[0] = time + rng.uniform(2.0, 8.0)
            now[0] = float(rng.integers(40, 101)), float(rng.integers(-35, 36))
        return now[0] if time < lasts else None

    return order


def trials(lasts: float) -> list[Orders]:
    """Return 16 zigzag and turning trials in mixed order."""
    each: list[Orders] = []
    for propeller in (65.0, 85.0):
        for angle in (10.0, -10.0, 20.0, -20.0):
            each.append(zigzag(propeller, angle, lasts))
        for rudder in (35.0, -35.0, 20.0, -20.0):
            each.append(circle(propeller, rudder, 0.8 * lasts))
    return [each[place] for place in np.random.default_rng(0).permutation(len(each))]
