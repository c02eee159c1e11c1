"""Robots of different make, for benchmarks of the learner.

Some of the learner's constants were chosen on the others; the :data:`FRESH` robots were added
afterwards.

Every robot is driven by random commands, one straight into the next, and seen by a camera with
noise; ``clean`` is the same motion without any noise. Lab robots are those of
:mod:`neurosim.lab.nxt`, of seeds that nothing else in the project uses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.lab.nxt import physics
from neurosim.lab.nxt.params import LabParams

Array = NDArray[np.float64]

#: Instants within a command at which the camera looks, as well as at its end.
LOOKS = 12
#: The camera's frame, s; instants are multiples of it.
FRAME = 1 / 30

DIFFERENTIAL, UNICYCLE, OMNI, CAR, FOUR = range(5)


@dataclass(frozen=True)
class Drives:
    """Commands of a robot, and its displacements.

    Attributes:
        x: inputs, [N, I]: the command before, the command, its duration (s).
        y: displacements, as the camera saw them, [N, 3] m, m, rad.
        times: instants within each command, [N, LOOKS] s since its beginning, increasing, the last
            its end.
        poses: at these, in the frame of the pose at the command's beginning, as the camera saw
            them, [N, LOOKS, 3].
    """

    x: Array
    y: Array
    times: Array
    poses: Array


@dataclass(frozen=True)
class Robot:
    """A robot of the zoo; see :data:`ZOO`.

    Attributes:
        names: of the parts of a command.
        units: of these.
        largest: magnitudes of the largest commands.
        kind: how actuators' speeds make a body twist.
        scale: of an actuator at its largest command, m/s or rad/s (a car's steering: rad).
        geometry: track width (m) of a differential drive or of four wheels (left ones first),
            wheel base (m) of a car.
        gain: of each actuator.
        lag: time constants of each actuator, s.
        slowing: of the lag where the speed falls.
        rate: the largest change in a second of an actuator's speed, as a fraction of its largest
            speed.
        delay: from a command to its first answer, s; commands given meanwhile wait their turn.
        dead_band: of each actuator, fraction of the largest command.
        bend: how much less than proportional speeds are at full command.
        slip: v and w lost, and sideways drift, in a curve: fractions per rad/s.
        noise: of a command: relative, of each actuator; pose (m, rad) at its end.
        camera: standard deviation of the camera's poses, m and rad.
    """

    names: tuple[str, ...] = ("left", "right")
    units: str = "%"
    largest: tuple[float, ...] = (100.0, 100.0)
    kind: int = DIFFERENTIAL
    scale: tuple[float, ...] = (0.2, 0.2)
    geometry: float = 0.1
    gain: tuple[float, ...] = (1.0, 1.0)
    lag: tuple[float, ...] = (0.1, 0.1)
    slowing: float = 1.0
    rate: float = 1e9
    delay: float = 0.0
    dead_band: tuple[float, ...] = (0.0, 0.0)
    bend: float = 0.0
    slip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise: tuple[float, float, float] = (0.01, 0.0, 0.0)
    camera: tuple[float, float] = (0.0005, 0.001)

    @property
    def inputs(self) -> list[dict[str, str]]:
        """Names and units of the inputs."""
        names = [f"prev_{name}" for name in self.names] + list(self.names)
        return [{"name": name, "unit": self.units} for name in names] + [
            {"name": "duration", "unit": "s"}
        ]

    def drive(
        self, commands: Array, seed: int, noisy: bool = True, times: Array | None = None
    ) -> Drives:
        """Drive commands [N, C + 1] one straight into the next, from rest."""
        rng = np.random.default_rng([seed, 0x200])
        times = instants(commands[:, -1], rng) if times is None else times
        starts, poses = self._poses(commands, times, rng, noisy)
        return seen(commands, times, starts, poses, self.camera if noisy else (0.0, 0.0), rng)

    def _poses(
        self, commands: Array, times: Array, rng: np.random.Generator, noisy: bool
    ) -> tuple[Array, Array]:
        """Return the poses where commands begin [N, 3] and at the instants [N, LOOKS, 3]."""
        slips, kicks = self._disturbed(len(commands), rng, noisy)
        each = (self.scale, self.gain, self.lag, self.dead_band, self.largest)
        arrays = [np.asarray(values, float) for values in each]
        rest = (self.slowing, self.rate, self.delay, self.bend, self.geometry)
        return _drive(self.kind, *arrays, rest, self.slip, commands, slips, kicks, times)

    def _disturbed(self, count: int, rng: np.random.Generator, noisy: bool) -> tuple[Array, Array]:
        """Return noise of commands: relative, of each actuator [N, C], and of poses [N, 3]."""
        relative, *pose = self.noise
        slips = relative * rng.standard_normal((count, len(self.names))) * noisy
        kicks = rng.standard_normal((count, 3)) * noisy
        return slips, kicks * np.take(pose, (0, 0, 1))


@dataclass(frozen=True)
class LabRobot(Robot):
    """A robot of the virtual lab, driven without brick and camera."""

    lab_seed: int = 0

    def _poses(
        self, commands: Array, times: Array, rng: np.random.Generator, noisy: bool
    ) -> tuple[Array, Array]:
        params = LabParams.sampled(self.lab_seed)
        if not noisy:
            params = replace(params, slip_draw=0.0, slip_field=0.0, caster_draw=0.0)
        ground = physics.slip_field(params)
        state = physics.new_state(params, int(rng.integers(2**31)), (0.0, 0.0, 0.0))
        return _lab(state, commands, times, params.coefficients(), ground, self.delay)


@dataclass(frozen=True)
class Boat(Robot):
    """A boat with two propellers (Fossen 2011, section 6.4, with three degrees of freedom).

    Attributes:
        thrust: forward (m/s^2) and turning acceleration (rad/s^2) at full power.
        drag: forward (1/s and 1/m), sideways (1/s), of the turn (1/s and 1/rad).
        coupling: sideways acceleration by speed times rate of turn, a fraction, and turning by
            sideways speed, rad/(s m).
        backwards: thrust of a propeller that turns backwards, a fraction.
    """

    thrust: tuple[float, float] = (0.0, 0.0)
    drag: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    coupling: tuple[float, float] = (0.0, 0.0)
    backwards: float = 1.0

    @classmethod
    def drawn(cls, seed: int) -> Boat:
        """Return a boat with random constants."""
        rng = np.random.default_rng([seed, 0xB0A7])
        low = (0.15, 0.7, 0.15, 0.3, 0.6, 0.4, 0.2, 0.3, 0.1, 0.6, 0.08, 0.08)
        high = (0.5, 2.5, 0.5, 1.0, 1.5, 1.2, 0.8, 0.8, 0.4, 0.9, 0.25, 0.25)
        own = rng.uniform(low, high).round(3).tolist()
        return cls(
            thrust=tuple(own[:2]), drag=tuple(own[2:7]), coupling=tuple(own[7:9]),
            backwards=own[9], lag=tuple(own[10:]), noise=(0.02, 0.002, 0.01), camera=(0.001, 0.002),
        )  # fmt: skip

    def _poses(
        self, commands: Array, times: Array, rng: np.random.Generator, noisy: bool
    ) -> tuple[Array, Array]:
        slips, kicks = self._disturbed(len(commands), rng, noisy)
        power = commands[:, :2] / np.array(self.largest)
        power = np.where(power < 0.0, self.backwards * power, power) * (1.0 + slips)
        constants = (*self.thrust, *self.drag, *self.coupling)
        return _sail(power, np.array(self.lag), constants, kicks, times)


@njit(cache=True)
def _kicked(pose, x, y, theta, kick, fraction):
    """Write a pose with the part of a command's noise until then."""
    pose[0], pose[1] = x + kick[0] * fraction, y + kick[1] * fraction
    pose[2] = theta + kick[2] * fraction


@njit(cache=True)
def _sail(power, lag, constants, kicks, times):
    forward, turning, drag, square, aside, slow, slower, sway, weathercock = constants
    thrust = np.zeros(2)
    starts = np.zeros((len(power), 3))
    poses = np.zeros((len(power), times.shape[1], 3))
    u, v, r, x, y, theta = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(power)):
        starts[i, 0], starts[i, 1], starts[i, 2] = x, y, theta
        elapsed = 0.0
        for k in range(times.shape[1]):
            span = times[i, k] - elapsed
            steps = max(math.ceil(span / 0.004 - 1e-9), 1)
            h = span / steps
            for _ in range(steps):
                for a in range(2):
                    thrust[a] += (power[i, a] - thrust[a]) * (1.0 - math.exp(-h / lag[a]))
                push = 0.5 * forward * (thrust[0] + thrust[1])
                du = push - (drag + square * abs(u)) * u + sway * v * r
                dv = -aside * v - sway * u * r
                dr = 0.5 * turning * (thrust[1] - thrust[0])
                dr += weathercock * v - (slow + slower * abs(r)) * r
                u, v, r = u + h * du, v + h * dv, r + h * dr
                middle = theta + 0.5 * r * h
                x += h * (u * math.cos(middle) - v * math.sin(middle))
                y += h * (u * math.sin(middle) + v * math.cos(middle))
                theta += r * h
            elapsed = times[i, k]
            _kicked(poses[i, k], x, y, theta, kicks[i], elapsed / times[i, -1])
        x, y, theta = poses[i, -1, 0], poses[i, -1, 1], poses[i, -1, 2]
    return starts, poses


@njit(cache=True)
def _lab(state, commands, times, p, ground, delay):
    inputs = np.zeros(6)
    inputs[2:4] = physics.REGULATED
    inputs[4:6] = np.nan
    starts = np.zeros((len(commands), 3))
    poses = np.zeros((len(commands), times.shape[1], 3))
    given, acts = np.zeros(len(commands) + 1), 0
    for i in range(len(commands)):
        given[i], given[i + 1 :] = state[0], np.inf
        # It is put back to the middle before it would leave the board; nothing else changes.
        if abs(state[1]) > 0.6 or abs(state[2]) > 0.4:
            state[1], state[2] = 0.0, 0.0
        starts[i] = state[1:4]
        began = state[0]
        for k in range(times.shape[1]):
            until = began + times[i, k]
            while given[acts] + delay <= until:
                physics.advance(state, inputs, p, ground, given[acts] + delay)
                for wheel in range(2):
                    inputs[wheel] = commands[acts, wheel]
                    physics.begin_command(state, wheel, p)
                acts += 1
            physics.advance(state, inputs, p, ground, until)
            poses[i, k] = state[1:4]
    return starts, poses


@njit(cache=True)
def _drive(kind, scale, gain, lag, dead_band, largest, rest, slip, commands, slips, kicks, times):
    slowing, rate, delay, bend, geometry = rest
    actuators = len(scale)
    speed, target = np.zeros(actuators), np.zeros(actuators)
    starts = np.zeros((len(commands), 3))
    poses = np.zeros((len(commands), times.shape[1], 3))
    x, y, theta = 0.0, 0.0, 0.0
    began, given, acts = 0.0, np.zeros(len(commands) + 1), 0
    for i in range(len(commands)):
        starts[i, 0], starts[i, 1], starts[i, 2] = x, y, theta
        given[i], given[i + 1 :] = began, np.inf
        elapsed = 0.0
        for k in range(times.shape[1]):
            span = times[i, k] - elapsed
            steps = max(math.ceil(span / 0.004 - 1e-9), 1)
            h = span / steps
            for s in range(steps):
                while given[acts] + delay <= began + elapsed + (s + 0.5) * h:
                    for a in range(actuators):
                        u = commands[acts, a] / largest[a]
                        u = 0.0 if abs(u) < dead_band[a] else u * (1.0 - bend * abs(u))
                        target[a] = u * gain[a]
                    acts += 1
                for a in range(actuators):
                    tau = lag[a] * (slowing if abs(target[a]) < abs(speed[a]) else 1.0)
                    change = (target[a] - speed[a]) * (1.0 - math.exp(-h / tau))
                    speed[a] += min(max(change, -rate * h), rate * h)
                q0 = speed[0] * scale[0] * (1.0 + slips[i, 0])
                q1 = speed[1] * scale[1] * (1.0 + slips[i, 1])
                side = 0.0
                if kind == 0:
                    v, w = 0.5 * (q0 + q1), (q1 - q0) / geometry
                elif kind == 1:
                    v, w = q0, q1
                elif kind == 2:
                    v, side, w = q0, q1, speed[2] * scale[2] * (1.0 + slips[i, 2])
                elif kind == 3:
                    v = q0
                    w = v * math.tan(q1) / geometry
                else:
                    q2 = speed[2] * scale[2] * (1.0 + slips[i, 2])
                    q3 = speed[3] * scale[3] * (1.0 + slips[i, 3])
                    v, w = 0.25 * (q0 + q1 + q2 + q3), 0.5 * (q2 + q3 - q0 - q1) / geometry
                side -= slip[2] * v * w
                v *= 1.0 - min(slip[0] * abs(w), 0.6)
                w *= 1.0 - min(slip[1] * abs(w), 0.6)
                middle = theta + 0.5 * w * h
                x += h * (v * math.cos(middle) - side * math.sin(middle))
                y += h * (v * math.sin(middle) + side * math.cos(middle))
                theta += w * h
            elapsed = times[i, k]
            _kicked(poses[i, k], x, y, theta, kicks[i], elapsed / times[i, -1])
        x, y, theta = poses[i, -1, 0], poses[i, -1, 1], poses[i, -1, 2]
        began += elapsed
    return starts, poses


def instants(durations: Array, rng: np.random.Generator) -> Array:
    """Return when the camera looks within commands, [N, LOOKS] s; the last is the end."""
    fraction = (np.arange(LOOKS - 1) + rng.uniform(size=(len(durations), LOOKS - 1))) / (LOOKS - 1)
    # Half of them at the beginning, where the speeds change.
    early = np.minimum(0.5, durations)[:, None] * fraction
    times = np.where(np.arange(LOOKS - 1) % 2 == 0, early, durations[:, None] * fraction)
    times = np.sort(np.ceil(times / FRAME) * FRAME, axis=1)
    times = np.minimum(times, durations[:, None] - 1e-3)
    return np.column_stack([times, durations])


def seen(
    commands: Array, times: Array, starts: Array, poses: Array, camera: tuple[float, float], rng
) -> Drives:
    """Return the camera's view of poses [N, 3] and [N, LOOKS, 3] on the floor."""
    noise = rng.standard_normal(poses.shape) * np.array([camera[0], camera[0], camera[1]])
    # A command begins at the frame with which the one before it ended.
    starts = starts + np.vstack([np.zeros_like(starts[:1]), noise[:-1, -1]])
    before = np.vstack([np.zeros_like(commands[:1, :-1]), commands[:-1, :-1]])
    moved = se2.between(starts[:, None], poses + noise)
    return Drives(np.column_stack([before, commands]), moved[:, -1], times, moved)


def random_commands(
    robot: Robot, count: int, rng: np.random.Generator, fraction: float = 1.0
) -> Array:
    """Return commands [count, C + 1]: one in twenty stops, the others uniform, 0.5 to 3 s."""
    largest = np.array(robot.largest)
    driven = rng.uniform(-fraction, fraction, (count, len(largest))) * largest
    if robot.kind == DIFFERENTIAL:
        straight = rng.uniform(size=count) < 0.15
        driven[straight, 1] = driven[straight, 0]
    driven[rng.uniform(size=count) < 0.05] = 0.0
    if robot.units == "%":
        driven = np.round(driven)
    return np.column_stack([driven, np.round(rng.uniform(0.5, 3.0, count), 3)])


def plan_commands(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Return commands [count, C + 1] as plans are made of: forward, fast, long."""
    largest = np.array(robot.largest)
    driven = rng.uniform(0.4, 1.0, (count, len(largest))) * largest
    if robot.kind != DIFFERENTIAL:
        driven[:, 1:] = rng.uniform(-0.5, 0.5, (count, len(largest) - 1)) * largest[1:]
    return np.column_stack([driven, rng.uniform(1.5, 3.0, count)])


_NXT = {"largest": (50.0, 50.0), "camera": (0.0004, 0.001)}

ZOO: dict[str, Robot] = {
    "lab 101": LabRobot(**_NXT, lab_seed=101),
    "lab 102": LabRobot(**_NXT, lab_seed=102),
    "lab 103": LabRobot(**_NXT, lab_seed=103),
    "small": Robot(
        scale=(0.13, 0.13), geometry=0.053, lag=(0.06, 0.06), dead_band=(0.02, 0.02),
        gain=(1.01, 0.99), noise=(0.0, 0.002, 0.0175), camera=(0.0, 0.0), slip=(0.005, 0.01, 0.002),
    ),
    "classroom": Robot(
        scale=(0.25, 0.25), geometry=0.14, lag=(0.15, 0.18), gain=(1.04, 0.96),
        dead_band=(0.12, 0.18), bend=0.15, noise=(0.02, 0.001, 0.01),
    ),
    "large": Robot(
        names=("v", "w"), units="SI", largest=(0.8, 1.5), kind=UNICYCLE, scale=(0.8, 1.5),
        lag=(0.25, 0.15), rate=1.0, noise=(0.015, 0.002, 0.005), camera=(0.002, 0.003),
    ),
    "late": Robot(
        names=("v", "w"), units="SI", largest=(0.4, 2.0), kind=UNICYCLE, scale=(0.4, 2.0),
        lag=(0.1, 0.08), delay=0.15, gain=(0.97, 1.05), noise=(0.01, 0.002, 0.01),
    ),
    "omni": Robot(
        names=("vx", "vy", "w"), largest=(100.0, 100.0, 100.0), kind=OMNI,
        scale=(0.5, 0.4, 2.0), gain=(1.0, 0.95, 1.02), lag=(0.12, 0.16, 0.1),
        dead_band=(0.05, 0.07, 0.04), noise=(0.015, 0.001, 0.005), slip=(0.03, 0.02, 0.01),
    ),
    "tracked": Robot(
        scale=(0.6, 0.6), geometry=0.35, lag=(0.2, 0.2), slowing=0.6, dead_band=(0.08, 0.08),
        slip=(0.06, 0.12, 0.05), noise=(0.04, 0.003, 0.01), camera=(0.001, 0.002),
    ),
    "car": Robot(
        names=("speed", "steering"), largest=(100.0, 100.0), kind=CAR, scale=(0.9, 0.5),
        geometry=0.26, lag=(0.3, 0.08), slowing=0.5, rate=4.0, dead_band=(0.1, 0.0),
        noise=(0.02, 0.002, 0.005), camera=(0.001, 0.002), slip=(0.02, 0.03, 0.01),
    ),
    "sticky": Robot(
        scale=(0.3, 0.28), geometry=0.11, lag=(0.08, 0.25), slowing=0.4, bend=0.3,
        dead_band=(0.15, 0.1), gain=(0.95, 1.08), noise=(0.03, 0.001, 0.005),
    ),
    "lab 104": LabRobot(**_NXT, lab_seed=104),
    "lab 105": LabRobot(**_NXT, lab_seed=105),
    "rover": Robot(
        scale=(1.2, 1.2), geometry=0.55, lag=(0.35, 0.3), slowing=0.8, rate=2.5,
        dead_band=(0.05, 0.06), bend=0.1, slip=(0.08, 0.2, 0.03), noise=(0.05, 0.005, 0.01),
        camera=(0.003, 0.004),
    ),
    "kart": Robot(
        names=("speed", "steering"), largest=(100.0, 100.0), kind=CAR, scale=(1.5, 0.45),
        geometry=0.4, lag=(0.5, 0.15), delay=0.06, gain=(1.0, 1.05), dead_band=(0.06, 0.0),
        noise=(0.03, 0.003, 0.005), camera=(0.002, 0.003), slip=(0.05, 0.06, 0.02),
    ),
    "vacuum": Robot(
        names=("v", "w"), units="SI", largest=(0.35, 2.5), kind=UNICYCLE, scale=(0.35, 2.5),
        lag=(0.05, 0.05), rate=3.0, delay=0.08, dead_band=(0.03, 0.04), gain=(0.98, 0.93),
        noise=(0.02, 0.001, 0.01), slip=(0.01, 0.03, 0.01),
    ),
    "soccer": Robot(
        names=("vx", "vy", "w"), largest=(100.0, 100.0, 100.0), kind=OMNI,
        scale=(1.0, 0.8, 4.0), gain=(1.03, 0.9, 1.0), lag=(0.08, 0.1, 0.06), rate=4.0,
        bend=0.15, dead_band=(0.08, 0.1, 0.08), noise=(0.03, 0.002, 0.01), slip=(0.02, 0.03, 0.02),
    ),
    "four wheels": Robot(
        names=("front_left", "rear_left", "front_right", "rear_right"), largest=(100.0,) * 4,
        kind=FOUR, scale=(0.7, 0.66, 0.68, 0.71), geometry=0.4, lag=(0.15, 0.2, 0.18, 0.16),
        gain=(1.0, 0.97, 1.03, 1.0), dead_band=(0.06, 0.08, 0.05, 0.07), slowing=0.7,
        noise=(0.03, 0.002, 0.008), camera=(0.001, 0.002), slip=(0.06, 0.15, 0.03),
    ),
    "boat": Boat.drawn(1),
    "barge": Boat.drawn(2),
}  # fmt: skip


#: Robots that were not looked at while constants of the learner were chosen.
FRESH = (
    *("lab 104", "lab 105", "rover", "kart", "vacuum", "soccer"),
    *("four wheels", "boat", "barge"),
)


def rows(robot: Robot, count: int, seed: int) -> Drives:
    """Return rows to learn from."""
    rng = np.random.default_rng([seed, 1])
    return robot.drive(random_commands(robot, count, rng), seed)


def clean(robot: Robot, count: int, make: Callable = random_commands) -> Drives:
    """Return rows to be judged by: the motion without noise."""
    rng = np.random.default_rng([999, 2])
    return robot.drive(make(robot, count, rng), 999, noisy=False)
