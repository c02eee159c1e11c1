"""Closed lines in the plane: the distance of points from a line, and their position along it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.base.compiled import njit
from neurosim.base.errors import UserError
from neurosim.base.threads import WORTH_SHARING, on_cores

SHAPES = ("rectangle", "ellipse")

#: Longest straight piece of an arc, m: at a radius of 0.2 m the error is at most 0.25 mm.
_PIECE = 0.02


class ClosedLine:
    """A closed line: a polygon whose last point is joined to its first.

    Attributes:
        points: [N, 2] m, in the board's frame, in driving order.
        length: all the way round, m.
    """

    def __init__(self, points: ArrayLike):
        """Make one of points.

        Raises:
            UserError: if there are fewer than 3, they are not finite, or all are equal.
        """
        corners = np.ascontiguousarray(points, np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise UserError("a closed line needs at least three points, each with x and y (m)")
        if not np.isfinite(corners).all() or np.abs(corners).max() > 1e3:
            raise UserError("the points of a closed line must be finite, and within 1000 m")
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        corners = corners[sides > 1e-9]
        if len(corners) < 3:
            raise UserError("a closed line needs at least three different points")
        self.points: NDArray[np.float64] = corners
        ends = np.roll(corners, -1, axis=0) - corners
        self._sides = np.linalg.norm(ends, axis=1)
        self._until = np.concatenate([[0.0], np.cumsum(self._sides)])
        self._headings = np.arctan2(ends[:, 1], ends[:, 0])
        self.length = float(self._until[-1])

    @classmethod
    def of(cls, shape: str, length: float, width: float, corner: float = 0.0) -> ClosedLine:
        """Make one around the board's middle, counter-clockwise.

        Args:
            shape: one of :data:`SHAPES`.
            length: along x, m.
            width: along y, m.
            corner: radius of a rectangle's corners, m.

        Raises:
            UserError: if a size is impossible.
        """
        if shape not in SHAPES:
            raise UserError(f"a closed line is one of {', '.join(SHAPES)}, not {shape!r}")
        if not (0 < length < 1e3 and 0 < width < 1e3):
            raise UserError(
                f"a closed line needs a length and a width above 0 m, not {length:g} m by "
                f"{width:g} m"
            )
        if shape == "ellipse":
            count = max(math.ceil(math.pi * (length + width) / 2 / _PIECE), 8)
            turn = 2 * np.pi * np.arange(count) / count
            return cls(np.stack([length / 2 * np.cos(turn), width / 2 * np.sin(turn)], axis=1))
        if not 0 <= corner <= min(length, width) / 2:
            raise UserError(
                f"corners of {corner:g} m do not fit into a line of {length:g} m by {width:g} m"
            )
        pieces = max(math.ceil(math.pi / 2 * corner / _PIECE), 1)
        arc = np.pi / 2 * np.arange(pieces + 1) / pieces
        parts = []
        for quarter, (right, upper) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
            middle = np.array([right * (length / 2 - corner), upper * (width / 2 - corner)])
            turn = arc + quarter * np.pi / 2
            parts.append(middle + corner * np.stack([np.cos(turn), np.sin(turn)], axis=1))
        return cls(np.concatenate(parts))

    def nearest(self, places: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distances [...] of points [..., 2] from the line, and positions along it, m."""
        given = np.asarray(places, np.float64)
        flat = np.ascontiguousarray(given.reshape(-1, 2))
        distance, along = np.empty(len(flat)), np.empty(len(flat))

        def part(first: int, last: int) -> None:
            ends = distance[first:last], along[first:last]
            _nearest(self.points, self._sides, self._until, flat[first:last], *ends)

        on_cores(_nearest, part, len(flat), WORTH_SHARING)
        along = np.remainder(along, self.length)  # its end is its beginning
        return distance.reshape(given.shape[:-1]), along.reshape(given.shape[:-1])

    def poses(self, along: ArrayLike, backwards: ArrayLike = False) -> NDArray[np.float64]:
        """Return poses [..., 3] on the line, facing along it, or against it.

        Args:
            along: [...] position along the line, m.
            backwards: [...] whether against its points' order.
        """
        distance = np.remainder(np.asarray(along, np.float64), self.length)
        side = np.clip(np.searchsorted(self._until, distance, "right") - 1, 0, len(self.points) - 1)
        fraction = (distance - self._until[side]) / self._sides[side]
        ends = np.roll(self.points, -1, axis=0)
        place = self.points[side] + fraction[..., None] * (ends[side] - self.points[side])
        heading = self._headings[side] + np.where(backwards, np.pi, 0.0)
        return np.concatenate([place, se2.wrapped(heading)[..., None]], axis=-1)


@njit(error_model="numpy")
def distance_to(points: NDArray[np.float64], x: float, y: float) -> float:
    """Return the distance of a point (m) from the closed line of points [N, 2]."""
    distance, _, _ = _nearest_side(points, x, y)
    return distance


@njit(error_model="numpy")
def _nearest_side(points: NDArray[np.float64], x: float, y: float) -> tuple[float, int, float]:
    """Return a point's distance (m), the nearest side, and the position along it, 0..1."""
    least, side, where = np.inf, 0, 0.0
    for i in range(len(points)):
        j = i + 1 if i + 1 < len(points) else 0
        ax, ay = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
        px, py = x - points[i, 0], y - points[i, 1]
        fraction = min(max((px * ax + py * ay) / (ax * ax + ay * ay), 0.0), 1.0)
        dx, dy = px - fraction * ax, py - fraction * ay
        square = dx * dx + dy * dy
        if square < least:
            least, side, where = square, i, fraction
    return math.sqrt(least), side, where


@njit(nogil=True, error_model="numpy")
def _nearest(
    points: NDArray[np.float64],
    sides: NDArray[np.float64],
    until: NDArray[np.float64],
    places: NDArray[np.float64],
    distance: NDArray[np.float64],
    along: NDArray[np.float64],
) -> None:
    """Write the distances [B] of points [B, 2], and their positions along the line, [B]."""
    for b in range(len(places)):
        distance[b], side, part = _nearest_side(points, places[b, 0], places[b, 1])
        along[b] = until[side] + part * sides[side]
