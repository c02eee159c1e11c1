"""A place that is drawn by clicks on the floor, part by part."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from neurosim.base.errors import UserError
from neurosim.base.perimeter import Board
from neurosim.base.place import Line, Place, Point

#: Meaning of each click on a part, in order; the same for all clicks on parts in ANY_NUMBER.
PARTS = {
    "outline": ("a corner",),
    "wall": ("one end", "the other end"),
    "cylinder": ("the middle", "the edge"),
    "box": ("a corner", "the next corner", "the side across"),
    "line": ("a point on the middle of the line",),
    "closed line": ("a point on the middle of the line",),
    "light": ("the light",),
    "start": ("the middle of the robot", "a point straight ahead of it"),
    "perimeter": ("the middle of the board's line",),
}
#: Parts with any number of clicks, which end with :meth:`Sketch.finish`.
ANY_NUMBER = ("outline", "line", "closed line")
#: Parts that have a width.
LINES = ("line", "closed line", "perimeter")


class Sketch:
    """A place, and the clicks on its next part.

    Args:
        place: the first place.

    Attributes:
        part: the part that is being drawn; empty: none.
        points: its clicked points, m.
    """

    def __init__(self, place: Place):
        self._versions = [place]
        self.part = ""
        self.points: list[Point] = []

    @property
    def place(self) -> Place:
        """The place as drawn so far."""
        return self._versions[-1]

    def set_board(self, length: float, width: float) -> None:
        """Set the board's measures, m; its line keeps its distance from the edge."""
        usual, given = Board(line_width=0.0), {"length": length, "width": width}
        self._versions = [
            replace(one, board=replace(one.board or usual, **given)) for one in self._versions
        ]

    def click(self, part: str, point: Point, width: float) -> str:
        """Take a click for a part, a key of :data:`PARTS`; return a message.

        Args:
            part: the part that is drawn.
            point: x and y, m.
            width: of lines, m.

        Raises:
            UserError: if another part is not finished, or the part is impossible there; this click
                is then dropped.
        """
        if self.points and part != self.part:
            raise UserError(f"finish the {self.part} first, or undo its clicks")
        points = [*self.points, point]
        if part not in ANY_NUMBER and len(points) == len(PARTS[part]):
            return self._add(part, points, width)
        self.part, self.points = part, points
        marks = PARTS[part]
        message = f"{part}: {_where(point)}; next: {marks[min(len(points), len(marks) - 1)]}"
        return f"{message}, or finish" if part in ANY_NUMBER else message

    def finish(self, width: float) -> str:
        """End a part with any number of clicks; return a message.

        Raises:
            UserError: if there is none, or it has too few clicks; it can then be continued.
        """
        if not self.points:
            raise UserError("there is nothing to finish: choose a part and click on it first")
        if self.part not in ANY_NUMBER:
            raise UserError(f"the {self.part} is finished by a click on {self._missing()}")
        return self._add(self.part, self.points, width)

    def undo(self) -> str:
        """Undo the last click, or the last part; return a message.

        Raises:
            UserError: if there is none.
        """
        if self.points:
            self.points = self.points[:-1]
            return f"the last click on the {self.part} is undone"
        if len(self._versions) == 1:
            raise UserError("there is nothing to undo")
        self._versions.pop()
        return "the last part is undone"

    def _missing(self) -> str:
        return PARTS[self.part][len(self.points)]

    def _add(self, part: str, points: list[Point], width: float) -> str:
        self._versions.append(_with(self.place, part, points, width))
        self.part, self.points = "", []
        return f"the {part} is drawn; click on the next part, or save the place"


def _with(place: Place, part: str, points: list[Point], width: float) -> Place:
    """Return a place with one more part, or with a replaced part of which only one can exist."""
    first, last = points[0], points[-1]
    if part in LINES and not width > 0:
        raise UserError("type the width of the line first: a number of metres, such as 0.02")
    if part == "outline":
        return replace(place, outline=tuple(points))
    if part == "wall":
        return replace(place, walls=(*place.walls, (*first, *last)))
    if part == "cylinder":
        if first == last:
            raise UserError("the cylinder has no radius: click on its edge")
        return replace(place, obstacles=(*place.obstacles, (*first, math.dist(first, last))))
    if part == "box":
        corners = _box(*points)
        sides = tuple((*a, *b) for a, b in pairwise([*corners, corners[0]]))
        return replace(place, walls=(*place.walls, *sides))
    if part in LINES[:2]:
        line = Line(tuple(points), width, part == "closed line")
        return replace(place, lines=(*place.lines, line))
    if part == "light":
        return replace(place, lights=(*place.lights, first))
    if part == "start":
        if first == last:
            raise UserError("a start needs a point straight ahead of the robot's middle")
        heading = math.atan2(last[1] - first[1], last[0] - first[0])
        return replace(place, start=(*first, round(heading, 4)))
    board = place.board or Board()
    inset = min(board.length / 2 - abs(first[0]), board.width / 2 - abs(first[1]))
    if inset < 0:
        raise UserError("the board's line is outside the board")
    return replace(place, board=replace(board, line_inset=round(inset, 4), line_width=width))


def _box(one: Point, other: Point, across: Point) -> list[Point]:
    """Return the corners of a rectangle: two of them, and a point on the side across."""
    along, off = np.subtract(other, one), np.subtract(across, one)
    length = float(np.linalg.norm(along))
    if length == 0:
        raise UserError("two corners of the box are the same")
    aside = np.array([-along[1], along[0]]) / length
    depth = float(off @ aside)
    if depth == 0:
        raise UserError("the box has no depth: click on the side across")
    corners = np.array([one, other, other + depth * aside, one + depth * aside])
    return [(float(x), float(y)) for x, y in corners.round(4)]


def _where(point: Point) -> str:
    return f"x {100 * point[0]:.1f} cm, y {100 * point[1]:.1f} cm"
