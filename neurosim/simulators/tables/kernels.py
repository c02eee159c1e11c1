"""The table simulator, compiled: sensing, motion and collisions.

The functions compute the same as :class:`neurosim.simulators.tables.simulator.TableSimulator` in
plain tensors, one robot after the other. Readings are in single precision, poses in double.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import vectorize

from neurosim.base.kernels import kernel
from neurosim.base.se2 import compiled as se2
from neurosim.simulators import engine
from neurosim.simulators.numbers import NORMAL, UNIFORM

#: Kinds of random numbers, in the order of :data:`neurosim.simulators.tables.simulator.NOISES`.
UNIFORM_NOISE, SAMPLES_NOISE = UNIFORM, NORMAL

#: Sums may be rearranged so that they vectorise; infinities and NaN keep their meaning.
_FAST = {"contract", "reassoc", "nsz", "arcp"}

#: Smallest number of sensors in a table, because a number known to the compiler is faster. Missing
#: sensors read nothing.
LANES = 8
#: Number of motions of a command whose timing is kept for the next one.
_PARTS = 64
#: Largest number of times that a robot in a corner is moved out of one wall and then the other.
PASSES = 8
#: Largest remaining overlap, m; with more it is jammed and stays at its position.
SLACK = 1e-4
#: Smallest distance from the rim at which objects are seen, m.
NEAREST = 1e-4
#: Fraction of an endless wall's light that counts as no light.
FAINT = 1e-6


class Lookup(NamedTuple):
    """A sensor table's numbers.

    The column of the first angle is repeated after the last. K is the number of kinds of objects,
    L that of sensors, but at least :data:`LANES`.
    """

    excess: np.ndarray  #: [K, D, A + 1, L] float32, reading above the one far from everything
    variance: np.ndarray  #: [K, D, A + 1, L] float32, of a reading, likewise
    ambient: np.ndarray  #: [L] float32, reading without objects
    ambient_variance: np.ndarray  #: [L] float32
    first: float  #: smallest sampled distance, rim to surface, m
    pitch: float  #: between sampled distances, m
    fade: float  #: length over which readings fade beyond the last distance, m
    reach: np.ndarray  #: [K] largest distance from the rim at which objects change a reading, m
    sensors: int  #: number of sensors that are read, 0 or all


class TableArrays(NamedTuple):
    """A table simulator's numbers for these kernels."""

    near: Lookup  #: of walls, its first kind, and of obstacles
    light: Lookup  #: of lights, its only kind; without lights, its sensors are not read
    twist: np.ndarray  #: [V, R, 3] body twists, m/s, m/s, rad/s
    twist_spread: np.ndarray  #: [V, R, 3] per square root of a second
    lowest: float  #: the first level of both motors, %
    level_pitch: float  #: between levels, %
    resolution: float  #: commands are rounded to multiples of it, %; 0: no rounding
    delay: float  #: delay until the wheels begin to answer a command, s
    lag: np.ndarray  #: [2] time constants of the wheels, s
    radius: float  #: of the robot, m
    fastest: float  #: its highest speed, m/s
    longest: float  #: longest motion of a command, s
    looks: np.ndarray  #: [2, L] directions of sensors of ``near``, unit vectors, ahead and left
    walls: np.ndarray  #: [W, 5] x, y of one end, direction x, y, length; free on their left
    screens: np.ndarray  #: [H, 5] the same of walls that may hide objects
    obstacles: np.ndarray  #: [N, 4] x, y, radius, kind in ``near``
    lights: np.ndarray  #: [M, 2] x, y
    noise: int  #: place in :data:`neurosim.simulators.tables.simulator.NOISES`
    sensor_noise: float  #: half width of uniform noise
    twist_noise: np.ndarray  #: [3] half widths of uniform noise, per square root of a second


@kernel(fastmath=_FAST, forceinline=True)
def _nearest(wall, x, y):
    """Return the vector from (x, y) to the nearest point of a wall."""
    along = (x - wall[0]) * wall[2] + (y - wall[1]) * wall[3]
    along = min(max(along, 0.0), wall[4])
    return wall[0] + along * wall[2] - x, wall[1] + along * wall[3] - y


@kernel(forceinline=True)
def _light(begin, end, height, ahead, aside):
    """Return the light that a straight surface reflects to a sensor, 1/m2.

    The surface is from ``begin`` to ``end`` (m) along a line at the height ``height`` (m) above the
    sensor, whose direction is the unit vector ``ahead`` (to the line) and ``aside`` (along it). By
    Lambert's law the light of a small angle falls with the cosine of the incidence a and with the
    square of the distance, height / cos a; the product of the lobes of sensor and emitter falls
    with cos^2. The sensor sees nothing behind it: a ends where sin a is -ahead. The
    integrand over a, with s = sin a and c = cos a, is c^3 (ahead c + aside s)^2.
    """
    square = height * height
    c, k = height / math.sqrt(begin * begin + square), height / math.sqrt(end * end + square)
    s, z = begin / height * c, end / height * k
    # Selected without a branch, so that several sensors are computed in parallel.
    cut_begin, cut_end = aside >= 0.0 and s < -ahead, aside <= 0.0 and z > ahead
    s, c = -ahead if cut_begin else s, aside if cut_begin else c
    z, k = ahead if cut_end else z, -aside if cut_end else k
    s2, z2, c2, k2 = s * s, z * z, c * c, k * k
    s3, z3 = s * s2, z * z2
    fifth, third = (z3 * z2 - s3 * s2) / 5.0, (z3 - s3) / 3.0
    straight = (z - s) - 2.0 * third + fifth
    mixed = (c * c2 * c2 - k * k2 * k2) / 5.0
    light = ahead * ahead * straight + 2.0 * ahead * aside * mixed + aside * aside * (third - fifth)
    return max(light, 0.0) / square if s < z else 0.0


@kernel(forceinline=True)
def _endless(height, ahead):
    """Return the light of an endless line, with a sensor's component ``ahead`` towards it."""
    side = max(1.0 - ahead * ahead, 0.0)
    a3 = ahead * ahead * ahead
    a5 = a3 * ahead * ahead
    straight = 8.0 / 15.0 + ahead - 2.0 * a3 / 3.0 + a5 / 5.0
    across = 2.0 / 15.0 + a3 / 3.0 - a5 / 5.0
    light = ahead * ahead * straight + 0.4 * ahead * side * side * side + side * across
    return max(light, 0.0) / (height * height)


@kernel(forceinline=True)
def _hidden(screens, x, y, dx, dy):
    """Return whether an object is between (x, y) and the point (dx, dy) from it."""
    for h in range(len(screens)):
        w = screens[h]
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


@kernel(forceinline=True)
def _column(angles, angle):
    """Return the table's column at an angle (rad) to the robot's left, and a remainder."""
    # Samples are in the order in which the robot turned to the left: objects pass to the right.
    turn = -angle / (2.0 * math.pi)
    column = (turn - math.floor(turn)) * angles
    c = min(int(column), angles - 1)
    return c, column - c


@kernel(fastmath=_FAST, forceinline=True)
def _mix(near, far, c, a, b, p, q, out):
    """Add four rows of a table, weighted; near and far are [A + 1, L]."""
    for s in range(LANES):
        out[s] += a * near[c, s] + b * near[c + 1, s] + p * far[c, s] + q * far[c + 1, s]
    for s in range(LANES, len(out)):
        out[s] += a * near[c, s] + b * near[c + 1, s] + p * far[c, s] + q * far[c + 1, s]


@kernel(fastmath=_FAST)
def _add(t, noisy, kind, distance, bearing, out, variance):
    """Add the reading of an object at a distance (m, rim to surface) and bearing (rad).

    ``t`` is a :class:`Lookup`; the variance is added only if ``noisy``.
    """
    distances, weight = t.excess.shape[1], 1.0
    row = max((distance - t.first) / t.pitch, 0.0)
    if row > distances - 1:
        weight -= (row - (distances - 1)) * t.pitch / t.fade
        row = float(distances - 1)
    r = min(int(row), distances - 2)
    u = row - r
    c, v = _column(t.excess.shape[2] - 1, bearing)
    a = np.float32(weight * (1.0 - u) * (1.0 - v))
    b = np.float32(weight * (1.0 - u) * v)
    p = np.float32(weight * u * (1.0 - v))
    q = np.float32(weight * u * v)
    near, far = t.excess[kind, r], t.excess[kind, r + 1]
    _mix(near, far, c, a, b, p, q, out)
    if noisy:
        _mix(t.variance[kind, r], t.variance[kind, r + 1], c, a, b, p, q, variance)


@kernel(forceinline=True)
def _visible(wall, screens, x, y, reach):
    """Return whether a wall's front is within reach (m) of (x, y), and the nearest vector to it."""
    dx, dy = _nearest(wall, x, y)
    front = (wall[0] - x) * wall[3] - (wall[1] - y) * wall[2] > 0.0
    seen = front and dx * dx + dy * dy < reach * reach and not _hidden(screens, x, y, dx, dy)
    return seen, dx, dy


@kernel(fastmath=_FAST)
def _add_light(wall, looks, radius, x, y, cos, sin, number, total, most, brightest):
    """Add the light [S] of a wall to the total, and note the brightest wall so far."""
    off_x, off_y = wall[0] - x, wall[1] - y
    high, first = off_x * wall[3] - off_y * wall[2], off_x * wall[2] + off_y * wall[3]
    along_x, along_y = cos * wall[2] + sin * wall[3], cos * wall[3] - sin * wall[2]
    for s in range(len(total)):
        ahead = looks[0, s] * along_y - looks[1, s] * along_x
        aside = looks[0, s] * along_x + looks[1, s] * along_y
        height, begin = high - radius * ahead, first - radius * aside
        light = _light(begin, begin + wall[4], max(height, NEAREST), ahead, aside)
        light = light if height >= -NEAREST else 0.0
        total[s] += light
        brightest[s] = number if light > most[s] else brightest[s]
        most[s] = max(light, most[s])


@kernel()
def _add_walls(t, x, y, theta, reach, sums, out, variance):
    """Add the reflection of all walls together, some of which end.

    Their light adds up. Every sensor has the reading of a single endless wall, perpendicular at the
    brightest point, at the distance with this amount of light.
    """
    near = t.near
    distances = near.excess.shape[1]
    sums[:] = 0.0
    total, most, brightest = sums[0], sums[1], sums[2]
    cos, sin = math.cos(theta), math.sin(theta)
    for w in range(len(t.walls)):
        seen, _, _ = _visible(t.walls[w], t.screens, x, y, reach)
        if seen:
            _add_light(
                t.walls[w], t.looks, t.radius, x, y, cos, sin, float(w), total, most, brightest
            )
    last, dx, dy, away, ahead_x, ahead_y, c, v = -1, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0
    for s in range(len(total)):
        if most[s] == 0.0:
            continue
        if int(brightest[s]) != last:
            last = int(brightest[s])
            dx, dy = _nearest(t.walls[last], x, y)
            away = math.sqrt(dx * dx + dy * dy)
            ahead_x, ahead_y = (cos * dx + sin * dy) / away, (cos * dy - sin * dx) / away
            c, v = _column(near.excess.shape[2] - 1, math.atan2(dy, dx) - theta)
        ahead = t.looks[0, s] * ahead_x + t.looks[1, s] * ahead_y
        height = max(away - t.radius * ahead, NEAREST)
        endless = _endless(height, ahead)
        if total[s] <= FAINT * endless:
            continue
        distance = away - t.radius + height * (math.sqrt(endless / total[s]) - 1.0)
        row = max((distance - near.first) / near.pitch, 0.0)
        weight = 1.0 - max(row - (distances - 1), 0.0) * near.pitch / near.fade
        if weight <= 0.0:
            continue
        row = min(row, distances - 1.0)
        r = min(int(row), distances - 2)
        u = row - r
        a, b, p, q = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
        table = near.excess[0]
        reading = a * table[r, c, s] + b * table[r, c + 1, s]
        out[s] += weight * (reading + p * table[r + 1, c, s] + q * table[r + 1, c + 1, s])
        if t.noise == SAMPLES_NOISE:
            table = near.variance[0]
            reading = a * table[r, c, s] + b * table[r, c + 1, s]
            variance[s] += weight * (reading + p * table[r + 1, c, s] + q * table[r + 1, c + 1, s])


@kernel(forceinline=True)
def _sense_near(t, x, y, theta, sums, out, variance):
    """Add walls and obstacles to mean readings [L], not yet clipped, and to their variance."""
    near, noisy = t.near, t.noise == SAMPLES_NOISE
    reach = near.reach[0] + t.radius
    count, alone = 0, True
    to_x, to_y = 0.0, 0.0
    for w in range(len(t.walls)):
        seen, dx, dy = _visible(t.walls[w], t.screens, x, y, reach)
        if seen:
            wall = t.walls[w]
            along = (x - wall[0]) * wall[2] + (y - wall[1]) * wall[3]
            alone = count == 0 and reach < along < wall[4] - reach
            count += 1
            to_x, to_y = dx, dy
            if not alone:
                break
    if count and alone:
        distance = math.sqrt(to_x * to_x + to_y * to_y) - t.radius
        _add(near, noisy, 0, distance, math.atan2(to_y, to_x) - theta, out, variance)
    elif count:
        _add_walls(t, x, y, theta, reach, sums, out, variance)
    for o in range(len(t.obstacles)):
        dx, dy, kind = t.obstacles[o, 0] - x, t.obstacles[o, 1] - y, int(t.obstacles[o, 3])
        square, limit = dx * dx + dy * dy, near.reach[kind] + t.radius + t.obstacles[o, 2]
        if square >= limit * limit or _hidden(t.screens, x, y, dx, dy):
            continue
        distance = math.sqrt(square) - t.radius - t.obstacles[o, 2]
        _add(near, noisy, kind, distance, math.atan2(dy, dx) - theta, out, variance)


@kernel()
def _sense_light(t, x, y, theta, out, variance):
    """Add lights that are not hidden to mean readings [L], likewise."""
    light, noisy = t.light, t.noise == SAMPLES_NOISE
    for m in range(len(t.lights)):
        dx, dy = t.lights[m, 0] - x, t.lights[m, 1] - y
        square, limit = dx * dx + dy * dy, light.reach[0] + t.radius
        if square >= limit * limit or _hidden(t.screens, x, y, dx, dy):
            continue
        lit = True
        for o in range(len(t.obstacles)):
            # The point between robot and light that is nearest to the obstacle's middle.
            off_x, off_y = t.obstacles[o, 0] - x, t.obstacles[o, 1] - y
            part = (off_x * dx + off_y * dy) / max(square, NEAREST * NEAREST)
            part = min(max(part, 0.0), 1.0)
            off_x, off_y = off_x - part * dx, off_y - part * dy
            lit = lit and off_x * off_x + off_y * off_y >= t.obstacles[o, 2] * t.obstacles[o, 2]
        if lit:
            distance = math.sqrt(square) - t.radius
            _add(light, noisy, 0, distance, math.atan2(dy, dx) - theta, out, variance)


@kernel(forceinline=True)
def sense(t, state, z, work, out):
    """Write the readings [S] of a robot in ``state`` [7] with the noise ``z`` [S + 3], or none."""
    near, light = t.near.sensors, t.light.sensors
    mean, variance = work[0], work[1]
    lanes = len(t.near.ambient)
    for s in range(len(mean)):
        table, k = (t.near, s) if s < lanes else (t.light, s - lanes)
        mean[s], variance[s] = table.ambient[k], table.ambient_variance[k]
    if near > 0:
        _sense_near(t, state[0], state[1], state[2], work[5], mean[:lanes], variance[:lanes])
    if light > 0:
        _sense_light(t, state[0], state[1], state[2], mean[lanes:], variance[lanes:])
    for s in range(len(out)):
        k = s if s < near else s - near + lanes
        if len(z) > 0 and t.noise == UNIFORM_NOISE:
            mean[k] += np.float32(t.sensor_noise) * z[s]
        elif len(z) > 0 and t.noise == SAMPLES_NOISE:
            mean[k] += math.sqrt(variance[k]) * z[s]
        out[s] = min(max(mean[k], np.float32(0.0)), np.float32(1.0))


@kernel(fastmath=_FAST, forceinline=True)
def _push_out(t, x, y):
    """Return the position of a robot at (x, y) after a move out of overlaps, and if it fits."""
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


@kernel(fastmath=_FAST, forceinline=True)
def _rounded(t, speed):
    """Return the nearest possible speed, in percent."""
    return t.resolution * np.rint(speed / t.resolution) if t.resolution > 0.0 else speed


@kernel(fastmath=_FAST, forceinline=True)
def _level(t, speed, levels):
    """Return index and fraction of the level below a speed in percent."""
    place = min(max((speed - t.lowest) / t.level_pitch, 0.0), levels - 1.0)
    below = min(int(place), levels - 2)
    return below, place - below


@kernel(fastmath=_FAST, forceinline=True)
def _twist(t, table, left, right, out):
    """Write a motor table's value [3] at the wheels' speeds (%, %)."""
    i, u = _level(t, left, table.shape[0])
    j, v = _level(t, right, table.shape[1])
    for k in range(3):
        out[k] = (1.0 - u) * ((1.0 - v) * table[i, j, k] + v * table[i, j + 1, k]) + u * (
            (1.0 - v) * table[i + 1, j, k] + v * table[i + 1, j + 1, k]
        )


@vectorize(["int64(float64, float64, float64, float64)"], cache=True)
def substeps(duration, fastest, radius, longest):
    """Return the number of motions into which a command of a duration (s) is cut.

    No motion is longer than half the robot's radius, so that it cannot pass through a wall; nor, if
    wheels have a lag, longer than a step, in which their mean speeds count.
    """
    parts = max(math.ceil(2.0 * duration * fastest / radius), math.ceil(duration / longest - 1e-9))
    return max(parts, 1)


@kernel()
def phases(t, duration, parts, first, out):
    """Write the approach of speeds to their goals in some parts of a command of ``duration`` (s).

    Args:
        t: :class:`TableArrays`.
        duration: of the command, s.
        parts: number of its parts.
        first: first part that is written.
        out: [N, 2, 5], written; for every part first the rest with the previous goals, then the new
            ones. Each has a duration (s), and for each wheel the weight of the first speed in the
            mean over that time, and in the last speed.
    """
    for n in range(min(len(out), parts - first)):
        length = duration / parts
        waiting = min(max(t.delay - (first + n) * length, 0.0), length)
        for phase in range(2):
            time = waiting if phase == 0 else length - waiting
            out[n, phase, 0] = time
            for wheel in range(2):
                mean, end = 1.0, 1.0
                if time > 0.0:
                    lag = t.lag[wheel]
                    end = math.exp(-time / lag) if lag > 0.0 else 0.0
                    mean = lag * (1.0 - end) / time
                out[n, phase, 1 + wheel], out[n, phase, 3 + wheel] = mean, end


@kernel(fastmath=_FAST, forceinline=True)
def _advance(t, phase, speeds, left, right, out):
    """Let speeds [2] approach goals (%, %) for a phase [5], and write the displacement's log."""
    left_off, right_off = speeds[0] - left, speeds[1] - right
    _twist(t, t.twist, left + phase[1] * left_off, right + phase[2] * right_off, out)
    for k in range(3):
        out[k] *= phase[0]
    speeds[0], speeds[1] = left + phase[3] * left_off, right + phase[4] * right_off


@kernel(fastmath=_FAST, forceinline=True)
def _moved(t, x, y, theta, first, second, noise):
    """Return the pose after two motions in a row, from their logs and the noise's [3]."""
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


def scratch(t):
    """Return the work arrays of :func:`step` and :func:`sense`."""
    timing, lasts = np.empty((_PARTS, 2, 5)), np.full(1, -1.0)
    lanes = len(t.near.ambient) + len(t.light.ambient)
    mean, variance = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
    return mean, variance, np.empty((3, 3)), timing, lasts, np.empty((3, t.looks.shape[1]))


@kernel(fastmath=_FAST, forceinline=True)
def step(t, states, command, z, work):
    """Change the states [N, 7] of robots by a command (%, %, s).

    ``z`` [N, S + 3] are the random numbers of the noise, the motion's last; N = 0: none.
    """
    twist, before, noise = work[2][0], work[2][1], work[2][2]
    timing, lasts = work[3], work[4]
    left, right, duration = _rounded(t, command[0]), _rounded(t, command[1]), command[2]
    parts = substeps(duration, t.fastest, t.radius, t.longest)
    if duration != lasts[0] and parts <= _PARTS:
        phases(t, duration, parts, 0, timing)
        lasts[0] = duration
    for r in range(len(states)):
        own = states[r]
        noise[:] = 0.0
        if len(z) > 0:
            if t.noise == UNIFORM_NOISE:
                for i in range(3):
                    noise[i] = t.twist_noise[i]
            elif t.noise == SAMPLES_NOISE:
                _twist(t, t.twist_spread, left, right, noise)
            first = z.shape[1] - 3
            for i in range(3):
                noise[i] *= math.sqrt(duration) * z[r, first + i] / parts
        x, y, theta = own[0], own[1], own[2]
        speeds = own[3:5]
        for part in range(parts):
            n = part % _PARTS
            if parts > _PARTS and n == 0:
                phases(t, duration, parts, part, timing)
                lasts[0] = -1.0
            if timing[n, 0, 0] > 0.0:
                _advance(t, timing[n, 0], speeds, own[5], own[6], before)
            else:
                before[:] = 0.0
            _advance(t, timing[n, 1], speeds, left, right, twist)
            x, y, theta = _moved(t, x, y, theta, before, twist, noise)
        own[0], own[1], own[2] = x, y, theta
        own[5], own[6] = left, right


engine.compiled(TableArrays, step, sense, scratch)
