"""Steps of whole batches of robots in a motion network, compiled and on all cores."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from neurosim.base.se2 import compiled as se2
from neurosim.simulators.base import Stepper
from neurosim.simulators.motion.closed_loop import lay_out_each, network_of
from neurosim.simulators.motion.kernels import SIZES, shake, spread, tell
from neurosim.simulators.motion.noise import DRAWS
from neurosim.simulators.motion.plan_kernels import displacements, scratch
from neurosim.simulators.motion.sensors import sensed
from neurosim.simulators.numbers import NORMAL, numbers_at

#: Robots that a core steps before it takes others.
_BLOCK = 32


class MotionStepper(Stepper):
    """Steps robots in a motion network of linear units."""

    worth_sharing = 1000  # these take a core a millisecond

    def __init__(self, simulator: Any):
        super().__init__(simulator)
        self._arrays = simulator.arrays()
        self._ensemble = lay_out_each(self._arrays)
        self._source = simulator.input_sources()
        self._sensors = simulator.sensor_arrays()
        names = [name for name in simulator.input_names if name.startswith("prev_")]
        self._next = np.array(
            [simulator.command_names.index(name.removeprefix("prev_")) for name in names], np.int64
        )

    def start(
        self, poses: NDArray[np.float64], member: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the states [B, S], as :meth:`Stepper.start` does, without tensors."""
        state = np.zeros((len(poses), len(self.simulator.state_names)))
        state[:, :3] = poses
        if self.simulator.members > 1:
            state[:, -1] = -1 if member is None else member
        return state

    def noise(self, seeds: NDArray[np.uint64], steps: NDArray[np.int64]) -> NDArray:
        """Return standard normal numbers [B, noise_width]."""
        return numbers_at(NORMAL, seeds, steps, max(DRAWS, self.simulator.noise_width))

    def sense(self, state: NDArray[np.float64], noise: NDArray | None) -> NDArray:
        """Return the readings [B, R] in 0..1 in states [B, S]."""
        if not self.simulator.reading_names:
            return super().sense(state, noise)
        return sensed(self._sensors, state[:, :3], noise, DRAWS)

    def step(
        self, state: NDArray[np.float64], command: NDArray[np.float64], noise: NDArray | None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] after commands [B, C] in the simulator's columns."""
        arrays, after = self._arrays, state.copy()
        if noise is None:
            arrays, noise = arrays._replace(noisy=False), np.zeros((len(state), DRAWS), np.float32)
        has_member = self.simulator.members > 1
        _step(self._ensemble, arrays, self._source, self._next, has_member, after, command, noise)
        return after


@njit(cache=True, parallel=True, error_model="numpy")
def _step(e, a, source, following, has_member, state, command, z):
    """Change states [B, S], laid out as :class:`MotionNetwork` says.

    Args:
        e: of :func:`lay_out_each`.
        a: :class:`~neurosim.simulators.motion.kernels.Arrays`, for the noise.
        source: as in :func:`~neurosim.simulators.motion.closed_loop.drive`.
        following: without a drive model, the column of the command that each column of the state
            behind the pose remembers.
        has_member: whether the last column names a member.
        state: [B, S], changed.
        command: [B, C].
        z: [B, DRAWS or more] draws of the noise.
    """
    rows, count = len(state), len(a.driven)
    behind = 3 + 2 * count + 1  # where a drive model's displacement until now stands
    for block in prange((rows + _BLOCK - 1) // _BLOCK):
        x, memory = np.empty(e.linear.shape[2]), np.zeros(2 * count + 2)
        size, moved, numbers = np.empty(SIZES), np.empty((1, 3)), np.empty(DRAWS)
        inner = scratch(network_of(e, -1))
        for b in range(block * _BLOCK, min((block + 1) * _BLOCK, rows)):
            own = state[b]
            one = network_of(e, int(own[-1]) if has_member else -1)
            for i in range(DRAWS):
                numbers[i] = z[b, i]
            began = 1
            if a.drives:
                for i in range(2 * count + 1):
                    memory[i] = own[3 + i]
                memory[2 * count + 1] = 0.0  # what began earlier, began in step 0
                began = tell(one, source, command[b], 1, memory, x)
                for i in range(2 * count + 1):
                    own[3 + i] = memory[i]
                for i in range(DRAWS):
                    if began == 0:
                        numbers[i] = own[behind + 3 + i]
                    else:
                        own[behind + 3 + i] = numbers[i] if a.noisy else 0.0
            else:
                for i in range(len(following)):
                    memory[following[i]] = own[3 + i]
                tell(one, source, command[b], 1, memory, x)
                for i in range(len(following)):
                    own[3 + i] = command[b, following[i]]
            displacements(one, x, inner, moved)
            if a.noisy:
                spread(a, x, moved[0], size)
                shake(moved[0], size, numbers, moved[0])
            dx, dy, turn = moved[0, 0], moved[0, 1], moved[0, 2]
            if a.drives:
                if began == 0:
                    gone_x, gone_y, gone = own[behind], own[behind + 1], own[behind + 2]
                    dx, dy = se2.rotate(-gone, dx - gone_x, dy - gone_y)
                    turn -= gone
                for i in range(3):
                    own[behind + i] = moved[0, i]
            heading = own[2]
            cos, sin = math.cos(heading), math.sin(heading)
            own[0] += cos * dx - sin * dy
            own[1] += sin * dx + cos * dy
            own[2] = heading + turn
