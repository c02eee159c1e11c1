"""Networks that drive robots in a motion network, compiled and on all cores.

In a closed loop every robot has commands of its own: of the ensemble only the member that a robot
moves as is evaluated.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.networks.control_kernels import act, observe
from neurosim.simulators.base import draw_outcomes
from neurosim.simulators.closed_loop import ClosedLoop
from neurosim.simulators.motion.kernels import SIZES, Arrays, shake, spread, tell
from neurosim.simulators.motion.noise import DRAWS
from neurosim.simulators.motion.plan_kernels import Ensemble, displacements, lay_out, scratch
from neurosim.simulators.motion.sensors import sense


class MotionClosedLoop(ClosedLoop):
    """Rollouts of networks in a motion network of linear units."""

    def __init__(self, simulator: Any, controller: Any, episode: Episode):
        """Lay out the networks; see :class:`ClosedLoop`."""
        super().__init__(simulator, controller, episode)
        self._arrays = simulator.arrays()
        self._ensemble = lay_out_each(self._arrays)
        self._source = simulator.input_sources()
        self._sensors = simulator.sensor_arrays()

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw outcomes: where the robot is put down, member and noise of each."""
        return draw_outcomes(self.simulator, starts, rng, placing, self.steps)

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...] of individuals [P, G] through outcomes [R]."""
        genes, starts, noise = self.checked(genes, draws)
        member = np.full(len(draws), -1)
        if draws.member is not None and self.simulator.members > 1:
            member = np.ascontiguousarray(draws.member, np.int64)
        poses, commands, readings = self.buffers(len(genes), len(draws), np.float64, reuse)
        drive(
            self._ensemble,
            self._arrays,
            self._source,
            self._sensors,
            self.loop,
            genes,
            starts,
            member,
            noise,
            self.room,
            poses,
            commands,
            readings,
        )
        return self.trajectory(poses, commands, readings)


def lay_out_each(a: Arrays) -> Ensemble:
    """Return an ensemble whose arrays of units, terms and weights have an axis of members before.

    The first is the mean of all. Members with fewer units or terms than others have empty ones.
    """
    each = [lay_out(a, mean=True)]
    names = ("exponents", "ceiling", "signed", "linear", "bias", "kernel_weights")
    for m in range(a.central, len(a.bias)):
        own = {name: getattr(a, name)[m : m + 1] for name in names}
        each.append(lay_out(a._replace(**own, central=False), mean=False))
    stacked: dict[str, Any] = {}
    for name in (*names, "row", "unit", "count", "weight"):
        parts = [getattr(one, name) for one in each]
        width = max(part.shape[-1] for part in parts)
        found = np.zeros((len(parts), *parts[0].shape[:-1], width), parts[0].dtype)
        for place, part in enumerate(parts):
            found[place, ..., : part.shape[-1]] = part
        stacked[name] = found
    return each[0]._replace(**stacked)


@njit(cache=True, error_model="numpy", forceinline=True)
def network_of(e, member):
    """Return one member's networks, -1 for the mean's, of an ensemble of :func:`lay_out_each`."""
    m = member + 1
    return Ensemble(
        1,
        e.outputs,
        e.exponents[m],
        e.ceiling[m],
        e.row[m],
        e.unit[m],
        e.count[m],
        e.weight[m],
        e.signed[m],
        e.linear[m],
        e.bias[m],
        e.kernel_weights[m],
        e.centres,
        e.lengths,
        e.input_scale,
        e.dead_zone,
        e.driven,
        e.before,
        e.duration,
        e.swing,
        e.floor,
        e.drives,
        e.lag,
        e.slowing,
        e.braking,
        e.rate,
        e.bend,
        e.stick,
        e.delay,
        e.kinematics,
        e.correction,
        e.longest,
    )


@njit(cache=True, parallel=True, error_model="numpy")
def drive(e, a, source, s, loop, genes, starts, member, z, room, poses, commands, readings):
    """Drive every network from every start, where the robot stands still at first.

    Args:
        e: of :func:`lay_out_each`.
        a: :class:`~neurosim.simulators.motion.kernels.Arrays`, for the noise.
        source: [I] of the motion network's inputs, see :meth:`MotionNetwork.input_sources`.
        s: :class:`~neurosim.simulators.motion.sensors.SensorArrays`.
        loop: :class:`~neurosim.networks.control_kernels.Loop`.
        genes: [P, G].
        starts: [R, 3] poses.
        member: [R] of the ensemble, -1 for the mean.
        z: [R, T, DRAWS + S] draws of the noise; T = 0: there is none.
        room: see :func:`~neurosim.networks.control_kernels.room`.
        poses: [P, R, T + 1, 3], written: before the first of T steps and after each.
        commands: [P, R, T, C], written: without the duration.
        readings: [P, R, T, S], written: before each step; T = 0: they are not kept.
    """
    count, steps, width = len(starts), commands.shape[2], commands.shape[3]
    noisy, sensors = a.noisy and z.shape[1] > 0, len(s.mount)
    kept = readings.shape[2] > 0
    remembered = 2 * len(a.driven) + 2
    for job in prange(len(genes) * count):
        p, r = job // count, job % count
        one = network_of(e, member[r])
        shape = loop.hidden, loop.scale, loop.recurrence, len(loop.source)
        values, net, read, still = np.zeros(room), genes[p], np.empty(sensors), np.empty(0)
        given = e.linear.shape[2]
        x, inner, memory = np.empty(given), scratch(one), np.zeros(remembered)
        size, moved = np.empty(SIZES), np.empty((1, 3))
        # The last column is the duration, where there is one.
        command = np.full(width + 1, loop.step)
        px, py, theta = starts[r, 0], starts[r, 1], starts[r, 2]
        goal = 0
        for k in range(steps):
            poses[p, r, k, 0], poses[p, r, k, 1], poses[p, r, k, 2] = px, py, theta
            cos, sin = math.cos(theta), math.sin(theta)
            if sensors > 0:
                sense(s, px, py, cos, sin, z[r, k] if z.shape[1] > 0 else still, DRAWS, read)
                for n in range(sensors * kept):
                    readings[p, r, k, n] = read[n]
            if k < loop.steps:
                goal = observe(loop, px, py, cos, sin, goal, k * loop.step, read, values)
                act(*shape, net, values, command)
            else:
                command[:width] = 0.0
                command[width] = loop.rest
            for c in range(width):
                commands[p, r, k, c] = command[c]
            began = tell(one, source, command, k, memory, x)
            displacements(one, x, inner, moved)
            if noisy:
                spread(a, x, moved[0], size)
                shake(moved[0], size, z[r, began], moved[0])
            from_ = poses[p, r, began]
            cos, sin = math.cos(from_[2]), math.sin(from_[2])
            px = from_[0] + cos * moved[0, 0] - sin * moved[0, 1]
            py = from_[1] + sin * moved[0, 0] + cos * moved[0, 1]
            theta = from_[2] + moved[0, 2]
        poses[p, r, steps, 0], poses[p, r, steps, 1], poses[p, r, steps, 2] = px, py, theta
