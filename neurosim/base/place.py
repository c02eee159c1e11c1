"""Places: walls, obstacles, lines, lights and the board around a robot, in one small JSON file.

Lengths are in metres, in a frame with x to the right and y up, its origin in the middle of the
board where there is one. The outline is a closed polygon of walls; further walls stand inside it; a
robot meets their two sides and their ends, which are hard to see. Obstacles are round.
Lines are printed on the floor. The board has an edge and a perimeter line, at which a guard ends
drives (:mod:`neurosim.base.perimeter`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import files, formats
from neurosim.base.closed_line import ClosedLine
from neurosim.base.compiled import njit
from neurosim.base.declared import (
    Checked,
    Coordinate,
    Metres,
    Mismatch,
    Pose,
    SettingError,
    convert,
)
from neurosim.base.errors import FileError, UserError
from neurosim.base.perimeter import Board

FORMAT, VERSION = "neurosim-place", 1
_Part = TypeVar("_Part")
#: Points nearer to each other than this count as one, m.
_SAME = 1e-3
#: Thickness of a wall that stands inside, m.
THICKNESS = 0.01
#: Radius of a light in pictures, m.
_LIGHT = 0.01

Point = tuple[Coordinate, Coordinate]
Wall = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Obstacle = tuple[Coordinate, Coordinate, Metres]


@dataclass(frozen=True)
class Line(Checked):
    """A dark line that is printed on the floor.

    Attributes:
        points: x and y of corners of its middle line, m; straight between them.
        width: width of the line, m.
        closed: whether the last point is joined to the first.
    """

    points: tuple[Point, ...]
    width: Metres = 0.04
    closed: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _rows(self.points))
        super().__post_init__()
        least, kind = (3, "a closed") if self.closed else (2, "an open")
        if len(self.points) < least:
            raise UserError(f"{kind} line needs at least {least} points, found {len(self.points)}")

    @cached_property
    def loop(self) -> ClosedLine:
        """The line as a closed one; an open line leads to its end and back."""
        points = self.points
        if not self.closed:
            back = points[-2:0:-1] or [tuple(np.mean(points, axis=0))]
            points = (*points, *back)
        return ClosedLine(points)

    def shapes(self) -> list[dict[str, Any]]:
        """Return the line's straight pieces as shapes of a picture."""
        points = [*self.points, *self.points[: int(self.closed)]]
        width = self.width
        return [{"polygon": [list(a), list(b)], "width": width} for a, b in pairwise(points)]


@dataclass(frozen=True)
class Place(Checked):
    """A place; every part may be missing.

    Attributes:
        outline: x and y of the corners of the walls around it, m, in order.
        walls: (x1, y1, x2, y2) of walls that stand inside, m, the middles of boards as thick as
            :data:`THICKNESS`.
        obstacles: (x, y, radius) of round obstacles, m.
        lines: lines printed on the floor.
        lights: x and y of lights, m.
        board: the board on the floor, its middle at x = y = 0.
        start: pose at which robots start: x (m), y (m), heading (rad).

    Raises:
        UserError: if a part has no size, is outside of the outline or overlaps another one.
    """

    outline: tuple[Point, ...] = ()
    walls: tuple[Wall, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    lines: tuple[Line, ...] = ()
    lights: tuple[Point, ...] = ()
    board: Board | None = None
    start: Pose | None = None

    def __post_init__(self) -> None:
        for name in ("outline", "walls", "obstacles", "lights"):
            object.__setattr__(self, name, _rows(getattr(self, name)))
        object.__setattr__(self, "lines", tuple(self.lines))
        if self.start is not None:
            object.__setattr__(self, "start", tuple(map(float, self.start)))
        super().__post_init__()
        self._check_walls()
        self._check_obstacles()
        if self.start is not None:
            self.check_start(self.start, 0.0)

    @classmethod
    def rectangle(cls, width: float, height: float, obstacles: Sequence[Obstacle] = ()) -> Place:
        """Return a rectangle of walls about the origin, m."""
        x, y = width / 2, height / 2
        return cls(((-x, -y), (x, -y), (x, y), (-x, y)), obstacles=tuple(obstacles))

    @classmethod
    def with_line(
        cls, shape: str, length: float = 1.4, width: float = 0.8, corner: float = 0.3
    ) -> Place:
        """Return a place with a closed line around the origin, counter-clockwise.

        Args:
            shape: ``rectangle`` with round corners, or ``ellipse``.
            length: of the line along x, m.
            width: of the line along y, m.
            corner: radius of a rectangle's corners, m.

        Raises:
            UserError: if a size is impossible.
        """
        line = ClosedLine.of(shape, length, width, corner)
        return cls(lines=(Line(_rows(np.round(line.points, 6).tolist())),))

    @classmethod
    def of(cls, place: Place | Mapping[str, Any] | str | Path) -> Place:
        """Return a place from a place, a result of :meth:`to_json`, a name or a file.

        Raises:
            SettingError: naming the field of a mapping that is not as declared.
            UserError: if the name is unknown.
            FileError: if a file is not a place.
        """
        if isinstance(place, Place):
            return place
        if isinstance(place, Mapping):
            try:
                convert(place, formats.Place)
            except Mismatch as error:
                raise SettingError(error.field, error.what) from None
            return cls._made(place)
        if str(place) in NAMED:
            return NAMED[str(place)]()
        if Path(place).suffix != ".json":
            raise UserError(
                f"{place}: no such file of a place (.json), and no place of this name; there are "
                f"{', '.join(NAMED)}"
            )
        return cls.read(place)

    @classmethod
    def read(cls, path: str | Path) -> Place:
        """Read and check a place.

        Raises:
            FileError: naming the field of a missing number, an obstacle outside or in another part,
                or a start in a solid part.
        """
        return cls.from_json(path, files.read_json(path, FORMAT, VERSION, formats.Place))

    @classmethod
    def from_json(cls, path: str | Path, content: Mapping[str, Any]) -> Place:
        """Return the place of a checked JSON object in the file ``path``."""
        try:
            return cls._made(content)
        except FileError:
            raise
        except SettingError as error:
            raise FileError(path, error.what, field=error.field) from None
        except UserError as error:
            raise FileError(path, str(error)) from None

    @classmethod
    def _made(cls, content: Mapping[str, Any]) -> Place:
        parts = _known(cls, content)
        if "lines" in parts:
            lines = enumerate(parts["lines"])
            parts["lines"] = tuple(_part(f"lines[{n}]", Line, line) for n, line in lines)
        if "board" in parts:
            # A line that is not written down does not exist.
            parts["board"] = _part("board", Board, {"line_width": 0.0, **parts["board"]})
        return cls(**parts)

    def to_json(self) -> dict[str, Any]:
        """Return the content for :meth:`of`, without missing parts."""
        parts = {name: value for name, value in asdict(self).items() if value not in (None, ())}
        plain: dict[str, Any] = json.loads(json.dumps(parts))  # tuples as lists
        return plain

    def write(self, path: str | Path) -> None:
        """Write the place's file, whole or not at all."""
        files.write_json(path, FORMAT, VERSION, self.to_json())

    def shapes(self) -> list[dict[str, Any]]:
        """Return the place's shapes for a picture, in the form of a task's outline."""
        shapes: list[dict[str, Any]] = []
        if self.board is not None:
            shapes += board_shapes(self.board)
        if self.outline:
            shapes.append({"polygon": [list(corner) for corner in self.outline]})
        for line in self.lines:
            shapes += line.shapes()
        for wall in self.walls:
            shapes.append({"polygon": strip(wall)[:, :2].tolist(), "forbidden": True})
        shapes += ({"circle": list(one), "forbidden": True} for one in self.obstacles)
        return [*shapes, *({"circle": [*light, _LIGHT]} for light in self.lights)]

    @cached_property
    def surfaces(self) -> NDArray[np.float64]:
        """All straight surfaces, [W, 4]: x1, y1, x2, y2, with the free side on the left.

        The outline first, then the four sides of each wall inside.
        """
        outline = self._outline
        x, y = outline[:, 0], outline[:, 1]
        if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:
            outline = outline[:, [2, 3, 0, 1]]
        return np.concatenate([outline, *map(strip, self.walls)])

    @cached_property
    def cylinders(self) -> NDArray[np.float64]:
        """All obstacles, [N, 3]: x, y, radius."""
        return np.array(self.obstacles, float).reshape(-1, 3)

    @property
    def solid(self) -> bool:
        """Whether the place has surfaces that a robot can touch."""
        return bool(self.outline or self.walls or self.obstacles)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x and y, largest x and y, of the outline, else of the board.

        Raises:
            UserError: if it has neither.
        """
        if self.outline:
            corners = np.array(self.outline)
            return (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())
        if self.board is None:
            raise UserError("the place has neither an outline nor a board, so its size is unknown")
        x, y = self.board.length / 2, self.board.width / 2
        return -x, -y, x, y

    @property
    def screens(self) -> NDArray[np.float64]:
        """Walls that may hide objects from a robot inside, [H, 4].

        These are the outline if it is not convex, and the middles of the walls inside.
        """
        sides = self._outline
        edges = sides[:, 2:] - sides[:, :2]
        after = np.roll(edges, -1, axis=0)
        turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
        convex = (turns >= -1e-12).all() or (turns <= 1e-12).all()
        inner = np.array(self.walls, float).reshape(-1, 4)
        return inner if convex else np.concatenate([sides, inner])

    def inside(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return whether points [..., 2] are inside the outline; without one, all are."""
        points, shape = _flat(points)
        inside = np.empty(len(points), np.bool_)
        _write_inside(self._outline, points, inside)
        return inside.reshape(shape)

    def clearance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the distance of points [..., 2] from the nearest surface, m; below 0 in solids."""
        points, shape = _flat(points)
        clearance = np.empty(len(points))
        _write_clearance(self._outline, self.surfaces, self.cylinders, points, clearance)
        return clearance.reshape(shape)

    def check_start(self, pose: ArrayLike, radius: float) -> None:
        """Check that a robot fits at its start.

        Raises:
            UserError: if it would stand outside, or in a wall or an obstacle.
        """
        x, y = np.asarray(pose, float)[:2]
        clearance = float(self.clearance([x, y]))
        if clearance < radius:
            where = "outside the outline" if clearance == -np.inf else "in a wall or an obstacle"
            raise UserError(
                f"the robot cannot start at x {100 * x:.1f} cm, y {100 * y:.1f} cm: it would "
                f"stand {where}"
            )

    def free_poses(
        self, count: int, radius: float, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return random poses [count, 3], uniform over all poses at which a robot touches nothing.

        Raises:
            UserError: if there are hardly any such poses, or the size of the place is unknown.
        """
        x1, y1, x2, y2 = self.bounds
        free = np.empty((0, 2))
        for _ in range(200):
            points = rng.uniform((x1, y1), (x2, y2), (4 * count, 2))
            free = np.concatenate([free, points[self.clearance(points) > radius]])
            if len(free) >= count:
                headings = rng.uniform(-math.pi, math.pi, (count, 1))
                return np.concatenate([free[:count], headings], axis=1)
        raise UserError("there is no room for the robot in this place")

    @cached_property
    def _outline(self) -> NDArray[np.float64]:
        """The sides of the outline, [N, 4], in order."""
        corners = np.array(self.outline, float).reshape(-1, 2)
        return np.hstack([corners, np.roll(corners, -1, axis=0)])

    def _check_walls(self) -> None:
        if 0 < len(self.outline) < 3:
            raise UserError("an outline has at least 3 corners")
        for index, (x1, y1, x2, y2) in enumerate(self._outline):
            if math.dist((x1, y1), (x2, y2)) <= _SAME:
                after = (index + 1) % len(self.outline)
                raise UserError(f"corners {index} and {after} of the outline are the same")
        crossed = np.argwhere(_crossings(self._outline))
        if len(crossed):
            one, other = crossed[0].tolist()
            raise UserError(
                f"the outline crosses itself: the sides after its corners {one} and {other}"
            )
        for index, wall in enumerate(self.walls):
            if math.dist(wall[:2], wall[2:]) <= _SAME:
                raise UserError(f"wall {index} has no length")
            if not self.inside([(wall[0] + wall[2]) / 2, (wall[1] + wall[3]) / 2]):
                raise UserError(f"wall {index} stands outside the outline")

    def _check_obstacles(self) -> None:
        for index, (x, y, radius) in enumerate(self.obstacles):
            if not self.inside((x, y)):
                raise UserError(f"obstacle {index} stands outside the outline")
            if _nearest(self.surfaces, x, y) < radius:
                raise UserError(f"obstacle {index} overlaps a wall")
            for other, (x2, y2, radius2) in enumerate(self.obstacles[:index]):
                if math.hypot(x - x2, y - y2) < radius + radius2:
                    raise UserError(f"obstacle {index} overlaps obstacle {other}")


def paper_arena(scale: float = 1.0) -> Place:
    """Return the arena of Lund and Miglino 1996.

    60 x 35 cm with three round obstacles of 5.5 cm diameter in its middle. The paper does not give
    their positions: here they are in a row, 12 cm apart.

    Args:
        scale: of the arena and of the distances in it, not of the obstacles.
    """
    places = [(scale * x, 0.0, 0.0275) for x in (-0.12, 0.0, 0.12)]
    return Place.rectangle(scale * 0.60, scale * 0.35, places)


def lit_arena() -> Place:
    """Return a room of 80 x 60 cm with a light in a corner behind a wall."""
    return replace(
        Place.rectangle(0.80, 0.60), walls=((0.0, 0.05, 0.15, 0.05),), lights=((0.20, 0.15),)
    )


def cylinder_arena() -> Place:
    """Return a room of 40 x 40 cm with a cylinder of 25 mm diameter, as in evorobotpy2's ErDiscrim.

    There the cylinder has a random position in one half of the room: here it is in the middle of
    it.
    """
    return Place.rectangle(0.40, 0.40, [(0.0, -0.05, 0.0125)])


#: Places by name.
NAMED = {
    "arena": paper_arena,
    "lit-arena": lit_arena,
    "cylinder-arena": cylinder_arena,
    "board": lambda: Place(board=Board()),
    "rectangle": lambda: Place.with_line("rectangle"),
    "ellipse": lambda: Place.with_line("ellipse"),
}


def board_shapes(board: Board) -> list[dict[str, Any]]:
    """Return the shapes of a board in a picture: its edge and its perimeter line."""
    sign = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    half = np.array([board.length, board.width]) / 2
    shapes: list[dict[str, Any]] = [{"polygon": (half * sign).tolist()}]
    if board.line_width:
        corners = ((half - board.line_inset) * sign).tolist()
        shapes += Line(_rows(corners), board.line_width).shapes()
    return shapes


def to_segment(points: NDArray, a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """Return the distances [...] of points [..., 2] from the segments from a to b [..., 2]."""
    # By components: sums over a last axis of 2 would take ten times as long.
    along_x, along_y = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    off_x, off_y = points[..., 0] - a[..., 0], points[..., 1] - a[..., 1]
    square = along_x * along_x + along_y * along_y
    fraction = (off_x * along_x + off_y * along_y) / np.where(square > 0, square, 1.0)
    fraction = np.clip(fraction, 0.0, 1.0)
    x, y = off_x - fraction * along_x, off_y - fraction * along_y
    return np.asarray(np.sqrt(x * x + y * y))


def _flat(points: ArrayLike) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """Return points [..., 2] as [N, 2], and the shape of the other axes."""
    given = np.asarray(points, float)
    return np.ascontiguousarray(given.reshape(-1, 2)), given.shape[:-1]


@njit(nogil=True, error_model="numpy")
def _is_inside(outline: NDArray, x: float, y: float) -> bool:
    """Return whether a point is inside the sides [N, 4] of an outline; without any, it is."""
    inside = len(outline) == 0
    for n in range(len(outline)):
        x1, y1, x2, y2 = outline[n]
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) / (y2 - y1) * (x2 - x1):
            inside = not inside
    return inside


@njit(nogil=True, error_model="numpy")
def _write_inside(outline: NDArray, points: NDArray, inside: NDArray) -> None:
    for n in range(len(points)):
        inside[n] = _is_inside(outline, points[n, 0], points[n, 1])


@njit(nogil=True, error_model="numpy")
def _nearest(surfaces: NDArray, x: float, y: float) -> float:
    """Return a point's distance from the nearest of surfaces [W, 4]."""
    nearest = math.inf
    for w in range(len(surfaces)):
        x1, y1, x2, y2 = surfaces[w]
        along_x, along_y = x2 - x1, y2 - y1
        square = along_x * along_x + along_y * along_y
        part = ((x - x1) * along_x + (y - y1) * along_y) / (square if square > 0.0 else 1.0)
        part = min(max(part, 0.0), 1.0)
        off_x, off_y = x - x1 - part * along_x, y - y1 - part * along_y
        nearest = min(nearest, off_x * off_x + off_y * off_y)
    return math.sqrt(nearest)


@njit(nogil=True, error_model="numpy")
def _write_clearance(
    outline: NDArray, surfaces: NDArray, cylinders: NDArray, points: NDArray, clearance: NDArray
) -> None:
    """Write :meth:`Place.clearance` of points [N, 2]."""
    for n in range(len(points)):
        x, y = points[n]
        if not _is_inside(outline, x, y):
            clearance[n] = -math.inf
            continue
        nearest = _nearest(surfaces, x, y)
        for wall in range(len(outline), len(surfaces), 4):  # the four sides of each wall inside
            behind = True
            for side in range(wall, wall + 4):
                x1, y1, x2, y2 = surfaces[side]
                behind &= (x2 - x1) * (y - y1) < (y2 - y1) * (x - x1)
            if behind:
                nearest = -abs(nearest)
        for c in range(len(cylinders)):
            middle_x, middle_y, radius = cylinders[c]
            nearest = min(nearest, math.hypot(x - middle_x, y - middle_y) - radius)
        clearance[n] = nearest


def _part(field: str, kind: type[_Part], content: Mapping[str, Any]) -> _Part:
    """Return a part of a place.

    Raises:
        SettingError: naming the field in the place.
    """
    try:
        return kind(**_known(kind, content))
    except SettingError as error:
        raise SettingError(f"{field}.{error.field}", error.what) from None
    except UserError as error:
        raise SettingError(field, str(error)) from None


def _crossings(lines: NDArray) -> NDArray[np.bool_]:
    """Return whether straight lines [N, 4] cross each other, [N, N]; touching ends do not count."""
    along = (lines[:, 2:] - lines[:, :2])[:, None]

    def side(points: NDArray) -> NDArray:
        off = points - lines[:, None, :2]
        return along[..., 0] * off[..., 1] - along[..., 1] * off[..., 0]

    apart = side(lines[:, :2]) * side(lines[:, 2:]) < 0
    return np.asarray(apart & apart.T)


def _known(kind: type, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the items of a mapping that are fields of a dataclass.

    Raises:
        UserError: if it has other names, such as a misspelt one.
    """
    names = [one.name for one in fields(kind)]
    for name in content:
        if name not in (*names, "format", "version"):
            raise UserError(f"there is no {name!r:.40}; expected {', '.join(names)}")
    return {name: content[name] for name in names if content.get(name) is not None}


def _rows(rows: Any) -> Any:
    """Return rows of numbers as tuples of floats; other values are left to a later check."""
    try:
        return tuple(tuple(map(float, row)) for row in rows)
    except (TypeError, ValueError):
        return tuple(rows)


def strip(line: ArrayLike, width: float = THICKNESS) -> NDArray[np.float64]:
    """Return the sides [4, 4] of a straight piece x1, y1, x2, y2, with free space on their left."""
    one, other = np.reshape(line, (2, 2))
    along = other - one
    aside = 0.5 * width * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    corners = np.array([one + aside, other + aside, other - aside, one - aside])
    return np.hstack([corners, np.roll(corners, -1, axis=0)])
