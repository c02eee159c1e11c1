"""Arenas: straight walls at any angle and round obstacles, in one small JSON file.

Lengths are in metres, in a frame with x to the right and y up. The outline is a closed polygon
of walls, each beginning where the one before ends; further walls may stand inside it. These are
boards: a robot meets their two sides and, less well seen, their ends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import files, formats
from neurosim.base.errors import FileError, UserError

FORMAT, VERSION = "neurosim-arena", 1
#: Walls, or obstacles, at most.
#: Ends of walls may be so far apart and still meet, m.
_TOUCHING = 1e-3
#: Metres and radians beyond this are a mistake.
#: Thickness of a wall that stands inside, m.
THICKNESS = 0.01

Wall = tuple[float, float, float, float]
Obstacle = tuple[float, float, float]


@dataclass(frozen=True)
class Arena:
    """Walls and round obstacles.

    Attributes:
        outline: (x1, y1, x2, y2) of the walls around it, m, in order.
        obstacles: (x, y, radius), m.
        inner: walls that stand inside, the middles of boards as thick as :data:`THICKNESS`.
        start: a pose (m, m, rad) that pictures and trials may start from, or None.
    """

    outline: tuple[Wall, ...]
    obstacles: tuple[Obstacle, ...] = ()
    inner: tuple[Wall, ...] = ()
    start: tuple[float, float, float] | None = None
    _corners: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_corners", np.array([wall[:2] for wall in self.outline]))
        self._check_walls()
        self._check_obstacles()

    @classmethod
    def rectangle(cls, width: float, height: float, obstacles: Sequence[Obstacle] = ()) -> Arena:
        """Return a rectangle about the origin, m."""
        x, y = width / 2, height / 2
        corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
        walls = [(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
        return cls(tuple(walls), tuple(obstacles))

    @classmethod
    def read(cls, path: str | Path) -> Arena:
        """Read and check an arena.

        Raises:
            FileError: naming the field: a number that is missing, walls that do not close, an
                obstacle that is outside or overlaps something, a start in something solid.
        """
        return cls.from_json(path, files.read_json(path, FORMAT, VERSION, formats.Arena))

    @classmethod
    def from_json(cls, path: str | Path, content: dict[str, Any]) -> Arena:
        """Return the arena of a checked JSON object in the file ``path``."""
        rows: dict[str, Any] = {
            name: tuple(tuple(map(float, row)) for row in content.get(name) or ())
            for name in ("outline", "inner", "obstacles")
        }
        if content.get("start") is not None:
            rows["start"] = tuple(map(float, content["start"]))
        try:
            return cls(**rows)
        except UserError as error:
            raise FileError(path, str(error)) from None

    def to_json(self) -> dict[str, Any]:
        """Return what :meth:`from_json` reads."""
        rows = {name: [list(row) for row in getattr(self, name)] for name in ("outline", "inner")}
        found = {**rows, "obstacles": [list(row) for row in self.obstacles]}
        return found if self.start is None else {**found, "start": list(self.start)}

    def write(self, path: str | Path) -> None:
        """Write the arena's file, whole or not at all."""
        files.write_json(path, FORMAT, VERSION, self.to_json())

    def shapes(self) -> list[dict[str, Any]]:
        """Return what a picture of it shows, as of a task's outline."""
        floor = {"polygon": [list(wall[:2]) for wall in self.outline]}
        inner = [
            {"polygon": _sides(wall)[:, :2].tolist(), "forbidden": True} for wall in self.inner
        ]
        return [floor, *inner, *({"circle": list(o), "forbidden": True} for o in self.obstacles)]

    @property
    def walls(self) -> NDArray[np.float64]:
        """All surfaces, [W, 4]: x1, y1, x2, y2, with the free side on the left.

        The outline first, then the four sides of each board.
        """
        outline = np.array(self.outline, float).reshape(-1, 4)
        x, y = self._corners.T
        if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:
            outline = outline[:, [2, 3, 0, 1]]
        return np.concatenate([outline, *map(_sides, self.inner)])

    @property
    def cylinders(self) -> NDArray[np.float64]:
        """All obstacles, [N, 3]: x, y, radius."""
        return np.array(self.obstacles, float).reshape(-1, 3)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x and y, largest x and y."""
        low, high = self._corners.min(axis=0), self._corners.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    @property
    def screens(self) -> NDArray[np.float64]:
        """Walls that may stand between a robot inside and something else, [H, 4].

        The outline where it is not convex, and the middles of the boards.
        """
        edges = np.roll(self._corners, -1, axis=0) - self._corners
        after = np.roll(edges, -1, axis=0)
        turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
        convex = (turns >= -1e-12).all() or (turns <= 1e-12).all()
        return np.array([*(() if convex else self.outline), *self.inner], float).reshape(-1, 4)

    def inside(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return whether points [..., 2] lie within the outline."""
        points = np.asarray(points, float)
        x, y = points[..., None, 0], points[..., None, 1]
        x1, y1, x2, y2 = np.array(self.outline).T
        crosses = (y1 > y) != (y2 > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            left_of = x < x1 + (y - y1) / (y2 - y1) * (x2 - x1)
        return (crosses & left_of).sum(-1) % 2 == 1

    def clearance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return how far points [..., 2] are from the nearest surface, m; below 0 in solids."""
        points = np.asarray(points, float)
        found = _wall_distances(self.walls, points).min(axis=-1)
        if self.obstacles:
            x, y, radius = self.cylinders.T
            to = np.hypot(points[..., None, 0] - x, points[..., None, 1] - y) - radius
            found = np.minimum(found, to.min(axis=-1))
        return np.where(self.inside(points), found, -np.inf)

    def check_start(self, pose: ArrayLike, radius: float) -> None:
        """Make sure that a robot fits where it is to start.

        Raises:
            UserError: if it would stand outside, or in a wall or an obstacle.
        """
        x, y = np.asarray(pose, float)[:2]
        clearance = float(self.clearance([x, y]))
        if clearance < radius:
            where = "outside the arena" if clearance == -np.inf else "in a wall or an obstacle"
            raise UserError(
                f"the robot cannot start at x {100 * x:.1f} cm, y {100 * y:.1f} cm: it would "
                f"stand {where}"
            )

    def free_poses(
        self, count: int, radius: float, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return poses [count, 3] drawn evenly from all where a robot touches nothing.

        Raises:
            UserError: if there is hardly such a place.
        """
        x1, y1, x2, y2 = self.bounds
        found = np.empty((0, 2))
        for _ in range(200):
            points = rng.uniform((x1, y1), (x2, y2), (4 * count, 2))
            found = np.concatenate([found, points[self.clearance(points) > radius]])
            if len(found) >= count:
                headings = rng.uniform(-math.pi, math.pi, (count, 1))
                return np.concatenate([found[:count], headings], axis=1)
        raise UserError("there is no room for the robot in this arena")

    def _check_walls(self) -> None:
        if len(self.outline) < 3:
            raise UserError("the walls do not close: an outline has at least 3")
        for index, wall in enumerate(self.outline):
            after = self.outline[(index + 1) % len(self.outline)]
            gap = math.dist(wall[2:], after[:2])
            if gap > _TOUCHING:
                raise UserError(
                    f"the walls do not close: wall {index} of the outline ends {100 * gap:.1f} cm "
                    f"from where wall {(index + 1) % len(self.outline)} begins"
                )
        for index, wall in enumerate([*self.outline, *self.inner]):
            if math.dist(wall[:2], wall[2:]) <= _TOUCHING:
                raise UserError(f"wall {index} has no length")
        for index, wall in enumerate(self.inner):
            middle = ((wall[0] + wall[2]) / 2, (wall[1] + wall[3]) / 2)
            if not self.inside(middle):
                raise UserError(f"inner wall {index} stands outside the outline")

    def _check_obstacles(self) -> None:
        for index, (x, y, radius) in enumerate(self.obstacles):
            if radius <= 0:
                raise UserError(f"obstacle {index} has a radius of {radius:g} m")
            if not self.inside((x, y)):
                raise UserError(f"obstacle {index} stands outside the outline")
            if _wall_distances(self.walls, np.array([x, y])).min() < radius:
                raise UserError(f"obstacle {index} overlaps a wall")
            for other, (x2, y2, radius2) in enumerate(self.obstacles[:index]):
                if math.hypot(x - x2, y - y2) < radius + radius2:
                    raise UserError(f"obstacle {index} overlaps obstacle {other}")


def paper_arena() -> Arena:
    """Return the arena of Lund and Miglino 1996.

    60 x 35 cm with three round obstacles of 5.5 cm across in its middle; the paper does not say
    how they stand: here in a row, 12 cm apart.
    """
    return Arena.rectangle(0.60, 0.35, [(x, 0.0, 0.0275) for x in (-0.12, 0.0, 0.12)])


def _sides(wall: Wall) -> NDArray[np.float64]:
    """Return the four sides [4, 4] of a board, which have what is free on their left."""
    one, other = np.array(wall).reshape(2, 2)
    along = other - one
    aside = 0.5 * THICKNESS * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    corners = np.array([one + aside, other + aside, other - aside, one - aside])
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def _wall_distances(walls: NDArray, points: NDArray) -> NDArray[np.float64]:
    """Return the distances [..., W] of points [..., 2] from walls [W, 4]."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    off = points[..., None, :] - start
    share = np.clip((off * along).sum(-1) / (along * along).sum(-1), 0.0, 1.0)
    return np.linalg.norm(off - share[..., None] * along, axis=-1)
