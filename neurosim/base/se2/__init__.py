"""Planar poses and displacements: the group SE(2).

A pose is (x, y, theta) in metres and radians; the last axis of every array has length 3.
Frames follow ROS REP 103: x forward, y left, heading counter-clockwise. Headings are not
wrapped: a turn of 400 degrees is 400, not 40. Functions take NumPy arrays of any leading
shape; ``arc`` and ``exp`` follow Lynch and Park, Modern Robotics (2017), section 3.3 in the
plane.

:mod:`neurosim.base.se2.tensors` has the same functions for PyTorch tensors, and
:mod:`neurosim.base.se2.compiled` those for compiled code; the three differ only by rounding.

The *mid-turn frame* of a displacement stands at its start and is turned by half of its turn. A
constant twist (v_x, v_y, omega) displaces in it by (v_x, v_y) times the :func:`chord` of omega.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def compose(pose: ArrayLike, displacement: ArrayLike) -> NDArray:
    """Return the pose reached from ``pose`` by a displacement given in its own frame."""
    pose, displacement = np.asarray(pose, float), np.asarray(displacement, float)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    dx, dy = displacement[..., 0], displacement[..., 1]
    return np.stack(
        [
            pose[..., 0] + cos * dx - sin * dy,
            pose[..., 1] + sin * dx + cos * dy,
            pose[..., 2] + displacement[..., 2],
        ],
        axis=-1,
    )


def between(start: ArrayLike, end: ArrayLike) -> NDArray:
    """Return the displacement from ``start`` to ``end`` in the frame of ``start``."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    cos, sin = np.cos(start[..., 2]), np.sin(start[..., 2])
    x, y = end[..., 0] - start[..., 0], end[..., 1] - start[..., 1]
    return np.stack([cos * x + sin * y, -sin * x + cos * y, end[..., 2] - start[..., 2]], axis=-1)


def exp(twist: ArrayLike) -> NDArray:
    """Return the displacement of a constant body twist (v_x, v_y, omega) held for unit time."""
    twist = np.asarray(twist, float)
    s, c = _sinc_cosc(twist[..., 2])
    vx, vy = twist[..., 0], twist[..., 1]
    return np.stack([s * vx - c * vy, c * vx + s * vy, twist[..., 2]], axis=-1)


def log(displacement: ArrayLike) -> NDArray:
    """Return the constant body twist whose exponential is ``displacement``.

    The heading is not wrapped, so a displacement that turns by a whole number of full turns (other
    than zero) and still moves has no logarithm: the result is not finite there and large near it.
    """
    displacement = np.asarray(displacement, float)
    s, c = _sinc_cosc(displacement[..., 2])
    dx, dy = displacement[..., 0], displacement[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (s * s + c * c)
        return np.stack(
            [scale * (s * dx + c * dy), scale * (s * dy - c * dx), displacement[..., 2]], axis=-1
        )


def mid_turn(displacement: ArrayLike) -> NDArray:
    """Return displacements with x and y in their mid-turn frames."""
    displacement = np.asarray(displacement, float)
    dx, dy, turn = (displacement[..., place] for place in range(3))
    cos, sin = np.cos(turn / 2), np.sin(turn / 2)
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, turn], axis=-1)


def chord(turn: ArrayLike) -> NDArray:
    """Return an arc's chord length over the arc's length, below 0 where the chord points back.

    It is sin(turn / 2) / (turn / 2).
    """
    return np.sinc(np.asarray(turn, float) / (2 * np.pi))


def arc_length(displacement: ArrayLike) -> NDArray:
    """Return the length of the constant-twist arc; infinite or very large if no arc exists."""
    displacement = np.asarray(displacement, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.hypot(displacement[..., 0], displacement[..., 1])
        return distance / np.abs(chord(displacement[..., 2]))


def arc(displacement: ArrayLike, fraction: ArrayLike) -> NDArray:
    """Return the pose on the constant-twist arc to ``displacement`` after ``fraction`` of it.

    Shapes broadcast: displacements (..., 3) against fractions (...,).
    """
    return exp(log(displacement) * np.asarray(fraction, float)[..., None])


def wrapped(angle: ArrayLike) -> NDArray:
    """Return angles without whole turns: from -pi, included, to pi."""
    return np.remainder(np.asarray(angle, float) + np.pi, 2 * np.pi) - np.pi


def of_wheels(left: ArrayLike, right: ArrayLike, wheel_base: float) -> NDArray:
    """Return the body twists (..., 3) of a differential drive.

    Args:
        left, right: speeds of the wheels, m/s; or their distances, m, for twists of displacements.
        wheel_base: distance between the wheels, m.
    """
    left, right = np.asarray(left, float), np.asarray(right, float)
    return np.stack([(left + right) / 2, 0.0 * left, (right - left) / wheel_base], axis=-1)


def _sinc_cosc(angle: NDArray) -> tuple[NDArray, NDArray]:
    """Return sin(a)/a and (1 - cos(a))/a, by series near zero."""
    small = np.abs(angle) < 1e-4
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    # 2 sin^2(a/2) rather than 1 - cos(a): no cancellation.
    c = np.where(small, angle / 2.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe)
    return s, c
