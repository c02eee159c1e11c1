"""Planar physics of the NXT robot, compiled: motors, slip, caster, battery.

One robot is a flat float64 array of state (:class:`S`) and one of inputs (:class:`U`), so that
a batch of robots is one more axis and a loop. Units are SI, powers are in percent, frames as
REP 103. Random draws come from a counter-based generator whose seed and counter are in the state:
the same seed and the same commands give the same numbers.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from neurosim.base.compiled import njit
from neurosim.base.random import GOLDEN, normal, uniform
from neurosim.lab.nxt.params import BOARD, LabParams

#: Longest integration step (s).
STEP = 0.002


class S(IntEnum):
    """Indices in the state; a pair of wheels is left, then right."""

    TIME = 0
    X = 1
    Y = 2
    THETA = 3
    SPEED = 4  # rad/s, two places
    ANGLE = 6  # rad since the start, two places
    PUSH = 8  # % s on a standing wheel, two places
    SLIP = 10  # this command's own slip, two places
    CASTER = 12  # direction in which the caster rolls, rad in the robot frame
    CASTER_PUSH = 13
    BATTERY = 14  # open-circuit voltage
    VOLTAGE = 15  # at the terminals
    SEED = 16
    DRAWS = 17
    SIZE = 18


class U(IntEnum):
    """Indices in the inputs; a pair of wheels is left, then right."""

    POWER = 0  # %, two places
    MODE = 2  # one of the drive modes below, two places
    LIMIT = 4  # wheel angle (rad) at which the drive is to stop, NaN for none, two places
    SIZE = 6


#: Drive modes of a wheel.
COAST, BRAKE, OPEN_LOOP, REGULATED = 0.0, 1.0, 2.0, 3.0

_GRID = 0.05  # m between the slip field's samples
_HALF_LENGTH, _HALF_WIDTH = BOARD.length / 2, BOARD.width / 2


def slip_field(params: LabParams) -> np.ndarray:
    """Return the slip field over the board, [NY, NX] at every 5 cm from its lower left corner.

    White noise smoothed by a Gaussian: covariance exp(-(d / length)^2 / 2), standard deviation
    as asked for over the board.
    """
    nx, ny = round(BOARD.length / _GRID) + 2, round(BOARD.width / _GRID) + 2
    rng = np.random.default_rng(int(params.slip_seed))
    # Smoothing by a Gaussian of length / sqrt(2) correlates over `length`.
    sigma = params.slip_length / math.sqrt(2.0) / _GRID
    reach = math.ceil(4.0 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= math.sqrt((kernel**2).sum())
    noise = rng.standard_normal((ny + 2 * reach, nx + 2 * reach))
    noise = np.apply_along_axis(np.convolve, 0, noise, kernel, "valid")
    return params.slip_field * np.apply_along_axis(np.convolve, 1, noise, kernel, "valid")


def new_state(params: LabParams, seed: int, pose: tuple[float, float, float]) -> np.ndarray:
    """Return the state of a robot that stands at ``pose`` (m, m, rad), caster trailing behind."""
    state = np.zeros(int(S.SIZE))
    state[S.X], state[S.Y], state[S.THETA] = pose
    state[S.BATTERY] = state[S.VOLTAGE] = params.battery
    state[S.SEED] = float(np.random.default_rng([seed, 0x5EED]).integers(2**52))
    return state


def new_inputs() -> np.ndarray:
    """Return the inputs of a robot whose motors were never switched on."""
    inputs = np.zeros(int(U.SIZE))
    inputs[U.LIMIT : U.LIMIT + 2] = np.nan
    return inputs


@njit
def _normal(state):
    state[S.DRAWS] += 2.0
    last = np.uint64(state[S.SEED]) + np.uint64(state[S.DRAWS]) * GOLDEN
    return normal(uniform(last - GOLDEN), uniform(last))


@njit
def begin_command(state, wheel, p):
    """Draw the random parts of a motor command: the wheel's slip and the caster's inclination."""
    state[S.SLIP + wheel] = p.slip_draw * _normal(state)
    state[S.CASTER_PUSH] = p.caster_draw * _normal(state)


@njit
def _turn_wheel(state, inputs, wheel, p, h):
    """Advance a motor by ``h`` seconds; return its wheel's mean speed meanwhile (rad/s)."""
    speed, power, mode = state[S.SPEED + wheel], inputs[U.POWER + wheel], inputs[U.MODE + wheel]
    if wheel == 0:
        gain, lag, dead_band = p.gain_left, p.lag_left, p.dead_band_left
    else:
        gain, lag, dead_band = p.gain_right, p.lag_right, p.dead_band_right
    strength = state[S.VOLTAGE] / p.rated_voltage
    ceiling = p.full_speed * strength
    target = 0.0
    if mode == COAST:
        lag = p.coast_lag
    elif mode == BRAKE:
        lag = p.brake_lag
    else:
        lag /= strength
        if abs(power) >= dead_band:
            target = gain * power / 100.0
            if mode == REGULATED:
                phase = p.ripple_periods * state[S.ANGLE + wheel]
                target *= p.full_speed * (1.0 + p.ripple * math.sin(phase))
            else:
                lost = math.copysign(p.load_droop * p.full_speed, target)
                target = target * ceiling - lost
                if target * power < 0.0:
                    target = 0.0
            target = min(max(target, -ceiling), ceiling)

    moving = h  # seconds of the step in which the wheel turns
    if speed == 0.0:
        if target == 0.0:
            state[S.PUSH + wheel] = 0.0
            return 0.0
        state[S.PUSH + wheel] += abs(power) * h
        beyond = state[S.PUSH + wheel] - p.breakaway
        if beyond < 0.0:
            return 0.0
        moving = min(beyond / abs(power), h)
    after = target + (speed - target) * math.exp(-moving / lag)
    if after != 0.0:  # free of static friction, with a margin for rounding
        state[S.PUSH + wheel] = 0.0
    if p.breakaway > 0.0 and after * speed < 0.0:
        # Static friction stops the wheel when its speed crosses zero.
        after = 0.0
        moving = lag * math.log((target - speed) / target)
        state[S.PUSH + wheel] = abs(power) * (h - moving)
    turned = target * moving + lag * (speed - after)
    if target == 0.0 and abs(after) < p.stop_speed:
        after = 0.0
    state[S.SPEED + wheel] = after
    state[S.ANGLE + wheel] += turned
    return turned / h


@njit
def _ground_slip(x, y, field, p):
    """Return the slip of the ground at a point: the field on the board, a constant beyond it."""
    if abs(x) > _HALF_LENGTH or abs(y) > _HALF_WIDTH:
        return p.slip_floor
    column, row = (x + _HALF_LENGTH) / _GRID, (y + _HALF_WIDTH) / _GRID
    i, j = int(column), int(row)
    a, b = column - i, row - j
    near = (1.0 - a) * field[j, i] + a * field[j, i + 1]
    far = (1.0 - a) * field[j + 1, i] + a * field[j + 1, i + 1]
    return p.slip_mean + (1.0 - b) * near + b * far


@njit
def step(state, inputs, p, field, h):
    """Advance one robot by ``h`` seconds, in place.

    Args:
        state: float64 [S.SIZE].
        inputs: float64 [U.SIZE].
        p: :class:`neurosim.lab.nxt.params.Coefficients`.
        field: slip field of :func:`slip_field`.
        h: step in seconds, at most :data:`STEP` for the accuracy that the tests pin.
    """
    load = 0.0
    for wheel in range(2):
        if inputs[U.MODE + wheel] >= OPEN_LOOP:
            load += abs(inputs[U.POWER + wheel]) / 200.0
    loss = p.battery_idle_loss + p.battery_drive_loss * load
    state[S.BATTERY] = max(state[S.BATTERY] - loss * h / 3600.0, 0.0)
    state[S.VOLTAGE] = max(state[S.BATTERY] - p.battery_sag * load, 0.5)

    theta = state[S.THETA]
    cos, sin = math.cos(theta), math.sin(theta)
    half = 0.5 * p.track
    left = _turn_wheel(state, inputs, 0, p, h) * 0.5 * p.diameter_left
    right = _turn_wheel(state, inputs, 1, p, h) * 0.5 * p.diameter_right
    x, y = state[S.X], state[S.Y]
    left *= 1.0 - state[S.SLIP] - _ground_slip(x - sin * half, y + cos * half, field, p)
    right *= 1.0 - state[S.SLIP + 1] - _ground_slip(x + sin * half, y - cos * half, field, p)
    v, w = 0.5 * (left + right), (right - left) / p.track

    # The caster's fork turns towards the direction in which its pivot is dragged.
    across = -p.caster_distance * w
    dragged = math.hypot(v, across)
    if dragged > 0.0:
        off = math.atan2(across, v) - state[S.CASTER]
        sin_off = math.sin(off)
        tip = (p.caster_bias + state[S.CASTER_PUSH]) * 0.5 * (1.0 - math.cos(off))
        state[S.CASTER] += h * (dragged / p.caster_trail * (sin_off + tip) - w)
        free = 1.0 - p.caster_drag * sin_off * sin_off
        v *= free
        w = w * free - p.caster_yaw * dragged * sin_off
    sideways = p.pivot_offset * w - p.side_slip * v * w

    middle = theta + 0.5 * w * h
    cos, sin = math.cos(middle), math.sin(middle)
    x += h * (v * cos - sideways * sin)
    y += h * (v * sin + sideways * cos)
    state[S.X] = min(max(x, -_HALF_LENGTH - p.room), _HALF_LENGTH + p.room)
    state[S.Y] = min(max(y, -_HALF_WIDTH - p.room), _HALF_WIDTH + p.room)
    state[S.THETA] = theta + w * h
    state[S.TIME] += h


@njit
def advance(state, inputs, p, field, until):
    """Advance one robot to the time ``until``, in equal steps of at most :data:`STEP`.

    Returns:
        The wheel (0 or 1) that has reached its limit of rotation, at whose time the state then is,
        or -1 when ``until`` is reached.
    """
    steps = math.ceil((until - state[S.TIME]) / STEP - 1e-9)
    if steps <= 0:
        return -1
    h = (until - state[S.TIME]) / steps
    for _ in range(steps):
        step(state, inputs, p, field, h)
        for wheel in range(2):
            limit = inputs[U.LIMIT + wheel]
            if (state[S.ANGLE + wheel] - limit) * inputs[U.POWER + wheel] >= 0.0:
                return wheel
    state[S.TIME] = until
    return -1
