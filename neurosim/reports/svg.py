"""Matplotlib figures as SVG inside an HTML page, in the page's colours.

Every colour of a figure is one of :data:`INK`'s codes. In the page each becomes a CSS variable,
so that one drawing serves light, dark and paper. The palette is Okabe and Ito's (2008), which
readers with colour vision deficiency can distinguish.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

#: CSS variable -> the colour that matplotlib uses for it.
INK = {
    "ink": "#1a1c1f",
    "muted": "#5c636b",
    "grid": "#dfe3e7",
    "paper": "#fefefe",
    "predicted": "#0072b2",
    "actual": "#d55e00",
    "third": "#009e73",
    "shade": "#c9ced4",
    "board": "#f4f1ea",
}

#: Largest number of pixels per point of a drawing, on a wide page.
_SCALE = 1.75

_STYLE = {
    "svg.fonttype": "none",  # text stays text: it can be searched, read aloud and selected
    "svg.hashsalt": "neurosim",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": INK["muted"],
    "axes.labelcolor": INK["ink"],
    "axes.titlecolor": INK["ink"],
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": INK["grid"],
    "grid.linewidth": 0.7,
    "xtick.color": INK["muted"],
    "ytick.color": INK["muted"],
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.labelcolor": INK["ink"],
    "text.color": INK["ink"],
    "figure.facecolor": "none",
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
    "path.simplify_threshold": 0.3,
}


@contextmanager
def drawing(width: float, height: float, **subplots: int) -> Iterator[tuple[Figure, Axes]]:
    """Give a styled figure of ``width`` x ``height`` inches and its axes (or array of them)."""
    with matplotlib.rc_context({**matplotlib.rcParamsDefault, **_STYLE}):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, figure.subplots(**subplots)


def to_svg(figure: Figure, label: str, prefix: str) -> str:
    """Return the figure as an ``<svg>`` element for an HTML page.

    Args:
        figure: drawn with the colours of :data:`INK` only.
        label: description of the picture, for those who cannot see it.
        prefix: makes the element's ids unique in the page.
    """
    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)  # not needed in HTML
    text = text.replace("xlink:href=", "href=")
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = re.sub(r'href="#', f'href="#{prefix}-', text)
    text = re.sub(r"url\(#", f"url(#{prefix}-", text)
    # The page sets these two: the joints of lines, and the fonts.
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"font-family: [^;\"]*;? ?", "", text)
    # A hundredth of a point is enough for places, but not for the labels between the tags.
    text = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d\.\d\d)\d+", r"\1", tag[0]), text)
    text = re.sub(r"\s*\n\s*", " ", text)
    for name, colour in INK.items():
        text = text.replace(colour, f"var(--{name})")
    width, height = figure.get_size_inches() * 72
    opening = (
        f'<svg class="figure" style="max-width: {_SCALE * width / 16:.1f}rem" '
        f'viewBox="0 0 {width:.2f} {height:.2f}" role="img" aria-label="{_attribute(label)}">'
    )
    return re.sub(r"<svg[^>]*>", lambda _: opening, text, count=1).strip()


def _attribute(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
