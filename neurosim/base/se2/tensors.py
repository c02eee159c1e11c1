"""Planar poses and displacements as PyTorch tensors [..., 3]; see :mod:`neurosim.base.se2`."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def compose(pose: Tensor, displacement: Tensor) -> Tensor:
    """Return the poses reached from ``pose`` by displacements given in its frame."""
    x, y, theta = pose.unbind(-1)
    dx, dy, dtheta = displacement.unbind(-1)
    cos, sin = theta.cos(), theta.sin()
    return torch.stack([x + cos * dx - sin * dy, y + sin * dx + cos * dy, theta + dtheta], dim=-1)


def between(start: Tensor, end: Tensor) -> Tensor:
    """Return the displacements from ``start`` to ``end`` in the frame of ``start``."""
    moved = end - start
    return torch.cat([rotate(-start[..., 2], moved[..., :2]), moved[..., 2:]], dim=-1)


def path(displacements: Tensor) -> Tensor:
    """Return the poses [N + 1, 3] of successive displacements [N, 3], from zero on."""
    theta = torch.cat([displacements.new_zeros(1), displacements[:, 2].cumsum(0)])
    steps = rotate(theta[:-1], displacements[:, :2]).cumsum(0)
    return torch.cat([torch.cat([steps.new_zeros(1, 2), steps]), theta.unsqueeze(1)], dim=1)


def exp(twist: Tensor) -> Tensor:
    """Return the displacements of constant body twists (v_x, v_y, omega) held for unit time."""
    vx, vy, omega = twist.unbind(-1)
    along = chord(omega)
    cos, sin = along * (omega / 2.0).cos(), along * (omega / 2.0).sin()
    return torch.stack([cos * vx - sin * vy, sin * vx + cos * vy, omega], dim=-1)


def mid_turn(displacement: Tensor) -> Tensor:
    """Return displacements with x and y in their mid-turn frames."""
    turn = displacement[..., 2]
    return torch.cat(
        [rotate(-turn / 2.0, displacement[..., :2]), turn.unsqueeze(-1)],
        dim=-1,
    )


def chord(turn: Tensor) -> Tensor:
    """Return the length of an arc's chord over that of the arc: sin(turn / 2) / (turn / 2)."""
    # torch.sinc(t) is sin(pi t) / (pi t).
    return torch.sinc(turn / (2.0 * math.pi))


def rotate(angle: Tensor, vector: Tensor) -> Tensor:
    """Return vectors [..., 2] turned by angles [...], rad."""
    cos, sin = angle.cos(), angle.sin()
    x, y = vector.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
