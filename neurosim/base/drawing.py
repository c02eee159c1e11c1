"""A place from a drawing in SVG.

The name of an element, or of the nearest named group around it, gives its meaning: its ``id``, its
``class`` or the label of its layer (``inkscape:label``). Names are those of the parts of a place,
in the singular or the plural; a number may follow: ``outline``, ``walls``, ``obstacles``,
``lines``, ``lights``, ``board``, ``perimeter``, ``start``. An element named ``scale-50cm`` is 50 cm
long; without one, the page's size gives the scale. All other elements are ignored.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from fontTools.misc.transform import Identity, Transform
from fontTools.pens.recordingPen import RecordingPen
from fontTools.svgLib.path.parser import parse_path
from numpy.typing import NDArray

from neurosim.base.errors import FileError, UserError
from neurosim.base.files import read_text
from neurosim.base.perimeter import Board
from neurosim.base.place import Line, Place

#: Largest size of a drawing, bytes.
MOST = 16 * 2**20
#: Number of straight pieces of a curve.
PIECES = 16
#: Points nearer than this count as one, m; also the tolerance of a rectangle's sides.
NEAR = 1e-3
#: A closed curve is a circle if its radii differ from their mean by less than this fraction.
ROUND = 0.02

_PART = re.compile(
    r"(outline|board|perimeter|start|wall|obstacle|line|light)s?(?:[-_ .]?\d+)?", re.IGNORECASE
)
_SCALE = re.compile(r"scale[-_ ]?(\d+(?:\.\d+)?)[-_ ]?(mm|cm|m)", re.IGNORECASE)
_PAGE = re.compile(r"\s*(\d+\.?\d*)\s*(mm|cm|in)\s*")
_METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}
_LENGTH = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*(px|mm|cm|in|pt|pc)?\s*$", re.I
)
#: Units of length of SVG, in user units.
_UNITS = {"": 1.0, "px": 1.0, "in": 96.0, "cm": 96 / 2.54, "mm": 96 / 25.4, "pt": 4 / 3, "pc": 16.0}
_FUNCTION = re.compile(r"(\w+)\s*\(([^()]*)\)")
#: Elements whose contents are not drawn at their position.
_HIDDEN = {"defs", "symbol", "clippath", "mask", "marker", "pattern", "metadata"}


@dataclass(frozen=True)
class _Stroke:
    """A piece of a drawing.

    Attributes:
        part: name of the part of a place, or ``scale``.
        name: of the element, for messages.
        points: [N, 2] in the drawing's units.
        closed: whether the last is joined to the first.
        width: of its stroke, in the drawing's units; None: unknown.
        metres: length of a ``scale``.
    """

    part: str
    name: str
    points: NDArray[np.float64]
    closed: bool
    width: float | None = None
    metres: float = 0.0

    @property
    def middle(self) -> NDArray[np.float64]:
        """The middle [2] of the box around it."""
        return (self.points.min(axis=0) + self.points.max(axis=0)) / 2


def read_drawing(path: str | Path) -> tuple[Place, list[str]]:
    """Return the place that a drawing shows, and sentences on what was added to it.

    x points to the right and y up. The origin is the middle of the board, else of the outline,
    else of everything. An outline and obstacles that are open are closed; a line without a stroke
    width has the usual one.

    Raises:
        FileError: if the file is not a drawing, has no parts of a place, has no size, or a part is
            wrong.
    """
    text = read_text(path, "a drawing in SVG, in UTF-8", most=MOST)
    if "<!ENTITY" in text.upper():
        raise FileError(path, "defines entities of its own; save it as plain SVG")
    try:
        root = ElementTree.fromstring(text.encode())
    except ElementTree.ParseError as error:
        raise FileError(path, f"is not XML ({error.msg})", line=error.position[0]) from None
    if _tag(root) != "svg":
        raise FileError(path, f"expected a drawing in SVG, found <{_tag(root)}>")
    try:
        strokes = list(_strokes(root, Identity, "", None))
        scaled = _in_metres(strokes, _page_scale(root))
        return _place(scaled), list(_added(scaled))
    except FileError:
        raise
    except UserError as error:
        raise FileError(path, str(error)) from None
    except RecursionError:
        raise FileError(path, "its groups are nested too deeply; ungroup them") from None


def _strokes(element: Any, outer: Transform, part: str, width: float | None) -> Iterator[_Stroke]:
    """Give the named pieces of an element and of all elements inside."""
    tag = _tag(element)
    style = dict(
        entry.split(":", 1) for entry in element.get("style", "").split(";") if ":" in entry
    )
    style = {name.strip(): value.strip() for name, value in style.items()}
    if tag in _HIDDEN or "none" in (element.get("display"), style.get("display")):
        return
    label = next((value for key, value in element.items() if key.endswith("}label")), None)
    names = [element.get("id"), label, *(element.get("class") or "").split()]
    part = next((named for name in names if name and (named := _part_of(name))), part)
    own = style.get("stroke-width", element.get("stroke-width"))
    width = width if own is None else _length(own, "stroke-width")
    transform = outer.transform(_transform(element.get("transform", "")))
    name = element.get("id") or label or f"<{tag}>"
    if part and tag in ("text", "image", "tspan"):
        raise UserError(f"{name} ({part}) is a <{tag}>: draw a shape, or turn it into a path")
    if part and (data := _path_data(element, tag, name)):
        scale = math.sqrt(abs(transform.xx * transform.yy - transform.xy * transform.yx))
        metres = 0.0
        if match := _SCALE.fullmatch(part):
            metres = float(match[1]) * _METRES[match[2].lower()]
        for points, closed in _flattened(data, transform, name):
            thick = None if width is None else width * scale
            yield _Stroke("scale" if metres else part, name, points, closed, thick, metres)
    for child in element:
        yield from _strokes(child, transform, part, width)


def _part_of(name: str) -> str | None:
    """Return the part of a place that a name denotes; for a scale, the name."""
    if _SCALE.fullmatch(name):
        return name
    if name.lower().startswith("scale-"):
        raise UserError(f"{name} is not a length such as scale-50cm")
    match = _PART.fullmatch(name)
    return match[1].lower() if match else None


def _path_data(element: Any, tag: str, name: str) -> str:
    """Return an element as path data; empty if it has no line."""

    def at(key: str, usual: str = "0") -> float:
        return _length(element.get(key, usual), f"{key} of {name}")

    if tag == "path":
        return str(element.get("d", ""))
    if tag in ("polygon", "polyline"):
        points = element.get("points", "").strip()
        return f"M{points}{'z' if tag == 'polygon' else ''}" if points else ""
    if tag == "line":
        return f"M{at('x1')!r},{at('y1')!r} L{at('x2')!r},{at('y2')!r}"
    if tag in ("circle", "ellipse"):
        x, y = at("cx"), at("cy")
        across, down = (at("r"), at("r")) if tag == "circle" else (at("rx"), at("ry"))
        if min(across, down) <= 0:
            raise UserError(f"{name} has a radius that is not above 0")
        half = f"A{across!r},{down!r} 0 0 1"
        return f"M{x - across!r},{y!r} {half} {x + across!r},{y!r} {half} {x - across!r},{y!r}z"
    if tag == "rect":
        x, y, wide, high = at("x"), at("y"), at("width"), at("height")
        across = at("rx", element.get("ry", "0"))
        down = at("ry", element.get("rx", "0"))
        across, down = min(across, wide / 2), min(down, high / 2)
        turn = f"A{across!r},{down!r} 0 0 1" if across and down else "L"
        return (
            f"M{x + across!r},{y!r} H{x + wide - across!r} {turn} {x + wide!r},{y + down!r} "
            f"V{y + high - down!r} {turn} {x + wide - across!r},{y + high!r} "
            f"H{x + across!r} {turn} {x!r},{y + high - down!r} V{y + down!r} "
            f"{turn} {x + across!r},{y!r}z"
        )
    if tag == "use":
        raise UserError(f"{name} is a copy of another element: make it an object of its own")
    return ""


def _flattened(
    data: str, transform: Transform, name: str
) -> Iterator[tuple[NDArray[np.float64], bool]]:
    """Give the pieces of a path's data: points [N, 2], and whether they are closed."""
    pen = RecordingPen()
    try:
        parse_path(data, pen)
    except Exception:
        raise UserError(f"the path of {name} cannot be read: {data:.40}") from None
    fraction = np.linspace(0.0, 1.0, PIECES + 1)[1:, None]
    points: list[NDArray[np.float64]] = []
    for what, given in pen.value:
        ends = np.array([transform.transformPoint(point) for point in given]).reshape(-1, 2)
        if not np.isfinite(ends).all():
            raise UserError(f"the path of {name} has numbers that are not finite")
        if what == "moveTo":
            points = [ends]
        elif what == "lineTo":
            points.append(ends)
        elif what in ("curveTo", "qCurveTo"):
            # De Casteljau, all pieces at once.
            row = [np.tile(points[-1][-1], (PIECES, 1)), *(np.tile(e, (PIECES, 1)) for e in ends)]
            while len(row) > 1:
                row = [a + fraction * (b - a) for a, b in pairwise(row)]
            points.append(row[0])
        elif points:  # closePath, endPath
            yield np.concatenate(points), what == "closePath"
            points = []


def _in_metres(strokes: list[_Stroke], page: float | None) -> list[_Stroke]:
    """Return the strokes in metres, y up, without the scale and without repeated points."""
    scales = [stroke for stroke in strokes if stroke.part == "scale"]
    strokes = [stroke for stroke in strokes if stroke.part != "scale"]
    if not strokes:
        raise UserError(
            "no element is named as a part of a place: name elements or layers outline, walls, "
            "obstacles, lines, lights, board, perimeter or start"
        )
    if len(scales) > 1:
        raise UserError("there are several scales: leave one")
    if scales:
        length = float(np.ptp(scales[0].points, axis=0).max())
        if not scales[0].closed:
            length = float(np.linalg.norm(scales[0].points[-1] - scales[0].points[0]))
        if length <= 0:
            raise UserError(f"{scales[0].name} has no length")
        page = scales[0].metres / length
    if page is None:
        raise UserError(
            "the drawing has no size: add a line of a known length and name it, such as "
            "scale-50cm, or give the page's width in mm"
        )
    scaled = []
    for stroke in strokes:
        points = _thinned(stroke.points * (page, -page))
        closed = stroke.closed
        if len(points) > (1 if closed else 3) and np.linalg.norm(points[-1] - points[0]) <= NEAR:
            points, closed = points[:-1], True
        if len(points) < 2 and stroke.part != "light":
            raise UserError(f"{stroke.name} ({stroke.part}) is smaller than {1000 * NEAR:g} mm")
        width = None if stroke.width is None else page * stroke.width
        scaled.append(replace(stroke, points=points, closed=closed, width=width))
    return scaled


def _thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points [N, 2] without those within NEAR of the last one kept."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) > NEAR:
            kept.append(point)
    return np.array(kept)


def _page_scale(root: Any) -> float | None:
    """Return metres per unit by the width of the drawing's page; None: it has no width."""
    match = _PAGE.fullmatch(root.get("width", ""))
    if match is None:
        return None
    try:
        box = [
            float(value) for value in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if value
        ]
    except ValueError:
        raise UserError(f"viewBox is not four numbers: {root.get('viewBox')!r:.40}") from None
    if not box:
        return _METRES["in"] / 96
    if len(box) != 4 or min(box[2:]) <= 0:
        raise UserError(f"viewBox is not four numbers: {root.get('viewBox')!r:.40}")
    scale = float(match[1]) * _METRES[match[2]] / box[2]
    # The drawing has the largest scale that fits both directions.
    if match := _PAGE.fullmatch(root.get("height", "")):
        scale = min(scale, float(match[1]) * _METRES[match[2]] / box[3])
    return scale


def _place(strokes: list[_Stroke]) -> Place:
    """Return the place of strokes in metres."""
    of: dict[str, list[_Stroke]] = {}
    for stroke in strokes:
        of.setdefault(stroke.part, []).append(stroke)
    for part in ("outline", "board", "perimeter", "start"):
        if len(of.get(part, [])) > 1:
            raise UserError(f"there are several elements named {part}: leave one")
    around = of.get("board") or of.get("outline") or strokes
    every = np.concatenate([stroke.points for stroke in around])
    origin = (every.min(axis=0) + every.max(axis=0)) / 2
    moved = {
        part: [replace(one, points=np.round(one.points - origin, 6)) for one in those]
        for part, those in of.items()
    }
    walls, obstacles = list(moved.get("wall", [])), []
    for stroke in moved.get("obstacle", []):
        radius = _radius(stroke)
        if radius is None:
            walls.append(replace(stroke, closed=True))
        else:
            obstacles.append((*_row(stroke.middle), radius))
    lines = tuple(
        Line(_rows(one.points), **({} if one.width is None else {"width": one.width}),
             closed=one.closed)
        for one in moved.get("line", [])
    )  # fmt: skip
    return Place(
        outline=_rows(moved["outline"][0].points) if "outline" in moved else (),
        walls=tuple(side for wall in walls for side in _sides(wall)),
        obstacles=tuple(obstacles),
        lines=lines,
        lights=tuple(_row(one.middle) for one in moved.get("light", [])),
        board=_board(of),
        start=_start(moved["start"][0]) if "start" in moved else None,
    )


def _added(strokes: list[_Stroke]) -> Iterator[str]:
    """Give a sentence about each stroke (in metres) that is completed."""
    usual = {"line": Line.width, "perimeter": Board.line_width}
    for one in strokes:
        if one.part in usual and one.width is None:
            width = f"{100 * usual[one.part]:g} cm"
            yield f"{one.name} ({one.part}) has no stroke width: {width} is used"
        if one.part in ("outline", "obstacle") and not one.closed:
            yield f"{one.name} ({one.part}) is open: its last point is joined to its first"


def _board(of: dict[str, list[_Stroke]]) -> Board | None:
    if "board" not in of:
        if "perimeter" in of:
            raise UserError("a perimeter needs a board around it: name that board")
        return None
    length, width = _rectangle(of["board"][0])
    if "perimeter" not in of:
        return Board(length, width, line_width=0.0)
    line = of["perimeter"][0]
    inner = _rectangle(line)
    insets = (length - inner[0]) / 2, (width - inner[1]) / 2
    apart = np.abs(line.middle - of["board"][0].middle).max()
    if min(insets) < 0 or max(abs(insets[0] - insets[1]), apart) > 5 * NEAR:
        raise UserError("the perimeter must have the same distance from all edges of the board")
    usual = Board.line_width if line.width is None else line.width
    return Board(length, width, line_inset=round(sum(insets) / 2, 6), line_width=round(usual, 6))


def _rectangle(stroke: _Stroke) -> tuple[float, float]:
    """Return the sides of an upright rectangle, m."""
    sides = np.ptp(stroke.points, axis=0)
    off = np.abs(np.abs(stroke.points - stroke.middle) - sides / 2).max(axis=-1)
    if len(stroke.points) != 4 or off.max() > NEAR:
        raise UserError(f"{stroke.name} ({stroke.part}) is not an upright rectangle")
    return round(float(sides[0]), 6), round(float(sides[1]), 6)


def _radius(stroke: _Stroke) -> float | None:
    """Return the radius of a circle, m; None for other shapes."""
    away = np.linalg.norm(stroke.points - stroke.middle, axis=1)
    mean = float(away.mean())
    if len(away) < 8 or np.abs(away - mean).max() > ROUND * mean:
        return None
    return round(mean, 4)


def _start(stroke: _Stroke) -> tuple[float, float, float]:
    """Return the pose of an arrow from the robot's middle, or of a mark that faces along x."""
    if stroke.closed or len(stroke.points) < 2:
        return (*_row(stroke.middle), 0.0)
    across, up = stroke.points[-1] - stroke.points[0]
    return (*_row(stroke.points[0]), round(math.atan2(up, across), 6))


def _sides(stroke: _Stroke) -> list[tuple[float, float, float, float]]:
    """Return the straight pieces of a stroke: x1, y1, x2, y2."""
    points = _rows(stroke.points)
    ends = points[1:] + points[: int(stroke.closed and len(points) > 2)]
    return [(*a, *b) for a, b in zip(points, ends, strict=False)]


def _row(point: NDArray[np.float64]) -> tuple[float, float]:
    x, y = (float(value) + 0.0 for value in point)  # no -0.0
    return x, y


def _rows(points: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    return tuple(map(_row, points))


def _transform(text: str) -> Transform:
    """Return the transform of an attribute, such as ``translate(1, 2) rotate(90)``."""
    transform = Identity
    for name, inside in _FUNCTION.findall(text):
        try:
            given = [float(value) for value in re.split(r"[\s,]+", inside.strip())]
            transform = transform.transform(_FUNCTIONS[name](*given))
        except (KeyError, TypeError, ValueError):
            raise UserError(f"the transform {name}({inside}) cannot be read") from None
    return transform


def _rotated(degrees: float, x: float = 0.0, y: float = 0.0) -> Transform:
    return Identity.translate(x, y).rotate(math.radians(degrees)).translate(-x, -y)


_FUNCTIONS: dict[str, Any] = {
    "matrix": lambda a, b, c, d, e, f: Transform(a, b, c, d, e, f),
    "translate": lambda x, y=0.0: Identity.translate(x, y),
    "scale": lambda x, y=None: Identity.scale(x, x if y is None else y),
    "rotate": _rotated,
    "skewX": lambda degrees: Identity.skew(math.radians(degrees), 0.0),
    "skewY": lambda degrees: Identity.skew(0.0, math.radians(degrees)),
}


def _length(text: str, what: str) -> float:
    """Return a length in the drawing's units.

    Raises:
        UserError: if it is not a length, or is relative.
    """
    match = _LENGTH.match(text)
    if match is None:
        raise UserError(f"{what} is not a length: {text!r:.40}")
    return float(match[1]) * _UNITS[(match[2] or "").lower()]


def _tag(element: Any) -> str:
    """Return an element's tag without its namespace; nothing for a comment."""
    return element.tag.rpartition("}")[2].lower() if isinstance(element.tag, str) else ""
