"""The motion network, compiled: steps of robots with the same commands.

The functions compute the same as :class:`MotionNetwork`,
:class:`neurosim.simulators.motion.drive.DriveModel` and
:func:`neurosim.simulators.motion.noise.disturb` for batches of tensors. The part that depends on
the command alone, the prediction of each ensemble member and the size of its noise, is
computed once for all robots.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from neurosim.base.kernels import kernel
from neurosim.base.se2 import compiled as se2
from neurosim.networks import LOG_LIMIT
from neurosim.simulators import engine
from neurosim.simulators.motion.derived import SAME
from neurosim.simulators.motion.drive import (
    ALIKE,
    CURVED,
    LONG_WAIT,
    MOVING,
    PHASES,
    SETTLED,
    SHORTEST,
    SHORTEST_COMMAND,
    STILL,
)
from neurosim.simulators.motion.floor import on_floor
from neurosim.simulators.motion.noise import DRAWS, HALF_MOVED, HEAVIEST, LEAST_CHORD, TINY
from neurosim.simulators.motion.sensors import read

#: Number of values of the noise's size, see :func:`spread`.
SIZES = 10
#: Number of values of an actuator's law, see :func:`_law`.
_LAW = 16

#: Sums may be rearranged so that they vectorise; infinities and NaN keep their meaning.
_FAST = {"contract", "reassoc", "nsz", "arcp"}

_LOG2_LIMIT = LOG_LIMIT / math.log(2.0)
#: Added to a number of at most 2^51 it leaves the nearest whole number in the lowest bits.
_ROUND = 1.5 * 2.0**52
#: For exp(-x / 2) as a power of 2.
HALF_LOG2_E = -0.5 / math.log(2.0)

#: The number of a row's units is filled up to a multiple of this by units without weight, because a
#: rest after whole vectors takes several times as long.
LANES = 16
#: See :data:`neurosim.simulators.motion.network.HELD`.
_HELD = 0.05


class MotionModel(NamedTuple):
    """A motion network's numbers: C-contiguous, float64, indices int64.

    Networks are those of the mean (0) and of the members (1 + m); a row is one output of one
    network, ``3 * network + output``.
    """

    exponents: np.ndarray  #: [I, U] of all product units, for base-2 logarithms
    first: np.ndarray  #: [R + 1] first product unit of each row, and their number
    signed: np.ndarray  #: [2^I, U] weights times cosines; bit i of the index: input i is negative
    linear: np.ndarray  #: [R, I] of scaled inputs
    bias: np.ndarray  #: [R]
    kernel_weights: np.ndarray  #: [R, K]
    centres: np.ndarray  #: [I, K], this and the next two make the base-2 logarithm of kernel units
    centre_square: np.ndarray  #: [K]: the sum of x times centres, of this, and of x^2 times
    nearness: np.ndarray  #: [I]
    input_scale: np.ndarray  #: [I]
    dead_band: np.ndarray  #: [I], scaled inputs that are smaller count as zero
    floor: float  #: the smallest magnitude of a scaled input in a product unit
    source: np.ndarray  #: [I] column c of the command, or -c - 1 for column c of the state
    following: np.ndarray  #: without a drive model, the command that each remembered column takes
    driven: np.ndarray  #: places of inputs, as in CommandFeatures
    before: np.ndarray
    duration: int
    swing: float  #: as in Derived, NaN for none
    drives: bool  #: whether there is a drive model; if not, the next sixteen hold anything
    slots: int  #: as in DriveModel
    lag: np.ndarray  #: [C], this and the next seven as in DriveModel
    slowing: np.ndarray
    braking: np.ndarray
    rate: np.ndarray
    stick: np.ndarray
    curve: np.ndarray  #: [C, 6]
    delay: np.ndarray  #: [1]
    kinematics: np.ndarray  #: [F, 3], corrected, as are the losses
    turning: np.ndarray  #: [C]
    losses: np.ndarray  #: [C, 3]
    modes: np.ndarray  #: [C, C]
    drag: np.ndarray  #: [C]
    drift: np.ndarray  #: [2]
    drifts: bool  #: whether a state has the drift
    correction: np.ndarray  #: [4], of the networks' twists: Correction's first four
    longest: float  #: what durations are scaled by, s; infinite without one
    members: bool  #: whether the last column of a state names a member
    noisy: bool  #: whether there is a noise model; if not, the next four hold zeros
    noise_unit: np.ndarray  #: [3], this and the next three as in NoiseModel
    noise_log_scale: np.ndarray  #: [3, F]
    noise_tail: np.ndarray  #: [F]
    noise_sources: np.ndarray  #: [K, 3, 3]
    sensor_mount: np.ndarray  #: [Q, 2] m, robot frame
    sensor_place: np.ndarray  #: [Q] which map each sensor reads
    sensor_noise: np.ndarray  #: [Q, 2] standard deviations: of readings, and of places (m)
    sensor_maps: np.ndarray  #: [K, NY, NX]
    sensor_origin: np.ndarray  #: [2] m, of the grid's first point
    sensor_cell: float  #: m, between its points
    floor_map: np.ndarray  #: [1 + M, NY, NX, 3], as in Floor's map; M = -1: the floor is even
    floor_corner: np.ndarray  #: [2] m, of the map's first point
    floor_cell: float  #: m, between its points
    floor_ahead: float  #: as in Floor
    excess_lasts: np.ndarray  #: [3] as in Excess; [0]: there is none


def scratch(a):
    """Return the work arrays of :func:`step` and :func:`sense`, see there."""
    inputs, actuators, networks = len(a.nearness), len(a.driven), len(a.bias) // 3
    under = (2 + a.slots) * actuators + a.slots + 2 * a.drifts
    size = 2 * inputs + (_LAW + 6) * actuators + 3 + under + len(a.exponents[0]) + len(a.centres[0])
    numbers = np.empty(size)
    x, end = numbers[:inputs], 2 * inputs
    log2 = numbers[inputs:end]
    law = numbers[end : end + _LAW * actuators].reshape(actuators, _LAW)
    end += _LAW * actuators
    memory = numbers[end : end + 3 * actuators + 3]
    end += 3 * actuators + 3
    began = numbers[end : end + under]
    end += under
    distance = numbers[end : end + 3 * actuators].reshape(3, actuators)
    end += 3 * actuators
    units = numbers[end : end + len(a.exponents[0])]
    end += len(a.exponents[0])
    nearness = numbers[end : end + len(a.centres[0])]
    means, sizes = np.empty((networks, 3)), np.empty((networks, SIZES))
    known, moved = np.empty(networks, np.bool_), np.empty((2, 3))
    return x, log2, law, memory, began, distance, units, nearness, means, sizes, known, moved


@kernel(forceinline=True)
def step(a, states, command, z, work):
    """Change the states [N, S] of robots with the same commands since their start.

    The columns are those of :class:`MotionNetwork`.

    Args:
        a: :class:`MotionModel`.
        states: of robots that differ only in pose, member and noise.
        command: [C or more].
        z: [N, DRAWS or more] numbers of the noise; N = 0: none.
        work: of :func:`scratch`.
    """
    x, log2, law, memory, began, distance, units, nearness, means, sizes, known, moved = work
    first, count = states[0], len(a.driven)
    noisy = a.noisy and len(z) > 0
    same = _inputs(a, first, command, memory, began, x)
    swung(a, x)
    known[:] = False
    pattern = _prepare(a, x, log2, nearness)
    if a.drives:
        phases(a, x, began, law, distance, memory, moved[0], moved[1])
    if noisy:
        own_spread(a, x, sizes[0])
    scale = sizes[0, 0], sizes[0, 1], sizes[0, 2], sizes[0, 9]
    behind = 3 + 3 * count + 1  # index of the displacement since the command began
    start = behind + 3 + DRAWS
    excess = start + len(began) + 2 * a.drifts
    time = command[a.source[a.duration]] if a.drives else 0.0
    for r in range(len(states)):
        own = states[r]
        m = int(own[-1]) + 1 if a.members else 0
        mean, size = means[m], sizes[m]
        if not known[m]:
            known[m] = True
            _predict(a, x, m, pattern, log2, units, nearness, moved, mean)
            if noisy:
                spread(a, scale, mean, size)
        dx, dy, turn = mean[0], mean[1], mean[2]
        if noisy:
            t, f, s, w = z[r, 0], z[r, 1], z[r, 2], z[r, 3]
            if a.drives:
                normal = own[behind + 3 : behind + 3 + DRAWS]
                if same:
                    t, f, s, w = normal[0], normal[1], normal[2], normal[3]
                else:
                    normal[0], normal[1], normal[2], normal[3] = t, f, s, w
            dx, dy, turn = shake(dx, dy, turn, size, t, f, s, w)
        elif a.drives and not same:
            own[behind + 3 : behind + 3 + DRAWS] = 0.0
        if a.drives:
            for i in range(3 * count + 1):
                own[3 + i] = memory[i]
            if not same:
                for i in range(len(began)):
                    own[start + i] = began[i]
            if a.drifts:
                own[start + len(began)] = memory[3 * count + 1]
                own[start + len(began) + 1] = memory[3 * count + 2]
            now_x, now_y, now = dx, dy, turn
            if same:
                gone_x, gone_y, gone = own[behind], own[behind + 1], own[behind + 2]
                dx, dy = se2.rotate(-gone, dx - gone_x, dy - gone_y)
                turn -= gone
            own[behind], own[behind + 1], own[behind + 2] = now_x, now_y, now
        else:
            for i in range(len(a.following)):
                own[3 + i] = command[a.following[i]]
        if len(a.floor_map) > 0:
            dx, dy, turn = on_floor(a, m, own[0], own[1], own[2], dx, dy, turn)
        if len(a.excess_lasts) > 0:
            dx, dy, turn = _exceed(a.excess_lasts, time, own[excess : excess + 3], dx, dy, turn)
        own[0], own[1], own[2] = se2.compose(own[0], own[1], own[2], dx, dy, turn)


@kernel(forceinline=True)
def sense(a, state, z, work, out):
    """Write the readings [Q] of a robot in ``state`` [S] with the noise ``z`` [Z], or none [0]."""
    read(a, state[0], state[1], state[2], z, DRAWS, out)


@kernel(forceinline=True)
def _scaled(a, value, i):
    x = value / a.input_scale[i]
    return 0.0 if abs(x) < a.dead_band[i] else x


@kernel(forceinline=True)
def goal_of(a, modes, commanded, c):
    """Return the goal of law c for a command [C], see :meth:`DriveModel.shaped`."""
    goal = 0.0
    for d in range(len(modes)):
        if modes[c, d] != 0.0:
            goal += modes[c, d] * _shaped(a, commanded[d], d)
    drag = a.drag[c]
    if drag > 0.0:
        goal *= 2.0 * (1.0 + drag) / (1.0 + math.sqrt(1.0 + 4.0 * drag * (1.0 + drag) * abs(goal)))
    return goal


@kernel(forceinline=True)
def _shaped(a, value, c):
    """Return the final speed of a command for actuator c."""
    x = _scaled(a, value, a.driven[c])
    size, curve = min(abs(x), 1.0), a.curve[c]
    even = curve[3] + size * (curve[4] + size * curve[5])
    odd = size * (curve[0] + size * (curve[1] + size * curve[2]))
    return x * (1.0 + odd) + abs(x) * even


@kernel(forceinline=True)
def _law(a, c, before, goal, push, law):
    """Write an actuator's approach from a speed to its goal; see :meth:`DriveModel.approach`.

    Args:
        a: :class:`MotionModel`.
        c: the actuator.
        before, goal: speeds.
        push: as in Underway.
        law: [_LAW], written: size and sign of the difference; the time (s) until which the speed in
            the other direction is above its goal, and the lag until then; the difference at that
            time, the lag from then on, the rate; the time from then on until the speed is 0, how
            long static friction holds it there, and the difference there; the settling time; the
            goal, its magnitude, and the push; the drag, and with which sign it changes the rate.
    """
    difference, speed = goal - before, max(abs(goal), STILL)
    size, rate, drag = abs(difference), a.rate[c], a.drag[c]
    lag = slow = a.lag[c]
    since, fast, until, stands, zero, along = size, 0.0, 0.0, 0.0, 0.0, -drag
    turns = False
    if speed <= STILL:
        lag *= a.braking[c]
        push, along = 0.0, drag
    else:
        turns = before * goal < 0.0
        if speed < abs(before) - ALIKE:
            slow *= a.slowing[c]
            if turns:
                since = 2.0 * speed
                fast, faded = _takes(size, since, slow, rate, 1.0, 0.5 * drag)
                until = fast + faded
            else:
                lag = slow
        if turns and abs(before) > STILL:
            push = 0.0
        if not turns and abs(before) > speed:
            along = drag
        held = min(1.0 - before * math.copysign(1.0, goal) / MOVING, 1.0)
        if turns or abs(before) < speed:
            stands = max(max(held, 0.0) * a.stick[c] - push, 0.0) / speed
    against, then = 1.0 + drag * speed, since
    if turns:
        then = speed
        ramp, faded = _takes(since, then, lag, rate, against, 0.0)
        zero = ramp + faded
    law[0], law[1], law[2], law[3] = size, math.copysign(1.0, difference), until, slow
    law[4], law[5], law[6], law[7] = since, lag, rate, zero
    law[8], law[9] = stands, then
    ramp = max(since - _unlimited(lag, rate, against, 0.0), 0.0) / rate
    settling = fast + ramp + SETTLED * lag / against + stands
    law[10] = settling if size > ALIKE else 0.0
    law[11], law[12], law[13], law[14], law[15] = goal, speed, push, drag, along


@kernel(forceinline=True)
def _unlimited(lag, rate, first, growth):
    """Return the difference from which the rate no longer limits its fall."""
    limit = rate * lag
    if growth == 0.0:
        return limit / first
    square = first * first + 4.0 * growth * limit
    return 2.0 * limit / (first + math.sqrt(square)) if square >= 0.0 else math.inf


@kernel(forceinline=True)
def _takes(size, less, lag, rate, first, growth):
    """Return how long a difference falls to a smaller one: on the ramp, and then."""
    linear = _unlimited(lag, rate, first, growth)
    ramp = (max(size - linear, 0.0) - max(less - linear, 0.0)) / rate
    size, less = min(size, linear), max(min(less, linear), STILL)
    ratio = size * (first + growth * less) / (less * (first + growth * size))
    return ramp, lag / first * math.log(max(ratio, 1.0))


@kernel(forceinline=True)
def _follow(law, time):
    """Return the remaining difference after a time (s), and its integral until then."""
    if law[0] == 0.0 and law[8] == 0.0:
        return 0.0, 0.0
    sign, until, drag = law[1], law[2], law[14]
    if time < until:
        left, missed = _fallen(law[0], law[3], law[6], time, 1.0, 0.5 * drag)
        return sign * left, sign * missed
    more, rest = 0.0, time - until
    if until > 0.0:
        more = _fallen(law[0], law[3], law[6], until, 1.0, 0.5 * drag)[1]
    if law[7] > 0.0:
        left, missed = _fallen(law[4], law[5], law[6], min(rest, law[7]), 1.0 + drag * law[12], 0.0)
        if rest < law[7]:
            return sign * left, sign * (more + missed)
        more += missed
        rest -= law[7]
    stood = min(rest, law[8])
    first = 1.0 + 2.0 * drag * law[12]
    left, missed = _fallen(law[9], law[5], law[6], rest - stood, first, law[15])
    return sign * left, sign * (more + missed + law[9] * stood)


@kernel(forceinline=True)
def _fallen(size, lag, rate, time, first, growth):
    """Return the remainder of a difference after a time (s), and its integral until then.

    See :meth:`DriveModel._fallen`.
    """
    linear = _unlimited(lag, rate, first, growth)
    ramp = max(size - linear, 0.0) / rate
    on_ramp = min(time, ramp)
    left, missed = size - rate * on_ramp, on_ramp * (size - 0.5 * rate * on_ramp)
    if time > ramp:
        fading, decay = min(size, linear), math.exp(-(time - on_ramp) * first / lag)
        share = fading / (first + growth * fading) * decay
        left = first * share / (1.0 - growth * share)
        fell = (fading - left) / (first + growth * left)
        curved = growth * fell
        if abs(curved) > CURVED:
            fell *= math.log1p(curved) / curved
        missed += lag * fell
    return left, missed


@kernel(forceinline=True)
def _come(law, time, left):
    """Return speed and push after a time (s), from the remaining difference."""
    speed, push = law[11] - left, law[13]
    if abs(speed) < STILL:
        speed = 0.0
    if abs(speed) >= MOVING or law[12] <= STILL:
        return speed, 0.0
    return speed, push + min(max(time - law[2] - law[7], 0.0), law[8]) * law[12]


@kernel(forceinline=True)
def _inputs(a, state, command, memory, began, x):
    """Write the inputs [I] of the networks, and the state at the beginning of the command.

    Args:
        a: :class:`MotionModel`.
        state: [S] before the command.
        command: [C or more].
        memory: [3 actuators + 3], written from the third part on except the last two: the speeds
            and pushes reached, the command, its duration so far (s), and the drift reached.
        began: [(2 + slots) actuators + slots], written: speeds and pushes at its beginning, times
            (s) at which the commands pending then act, and their goals; and the drift, if any.
        x: [I], written except derived inputs.

    Returns:
        Whether the previous command continues.
    """
    if not a.drives:
        for i in range(len(a.source)):
            source = a.source[i]
            x[i] = _scaled(a, command[source] if source >= 0 else state[-source - 1], i)
        return False
    count, slots = len(a.driven), a.slots
    commanded, start = 3 + 2 * count, 3 + 3 * count + 1 + 3 + DRAWS
    time, lasted = command[a.source[a.duration]], state[commanded + count]
    same = lasted > 0.0 and lasted + time <= a.longest * (1.0 + _HELD)
    for c in range(count):
        if state[commanded + c] != command[a.source[a.driven[c]]]:
            same = False
    for i in range(len(began)):
        began[i] = state[start + i]
    if not same:
        for i in range(2 * count):
            began[i] = state[3 + i]
        if a.drifts:
            began[-2], began[-1] = state[start + len(began)], state[start + len(began) + 1]
        if slots > 0 and lasted > 0.0:
            _queue(a, state[commanded : commanded + count], lasted, began[2 * count :])
    for c in range(count):
        memory[2 * count + c] = command[a.source[a.driven[c]]]
    for c in range(count):
        goal = goal_of(a, a.modes, memory[2 * count : 3 * count], c)
        x[a.before[c]], x[a.driven[c]] = began[c], goal
    memory[3 * count] = lasted + time if same else time
    x[a.duration] = memory[3 * count] / a.longest
    return same


@kernel(forceinline=True)
def _queue(a, commanded, lasted, queue):
    """Add a command to the pending ones, see :meth:`DriveModel.after`.

    Args:
        a: :class:`MotionModel`.
        commanded: the command, [C].
        lasted: its duration, s.
        queue: [slots + slots * C] times at which commands act, and their goals, changed.
    """
    count, slots = len(a.driven), a.slots
    for n in range(slots):
        queue[n] -= lasted
    acts, last = a.delay[0] - lasted, queue[slots - 1]
    short = SHORTEST_COMMAND * (1.0 - 1e-6)
    join = max(lasted, acts - last) < short and last > 0.0
    if join or (queue[1] if slots > 1 else acts) > 0.0:
        waited = max(acts - max(last, 0.0), 0.0)
        fraction = waited / max(waited + lasted, 1e-9)
        for c in range(count):
            place = slots + (slots - 1) * count + c
            goal = goal_of(a, a.modes, commanded, c)
            queue[place] = fraction * queue[place] + (1.0 - fraction) * goal
        return
    for n in range(slots - 1):
        queue[n] = queue[n + 1]
    queue[slots - 1] = acts
    for i in range(slots, slots + (slots - 1) * count):
        queue[i] = queue[i + count]
    for c in range(count):
        queue[slots + (slots - 1) * count + c] = goal_of(a, a.modes, commanded, c)


@kernel(forceinline=True)
def swung(a, x):
    """Write the derived input, if any; see :class:`Derived`."""
    if math.isnan(a.swing):
        return
    place = len(a.source)
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


@kernel(forceinline=True)
def phases(a, x, began, law, distance, memory, twist, moved):
    """Write displacement and twist of the drive model; see :meth:`DriveModel.phases`.

    Args:
        a: :class:`MotionModel`.
        x: [I] inputs.
        began: of :func:`_inputs`.
        law: [C, _LAW] scratch.
        distance: [3, C] scratch.
        memory: [3 C + 3], written: speeds and pushes at the end, and the drift.
        twist: [3], written: of the piece after the speeds have settled.
        moved: [3], written: while they change.
    """
    count, slots, time = len(a.driven), a.slots, x[a.duration] * a.longest
    for i in range(2 * count):
        memory[i] = began[i]
    twist[0], twist[1], twist[2] = 0.0, 0.0, 0.0
    px, py, theta, begin = 0.0, 0.0, 0.0, 0.0
    drift_x, drift_y = began[-2], began[-1]
    for n in range(slots + 1):
        own, until = n == slots, time
        if not own:
            acts = began[2 * count + n + 1] if n + 1 < slots else a.delay[0]
            until = min(max(acts, 0.0), time)
        span = until - begin
        if span <= 0.0:
            continue
        begin, settling = until, SHORTEST
        for c in range(count):
            goal = x[a.driven[c]] if own else began[2 * count + slots + n * count + c]
            _law(a, c, memory[c], goal, memory[count + c], law[c])
            settling = max(settling, law[c, 10])
            distance[0, c] = 0.0
        changing = min(span, settling) if own else span
        pieces = PHASES if own or span > LONG_WAIT else 1
        end = 0.0
        for k in range(pieces):
            last, end = end, changing * (k + 1) / pieces
            vx, vy, turn, late_x, late_y = _twist(a, law, last, end, distance)
            late_x, drift_x = drifted(a.drift[0], drift_x, late_x, end - last)
            late_y, drift_y = drifted(a.drift[1], drift_y, late_y, end - last)
            px, py, theta = se2.compose_exp(px, py, theta, vx + late_x, vy + late_y, turn)
        if end < span:
            vx, vy, turn, late_x, late_y = _twist(a, law, end, span, distance)
            late_x, drift_x = drifted(a.drift[0], drift_x, late_x, span - end)
            late_y, drift_y = drifted(a.drift[1], drift_y, late_y, span - end)
            twist[0], twist[1], twist[2] = vx + late_x, vy + late_y, turn
        for c in range(count):
            memory[c], memory[count + c] = _come(law[c], span, distance[2, c])
    moved[0], moved[1], moved[2] = px, py, theta
    memory[3 * count + 1], memory[3 * count + 2] = drift_x, drift_y


@kernel(forceinline=True)
def drifted(lag, drift, moved, time):
    """Return motion by products and losses with its own lag, if any, and its speed then.

    Args:
        lag: s; 0: none.
        drift: its speed at the beginning, m/s.
        moved: motion without the lag, m.
        time: its duration, s.
    """
    steady = moved / max(time, 1e-9)
    if lag <= 0.0:
        return moved, steady
    then = steady + (drift - steady) * math.exp(-time / lag)
    return moved - lag * (then - drift), then


@kernel(forceinline=True)
def _twist(a, law, begin, end, distance):
    """Return the mean twist times the time from one instant to another, and how much comes late.

    That is its translation without products and losses, its turn, and the translation by these: m,
    m, rad, m, m.

    Args:
        a: :class:`MotionModel`.
        law: of :func:`_law`, of each actuator.
        begin, end: s.
        distance: [3, C] of the actuators: until ``begin``, changed to ``end``; scratch; remaining
            differences at ``end``, written.
    """
    count, span = len(a.driven), end - begin
    inverse = 1.0 / max(span, 1e-9)
    for c in range(count):
        left, missed = _follow(law[c], end)
        until = law[c, 11] * end - missed
        distance[1, c], distance[0, c], distance[2, c] = until - distance[0, c], until, left
    vx, vy, turn, late_x, late_y, turned = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    place = count
    for c in range(count):
        turned += distance[1, c] * a.turning[c]
    turned = abs(turned) * inverse
    for c in range(count):
        w = distance[1, c]
        late_x += w * turned * a.losses[c, 0]
        late_y += w * turned * a.losses[c, 1]
        turn += w * turned * a.losses[c, 2]
        vx += w * a.kinematics[c, 0]
        vy += w * a.kinematics[c, 1]
        turn += w * a.kinematics[c, 2]
        mean = w * inverse
        for d in range(c, count):
            q = mean * distance[1, d] * inverse * span
            late_x += q * a.kinematics[place, 0]
            late_y += q * a.kinematics[place, 1]
            turn += q * a.kinematics[place, 2]
            place += 1
    return vx, vy, turn, late_x, late_y


@kernel(forceinline=True)
def _prepare(a, x, log2, nearness):
    """Write logarithms and kernel units of inputs [I]; return their sign pattern."""
    pattern = 0
    for i in range(len(x)):
        pattern += (1 << i) * (x[i] < 0.0)
        log2[i] = math.log2(max(abs(x[i]), a.floor))
    if len(nearness) > 0:
        _kernel_units(a, x, nearness)
    return pattern


@kernel(forceinline=True)
def _predict(a, x, network, pattern, log2, units, nearness, moved, mean):
    """Write the mean displacement [3] (m, m, rad) that a network predicts.

    Args:
        a: :class:`MotionModel`.
        x: [I] inputs.
        network: 0 for the mean, 1 + m for a member.
        pattern, log2, nearness: of :func:`_prepare`.
        units: [U] product units, written row by row.
        moved: [2, 3], of :func:`phases`.
        mean: [3], written.
    """
    signed = a.signed[pattern]
    for o in range(3):
        row = 3 * network + o
        total = a.bias[row]
        for i in range(len(x)):
            total += a.linear[row, i] * x[i]
        begin, end = a.first[row], a.first[row + 1]
        if end > begin:
            _units(a.exponents, log2, begin, end, units)
            total += _dot(signed[begin:end], units[begin:end])
        if len(nearness) > 0:
            total += _dot(a.kernel_weights[row], nearness)
        mean[o] = total
    if a.drives:
        duration, c = x[a.duration], a.correction
        dx, dy, turn = mean[0], mean[1], mean[2]
        dx, turn = c[0] * dx + c[3] * turn, c[2] * dx + c[1] * turn
        twist, at = moved[0], moved[1]
        mean[0], mean[1], mean[2] = se2.compose_exp(
            at[0],
            at[1],
            at[2],
            twist[0] + duration * dx,
            twist[1] + duration * dy,
            twist[2] + duration * turn,
        )


@kernel(fastmath={"contract", "nsz"}, inline="always")
def _exp2(z):
    """Return 2 to the power of z, |z| < 1000, to about 1e-12 relative.

    Plain arithmetic, which the compiler turns into vector instructions: Taylor's series of
    exp(f ln 2) for the remainder from the nearest whole number, whose bits go into the exponent.
    """
    shifted = z + _ROUND
    f = z - (shifted - _ROUND)
    p = 7.0549116208011233e-9
    p = p * f + 1.0178086009239699e-7
    p = p * f + 1.3215486790144309e-6
    p = p * f + 1.5252733804059840e-5
    p = p * f + 1.5403530393381608e-4
    p = p * f + 1.3333558146428443e-3
    p = p * f + 9.6181291076284772e-3
    p = p * f + 5.5504108664821580e-2
    p = p * f + 2.4022650695910071e-1
    p = p * f + 6.9314718055994531e-1
    p = p * f + 1.0
    bits = np.float64(shifted).view(np.int64) << np.int64(52)
    return np.int64(np.float64(p).view(np.int64) + bits).view(np.float64)


@kernel(fastmath={"contract", "nsz"})
def _units(exponents, log2, begin, end, out):
    """Write the magnitudes of the product units from ``begin`` to before ``end``."""
    inputs, count = exponents.shape[0], end - begin
    out = out[begin:end]
    if 5 <= inputs <= 7:
        # Without intermediate values in memory; usual robots have five inputs, and up to two
        # derived ones. A missing input counts as the first to the power of 0.
        l0, l1, l2, l3, l4 = log2[0], log2[1], log2[2], log2[3], log2[4]
        l5, e5 = (
            (log2[5], exponents[5][begin:end]) if inputs > 5 else (0.0, exponents[0][begin:end])
        )
        l6, e6 = (
            (log2[6], exponents[6][begin:end]) if inputs > 6 else (0.0, exponents[0][begin:end])
        )
        e0, e1, e2 = exponents[0][begin:end], exponents[1][begin:end], exponents[2][begin:end]
        e3, e4 = exponents[3][begin:end], exponents[4][begin:end]
        for u in range(count):
            z = e0[u] * l0 + e1[u] * l1 + e2[u] * l2 + e3[u] * l3 + e4[u] * l4
            z += e5[u] * l5 + e6[u] * l6
            out[u] = _exp2(max(min(z, _LOG2_LIMIT), -_LOG2_LIMIT))
        return
    for u in range(count):
        out[u] = 0.0
    for i in range(exponents.shape[0]):
        e, log = exponents[i][begin:end], log2[i]
        for u in range(count):
            out[u] += e[u] * log
    for u in range(count):
        out[u] = _exp2(max(min(out[u], _LOG2_LIMIT), -_LOG2_LIMIT))


@kernel(fastmath=_FAST)
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@kernel(fastmath={"contract", "nsz"})
def _kernel_units(a, x, out):
    """Write the kernel units; the square of the distance is multiplied out."""
    here = 0.0
    for i in range(len(x)):
        here += x[i] * x[i] * a.nearness[i]
    square, centres = a.centre_square, a.centres
    if 5 <= len(x) <= 6:
        # As in :func:`_units`.
        x0, x1, x2, x3, x4 = x[0], x[1], x[2], x[3], x[4]
        x5, c5 = (x[5], centres[5]) if len(x) > 5 else (0.0, centres[0])
        c0, c1, c2, c3, c4 = centres[0], centres[1], centres[2], centres[3], centres[4]
        for u in range(out.shape[0]):
            z = here + square[u] + x0 * c0[u] + x1 * c1[u] + x2 * c2[u]
            z += x3 * c3[u] + x4 * c4[u] + x5 * c5[u]
            out[u] = _exp2(max(z, -_LOG2_LIMIT))
        return
    for u in range(len(out)):
        out[u] = square[u] + here
    for i in range(len(x)):
        value, row = x[i], centres[i]
        for u in range(len(out)):
            out[u] += value * row[u]
    for u in range(len(out)):
        out[u] = _exp2(max(out[u], -_LOG2_LIMIT))


@kernel(forceinline=True)
def own_spread(a, x, out):
    """Write the part of the noise's size that depends on the command, not on the member.

    Args:
        a: :class:`MotionModel` of a simulator with a noise model.
        x: [I] inputs.
        out: [SIZES], written: the parts of s_t^2 (rad^2), s_f^2, s_s^2 (m^2) and, last, of ln tau
            that depend on the inputs.
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
    out[9] = a.noise_tail[0] + a.noise_tail[1] * math.log(travel + 0.01)


@kernel(forceinline=True)
def spread(a, scale, mean, out):
    """Write the size of the noise on a member's displacement, the same for all robots.

    Args:
        a: :class:`MotionModel` of a simulator with a noise model.
        scale: of :func:`own_spread`, four numbers.
        mean: [3] displacement (m, m, rad) without noise.
        out: [SIZES], written: s_t^2 (rad^2), s_f^2, s_s^2 (m^2), the covariance of the noise of the
            motion (tt, ft, ff, st, sf, ss), and tau.
    """
    ahead, left, turn = se2.mid_turn(mean[0], mean[1], mean[2])
    along = se2.chord(turn)
    bent = -turn / 12.0
    if abs(turn) >= 1e-3:
        bent = (math.cos(0.5 * turn) - along) / turn
    along = math.copysign(max(abs(along), LEAST_CHORD), along)
    ahead, left = ahead / along, left / along
    m_t = turn / a.noise_unit[0]
    m_f, m_s = ahead / a.noise_unit[1], left / a.noise_unit[2]
    size = math.sqrt(m_t * m_t + m_f * m_f + m_s * m_s)
    log_moved = math.log(size / (size + HALF_MOVED) + 0.02)
    for j in range(3):
        out[j] = scale[j] * math.exp(2.0 * a.noise_log_scale[j, 5] * log_moved)
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
    log_tau = scale[3] + a.noise_tail[2] * math.log(abs(turn / a.noise_unit[0]) + 0.02)
    out[9] = min(math.exp(log_tau), HEAVIEST)


@kernel(forceinline=True)
def shake(dx, dy, turn, size, t, f, s, w):
    """Return a displacement with noise of a given size.

    Args:
        dx, dy, turn: displacement (m, m, rad) without noise.
        size: [SIZES], of :func:`spread`.
        t, f, s, w: standard normal numbers, see :meth:`NoiseModel.draw`.
    """
    width = math.exp(2.0 * size[9] * w)
    tt = math.sqrt(max(size[0] * width + size[3], TINY))
    ft, st = size[4] / tt, size[6] / tt
    ff = math.sqrt(max(size[1] * width + size[5] - ft * ft, TINY))
    sf = (size[7] - st * ft) / ff
    ss = math.sqrt(max(size[2] * width + size[8] - st * st - sf * sf, TINY))
    return _added(dx, dy, turn, ft * t + ff * f, st * t + sf * f + ss * s, tt * t)


@kernel(forceinline=True)
def _added(dx, dy, turn, ahead, left, more):
    """Return a displacement with more motion; see :func:`.noise.added`."""
    x, y = se2.rotate(0.5 * more, dx, dy)
    theta = turn + more
    return se2.compose(x, y, 0.5 * theta, ahead, left, 0.5 * theta)


@kernel(forceinline=True)
def _exceed(lasts, time, excess, dx, dy, turn):
    """Return a displacement with the excess [3] of a time (s), which fades; see :class:`Excess`."""
    if excess[0] == 0.0 and excess[1] == 0.0 and excess[2] == 0.0:
        return dx, dy, turn
    x, y, more = excess[0], excess[1], excess[2]
    for i in range(3):
        excess[i] *= math.exp(-time / lasts[i])
    x, y = lasts[0] * (x - excess[0]), lasts[1] * (y - excess[1])
    return _added(dx, dy, turn, x, y, lasts[2] * (more - excess[2]))


engine.compiled(MotionModel, step, sense, scratch)
