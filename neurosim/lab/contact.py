"""What a virtual robot runs into."""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True)
def deepest(x, y, size, walls, cylinders):
    """Return the deepest contact of a disc: its depth (m) and the direction out of it.

    Args:
        x, y: its middle, m.
        size: its radius, m.
        walls: [W, 4] m.
        cylinders: [N, 3] m.
    """
    depth, nx, ny = -1.0, 0.0, 0.0
    for i in range(walls.shape[0]):
        x1, y1 = walls[i, 0], walls[i, 1]
        dx, dy = walls[i, 2] - x1, walls[i, 3] - y1
        share = ((x - x1) * dx + (y - y1) * dy) / (dx * dx + dy * dy)
        share = max(0.0, min(1.0, share))
        ox, oy = x - x1 - share * dx, y - y1 - share * dy
        away = math.hypot(ox, oy)
        if size - away > depth:
            depth = size - away
            nx, ny = (ox / away, oy / away) if away > 0.0 else (1.0, 0.0)
    for i in range(cylinders.shape[0]):
        ox, oy = x - cylinders[i, 0], y - cylinders[i, 1]
        away = math.hypot(ox, oy)
        into = size + cylinders[i, 2] - away
        if into > depth:
            depth = into
            nx, ny = (ox / away, oy / away) if away > 0.0 else (1.0, 0.0)
    return depth, nx, ny
