"""The report's charts of numbers: predictions, learning, displacements, growth of errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from neurosim.reports.svg import INK, drawing, to_svg

_THREE = ("predicted", "actual", "third")
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)))


def series(
    actual: ArrayLike, predicted: ArrayLike, what: str, axis: str, label: str, prefix: str
) -> str:
    """Draw actual and predicted values over the number of the row or window (Figures 3 to 5)."""
    actual, predicted = np.asarray(actual), np.asarray(predicted)
    with drawing(7.4, 2.5) as (figure, axes):
        number = np.arange(1, len(actual) + 1)
        axes.plot(
            number, actual, color=INK["actual"], lw=0.9, marker="o", ms=4.5, mew=1.1,
            mfc=INK["paper"], label="actual",
        )  # fmt: skip
        axes.plot(
            number, predicted, color=INK["predicted"], lw=0.9, marker="x", ms=4.2, mew=1.3,
            label="predicted",
        )  # fmt: skip
        axes.set_xlabel(f"held-out {what}")
        axes.set_ylabel(axis)
        axes.set_xlim(0, len(actual) + 1)
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
        return to_svg(figure, label, prefix)


def scatter(actual: ArrayLike, predicted: ArrayLike, axis: str, label: str, prefix: str) -> str:
    """Draw predicted over actual values of every held-out command, with the line of equality."""
    actual, predicted = np.asarray(actual), np.asarray(predicted)
    with drawing(3.1, 2.9) as (figure, axes):
        low = float(min(actual.min(), predicted.min()))
        high = float(max(actual.max(), predicted.max()))
        margin = 0.06 * (high - low) or 1.0
        limits = (low - margin, high + margin)
        axes.plot(limits, limits, color=INK["muted"], lw=0.8)
        shown = _spread(len(actual), 600)
        axes.plot(
            actual[shown], predicted[shown], "o", ms=3, mew=0, alpha=0.45, color=INK["predicted"]
        )
        axes.set(xlim=limits, ylim=limits, aspect="equal")
        axes.set_xlabel(f"actual {axis}")
        axes.set_ylabel(f"predicted {axis}")
        return to_svg(figure, label, prefix)


def curves(
    lines: Mapping[str, tuple[ArrayLike, ArrayLike]],
    axis: str,
    label: str,
    prefix: str,
) -> str:
    """Draw one line per name, each given as (x, y), over generations, on a logarithmic axis."""
    with drawing(4.6, 3.0) as (figure, axes):
        for number, (name, (x, y)) in enumerate(lines.items()):
            x, y = np.asarray(x, float), np.asarray(y, float)
            shown = _spread(len(x), 500)
            axes.plot(
                x[shown], y[shown], label=name, color=INK[_THREE[number % 3]],
                ls=_DASHES[number % 3], marker="o" if len(x) == 1 else None,
            )  # fmt: skip
        if any((np.asarray(y, float) > 0.0).any() for _, y in lines.values()):
            axes.set_yscale("log")
        axes.set_xlabel("generation")
        axes.set_ylabel(axis)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if len(lines) > 1:
            axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(lines), borderaxespad=0)
        return to_svg(figure, label, prefix)


def fan(lines: Sequence[ArrayLike], axis: str, label: str, prefix: str, *, x_axis: str) -> str:
    """Draw several runs over the same numbers: each thin, their median bold.

    Runs may be of different length and hold NaN; x counts from 1.
    """
    table = ragged(lines)
    with drawing(4.6, 3.0) as (figure, axes):
        number = np.arange(1, table.shape[1] + 1)
        marks = {"marker": "o", "ms": 3} if table.shape[1] <= 40 else {}
        for place, row in enumerate(table):
            axes.plot(
                number, row, color=INK["predicted"], lw=0.8, alpha=0.45,
                label="each one" if place == 0 and len(table) > 1 else None,
                **({"marker": ".", "ms": 3} if marks else {}),
            )  # fmt: skip
        axes.plot(
            number, median(table), color=INK["actual"] if len(table) > 1 else INK["predicted"],
            lw=2.4, label="median" if len(table) > 1 else None, **marks,
        )  # fmt: skip
        axes.set_xlabel(x_axis)
        axes.set_ylabel(axis)
        axes.set_ylim(bottom=min(0.0, float(np.nanmin(table))) if table.size else 0.0)
        if table.shape[1] <= 20:
            axes.set_xticks(number)
        if len(table) > 1:
            axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
        return to_svg(figure, label, prefix)


def calibration(lines: Mapping[str, tuple[ArrayLike, ArrayLike]], label: str, prefix: str) -> str:
    """Draw the fractions that happened over the predicted probabilities, with a diagonal."""
    with drawing(3.1, 2.9) as (figure, axes):
        axes.plot((0, 1), (0, 1), color=INK["muted"], lw=0.8)
        for number, (name, (predicted, held)) in enumerate(lines.items()):
            axes.plot(predicted, held, label=name, color=INK[_THREE[number]], ls=_DASHES[number])
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
        axes.set_xlabel("predicted")
        axes.set_ylabel("held")
        axes.legend(loc="lower right")
        return to_svg(figure, label, prefix)


def histogram(values: ArrayLike, axis: str, label: str, prefix: str) -> str:
    """Draw how often values occur."""
    with drawing(3.1, 2.3) as (figure, axes):
        numbers = np.asarray(values, float)
        low, high = (numbers.min(), numbers.max()) if len(numbers) else (0.0, 1.0)
        if high - low <= 1e-6 * max(abs(low), abs(high)):  # no room for bins
            wide = max(abs(high), 0.5)
            low, high = low - wide, high + wide
        axes.hist(
            numbers, bins=30, range=(low, high), color=INK["predicted"], ec=INK["paper"], lw=0.4
        )
        axes.grid(axis="x", visible=False)
        axes.set_xlabel(axis)
        axes.set_ylabel("commands")
        return to_svg(figure, label, prefix)


def ragged(lines: Sequence[ArrayLike]) -> NDArray:
    """Return rows of different length as one array, NaN where a row has ended."""
    rows = [np.asarray(line, float) for line in lines]
    table = np.full((len(rows), max((len(row) for row in rows), default=0)), np.nan)
    for place, row in enumerate(rows):
        table[place, : len(row)] = row
    return table


def median(table: NDArray) -> NDArray:
    """Return the median of every column without NaN; NaN for a column without numbers."""
    columns = [column[~np.isnan(column)] for column in table.T]
    return np.array([np.median(column) if column.size else np.nan for column in columns])


def _spread(count: int, most: int) -> NDArray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
