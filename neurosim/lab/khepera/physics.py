"""Planar physics of the virtual Khepera, compiled: wheels, contact, infra-red light.

State and inputs are flat arrays (:class:`S`, :class:`U`), one robot. Time advances in whole ticks,
so that the result does not depend on the number of calls. Random numbers come from a given
generator.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from neurosim.base.compiled import njit
from neurosim.lab.contact import deepest, hit
from neurosim.lab.khepera.params import PULSES_PER_METRE, RADIUS, WHEEL_BASE

#: Time step of the physics, and of the scan of the sensors, which takes 8 x 2.5 ms (s).
TICK = 0.0025
SCAN_TICKS = 8
#: Number of rays of a sensor's cone, and its half opening (rad).
RAYS, HALF_CONE = 15, math.radians(60.0)
#: Distance behind the rim at which a sensor's light begins (m).
DEPTH = 0.003
#: Sharpness of saturation: 1 would be 1/(1+x), infinity a clip.
KNEE = 8.0
#: Largest depth of the robot in a surface (m).
TOUCH = 1e-9


class S(IntEnum):
    """Indices in the state; a pair of wheels is left, then right."""

    TICKS = 0
    X = 1
    Y = 2
    THETA = 3
    SPEED = 4  # of the rim as the encoder sees it, m/s, two places
    DISTANCE = 6  # of the rim as the encoder sees it, m, two places
    SLIP = 8  # relative, two places
    SCAN = 10  # pose when the sensors were last scanned, three places
    DRIFT = 13  # of the ambient light, counts
    TOUCHES = 14  # ticks in touch with something so far
    SIZE = 15


class U(IntEnum):
    """Indices in the inputs; a pair of wheels is left, then right."""

    TARGET = 0  # m/s, or m of the encoder in position mode, two places
    POSITION = 2  # 1 in position mode, else 0, two places
    LIMIT = 4  # m/s in position mode, two places
    SIZE = 6


#: Gain of the position mode, 1/s.
_POSITION_GAIN = 8.0


def new_state(x: float, y: float, theta: float) -> np.ndarray:
    """Return the state of a robot that stands at a pose (m, m, rad)."""
    state = np.zeros(int(S.SIZE))
    state[S.X], state[S.Y], state[S.THETA] = x, y, theta
    state[S.SCAN : S.SCAN + 3] = x, y, theta
    return state


def new_inputs() -> np.ndarray:
    """Return the inputs of motors at rest."""
    return np.zeros(int(U.SIZE))


@njit
def _wanted(state, inputs, wheel, motor):
    """Return the speed that a wheel's controller holds, m/s: with the gain, less the friction."""
    target = inputs[U.TARGET + wheel]
    if inputs[U.POSITION + wheel] > 0.0:
        missing = target - state[S.DISTANCE + wheel]
        limit = inputs[U.LIMIT + wheel]
        if abs(missing) * PULSES_PER_METRE < 1.0:
            return 0.0
        target = max(-limit, min(limit, _POSITION_GAIN * missing))
        # Enough to move: a position controller compensates friction by integration.
        return target
    loss = motor[2 + wheel]
    size = max(motor[wheel] * abs(target) - loss, 0.0)
    return math.copysign(size, target)


@njit
def penetration(x, y, walls, cylinders):
    """Return the depth in a surface of a robot at (x, y), m; below 0 where it is free."""
    depth, _, _ = deepest(x, y, RADIUS, walls, cylinders)
    return depth


@njit
def _settle(state, old_x, old_y, walls, cylinders, friction):
    """Push a robot out of a surface; along the surface, friction holds it back."""
    touched = False
    for _ in range(6):
        depth, nx, ny = deepest(state[S.X], state[S.Y], RADIUS, walls, cylinders)
        if depth <= 0.0:
            break
        touched = True
        state[S.X] += depth * nx
        state[S.Y] += depth * ny
        along = -(state[S.X] - old_x) * ny + (state[S.Y] - old_y) * nx
        held = math.copysign(min(abs(along), friction * depth), along)
        state[S.X] += held * ny
        state[S.Y] -= held * nx
    if touched:
        state[S.TOUCHES] += 1.0
        if penetration(state[S.X], state[S.Y], walls, cylinders) > TOUCH:
            state[S.X], state[S.Y] = old_x, old_y


@njit
def advance(state, inputs, motor, walls, cylinders, rng, until):
    """Drive on to the tick ``until``; earlier ones change nothing.

    Args:
        state: [S], changed in place.
        inputs: [U].
        motor: :meth:`KheperaParams.motor_row`.
        walls: [W, 4] m.
        cylinders: [N, 3] m.
        rng: generator of all random numbers.
        until: whole ticks since the beginning.
    """
    slip, slip_time, friction = motor[8], motor[9], motor[10]
    drift, drift_time = motor[11], motor[12]
    keep = math.exp(-TICK / slip_time)
    fresh = slip * math.sqrt(1.0 - keep * keep)
    scan = TICK * SCAN_TICKS
    drift_keep = math.exp(-scan / drift_time)
    drift_fresh = drift * math.sqrt(1.0 - drift_keep * drift_keep)
    while state[S.TICKS] < until:
        moves = 0.0
        distances = (0.0, 0.0)
        for wheel in range(2):
            wanted = _wanted(state, inputs, wheel, motor)
            decay = math.exp(-TICK / motor[4 + wheel])
            before = state[S.SPEED + wheel]
            after = wanted + (before - wanted) * decay
            turned = wanted * TICK + (before - wanted) * motor[4 + wheel] * (1.0 - decay)
            state[S.SPEED + wheel] = after
            state[S.DISTANCE + wheel] += turned
            if fresh > 0.0 and turned != 0.0:
                state[S.SLIP + wheel] = keep * state[S.SLIP + wheel] + fresh * rng.standard_normal()
            distance = turned * motor[6 + wheel] * (1.0 - state[S.SLIP + wheel])
            distances = (distance, distances[1]) if wheel == 0 else (distances[0], distance)
            moves += abs(turned)
        if moves > 0.0:
            turn = (distances[1] - distances[0]) / WHEEL_BASE
            forward = 0.5 * (distances[0] + distances[1])
            heading = state[S.THETA] + 0.5 * turn
            half = 0.5 * turn
            chord = forward if abs(half) < 1e-9 else forward * math.sin(half) / half
            old_x, old_y = state[S.X], state[S.Y]
            state[S.X] = old_x + chord * math.cos(heading)
            state[S.Y] = old_y + chord * math.sin(heading)
            state[S.THETA] += turn
            _settle(state, old_x, old_y, walls, cylinders, friction)
        state[S.TICKS] += 1.0
        if state[S.TICKS] % SCAN_TICKS == 0.0:
            for axis in range(3):
                state[S.SCAN + axis] = state[S.X + axis]
            if drift_fresh > 0.0:
                state[S.DRIFT] = drift_keep * state[S.DRIFT] + drift_fresh * rng.standard_normal()


@njit
def reflected(pose, angle, walls, cylinders):
    """Return the light (1/m2) that comes back to a sensor at ``angle`` (rad) on the rim.

    The emitter's cone is cast in rays. A surface that light meets at the angle of incidence i
    reflects it by Lambert's law: the light at the receiver falls with cos i and with the square of
    the distance. Emitter and receiver each have a lobe of cos^2, so that a ray at the
    angle a from the axis counts cos^4 a; the weights sum up to 1 over the cone. A large wall
    straight ahead at the distance d gives a bit less than 1/d^2; a small object gives less, because
    it fills less of the cone.
    """
    direction = pose[2] + angle
    cos, sin = math.cos(direction), math.sin(direction)
    x = pose[0] + (RADIUS - DEPTH) * cos
    y = pose[1] + (RADIUS - DEPTH) * sin
    light, weights = 0.0, 0.0
    for ray in range(RAYS):
        off = HALF_CONE * ((2.0 * ray + 1.0) / RAYS - 1.0)
        weight = math.cos(off) ** 4
        weights += weight
        far, incidence = hit(
            x, y, math.cos(direction + off), math.sin(direction + off), walls, cylinders
        )
        if far < np.inf:
            light += weight * incidence / (far * far)
    return light / weights


@njit
def saturated(light):
    """Return a reading (0..1) of light over full range: itself when small, 1 at most, smoothly."""
    if light <= 0.0:
        return 0.0
    return light / (1.0 + light**KNEE) ** (1.0 / KNEE)


@njit
def proximity(pose, angles, reach, threshold, offset, noises, drift, walls, cylinders, albedo, rng):
    """Return the sensors' readings, [8] int 0..1023.

    Args:
        pose: [3] of the robot during the scan.
        angles: [8] rad.
        reach: [8] m2.
        threshold: [8].
        offset: [8] counts.
        noises: (counts, relative) standard deviations.
        drift: of ambient light, counts; it shifts the threshold in proportion to the full range.
        walls: [W, 4] m.
        cylinders: [N, 3] m.
        albedo: of all of them.
        rng: generator of the noise.
    """
    read = np.empty(8, np.int64)
    for i in range(8):
        light = albedo * reach[i] * reflected(pose, angles[i], walls, cylinders)
        if noises[1] > 0.0:
            light *= 1.0 + noises[1] * rng.standard_normal()
        value = 1023.0 * saturated(light - threshold[i] - drift / 1023.0) + offset[i]
        if noises[0] > 0.0:
            value += noises[0] * rng.standard_normal()
        read[i] = round(max(0.0, min(1023.0, value)))
    return read
