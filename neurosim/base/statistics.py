"""Statistics that several packages need."""

from __future__ import annotations

import math

#: 95 % of a normal distribution lie within this many standard deviations.
_Z = 1.959964


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a probability (Wilson 1927, J. Am. Stat. Assoc. 22).

    Args:
        successes: out of ``trials``.
        trials: at least 1.
    """
    fraction, z2 = successes / trials, _Z**2
    middle = (fraction + z2 / (2 * trials)) / (1 + z2 / trials)
    half = (
        _Z
        * math.sqrt(fraction * (1 - fraction) / trials + z2 / (4 * trials**2))
        / (1 + z2 / trials)
    )
    return max(middle - half, 0.0), min(middle + half, 1.0)
