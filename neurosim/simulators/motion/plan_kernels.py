"""Rollouts of plans in a motion network, compiled and on all cores.

They compute what :class:`neurosim.loop.stepped.SteppedRollouts` does one step at a time.
Two things make them fast. What a command does to the network's inputs and to the size of the noise
is the same
for all draws of a plan, so networks are evaluated once a command and member, not once a draw.
And the product units of a whole ensemble lie in one row, networks with the same exponents only
once, so that a core works on several at a time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from neurosim.base.se2 import compiled as se2
from neurosim.networks import LOG_LIMIT
from neurosim.simulators.motion.kernels import (
    SIZES,
    Arrays,
    phases,
    shake,
    spread,
    tell,
)

#: Sums may be rearranged so that they vectorise; infinities and NaN keep their meaning.
_FAST = {"contract", "reassoc", "nsz", "arcp"}

_LOG2_LIMIT = LOG_LIMIT / math.log(2.0)
#: Added to a number of at most 2^51 it leaves the nearest whole number in the lowest bits.
_ROUND = 1.5 * 2.0**52
#: For exp(-x / 2) as a power of 2.
_HALF_LOG2_E = -0.5 / math.log(2.0)


class Ensemble(NamedTuple):
    """An ensemble's networks, laid out for evaluation of all of them on the same inputs.

    A row is one output of one member, row ``member * outputs + output``. It is a sum of terms,
    each over a run of product units.
    """

    members: int
    outputs: int
    exponents: np.ndarray  #: [I, U] of all different product units, for base-2 logarithms
    ceiling: np.ndarray  #: [U] of the base-2 logarithms of their magnitudes
    row: np.ndarray  #: of each term
    unit: np.ndarray  #: first product unit of each term
    count: np.ndarray  # type: ignore[assignment]  #: product units of each term
    weight: np.ndarray  #: place of each term's first weight in ``signed``
    signed: np.ndarray  #: [2^I, W] weights times cosines by the inputs' signs
    linear: np.ndarray  #: [R, I]
    bias: np.ndarray  #: [R]
    kernel_weights: np.ndarray  #: [R, K], this and the next as in Arrays
    centres: np.ndarray
    lengths: np.ndarray
    input_scale: np.ndarray
    dead_zone: np.ndarray
    driven: np.ndarray
    before: np.ndarray
    duration: int
    swing: float
    floor: float
    drives: bool
    lag: np.ndarray
    slowing: np.ndarray
    braking: np.ndarray
    rate: np.ndarray
    bend: np.ndarray
    stick: np.ndarray
    delay: np.ndarray
    kinematics: np.ndarray
    correction: np.ndarray
    longest: float


#: Fields of :class:`Ensemble` that are those of :class:`Arrays`.
SHARED = Ensemble._fields[Ensemble._fields.index("centres") :]


def lay_out(a: Arrays, *, mean: bool) -> Ensemble:
    """Return the networks of a simulator for these kernels.

    Args:
        a: the simulator's numbers.
        mean: whether only the mean of all members is wanted: an ensemble of one.
    """
    if a.central:
        own = slice(0, 1) if mean else slice(1, None)
        names = ("exponents", "ceiling", "signed", "linear", "bias", "kernel_weights")
        a = a._replace(**{name: getattr(a, name)[own] for name in names})
    members, outputs, _, inputs = a.exponents.shape
    units, ceilings, places = [], [], {}
    weights: list[np.ndarray] = []
    terms: list[tuple[int, int, int, int]] = []
    filled = written = 0
    for m in range(members):
        for o in range(outputs):
            used = (a.signed[m, o] != 0.0).any(axis=0)
            exponents, signed = a.exponents[m, o][used], a.signed[m, o][:, used]
            ceiling = a.ceiling[m, o][used] / math.log(2.0)
            if not used.any():
                continue
            key = exponents.tobytes(), ceiling.tobytes()
            if key not in places:
                places[key] = filled
                units.append(exponents)
                ceilings.append(ceiling)
                filled += len(exponents)
            row, share = (o, 1.0 / members) if mean else (m * outputs + o, 1.0)
            same = [t for t in terms if t[0] == row and t[1] == places[key]]
            if same:
                weights[terms.index(same[0])] += share * signed
                continue
            terms.append((row, places[key], len(exponents), written))
            weights.append(share * signed)
            written += len(exponents)
    columns = np.array(terms, np.int64).reshape(-1, 4).T
    linear, bias, kernel_weights = (
        v.mean(0, keepdims=True) if mean else v for v in (a.linear, a.bias, a.kernel_weights)
    )
    return Ensemble(
        members=1 if mean else members,
        outputs=outputs,
        exponents=np.ascontiguousarray(np.concatenate(units).T) if units else np.empty((inputs, 0)),
        ceiling=np.concatenate([*ceilings, np.empty(0)]),
        row=np.ascontiguousarray(columns[0]),
        unit=np.ascontiguousarray(columns[1]),
        count=np.ascontiguousarray(columns[2]),
        weight=np.ascontiguousarray(columns[3]),
        signed=np.ascontiguousarray(np.concatenate(weights, axis=1))
        if weights
        else np.empty((2**inputs, 0)),
        linear=np.ascontiguousarray(linear.reshape(-1, inputs)),
        bias=np.ascontiguousarray(bias.reshape(-1)),
        kernel_weights=np.ascontiguousarray(kernel_weights.reshape(len(bias) * outputs, -1)),
        **{name: getattr(a, name) for name in SHARED},
    )


@njit(fastmath={"contract", "nsz"}, inline="always")
def _exp2(z):
    """Return 2 to the power of z, |z| < 1000, to about 1e-12 relative.

    Plain arithmetic, which the compiler turns into vector instructions: Taylor's series of
    exp(f ln 2) for what is left beside the nearest whole number, whose bits go into the exponent.
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


@njit(cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _units(exponents, ceiling, log2, out):
    """Write the magnitude of every product unit."""
    count = out.shape[0]
    inputs = exponents.shape[0]
    if 5 <= inputs <= 7:
        # Without the detour through memory; both kinds of robots have five inputs, and up to two
        # derived from them. One that is not there counts as the first to the power of 0.
        l0, l1, l2, l3, l4 = log2[0], log2[1], log2[2], log2[3], log2[4]
        l5, e5 = (log2[5], exponents[5]) if inputs > 5 else (0.0, exponents[0])
        l6, e6 = (log2[6], exponents[6]) if inputs > 6 else (0.0, exponents[0])
        e0, e1, e2 = exponents[0], exponents[1], exponents[2]
        e3, e4 = exponents[3], exponents[4]
        for u in range(count):
            z = e0[u] * l0 + e1[u] * l1 + e2[u] * l2 + e3[u] * l3 + e4[u] * l4
            z += e5[u] * l5 + e6[u] * l6
            out[u] = _exp2(max(min(z, ceiling[u]), -_LOG2_LIMIT))
        return
    for u in range(count):
        out[u] = 0.0
    for i in range(exponents.shape[0]):
        e, log = exponents[i], log2[i]
        for u in range(count):
            out[u] += e[u] * log
    for u in range(count):
        out[u] = _exp2(max(min(out[u], ceiling[u]), -_LOG2_LIMIT))


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit(cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _kernel_units(centres, lengths, x, out):
    """Write the kernel units."""
    inputs = centres.shape[0]
    if 5 <= inputs <= 6:
        # As in :func:`_units`.
        p0, p1, p2 = x[0] / lengths[0], x[1] / lengths[1], x[2] / lengths[2]
        p3, p4 = x[3] / lengths[3], x[4] / lengths[4]
        c0, c1, c2, c3, c4 = centres[0], centres[1], centres[2], centres[3], centres[4]
        p5, c5 = (x[5] / lengths[5], centres[5]) if inputs > 5 else (p4, c4)
        more = 1.0 if inputs > 5 else 0.0
        for u in range(out.shape[0]):
            a0, a1, a2, a3 = p0 - c0[u], p1 - c1[u], p2 - c2[u], p3 - c3[u]
            a4, a5 = p4 - c4[u], more * (p5 - c5[u])
            away = a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3 + a4 * a4 + a5 * a5
            out[u] = _exp2(max(_HALF_LOG2_E * away, -_LOG2_LIMIT))
        return
    for u in range(out.shape[0]):
        out[u] = 0.0
    for i in range(centres.shape[0]):
        place = x[i] / lengths[i]
        row = centres[i]
        for u in range(out.shape[0]):
            away = place - row[u]
            out[u] += away * away
    for u in range(out.shape[0]):
        out[u] = _exp2(max(_HALF_LOG2_E * out[u], -_LOG2_LIMIT))


@njit(cache=True, error_model="numpy", inline="always")
def scratch(e):
    """Return arrays that :func:`displacements` needs for itself, a tuple."""
    inputs, units = e.exponents.shape
    return (
        np.empty(inputs),
        np.empty(units),
        np.empty(e.centres.shape[1]),
        np.empty(len(e.bias)),
        np.empty((2, len(e.driven))),
        np.empty(3),
        np.empty(3),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def displacements(e, x, room, out):
    """Write every member's mean displacement (m, m, rad) of a command.

    Args:
        e: :class:`Ensemble`.
        x: of :func:`neurosim.simulators.motion.kernels.tell`.
        room: of :func:`scratch`.
        out: [M, 3], written.
    """
    log2, units, nearness, rows, way, twist, moved = room
    near = len(nearness)
    pattern = 0
    for i in range(len(x)):
        if x[i] < 0.0:
            pattern += 1 << i
        log2[i] = math.log2(max(abs(x[i]), e.floor))
    _units(e.exponents, e.ceiling, log2, units)
    for r in range(len(rows)):
        total = e.bias[r]
        for i in range(len(x)):
            total += e.linear[r, i] * x[i]
        rows[r] = total
    signed = e.signed[pattern]
    for t in range(len(e.row)):
        start, weight, terms = e.unit[t], e.weight[t], e.count[t]
        rows[e.row[t]] += _dot(signed[weight : weight + terms], units[start : start + terms])
    if near > 0:
        _kernel_units(e.centres, e.lengths, x, nearness)
        for r in range(len(rows)):
            rows[r] += _dot(e.kernel_weights[r], nearness)
    share = 1.0
    if e.drives:
        phases(e, x, way, twist, moved)
        share = x[e.duration]
    for m in range(e.members):
        dx, dy, turn = rows[3 * m], rows[3 * m + 1], rows[3 * m + 2]
        if e.drives:
            c = e.correction
            dx, turn = c[0] * dx + c[3] * turn, c[2] * dx + c[1] * turn
            dx, dy, turn = se2.compose_exp(
                moved[0],
                moved[1],
                moved[2],
                twist[0] + share * dx,
                twist[1] + share * dy,
                twist[2] + share * turn,
            )
        out[m, 0], out[m, 1], out[m, 2] = dx, dy, turn


@njit(cache=True, error_model="numpy", parallel=True)
def mean_poses(e, source, start, begun, commands, given, rests):
    """Drive plans as the mean of the ensemble says.

    Args:
        e: :class:`Ensemble` of the mean.
        source: [I] where each input comes from: c for column c of the command, -c - 1 for column
            c of the command before.
        start: [3] pose.
        begun: what :func:`~neurosim.simulators.motion.kernels.tell` remembers of the robot there.
        commands: [B, T, C].
        given: [B, T] bool; a command that is not given leaves the robot as it is.
        rests: whether the last command, which stops the robot, is sent though not given.

    Returns:
        [B, T + 1, 3].
    """
    batch, count = commands.shape[:2]
    poses = np.empty((batch, count + 1, 3))
    for b in prange(batch):
        x, room, memory = np.empty(len(e.exponents)), scratch(e), begun.copy()
        moved = np.empty((1, 3))
        px, py, theta = start[0], start[1], start[2]
        for k in range(count):
            poses[b, k, 0], poses[b, k, 1], poses[b, k, 2] = px, py, theta
            if not (given[b, k] or (rests and k == count - 1)):
                continue
            began = tell(e, source, commands[b, k], k, memory, x)
            displacements(e, x, room, moved)
            from_ = poses[b, began]
            # Not se2.compose, which adds in another order: the plans of fixed seeds would change.
            dx, dy = se2.rotate(from_[2], moved[0, 0], moved[0, 1])
            px, py, theta = from_[0] + dx, from_[1] + dy, from_[2] + moved[0, 2]
        poses[b, count, 0], poses[b, count, 1], poses[b, count, 2] = px, py, theta
    return poses


@njit(cache=True, error_model="numpy", parallel=True)
def drawn_poses(e, a, source, starts, member, z, begun, commands, given, rests):
    """Drive every plan through the same drawn outcomes.

    Args:
        e: :class:`Ensemble` of all members.
        a: :class:`neurosim.simulators.motion.kernels.Arrays`, for the noise.
        source, begun, commands, given, rests: as :func:`mean_poses` takes them.
        starts: [R, 3] poses.
        member: [R] of the ensemble; below 0 in none.
        z: [R, T, DRAWS] draws for the n-th command that is sent.

    Returns:
        [B, R, T + 1, 3].
    """
    batch, count = commands.shape[:2]
    draws = len(starts)
    poses = np.empty((batch, draws, count + 1, 3))
    for b in prange(batch):
        x, room, memory = np.empty(len(e.exponents)), scratch(e), begun.copy()
        means, sizes = np.empty((e.members, 3)), np.empty((e.members, SIZES))
        moved = np.empty(3)
        poses[b, :, 0] = starts
        #: How many commands were sent before each.
        sent = np.zeros(count + 1, np.int64)
        for k in range(count):
            if not (given[b, k] or (rests and k == count - 1)):
                poses[b, :, k + 1] = poses[b, :, k]
                sent[k + 1] = sent[k]
                continue
            sent[k + 1] = sent[k] + 1
            began = tell(e, source, commands[b, k], k, memory, x)
            displacements(e, x, room, means)
            if a.noisy:
                for m in range(e.members):
                    spread(a, x, means[m], sizes[m])
            for r in range(draws):
                m = member[r]
                if a.noisy:
                    shake(means[m], sizes[m], z[r, sent[began]], moved)
                else:
                    moved[0], moved[1], moved[2] = means[m, 0], means[m, 1], means[m, 2]
                pose, after = poses[b, r, began], poses[b, r, k + 1]
                after[0], after[1], after[2] = se2.compose(
                    pose[0], pose[1], pose[2], moved[0], moved[1], moved[2]
                )
    return poses
