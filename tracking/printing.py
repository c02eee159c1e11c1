"""A page to print and cut up: two markers or a tag, and a chessboard for the camera's lens."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from msgspec import Meta

from neurosim.base.declared import Checked, Metres, TagId
from neurosim.base.errors import UserError
from neurosim.base.files import atomic_path
from tracking.camera.targets import Pattern
from tracking.markers.colours import Colour, colour_pair, parse_colour
from tracking.markers.pointing import distinguishable
from tracking.markers.tags import QUIET, Tag, kind_of

#: Sheets of paper, width and height, m.
PAPER = {"A4": (0.210, 0.297), "Letter": (0.2159, 0.2794)}
#: Formats of the page by suffix, with the metadata that would differ from day to day.
FORMATS = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
#: Space around and between the parts of the page, and for a line of text, m; printers need the
#: margin.
MARGIN, GAP, LINE = 0.010, 0.008, 0.005
#: Width of the black backing around a marker, as a fraction of its diameter: 1 cm for 6 cm.
BACKING = 1 / 6
#: Length of the line that shows whether the printer kept the size, m.
RULER = 0.100
#: Rings of a marker, each lighter than the one around it.
_RINGS = 48
_INCH = 0.0254


@dataclass(frozen=True)
class PageSettings(Checked):
    """The content of the page.

    Attributes:
        markers: colours of the front and of the rear marker, or a kind of tag.
        diameter: Diameter of a marker's coloured disc, m.
        square: side of a square of the chessboard, m.
        pattern: inner corners of the chessboard.
        paper: size of the sheet.
        plain: discs of one colour, which do not fade to white in their middle.
        tag: Number of the tag.
        side: Side of the tag's black square, m.
    """

    markers: str = "pink,blue"
    diameter: Annotated[float, Meta(ge=0.002, le=1)] = 0.060
    square: Metres = 0.018
    pattern: Pattern = (9, 6)
    paper: Literal["A4", "Letter"] = "A4"
    plain: bool = False
    tag: TagId = 0
    side: Annotated[float, Meta(ge=0.002, le=1)] = 0.080

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.printed_tag is None:
            front, rear = (parse_colour(name) for name in colour_pair(self.markers))
            if not distinguishable(front, rear):
                raise UserError(
                    f"{front.name} and {rear.name} are too much alike for a camera; choose others, "
                    "such as pink and blue"
                )
        self._check_room()

    @property
    def printed_tag(self) -> Tag | None:
        """The tag; None where there are two colours."""
        kind = kind_of(self.markers)
        return None if kind is None else Tag(kind, self.tag)

    @property
    def board(self) -> tuple[float, float]:
        """Width and height of the chessboard, m."""
        return (self.pattern[0] + 1) * self.square, (self.pattern[1] + 1) * self.square

    @property
    def backing(self) -> float:
        """Side of the black square under a marker, or of the white one under a tag, m."""
        if (tag := self.printed_tag) is not None:
            return self.side * (1 + 2 * QUIET / len(tag.cells))
        return self.diameter * (1 + 2 * BACKING)

    def _check_room(self) -> None:
        width, height = PAPER[self.paper]
        room = width - 2 * MARGIN
        if self.printed_tag is not None:
            if self.backing > room:
                most = room * self.side / self.backing
                raise UserError(
                    f"a tag of {1000 * self.side:g} mm does not fit on {self.paper}; the largest "
                    f"that does is of {np.floor(1000 * most):g} mm"
                )
        elif 2 * self.backing + GAP > room:
            most = (room - GAP) / 2 / (1 + 2 * BACKING)
            raise UserError(
                f"two markers of {1000 * self.diameter:g} mm do not fit on {self.paper}; the "
                f"largest that do are of {np.floor(1000 * most):g} mm"
            )
        left = height - 2 * MARGIN - self.backing - 2 * GAP - 6 * LINE
        most = min(room / (self.pattern[0] + 1), left / (self.pattern[1] + 1))
        if self.square > most + 1e-9:
            raise UserError(
                f"a chessboard of {self.pattern[0]} x {self.pattern[1]} inner corners with squares "
                f"of {1000 * self.square:g} mm does not fit on {self.paper} with these markers; "
                f"the largest squares that do are of {np.floor(1000 * most):g} mm"
            )


def write_page(out: str | Path, settings: PageSettings | None = None) -> None:
    """Write the page, at its true size.

    Args:
        out: a new ``.pdf`` or ``.svg``.
        settings: its content.

    Raises:
        UserError: if the file exists, or has another suffix.
    """
    out = Path(out)
    if out.suffix.lower() not in FORMATS:
        raise UserError(f"{out}: a page is written as {' or '.join(FORMATS)}; name one of these")
    if out.exists():
        raise UserError(f"{out} exists already; name another file, or remove it yourself")
    # The names of a picture's parts are random unless a salt is given.
    with matplotlib.rc_context({"svg.hashsalt": "page"}), atomic_path(out) as partial:
        draw_page(settings or PageSettings()).savefig(
            partial, format=out.suffix.lower()[1:], metadata=FORMATS[out.suffix.lower()]
        )


def draw_page(settings: PageSettings) -> Figure:
    """Return the page as a figure of its true size.

    From the top down: the chessboard, a ruler, the two markers, front on the left, or the tag.
    """
    width, height = PAPER[settings.paper]
    figure = Figure((width / _INCH, height / _INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.set_axis_off()
    top = height - MARGIN - settings.board[1]
    _draw_chessboard(axes, settings, ((width - settings.board[0]) / 2, top))
    pattern, square = "x".join(map(str, settings.pattern)), f"{1000 * settings.square:g}"
    _write(axes, top - GAP, f"neurosim calibrate PHOTOGRAPHS --pattern {pattern} --square {square}")
    ruler = top - GAP - 3 * LINE
    _draw_ruler(axes, ((width - RULER) / 2, ruler))
    _write(
        axes, ruler - LINE,
        f'Print at 100 % ("actual size"): the line above must be {1000 * RULER:g} mm long.',
    )  # fmt: skip
    bottom = MARGIN + LINE
    if (tag := settings.printed_tag) is not None:
        _draw_tag(axes, (width / 2, bottom + settings.backing / 2), tag, settings)
        axes.text(
            width / 2, MARGIN, f"{tag}, {1000 * settings.side:g} mm: this edge is at the back",
            ha="center", va="bottom", fontsize=8,
        )  # fmt: skip
        return figure
    names = colour_pair(settings.markers)
    middle = (settings.backing + GAP) / 2
    for side, which, name in ((-1, "front", names[0]), (1, "rear", names[1])):
        u = width / 2 + side * middle
        _draw_marker(axes, (u, bottom + settings.backing / 2), parse_colour(name), settings)
        axes.text(u, MARGIN, f"{which}: {name}", ha="center", va="bottom", fontsize=8)
    return figure


def _draw_chessboard(axes: Axes, settings: PageSettings, corner: tuple[float, float]) -> None:
    side = settings.square
    for row in range(settings.pattern[1] + 1):
        for column in range(settings.pattern[0] + 1):
            if (row + column) % 2 == 0:
                place = corner[0] + column * side, corner[1] + row * side
                axes.add_patch(Rectangle(place, side, side, color="black", linewidth=0))


def _draw_ruler(axes: Axes, begin: tuple[float, float]) -> None:
    u, v = begin
    axes.plot([u, u + RULER], [v, v], color="black", linewidth=0.6)
    for end in (u, u + RULER):
        axes.plot([end, end], [v - 0.002, v + 0.002], color="black", linewidth=0.6)


def _draw_marker(
    axes: Axes, middle: tuple[float, float], colour: Colour, settings: PageSettings
) -> None:
    side, radius = settings.backing, settings.diameter / 2
    corner = middle[0] - side / 2, middle[1] - side / 2
    axes.add_patch(Rectangle(corner, side, side, color="black", linewidth=0))
    rim = _rgb(colour)
    for ring in range(_RINGS, 0, -1):
        fraction = 1.0 if settings.plain else ring / _RINGS
        paint = tuple(fraction * rim + (1 - fraction))
        axes.add_patch(Circle(middle, radius * ring / _RINGS, color=paint, linewidth=0))


def _draw_tag(axes: Axes, middle: tuple[float, float], tag: Tag, settings: PageSettings) -> None:
    cell, count = settings.side / len(tag.cells), len(tag.cells)
    left, top = middle[0] - settings.side / 2, middle[1] + settings.side / 2
    # Cells of a row in one piece, and rows that overlap a little: no seams in print.
    for row, cells in enumerate(tag.cells):
        edges = np.flatnonzero(np.diff(np.concatenate([[True], cells, [True]]).astype(int)))
        for begin, end in edges.reshape(-1, 2):
            below = (
                0.01 * cell if row + 1 < count and not tag.cells[row + 1, begin:end].any() else 0
            )
            corner = left + begin * cell, top - (row + 1) * cell - below
            shape = Rectangle(
                corner, (end - begin) * cell, cell + below, color="black", linewidth=0
            )
            axes.add_patch(shape)
    side = settings.backing
    corner = middle[0] - side / 2, middle[1] - side / 2
    axes.add_patch(Rectangle(corner, side, side, fill=False, edgecolor="0.75", linewidth=0.4))


def _rgb(colour: Colour) -> np.ndarray:
    """Return red, green and blue, [3] of 1: as given, or fully saturated."""
    if re.fullmatch("#[0-9a-f]{6}", colour.name):
        return np.array([int(colour.name[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.array(colour.bgr[::-1]) / 255


def _write(axes: Axes, height: float, text: str) -> None:
    axes.text(axes.get_xlim()[1] / 2, height, text, ha="center", va="top", fontsize=8)
