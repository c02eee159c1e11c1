"""The table simulator, compiled: sensing, motion and collisions.

They compute what :class:`neurosim.simulators.tables.simulator.TableSimulator` does in plain
tensors, one robot after the other. Readings are in single precision, poses in double.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from neurosim.base.se2 import compiled as se2
from neurosim.simulators.numbers import NORMAL, UNIFORM

#: Places in :data:`neurosim.simulators.tables.simulator.NOISES`: what their numbers are.
UNIFORM_NOISE, SAMPLES_NOISE = UNIFORM, NORMAL

#: Sums may be rearranged so that they vectorise; infinities and NaN keep their meaning.
_FAST = {"contract", "reassoc", "nsz", "arcp"}

#: Tables hold at least so many sensors: a number that is known when the kernels are compiled is
#: faster. Those that a robot does not have read nothing.
LANES = 8
#: A robot in a corner is moved out of one wall and then the other, at most so often.
PASSES = 8
#: What is left of an overlap then, m; with more it is jammed and stays where it was.
SLACK = 1e-4


class TableArrays(NamedTuple):
    """A table simulator's numbers, laid out for these kernels.

    Objects are 0, walls, and 1, round obstacles. The column of the first angle is repeated
    after the last. L is the number of sensors, but at least :data:`LANES`.
    """

    excess: np.ndarray  #: [2, D, A + 1, L] float32, reading above ambient
    variance: np.ndarray  #: [2, D, A + 1, L] float32, of a reading, above ambient
    ambient: np.ndarray  #: [L] float32, reading far from everything
    ambient_variance: np.ndarray  #: [L] float32
    first: float  #: smallest sampled distance, rim to surface, m
    pitch: float  #: between sampled distances, m
    fade: float  #: beyond the last distance readings fade over this length, m
    twist: np.ndarray  #: [L, R, 3] body twists, m/s, m/s, rad/s
    twist_spread: np.ndarray  #: [L, R, 3] per square root of a second
    lowest: float  #: the first level of both motors, %
    level_pitch: float  #: between levels, %
    resolution: float  #: commands are rounded to multiples of it, %; 0: not at all
    delay: float  #: until the wheels begin to answer a command, s
    lag: np.ndarray  #: [2] in which a wheel comes within 1/e of its new speed, s
    radius: float  #: of the robot, m
    walls: np.ndarray  #: [W, 5] x, y of one end, direction x, y, length
    hiding: np.ndarray  #: places of walls that may stand before something
    corners: np.ndarray  #: [W, 2] as :attr:`neurosim.simulators.tables.arena.Arena.inward_corners`
    obstacles: np.ndarray  #: [N, 3] x, y, radius
    noise: int  #: place in :data:`neurosim.simulators.tables.simulator.NOISES`
    sensor_noise: float  #: half width of uniform noise
    twist_noise: np.ndarray  #: [3] half widths of uniform noise, per square root of a second


@njit(cache=True, inline="always", error_model="numpy")
def _nearest(wall, x, y):
    """Return the vector from (x, y) to the nearest point of a wall."""
    along = (x - wall[0]) * wall[2] + (y - wall[1]) * wall[3]
    along = min(max(along, 0.0), wall[4])
    return wall[0] + along * wall[2] - x, wall[1] + along * wall[3] - y


@njit(cache=True, error_model="numpy", forceinline=True)
def _share(t, w, x, y):
    """Return how much of a wall counts for a robot at (x, y): less beyond an inward corner."""
    wall = t.walls[w]
    along = (x - wall[0]) * wall[2] + (y - wall[1]) * wall[3]
    if 0.0 <= along <= wall[4]:
        return 1.0
    other = t.corners[w, 0 if along < 0.0 else 1]
    if other < 0:
        return 1.0
    wall = t.walls[other]
    along = (x - wall[0]) * wall[2] + (y - wall[1]) * wall[3]
    return 0.0 if 0.0 <= along <= wall[4] else 0.5


@njit(cache=True, error_model="numpy", forceinline=True)
def _hidden(walls, hiding, x, y, dx, dy, itself):
    """Return whether a wall stands between (x, y) and the point (dx, dy) from it."""
    for h in hiding:
        if h == itself:
            continue
        w = walls[h]
        here = (x - w[0]) * w[3] - (y - w[1]) * w[2]
        change = dx * w[3] - dy * w[2]
        there = here + change
        if here * there >= 0.0 or abs(there) < 1e-9:
            continue
        part = -here / change
        along = (x + part * dx - w[0]) * w[2] + (y + part * dy - w[1]) * w[3]
        if 0.0 <= along <= w[4]:
            return True
    return False


@njit(cache=True, fastmath=_FAST, error_model="numpy", inline="always")
def _mix(near, far, c, a, b, p, q, out):
    """Add four rows of a table, weighted; near and far are [A + 1, L]."""
    for s in range(LANES):
        out[s] += a * near[c, s] + b * near[c + 1, s] + p * far[c, s] + q * far[c + 1, s]
    for s in range(LANES, len(out)):
        out[s] += a * near[c, s] + b * near[c + 1, s] + p * far[c, s] + q * far[c + 1, s]


@njit(cache=True, fastmath=_FAST, error_model="numpy", inline="always")
def _add(t, kind, distance, bearing, weight, out, variance):
    """Add what an object at a distance (m, rim to surface) and bearing (rad) reflects."""
    distances, angles = t.excess.shape[1], t.excess.shape[2] - 1
    row = max((distance - t.first) / t.pitch, 0.0)
    if row > distances - 1:
        weight *= 1.0 - (row - (distances - 1)) * t.pitch / t.fade
        row = float(distances - 1)
    # Samples are in the order in which the robot turned to the left: objects pass to the right.
    turn = -bearing / (2.0 * math.pi)
    column = (turn - math.floor(turn)) * angles
    r, c = min(int(row), distances - 2), min(int(column), angles - 1)
    u, v = row - r, column - c
    a = np.float32(weight * (1.0 - u) * (1.0 - v))
    b = np.float32(weight * (1.0 - u) * v)
    p = np.float32(weight * u * (1.0 - v))
    q = np.float32(weight * u * v)
    near, far = t.excess[kind, r], t.excess[kind, r + 1]
    _mix(near, far, c, a, b, p, q, out)
    if t.noise == SAMPLES_NOISE:
        _mix(t.variance[kind, r], t.variance[kind, r + 1], c, a, b, p, q, variance)


@njit(cache=True, error_model="numpy", inline="always")
def _sense(t, x, y, theta, out, variance):
    """Write the mean readings [L], not yet clipped, and their variance."""
    reach = t.first + (t.excess.shape[1] - 1) * t.pitch + t.fade + t.radius
    for s in range(len(out)):
        out[s] = t.ambient[s]
        variance[s] = t.ambient_variance[s]
    for w in range(len(t.walls)):
        dx, dy = _nearest(t.walls[w], x, y)
        square = dx * dx + dy * dy
        if square >= reach * reach or _hidden(t.walls, t.hiding, x, y, dx, dy, w):
            continue
        share = _share(t, w, x, y)
        if share > 0.0:
            distance = math.sqrt(square) - t.radius
            _add(t, 0, distance, math.atan2(dy, dx) - theta, share, out, variance)
    for o in range(len(t.obstacles)):
        dx, dy = t.obstacles[o, 0] - x, t.obstacles[o, 1] - y
        square, limit = dx * dx + dy * dy, reach + t.obstacles[o, 2]
        if square >= limit * limit or _hidden(t.walls, t.hiding, x, y, dx, dy, -1):
            continue
        distance = math.sqrt(square) - t.radius - t.obstacles[o, 2]
        _add(t, 1, distance, math.atan2(dy, dx) - theta, 1.0, out, variance)


@njit(cache=True, error_model="numpy", inline="always")
def read(t, x, y, theta, draws, sensors, mean, variance):
    """Write the readings of ``sensors`` sensors to ``mean`` [L], with noise of ``draws`` [Z]."""
    _sense(t, x, y, theta, mean, variance)
    for s in range(sensors):
        if t.noise == UNIFORM_NOISE:
            mean[s] += np.float32(t.sensor_noise) * draws[s]
        elif t.noise == SAMPLES_NOISE:
            mean[s] += math.sqrt(variance[s]) * draws[s]
        mean[s] = min(max(mean[s], np.float32(0.0)), np.float32(1.0))


@njit(cache=True, error_model="numpy", inline="always")
def _push_out(t, x, y):
    """Return where a robot at (x, y) is moved to, out of what it overlaps, and if it fits there."""
    for _ in range(PASSES):
        free = True
        for w in range(len(t.walls)):
            dx, dy = _nearest(t.walls[w], x, y)
            square = dx * dx + dy * dy
            if 0.0 < square < t.radius * t.radius:
                distance = math.sqrt(square)
                back = (t.radius - distance) / distance
                x -= back * dx
                y -= back * dy
                free = free and t.radius - distance < SLACK
        for o in range(len(t.obstacles)):
            dx, dy = t.obstacles[o, 0] - x, t.obstacles[o, 1] - y
            square, limit = dx * dx + dy * dy, t.radius + t.obstacles[o, 2]
            if 0.0 < square < limit * limit:
                distance = math.sqrt(square)
                back = (limit - distance) / distance
                x -= back * dx
                y -= back * dy
                free = free and limit - distance < SLACK
        if free:
            return x, y, True
    return x, y, False


@njit(cache=True, error_model="numpy", inline="always")
def _rounded(t, speed):
    """Return the speed in percent that the robot takes for one."""
    return t.resolution * np.rint(speed / t.resolution) if t.resolution > 0.0 else speed


@njit(cache=True, error_model="numpy", inline="always")
def _level(t, speed, levels):
    """Return place and share of the level below a speed in percent."""
    place = min(max((speed - t.lowest) / t.level_pitch, 0.0), levels - 1.0)
    below = min(int(place), levels - 2)
    return below, place - below


@njit(cache=True, error_model="numpy", inline="always")
def _twist(t, table, left, right, out):
    """Write a motor table's value [3] at the wheels' speeds (%, %)."""
    i, u = _level(t, left, table.shape[0])
    j, v = _level(t, right, table.shape[1])
    for k in range(3):
        out[k] = (1.0 - u) * ((1.0 - v) * table[i, j, k] + v * table[i, j + 1, k]) + u * (
            (1.0 - v) * table[i + 1, j, k] + v * table[i + 1, j + 1, k]
        )


@njit(cache=True)
def phases(t, duration, parts):
    """Return how speeds approach their goals in the parts of a command of ``duration`` (s).

    Returns:
        [parts, 2, 5]; in every part first what is left of the goals before, then the new ones.
        Each for so long (s); then, for either wheel, the share that the speed at its beginning
        has in the mean over that time, and in the speed at its end.
    """
    out = np.zeros((parts, 2, 5))
    for part in range(parts):
        length = duration / parts
        waiting = min(max(t.delay - part * length, 0.0), length)
        for phase in range(2):
            time = waiting if phase == 0 else length - waiting
            out[part, phase, 0] = time
            for wheel in range(2):
                mean, end = 1.0, 1.0
                if time > 0.0:
                    lag = t.lag[wheel]
                    end = math.exp(-time / lag) if lag > 0.0 else 0.0
                    mean = lag * (1.0 - end) / time
                out[part, phase, 1 + wheel], out[part, phase, 3 + wheel] = mean, end
    return out


@njit(cache=True, inline="always", error_model="numpy")
def _advance(t, phase, speeds, left, right, out):
    """Let speeds [2] approach goals (%, %) for a phase [5], and write the displacement's log."""
    left_off, right_off = speeds[0] - left, speeds[1] - right
    _twist(t, t.twist, left + phase[1] * left_off, right + phase[2] * right_off, out)
    for k in range(3):
        out[k] *= phase[0]
    speeds[0], speeds[1] = left + phase[3] * left_off, right + phase[4] * right_off


@njit(cache=True, inline="always", error_model="numpy")
def _moved(t, x, y, theta, first, second, noise):
    """Return where two motions in a row, their logs and the noise's [3], lead from a pose."""
    # As one motion (Baker, Campbell and Hausdorff, second order).
    ahead = 0.5 * (second[2] * first[1] - first[2] * second[1])
    side = 0.5 * (first[2] * second[0] - second[2] * first[0])
    forward = second[0] + first[0] + ahead + noise[0]
    leftward = second[1] + first[1] + side + noise[1]
    turn = second[2] + first[2] + noise[2]
    to_x, to_y, theta = se2.compose_exp(x, y, theta, forward, leftward, turn)
    to_x, to_y, fits = _push_out(t, to_x, to_y)
    if fits:
        x, y = to_x, to_y
    return x, y, theta
