"""Random numbers in compiled code: SplitMix64 (Steele, Lea, Flood 2014) of a counter.

A number depends only on the seed and its index in the sequence, so that each can be computed alone.
"""

from __future__ import annotations

import math

import numpy as np

from neurosim.base.kernels import kernel

#: From one state of the generator to the next.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@kernel(inline="always")
def bits(state):
    """Return 64 random bits of a state, uint64: a seed plus a multiple of :data:`GOLDEN`."""
    z = state
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel(inline="always")
def uniform(state):
    """Return a number above 0 and below 1."""
    return (np.float64(bits(state) >> np.uint64(12)) + 0.5) * 2.0**-52


@kernel(inline="always")
def normal(one, other):
    """Return a standard normal number from two uniform ones (Box and Muller 1958)."""
    return math.sqrt(-2.0 * math.log(one)) * math.cos(2.0 * math.pi * other)
