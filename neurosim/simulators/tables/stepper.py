"""Steps of whole batches of robots in tables, compiled and on all cores."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from neurosim.simulators.base import Stepper
from neurosim.simulators.numbers import NONE, numbers_at
from neurosim.simulators.tables.kernels import _FAST, phases, read
from neurosim.simulators.tables.plan_kernels import carry_out

#: Robots that a core steps before it takes others.
_BLOCK = 64


class TableStepper(Stepper):
    """Steps robots in tables; readings are in single precision."""

    simulator: Any
    worth_sharing = 500  # these take a core a fifth of a millisecond

    def __init__(self, simulator: Any):
        super().__init__(simulator)
        self._arrays = simulator.arrays
        self._quiet = self._arrays._replace(noise=NONE)
        self._sensors = len(simulator.reading_names)

    def noise(self, seeds: NDArray[np.uint64], steps: NDArray[np.int64]) -> NDArray:
        """Return the numbers [B, noise_width], those of :meth:`TableSimulator.expand_noise`."""
        return numbers_at(self._arrays.noise, seeds, steps, self.simulator.noise_width)

    def step(
        self, state: NDArray[np.float64], command: NDArray[np.float64], noise: NDArray | None
    ) -> NDArray[np.float64]:
        """Return the states [B, 7] after commands [B, 3] (%, %, s)."""
        after, sensors = state.copy(), self._sensors
        if noise is None:
            z, arrays = np.zeros((len(state), 3), np.float32), self._quiet
        else:
            z, arrays = noise[:, sensors:].astype(np.float32, copy=False), self._arrays
        _step(arrays, after, command, z)
        return after

    def sense(self, state: NDArray[np.float64], noise: NDArray | None) -> NDArray:
        """Return the readings [B, S], float32."""
        sensors = self._sensors
        out = np.empty((len(state), sensors), np.float32)
        if noise is None:
            _sense(self._quiet, state, np.empty((len(state), sensors), np.float32), out)
        else:
            _sense(self._arrays, state, noise.astype(np.float32, copy=False), out)
        return out


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_FAST)
def _step(t, state, command, z):
    """Change states [B, 7]; ``z`` [B, 3] is the commands' noise."""
    rows = len(state)
    for block in prange((rows + _BLOCK - 1) // _BLOCK):
        kept, lasts, timing = np.empty((3, 3)), -1.0, np.empty((0, 2, 5))
        for b in range(block * _BLOCK, min((block + 1) * _BLOCK, rows)):
            if command[b, 2] != lasts:
                lasts = command[b, 2]
                timing = phases(t, lasts)
            own = state[b]
            carry_out(t, timing, own[:3], own[3:5], own[5:7], command[b], z[b], kept)


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_FAST)
def _sense(t, state, z, out):
    """Write the readings [B, S] in states [B, 7] with noise of ``z`` [B, S or more]."""
    rows, sensors, lanes = len(state), out.shape[1], len(t.ambient)
    for block in prange((rows + _BLOCK - 1) // _BLOCK):
        mean, variance = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
        for b in range(block * _BLOCK, min((block + 1) * _BLOCK, rows)):
            read(t, state[b, 0], state[b, 1], state[b, 2], z[b], sensors, mean, variance)
            for s in range(sensors):
                out[b, s] = mean[s]
