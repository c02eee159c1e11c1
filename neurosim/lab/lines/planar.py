"""A model car and an omnidirectional base in the lab; each number of a command has its own drive.

No learner reads this. Each drive has its own gain, dead band and lag; a steering servo has a
largest speed. The car understeers at speed. The base slips more to its sides than forward, and
turns a little as it drives. The slip of each command is drawn again.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurosim.base.commands import Commands, Number
from neurosim.base.compiled import njit
from neurosim.lab.nxt.body import Lamp
from neurosim.robots.lines.protocol import Counter, Greeting

#: Longest integration step, s.
STEP = 0.002
#: Below this speed a stopping drive stands, m/s and rad/s.
STANDS = 0.003
#: A wheel's counter.
PER_METRE = 2000.0
WHEELBASE = 0.14
#: The kinds of bodies, and their commands.
KINDS: dict[str, Commands] = {
    "car": Commands(
        (Number("speed", "m/s", -0.3, 0.4), Number("steer", "rad", -0.45, 0.45, speed=False)),
        "car",
        {"wheelbase": WHEELBASE, "radius": 0.12},
    ),
    "omni": Commands(
        (
            Number("vx", "m/s", -0.3, 0.3),
            Number("vy", "m/s", -0.3, 0.3),
            Number("omega", "rad/s", -2.5, 2.5),
        ),
        "twist",
        {"radius": 0.11},
    ),
}
#: Of each drive: gain, lag (s), dead band, offset, and the fastest change (per s).
_DRIVES = {
    "car": [(0.97, 0.15, 0.02, 0.0, 1e9), (0.94, 0.04, 0.0, 0.015, 4.0), (0.0, 1.0, 0.0, 0.0, 1e9)],
    "omni": [(0.98, 0.10, 0.01, 0.0, 1e9), (0.90, 0.12, 0.015, 0.0, 1e9),
             (0.96, 0.08, 0.1, 0.0, 1e9)],
}  # fmt: skip
#: Slip of a command: standard deviation of each part of its twist, as a fraction.
SLIP = 0.008


@njit
def _advance(state, given, drives, car, bends, slip, until):
    """Advance to a time.

    Args:
        state: [7] time, x, y, heading, and the speeds that three drives have reached; changed.
        given: [3] the commanded speed of each drive.
        drives: [3, 5] see ``_DRIVES``.
        car: whether the second is a steering angle.
        bends: the understeer of a car (s^2/m^2), or the turn of a base per metre sideways.
        slip: [3] factors of the twist.
        until: s.
    """
    steps = math.ceil((until - state[0]) / STEP - 1e-9)
    if steps <= 0:
        return
    h = (until - state[0]) / steps
    for _ in range(steps):
        for k in range(3):
            gain, lag, dead, offset, rate = drives[k]
            goal = gain * given[k] + offset if abs(given[k]) >= dead else offset
            change = (goal - state[4 + k]) * (1.0 - math.exp(-h / lag))
            state[4 + k] += min(max(change, -rate * h), rate * h)
            if goal == 0.0 and abs(state[4 + k]) < STANDS:
                state[4 + k] = 0.0
        if car:
            v, side = state[4], 0.0
            turn = v * math.tan(state[5]) / WHEELBASE / (1.0 + bends * v * v)
        else:
            v, side = state[4], state[5]
            turn = state[6] + bends * side
        v, side, turn = v * slip[0], side * slip[1], turn * slip[2]
        middle = state[3] + 0.5 * h * turn
        state[1] += h * (v * math.cos(middle) - side * math.sin(middle))
        state[2] += h * (v * math.sin(middle) + side * math.cos(middle))
        state[3] += h * turn
    state[0] = until


class PlanarBody:
    """The hardware behind a lines robot's program, and a body in the lab.

    Args:
        kind: a key of :data:`KINDS`.
        robot_seed: number of the robot; the same number gives the same robot.
        seed: of its slip.

    Attributes:
        greeting: its description. The car has a counter and no lamp, the base a lamp.
        driven_at: time of the first command to move, s, or None.
    """

    def __init__(self, kind: str, robot_seed: int, seed: int):
        own = np.random.default_rng([robot_seed, 0x9A12])
        self._car = kind == "car"
        self._drives = np.array(_DRIVES[kind])
        self._drives[:, :2] *= own.uniform(0.97, 1.03, (3, 2))
        self._bends = float(own.uniform(0.5, 1.0) if self._car else own.uniform(0.2, 0.4))
        self._rng = np.random.default_rng([seed, 0x9A13])
        self._state, self._given, self._slip = np.zeros(7), np.zeros(3), np.ones(3)
        self._state[4:] = self._drives[:, 3]
        self._distance = 0.0
        self._lamp = Lamp(0.004)
        self.driven_at: float | None = None
        self.greeting = Greeting(
            name=kind,
            firmware="neurosim-lab",
            commands=KINDS[kind],
            longest=60.0,
            counters=(Counter("rear", PER_METRE),) if self._car else (),
            lamp=not self._car,
            virtual=True,
        )
        # Compiled before a client waits for an answer.
        copy = self._state.copy()
        _advance(copy, self._given, self._drives, self._car, self._bends, self._slip, STEP)

    @property
    def time(self) -> float:
        """The time in seconds."""
        return float(self._state[0])

    @property
    def pose(self) -> NDArray[np.float64]:
        """The true pose of the middle (of a car: of its rear axle), [3]."""
        return self._state[1:4].copy()

    @property
    def voltage(self) -> float:
        """The battery's voltage, V: always that of a full one."""
        return 8.0

    def place(self, x: float, y: float, theta: float) -> None:
        """Place the robot at a pose (m, m, rad)."""
        self._state[1:4] = x, y, theta

    def shove(self, x: float, y: float) -> None:
        """Push the robot aside by these distances, m."""
        self._state[1:3] += x, y

    def advance(self, until: float) -> None:
        """Advance to a time, s; earlier times change nothing."""
        before = self._state[1:3].copy()
        given, slip = self._given, self._slip
        _advance(self._state, given, self._drives, self._car, self._bends, slip, until)
        moved = self._state[1:3] - before
        heading = self._state[3]
        self._distance += float(moved @ (math.cos(heading), math.sin(heading)))

    def lamp_light(self) -> float:
        """Return the integral of the lamp's brightness so far, in seconds of full brightness."""
        return self._lamp.sum(self.time)

    def move(self, command: tuple[float, ...]) -> None:
        """Carry out a command from now on."""
        if any(command) and self.driven_at is None:
            self.driven_at = self.time
        self._given[: len(command)] = command
        self._slip = 1.0 + SLIP * self._rng.standard_normal(3)

    def halt(self) -> None:
        """Stop; the car keeps its steering angle."""
        held = self._given[1] if self._car else 0.0
        self._given[:] = 0.0, held, 0.0

    def reached(self) -> tuple[float, float]:
        """Return the present forward speed, m/s, and the turn rate of a base, rad/s."""
        return float(self._state[4]), float(self._state[6])

    def values(self) -> list[int]:
        """Return the counter's pulses, if there is a counter."""
        return [math.floor(PER_METRE * self._distance)] if self._car else []

    def lamp(self, on: bool) -> None:
        """Switch the lamp."""
        self._lamp.port_level = float(on)
        self._lamp.switch(self.time)
