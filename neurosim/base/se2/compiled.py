"""Planar poses and displacements in compiled code, one at a time; see :mod:`neurosim.base.se2`.

Every function takes numbers and returns a tuple of numbers. Numba copies it into its caller, so
that a call costs nothing.
"""

from __future__ import annotations

import math

from neurosim.base.kernels import kernel

#: Below this square of half the turn a series is exact to rounding, and takes less time.
_SMALL = 0.04
#: An arc with a smaller turn (rad) is a straight line: ratios of such sines may be 0/0.
_STRAIGHT = 1e-100


@kernel(inline="always")
def compose(x, y, theta, dx, dy, dtheta):
    """Return the pose reached from a pose by a displacement given in its frame."""
    cos, sin = math.cos(theta), math.sin(theta)
    return x + cos * dx - sin * dy, y + sin * dx + cos * dy, theta + dtheta


@kernel(inline="always")
def exp(vx, vy, omega):
    """Return the displacement of a constant body twist held for unit time."""
    along = chord(omega)
    cos, sin = along * math.cos(0.5 * omega), along * math.sin(0.5 * omega)
    return cos * vx - sin * vy, sin * vx + cos * vy, omega


@kernel(inline="always")
def compose_exp(x, y, theta, vx, vy, omega):
    """Return the pose reached by a constant body twist: a faster ``compose`` of ``exp``."""
    along, heading = chord(omega), theta + 0.5 * omega
    cos, sin = along * math.cos(heading), along * math.sin(heading)
    return x + cos * vx - sin * vy, y + sin * vx + cos * vy, theta + omega


@kernel(inline="always")
def mid_turn(dx, dy, turn):
    """Return a displacement with x and y in its mid-turn frame."""
    ahead, left = rotate(-0.5 * turn, dx, dy)
    return ahead, left, turn


@kernel(inline="always")
def chord(turn):
    """Return the length of an arc's chord over that of the arc: sin(turn / 2) / (turn / 2)."""
    half = 0.5 * turn
    square = half * half
    if square < _SMALL:
        series = 1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0)
        return 1.0 - square * (1.0 / 6.0 - square * series)
    return math.sin(half) / half


@kernel(inline="always")
def arc_length(dx, dy, turn):
    """Return the length of the constant-twist arc; infinite or very large if no arc exists."""
    along = abs(chord(turn))
    return math.sqrt(dx * dx + dy * dy) / along if along > 0.0 else math.inf


@kernel(inline="always")
def arc(dx, dy, turn, fraction):
    """Return x and y of a constant-twist arc after a fraction of it.

    It is computed from the chord's length and direction. ``dx`` and ``dy`` may be in any frame; x
    and y are in the same one.
    """
    half = 0.5 * turn
    if not abs(turn) > _STRAIGHT:
        return fraction * dx, fraction * dy
    # The chord of the part is turned by (fraction - 1) * half. Only two of these change with it.
    sin, cos = math.sin(fraction * half), math.cos(fraction * half)
    sin_half, cos_half = math.sin(half), math.cos(half)
    part = sin / sin_half
    along, across = (
        part * (cos * cos_half + sin * sin_half),
        part * (sin * cos_half - cos * sin_half),
    )
    return along * dx - across * dy, across * dx + along * dy


@kernel(inline="always")
def rotate(angle, x, y):
    """Return a vector turned by an angle, rad."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * x - sin * y, sin * x + cos * y
