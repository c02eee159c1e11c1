"""Networks that drive robots in a table simulator, compiled and on all cores."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from neurosim.base.trajectory import Draws, Trajectory
from neurosim.networks.control_kernels import act, observe
from neurosim.simulators.closed_loop import ClosedLoop
from neurosim.simulators.numbers import draw
from neurosim.simulators.tables.kernels import (
    _FAST,
    SAMPLES_NOISE,
    UNIFORM_NOISE,
    _advance,
    _moved,
    _rounded,
    _twist,
    phases,
    read,
)


class TableClosedLoop(ClosedLoop):
    """Rollouts of networks in a table simulator: as stepped ones, readings in single precision."""

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw outcomes: where each robot stands, and a seed of its noise."""
        rng = np.random.default_rng(rng)
        starts = self.put_down(starts, rng, placing)
        return Draws(starts, seeds=rng.integers(0, 2**64, len(starts), dtype=np.uint64))

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...] of individuals [P, G] through outcomes [R]."""
        simulator, loop = self.simulator, self.loop
        arrays, seeds = simulator.arrays, draws.seeds
        genes, starts, noise = self.checked(genes, draws)
        if draws.noise is None and seeds is None:
            arrays = arrays._replace(noise=0)
        seeds = np.zeros(len(draws), np.uint64) if seeds is None else seeds
        poses, commands, readings = self.buffers(len(genes), len(draws), np.float32, reuse)
        drive(
            arrays,
            loop,
            genes,
            starts,
            np.ascontiguousarray(seeds, np.uint64),
            noise,
            self.room,
            poses,
            readings,
            commands,
        )
        return self.trajectory(poses, commands, readings)


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_FAST)
def drive(t, loop, genes, starts, seeds, z, room, poses, readings, commands):
    """Drive every network from every start, where the robot stands still at first.

    Args:
        t: :class:`~neurosim.simulators.tables.kernels.TableArrays`.
        loop: :class:`~neurosim.networks.control_kernels.Loop`.
        genes: [P, G].
        starts: [R, 3] poses.
        seeds: [R] uint64, of the noise: the same for all networks.
        z: [R, T, S + 3], the noise itself; T = 0: it is made of the seeds.
        room: see :func:`~neurosim.networks.control_kernels.room`.
        poses: [P, R, T + 1, 3] float64, written: before the first of T steps and after each.
        readings: [P, R, T, S] float32, written; T = 0: robots need not sense.
        commands: [P, R, T, 2] float32, %, written.
    """
    count, steps, sensors, lanes = len(starts), commands.shape[2], readings.shape[3], len(t.ambient)
    timing, stopping = phases(t, loop.step), phases(t, loop.rest)
    for job in prange(len(genes) * count):
        p, r = job // count, job % count
        shape = loop.hidden, loop.scale, loop.recurrence, len(loop.source)
        mean, variance = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
        draws = np.zeros((sensors + 6) // 4 * 4, np.float32)
        twist, before, noise = np.empty(3), np.zeros(3), np.zeros(3)
        values, command, net = np.zeros(room), np.zeros(2), genes[p]
        speeds, left_goal, right_goal = np.zeros(2), 0.0, 0.0
        x, y, theta = starts[r, 0], starts[r, 1], starts[r, 2]
        state, goal = seeds[r], 0
        phase, root = timing, math.sqrt(loop.step)
        for k in range(steps):
            poses[p, r, k, 0], poses[p, r, k, 1], poses[p, r, k, 2] = x, y, theta
            if z.shape[1] > 0:
                for i in range(sensors + 3):
                    draws[i] = z[r, k, i]
            else:
                state = draw(t.noise, state, draws)
            if readings.shape[2] > 0:
                read(t, x, y, theta, draws, sensors, mean, variance)
                for s in range(sensors):
                    readings[p, r, k, s] = mean[s]
            if k < loop.steps:
                cos, sin = 1.0, 0.0
                if loop.turned:
                    cos, sin = math.cos(theta), math.sin(theta)
                goal = observe(loop, x, y, cos, sin, goal, k * loop.step, mean, values)
                act(*shape, net, values, command)
            else:
                command[0], command[1] = 0.0, 0.0
                phase, root = stopping, math.sqrt(loop.rest)
            commands[p, r, k, 0], commands[p, r, k, 1] = command[0], command[1]
            left, right = _rounded(t, command[0]), _rounded(t, command[1])
            if t.noise == SAMPLES_NOISE:
                _twist(t, t.twist_spread, left, right, noise)
            for i in range(3):
                if t.noise == UNIFORM_NOISE:
                    noise[i] = t.twist_noise[i]
                noise[i] *= root * draws[sensors + i] / len(phase)
            for part in range(len(phase)):
                if phase[part, 0, 0] > 0.0:
                    _advance(t, phase[part, 0], speeds, left_goal, right_goal, before)
                else:
                    before[:] = 0.0
                _advance(t, phase[part, 1], speeds, left, right, twist)
                x, y, theta = _moved(t, x, y, theta, before, twist, noise)
            left_goal, right_goal = left, right
        poses[p, r, steps, 0], poses[p, r, steps, 1], poses[p, r, steps, 2] = x, y, theta


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def expand(noise, seeds, out):
    """Write the numbers [R, T, Z] that seeds [R] stand for, as :func:`drive` draws them."""
    draws = np.zeros((out.shape[2] + 3) // 4 * 4, np.float32)
    for r in range(len(seeds)):
        state = seeds[r]
        for k in range(out.shape[1]):
            state = draw(noise, state, draws)
            out[r, k] = draws[: out.shape[2]]
