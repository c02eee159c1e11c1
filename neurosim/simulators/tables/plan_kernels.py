"""Plans driven in a table simulator, compiled.

As :meth:`neurosim.simulators.tables.simulator.TableSimulator.step` does it in plain tensors, one
robot after the other.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from neurosim.simulators.tables.kernels import (
    SAMPLES_NOISE,
    UNIFORM_NOISE,
    _advance,
    _moved,
    _rounded,
    _twist,
    phases,
)


@njit(cache=True, error_model="numpy", inline="always")
def carry_out(t, timing, pose, speeds, goals, command, z, kept):
    """Carry out a command [3] (%, %, s); change pose [3], speeds and goals [2].

    ``timing`` is of :func:`phases`, ``z`` [3] the command's noise; ``kept`` [3, 3] is scratch.
    """
    parts = len(timing)
    twist, before, noise = kept[0], kept[1], kept[2]
    left, right, duration = _rounded(t, command[0]), _rounded(t, command[1]), command[2]
    noise[:] = 0.0
    if t.noise == UNIFORM_NOISE:
        noise[:] = t.twist_noise
    elif t.noise == SAMPLES_NOISE:
        _twist(t, t.twist_spread, left, right, noise)
    for i in range(3):
        noise[i] *= math.sqrt(duration) * z[i] / parts
    x, y, theta = pose[0], pose[1], pose[2]
    for part in range(parts):
        if timing[part, 0, 0] > 0.0:
            _advance(t, timing[part, 0], speeds, goals[0], goals[1], before)
        else:
            before[:] = 0.0
        _advance(t, timing[part, 1], speeds, left, right, twist)
        x, y, theta = _moved(t, x, y, theta, before, twist, noise)
    pose[0], pose[1], pose[2] = x, y, theta
    goals[0], goals[1] = left, right


@njit(cache=True, parallel=True, error_model="numpy")
def drive_plans(t, starts, begun, z, commands, given, rests):
    """Drive every plan from every start.

    Args:
        t: :class:`~neurosim.simulators.tables.kernels.TableArrays`.
        starts: [R, 3] poses.
        begun: [4] the wheels' speeds there and what they were told last, %.
        z: [R, T, 3] the noise of the n-th command that is sent, the same for all plans.
        commands: [B, T, 3] left, right (%), duration (s).
        given: [B, T] bool; a command that is not given leaves the robot as it is.
        rests: whether the last command, which stops the robot, is sent though not given.

    Returns:
        Poses [B, R, T + 1, 3]: at the start and after each command.
    """
    plans, length = given.shape
    count = len(starts)
    poses = np.empty((plans, count, length + 1, 3))
    for job in prange(plans * count):
        b, r = job // count, job % count
        pose, speeds, goals = starts[r].copy(), begun[:2].copy(), begun[2:].copy()
        kept = np.empty((3, 3))
        poses[b, r, 0] = pose
        sent = 0
        for k in range(length):
            if given[b, k] or (rests and k == length - 1):
                timing = phases(t, commands[b, k, 2])
                carry_out(t, timing, pose, speeds, goals, commands[b, k], z[r, sent], kept)
                sent += 1
            poses[b, r, k + 1] = pose
    return poses
