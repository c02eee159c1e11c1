"""The parts of a page, and their HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any


@dataclass
class Picture:
    """A figure: an SVG and its caption.

    Attributes:
        film: JSON of the moving parts over it (:mod:`neurosim.reports.film`), or None.
    """

    svg: str
    caption: str
    wide: bool = False
    film: str | None = None
    kind: str = field(default="picture", init=False)


@dataclass
class Row:
    """Figures that belong together; side by side where they fit."""

    pictures: list[Picture]
    kind: str = field(default="row", init=False)


@dataclass
class Table:
    """A table; the first column names the row, the others are numbers unless ``words``.

    Attributes:
        groups: a first line of the head, [(name, number of columns)] after the first column.
        folded: whether it is hidden until a click (but printed).
        words: whether the cells are words, which are aligned to the left and may wrap.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    groups: Sequence[tuple[str, int]] = ()
    folded: bool = False
    words: bool = False
    kind: str = field(default="table", init=False)


@dataclass
class Text:
    """A paragraph; ``missing`` marks one about a folder to add."""

    text: str
    missing: bool = False
    kind: str = field(default="text", init=False)


Block = Picture | Row | Table | Text


@dataclass
class Section:
    """A part of the page under a heading."""

    id: str
    title: str
    blocks: list[Block]


@dataclass
class Page:
    """The whole page.

    Attributes:
        title: the window's title and the page's first heading.
        verdict: the result, in a sentence or two.
        good: whether the result is a success; None if there is no trial.
        virtual: whether data is from the virtual lab.
        figures: key figures (value, description).
        sections: the rest.
        footer: version and date.
    """

    title: str
    verdict: str
    good: bool | None
    virtual: bool
    figures: list[tuple[str, str]]
    sections: list[Section]
    footer: str

    def html(self) -> str:
        """Return the page, with its style and script inside."""
        import jinja2

        here = resources.files(__package__)
        environment = jinja2.Environment(
            autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
        )
        template = environment.from_string((here / "page.html").read_text(encoding="utf-8"))
        style = (here / "page.css").read_text(encoding="utf-8")
        script = (here / "film.js").read_text(encoding="utf-8")
        context: dict[str, Any] = {"page": self, "style": style, "script": script}
        return template.render(context)
