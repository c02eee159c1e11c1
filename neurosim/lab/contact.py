"""Walls and obstacles of the lab: contacts of a robot with them, and their distances."""

from __future__ import annotations

import math

import numpy as np

from neurosim.base.compiled import njit


@njit
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
        fraction = ((x - x1) * dx + (y - y1) * dy) / (dx * dx + dy * dy)
        fraction = max(0.0, min(1.0, fraction))
        ox, oy = x - x1 - fraction * dx, y - y1 - fraction * dy
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


@njit
def hit(x, y, cos, sin, walls, cylinders):
    """Return a ray's distance to the nearest surface (m) and its cosine of incidence there.

    Args:
        x, y: where the ray begins, m.
        cos, sin: of its direction.
        walls: [W, 4] m.
        cylinders: [N, 3] m.

    Returns:
        Infinity and 0 if there is none.
    """
    best, incidence = np.inf, 0.0
    for i in range(walls.shape[0]):
        x1, y1 = walls[i, 0], walls[i, 1]
        dx, dy = walls[i, 2] - x1, walls[i, 3] - y1
        cross = cos * dy - sin * dx
        if cross == 0.0:
            continue
        far = ((x1 - x) * dy - (y1 - y) * dx) / cross
        fraction = ((x1 - x) * sin - (y1 - y) * cos) / cross
        if 0.0 < far < best and 0.0 <= fraction <= 1.0:
            best, incidence = far, abs(cross) / math.hypot(dx, dy)
    for i in range(cylinders.shape[0]):
        ox, oy, radius = cylinders[i, 0] - x, cylinders[i, 1] - y, cylinders[i, 2]
        along = ox * cos + oy * sin
        inside = along * along - ox * ox - oy * oy + radius * radius
        if inside <= 0.0:
            continue
        far = along - math.sqrt(inside)
        if 0.0 < far < best:
            best, incidence = far, math.sqrt(inside) / radius
    return best, incidence


@njit
def distances(origins, directions, walls, cylinders):
    """Return the distance of the nearest surface along rays, [N] m; infinity: there is none.

    Args:
        origins: [N, 2] of the rays, m.
        directions: [N] rad.
        walls: [W, 4] m.
        cylinders: [N, 3] m.
    """
    distances = np.empty(len(directions))
    for i in range(len(directions)):
        cos, sin = math.cos(directions[i]), math.sin(directions[i])
        distances[i], _ = hit(origins[i, 0], origins[i, 1], cos, sin, walls, cylinders)
    return distances
