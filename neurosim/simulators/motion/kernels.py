"""What a motion network's rollouts share: inputs, drive model and noise, compiled, of one robot.

They compute what :class:`MotionNetwork`, :class:`neurosim.simulators.motion.drive.DriveModel` and
:func:`neurosim.simulators.motion.noise.disturb` do for batches of tensors. Call them from functions
compiled by Numba.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from neurosim.base.se2 import compiled as se2
from neurosim.simulators.motion.derived import SAME
from neurosim.simulators.motion.drive import (
    ALIKE,
    MOVING,
    PHASES,
    SETTLED,
    SHORTEST,
    STILL,
)
from neurosim.simulators.motion.noise import HEAVIEST, LEAST_CHORD, TINY

#: Numbers that the size of the noise is, see :func:`spread`.
SIZES = 10

#: As :data:`neurosim.simulators.motion.network.HELD`.
_HELD = 0.05


class Arrays(NamedTuple):
    """A simulator's numbers: C-contiguous, float64 but for the places, which are int64."""

    exponents: np.ndarray  #: of product units, [M, O, P, I]
    ceiling: np.ndarray  #: of the logarithms of product units' magnitudes, [M, O, P]
    signed: np.ndarray  #: product weight times cosine; bit i: input i < 0. [M, O, 2^I, P]
    linear: np.ndarray  #: of scaled inputs; as the two others in m and rad. [M, O, I]
    bias: np.ndarray  #: [M, O]
    input_scale: np.ndarray  #: [I]
    dead_zone: np.ndarray  #: [I], scaled inputs that are smaller count as zero
    floor: float  #: the smallest magnitude of a scaled input in a product unit
    centres: np.ndarray  #: of kernel units, over their lengths, [J, K]
    lengths: np.ndarray  #: [J]
    kernel_weights: np.ndarray  #: [M, O, K]
    drives: bool  #: whether there is a drive model; if not, the next nine hold anything
    lag: np.ndarray  #: [C], this and the next seven as in DriveModel
    slowing: np.ndarray  #: [C]
    braking: np.ndarray  #: [C]
    rate: np.ndarray  #: [C]
    bend: np.ndarray  #: [C]
    stick: np.ndarray  #: [C]
    delay: np.ndarray  #: [1]
    kinematics: np.ndarray  #: [F, 3], corrected
    correction: np.ndarray  #: [4], of the networks' twists: Correction's first four
    longest: float  #: what durations are scaled by, s; infinite without one
    central: bool  #: whether the first network is the mean's own, and no member
    noisy: bool  #: whether there is a noise model; if not, the rest holds zeros
    noise_unit: np.ndarray  #: [3], this and the next three as in NoiseModel
    noise_log_scale: np.ndarray  #: [3, F]
    noise_tail: np.ndarray  #: [F]
    noise_sources: np.ndarray  #: [K, 3, 3]
    driven: np.ndarray  #: places of inputs, as in CommandFeatures
    before: np.ndarray
    duration: int
    swing: float  #: as in Derived, NaN for none


@njit(cache=True, error_model="numpy", forceinline=True)
def _scaled(a, value, i):
    x = value / a.input_scale[i]
    return 0.0 if abs(x) < a.dead_zone[i] else x


@njit(cache=True, error_model="numpy", forceinline=True)
def _speed(a, value, c):
    """Return the speed that a command for actuator c comes to in the end."""
    x = _scaled(a, value, a.driven[c])
    return x * (1.0 - a.bend[c] * abs(x))


@njit(cache=True, error_model="numpy")
def _approach(a, c, before, told, time):
    """Return (left, missed, settling) of an actuator; see :class:`Approach`."""
    difference, speed = told - before, max(abs(told), STILL)
    size = abs(difference)
    lag = a.lag[c]
    if speed <= STILL:
        lag *= a.braking[c]
    elif speed < abs(before) - ALIKE:
        lag *= a.slowing[c]
    rate = a.rate[c]
    linear = rate * lag
    ramp, fading = max(size - linear, 0.0) / rate, min(size, linear)
    t = max(time - a.delay[0], 0.0)
    stands = stood = then = 0.0
    held = 1.0 - before * math.copysign(1.0, told) / MOVING
    if a.stick[c] > 0.0 and speed > STILL and held > 0.0:
        then = size if told * before > 0.0 else min(size, speed)
        zero = (size - then) / rate
        if then < linear:
            zero = ramp + lag * math.log(max(fading / max(then, STILL), 1.0))
        stands = min(held, 1.0) * a.stick[c] / speed
        stood = min(max(t - zero, 0.0), stands)
        t -= stood
    on_ramp = min(t, ramp)
    left, missed = size - rate * on_ramp, on_ramp * (size - 0.5 * rate * on_ramp)
    if t > ramp:
        decay = math.exp(-(t - on_ramp) / lag)
        left = fading * decay
        missed += fading * lag * (1.0 - decay)
    missed += size * min(time, a.delay[0]) + then * stood
    sign = math.copysign(1.0, difference)
    settling = ramp + SETTLED * lag + stands + a.delay[0] if size > ALIKE else 0.0
    return sign * left, sign * missed, settling


@njit(cache=True, error_model="numpy", forceinline=True)
def tell(a, source, command, k, memory, x):
    """Write what networks are given for a command, and remember what it did to the actuators.

    Args:
        a: :class:`Arrays`, or others that have its fields of inputs and of the drive model.
        source: [I] where each input comes from: c for column c of the command, -c - 1 for column c
            of the command before.
        command: [C + 1].
        k: number of the step.
        memory: of the robot, see :func:`memory_size`; zero at the start; changed.
        x: [I + derived], written.

    Returns:
        The step with which the command began: another one than ``k`` if the robot was already told
        the same.
    """
    began = k
    if a.drives:
        count = len(a.driven)
        step = command[source[a.duration]]
        lasted = memory[2 * count]
        same = lasted > 0.0 and lasted + step <= a.longest * (1.0 + _HELD)
        for c in range(count):
            if memory[count + c] != command[source[a.driven[c]]]:
                same = False
        if same:
            began = int(memory[2 * count + 1])
        else:
            for c in range(count):
                told = _speed(a, memory[count + c], c)
                speed = told - _approach(a, c, memory[c], told, memory[2 * count])[0]
                memory[c] = 0.0 if abs(speed) < STILL else speed
                memory[count + c] = command[source[a.driven[c]]]
            memory[2 * count] = 0.0
            memory[2 * count + 1] = k
        memory[2 * count] += step
        for c in range(count):
            x[a.before[c]] = memory[c]
            x[a.driven[c]] = _speed(a, memory[count + c], c)
        x[a.duration] = memory[2 * count] / a.longest
    else:
        for i in range(len(source)):
            value = memory[-source[i] - 1] if source[i] < 0 else command[source[i]]
            x[i] = _scaled(a, value, i)
        for c in range(len(command)):
            memory[c] = command[c]
    if not math.isnan(a.swing):
        place = len(source)
        now, before = (x[a.driven[0]], x[a.driven[1]]), (x[a.before[0]], x[a.before[1]])
        x[place] = 0.0
        if (now[0] != 0.0 or now[1] != 0.0) and (before[0] != 0.0 or before[1] != 0.0):
            angle = math.atan2(now[1], now[0]) - math.atan2(before[1], before[0])
            x[place] = angle / math.pi
            if x[place] >= 1.0 - a.swing:
                x[place] -= 2.0
            elif x[place] < -1.0 - a.swing:
                x[place] += 2.0
            if abs(x[place]) < SAME:
                x[place] = 0.0
    return began


def memory_size(a: Any) -> int:
    """Return how many numbers :func:`tell` remembers of a robot.

    With a drive model the actuators' speeds when the command began, the command, how long it has
    lasted, and its first step; without, the command.
    """
    return 2 * len(a.driven) + 2


@njit(cache=True, error_model="numpy", forceinline=True)
def phases(a, x, way, twist, moved):
    """Write displacement and twist of the drive model; see :meth:`DriveModel.phases`.

    Args:
        a: as :func:`tell` takes it, with a drive model.
        x: of :func:`tell`.
        way: [2, C] scratch.
        twist: [3], written: of the piece after the speeds have settled.
        moved: [3], written: while they change.
    """
    count = len(a.driven)
    time = x[a.duration] * a.longest
    settling = SHORTEST
    for c in range(count):
        settling = max(settling, _approach(a, c, x[a.before[c]], x[a.driven[c]], time)[2])
    settled = min(time, settling)
    px, py, theta, end = 0.0, 0.0, 0.0, 0.0
    for c in range(count):
        way[0, c] = 0.0
    for phase in range(PHASES + 1):
        began = end
        end = settled * (phase + 1) / PHASES if phase < PHASES else time
        span = end - began
        inverse = 1.0 / max(span, 1e-9)
        for c in range(count):
            told = x[a.driven[c]]
            until = told * end - _approach(a, c, x[a.before[c]], told, end)[1]
            way[1, c] = until - way[0, c]
            way[0, c] = until
        vx, vy, turn = 0.0, 0.0, 0.0
        place = count
        for c in range(count):
            w = way[1, c]
            vx += w * a.kinematics[c, 0]
            vy += w * a.kinematics[c, 1]
            turn += w * a.kinematics[c, 2]
            mean = w * inverse
            for d in range(c, count):
                q = mean * way[1, d] * inverse * span
                vx += q * a.kinematics[place, 0]
                vy += q * a.kinematics[place, 1]
                turn += q * a.kinematics[place, 2]
                place += 1
        if phase < PHASES:
            px, py, theta = se2.compose_exp(px, py, theta, vx, vy, turn)
        else:
            twist[0], twist[1], twist[2] = vx, vy, turn
    moved[0], moved[1], moved[2] = px, py, theta


@njit(cache=True, error_model="numpy", forceinline=True)
def spread(a, x, mean, out):
    """Write the size of the noise on a command, the same for all draws of it.

    Args:
        a: :class:`Arrays` of a simulator with a noise model.
        x: of :func:`tell`.
        mean: [3] displacement (m, m, rad) without noise.
        out: [SIZES], written: s_t^2 (rad^2), s_f^2, s_s^2 (m^2), the covariance of what happens
            in the motion (tt, ft, ff, st, sf, ss), and tau.
    """
    duration = 1.0
    if a.duration >= 0:
        duration = max(x[a.duration], 0.0)
    travel, jump, reversal, speed = 0.0, 0.0, 0.0, 0.0
    for k in range(len(a.driven)):
        u = x[a.driven[k]]
        v = u
        if a.before[k] >= 0:
            v = x[a.before[k]]
        travel += abs(u) * duration / len(a.driven)
        jump += abs(u - v)
        reversal += max(-u * v, 0.0)
        speed += abs(v) / len(a.driven)
    log_jump, log_time = math.log(jump + 0.02), math.log(duration + 0.02)
    root, log_before = math.sqrt(reversal), math.log(speed + 0.02)
    for j in range(3):
        w = a.noise_log_scale[j]
        log_s = w[0] + w[1] * log_jump + w[2] * root + w[3] * log_time + w[4] * log_before
        out[j] = math.exp(2.0 * log_s)
    ahead, left, turn = se2.mid_turn(mean[0], mean[1], mean[2])
    along = se2.chord(turn)
    bent = -turn / 12.0
    if abs(turn) >= 1e-3:
        bent = (math.cos(0.5 * turn) - along) / turn
    along = math.copysign(max(abs(along), LEAST_CHORD), along)
    ahead, left = ahead / along, left / along
    m_t = turn / a.noise_unit[0]
    m_f, m_s = ahead / a.noise_unit[1], left / a.noise_unit[2]
    for j in range(3, 9):
        out[j] = 0.0
    for k in range(len(a.noise_sources)):
        u = a.noise_sources[k]
        t = u[0, 0] * m_t + u[0, 1] * m_f + u[0, 2] * m_s
        f = along * (u[1, 0] * m_t + u[1, 1] * m_f + u[1, 2] * m_s) + ahead * bent * t
        s = along * (u[2, 0] * m_t + u[2, 1] * m_f + u[2, 2] * m_s) + left * bent * t
        out[3] += t * t
        out[4] += f * t
        out[5] += f * f
        out[6] += s * t
        out[7] += s * f
        out[8] += s * s
    tail = a.noise_tail
    log_tau = tail[0] + tail[1] * math.log(travel + 0.01)
    log_tau += tail[2] * math.log(abs(turn / a.noise_unit[0]) + 0.02)
    out[9] = min(math.exp(log_tau), HEAVIEST)


@njit(cache=True, error_model="numpy", forceinline=True)
def shake(mean, size, z, out):
    """Write a displacement with noise of a size that is known.

    Args:
        mean: [3] displacement (m, m, rad) without noise.
        size: [SIZES], of :func:`spread`.
        z: [4], of :meth:`NoiseModel.draw`.
        out: [3], written; may be ``mean``.
    """
    width = math.exp(2.0 * size[9] * z[3])
    tt = math.sqrt(max(size[0] * width + size[3], TINY))
    ft, st = size[4] / tt, size[6] / tt
    ff = math.sqrt(max(size[1] * width + size[5] - ft * ft, TINY))
    sf = (size[7] - st * ft) / ff
    ss = math.sqrt(max(size[2] * width + size[8] - st * st - sf * sf, TINY))
    e_t = tt * z[0]
    e_f = ft * z[0] + ff * z[1]
    e_s = st * z[0] + sf * z[1] + ss * z[2]
    theta = mean[2] + e_t
    x, y = se2.rotate(0.5 * e_t, mean[0], mean[1])
    out[0], out[1], out[2] = se2.compose(x, y, 0.5 * theta, e_f, e_s, 0.5 * theta)
