"""Random numbers of noise from a seed and a step's number, compiled (SplitMix64).

Every sample has its own seed: its numbers depend neither on the number of other samples nor on
their order.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.base.random import GOLDEN, bits
from neurosim.base.threads import on_cores

#: Kinds of numbers: none; uniform in -1 to 1; standard normal.
NONE, UNIFORM, NORMAL = 0, 1, 2

#: Number of random numbers for which another core is worth starting.
_WORTH_SHARING = 10_000


@njit(inline="always", error_model="numpy")
def draw(noise, state, out):
    """Write numbers for the noise of a step; return the next state.

    Args:
        noise: NONE, UNIFORM or NORMAL.
        state: uint64; a seed at first.
        out: [Z] float32, a multiple of 4: uniform in -1 to 1, or standard normal (Box and
            Muller).
    """
    if noise == UNIFORM:
        for place in range(len(out) // 4):
            state += GOLDEN
            word = bits(state)
            for part in range(4):
                low = np.int64((word >> np.uint64(16 * part)) & np.uint64(0xFFFF))
                value = np.float32(low) * np.float32(2.0 / 65535.0) - np.float32(1.0)
                out[4 * place + part] = value
    elif noise == NORMAL:
        for pair in range(len(out) // 2):
            state += GOLDEN
            word = bits(state)
            u = (np.float64(word >> np.uint64(32)) + 0.5) / 4294967296.0
            angle = np.float64(word & np.uint64(0xFFFFFFFF)) * (2.0 * math.pi / 4294967296.0)
            size = math.sqrt(-2.0 * math.log(u))
            out[2 * pair], out[2 * pair + 1] = size * math.cos(angle), size * math.sin(angle)
    return state


def numbers(
    noise: int, seeds: NDArray[np.uint64], first: NDArray[np.int64], steps: int, width: int
) -> NDArray[np.float32]:
    """Return the numbers [R, steps, width] of some steps of samples.

    Args:
        noise: UNIFORM or NORMAL.
        seeds: [R] of the samples.
        first: [R] number of the first of these steps, from 0.
        steps: number of steps.
        width: number of random numbers of a step.
    """
    out = np.empty((len(seeds), steps, width), np.float32)

    def part(one: int, end: int) -> None:
        _fill(noise, seeds[one:end], first[one:end], out[one:end])

    least = -(-_WORTH_SHARING // max(1, steps * width))
    on_cores(_fill, part, len(seeds), least)
    return out


@njit(nogil=True, error_model="numpy")
def _fill(
    noise: int, seeds: NDArray[np.uint64], first: NDArray[np.int64], out: NDArray[np.float32]
) -> None:
    """Write the numbers [R, steps, width] of :func:`numbers`."""
    steps, width = out.shape[1:]
    padded = (width + 3) // 4 * 4
    words = padded // 4 if noise == UNIFORM else padded // 2
    numbers = np.empty(padded, np.float32)
    for row in range(len(seeds)):
        state = seeds[row] + GOLDEN * np.uint64(first[row] * words)
        for step in range(steps):
            state = draw(noise, state, numbers)
            for n in range(width):
                out[row, step, n] = numbers[n]


@njit
def words(seeds: NDArray[np.uint64], steps: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return a word of 64 random bits [R] for each seed and step, [R] both."""
    out = np.empty(len(seeds), np.uint64)
    for row in range(len(seeds)):
        out[row] = bits(seeds[row] + GOLDEN * np.uint64(steps[row] + 1))
    return out
