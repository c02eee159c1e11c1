"""What a motion network's rollouts share: its inputs and its noise, compiled, of one robot.

They compute what :meth:`MotionNetwork.network_inputs` and
:func:`neurosim.simulators.motion.noise.disturb` do for batches of tensors. Call them from functions
compiled by Numba.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from neurosim.base.se2 import compiled as se2
from neurosim.simulators.motion.derived import SAME
from neurosim.simulators.motion.noise import HEAVIEST

#: Numbers that the size of the noise is, see :func:`spread`.
SIZES = 10


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
    twist: bool  #: whether the outputs are a body twist and an offset
    central: bool  #: whether the first network is the mean's own, and no member
    noisy: bool  #: whether there is a noise model; if not, the rest holds zeros
    noise_unit: np.ndarray  #: [3], this and the next four as in NoiseModel
    noise_log_scale: np.ndarray  #: [3, F]
    noise_coupling: np.ndarray  #: [3, F]
    noise_tail: np.ndarray  #: [F]
    noise_motion: np.ndarray  #: [3, F]
    driven: np.ndarray  #: places of inputs, as in CommandFeatures
    before: np.ndarray
    duration: int
    moving: bool  #: which derived inputs there are, as in Derived
    swing: float  #: NaN for none


@njit(cache=True, error_model="numpy", forceinline=True)
def _scaled(a, inputs, i):
    x = inputs[i] / a.input_scale[i]
    return 0.0 if abs(x) < a.dead_zone[i] else x


@njit(cache=True, error_model="numpy", forceinline=True)
def network_inputs(a, inputs, x):
    """Write what the networks are given: scaled inputs, and those derived from them.

    Args:
        a: :class:`Arrays`, or others that have its fields of inputs.
        inputs: [I], in the dataset's units.
        x: [I + derived], written.
    """
    for i in range(len(inputs)):
        x[i] = _scaled(a, inputs, i)
    place = len(inputs)
    if a.moving:
        x[place] = 0.0
        for k in a.driven:
            if inputs[k] != 0.0:
                x[place] = 1.0
        place += 1
    if not math.isnan(a.swing):
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


@njit(cache=True, error_model="numpy", forceinline=True)
def spread(a, inputs, mean, out):
    """Write the size of the noise on a command, the same for all draws of it.

    Args:
        a: :class:`Arrays` of a simulator with a noise model.
        inputs: [I], in the dataset's units.
        mean: [3] displacement (m, m, rad) without noise.
        out: [SIZES], written: s_t^2 (rad^2), s_f^2, s_s^2 (m^2), the couplings c_1, c_2, c_3,
            r^2 of the three, and tau.
    """
    duration = 1.0
    if a.duration >= 0:
        duration = max(_scaled(a, inputs, a.duration), 0.0)
    travel, jump, reversal, speed = 0.0, 0.0, 0.0, 0.0
    for k in range(len(a.driven)):
        u = _scaled(a, inputs, a.driven[k])
        v = u
        if a.before[k] >= 0:
            v = _scaled(a, inputs, a.before[k])
        travel += abs(u) * duration / len(a.driven)
        jump += abs(u - v)
        reversal += max(-u * v, 0.0)
        speed += abs(v) / len(a.driven)
    ahead, _, turn = se2.mid_turn(mean[0], mean[1], mean[2])
    t, f = turn / a.noise_unit[0], ahead / a.noise_unit[1]
    log_travel = math.log(travel + 0.01)
    log_turn, log_forward = math.log(abs(t) + 0.02), math.log(abs(f) + 0.02)
    log_jump, log_time = math.log(jump + 0.02), math.log(duration + 0.02)
    root, log_before = math.sqrt(reversal), math.log(speed + 0.02)
    product = t * f / (t * t + f * f + 0.01)
    turning, going = t / math.sqrt(t * t + 0.05), f / math.sqrt(f * f + 0.05)
    for j in range(3):
        w, c = a.noise_log_scale[j], a.noise_coupling[j]
        log_s = (
            w[0]
            + w[1] * log_travel
            + w[2] * log_travel * log_travel
            + w[3] * log_turn
            + w[4] * log_forward
            + w[5] * log_jump
            + w[6] * root
            + w[7] * log_time
            + w[8] * log_before
        )
        out[j] = math.exp(2.0 * log_s)
        out[3 + j] = c[0] + c[1] * product + c[2] * turning + c[3] * going
        r = a.noise_motion[j]
        out[6 + j] = r[0] + r[1] * t * t + r[2] * f * f
    tail = a.noise_tail
    out[9] = min(math.exp(tail[0] + tail[1] * log_travel + tail[2] * log_turn), HEAVIEST)


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
    s_t = math.sqrt(size[0] * width + size[6])
    s_f = math.sqrt(size[1] * width + size[7])
    s_s = math.sqrt(size[2] * width + size[8])
    e_t = s_t * z[0]
    e_f = s_f * (z[1] + size[3] * z[0])
    e_s = s_s * (z[2] + size[4] * z[0] + size[5] * z[1])
    theta = mean[2] + e_t
    x, y = se2.rotate(0.5 * e_t, mean[0], mean[1])
    out[0], out[1], out[2] = se2.compose(x, y, 0.5 * theta, e_f, e_s, 0.5 * theta)
