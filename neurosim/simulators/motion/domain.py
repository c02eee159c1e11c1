"""The domain of a motion network: the commands from which it has learned.

Ranges alone do not show gaps: a robot may never have turned left quickly, although each number of
this command was recorded. So the space of commands is cut into cells, and each cell near a row is
marked. Then one look at a cell tells whether a command is like the recorded ones, for any number of
rows, so that evolution can check every command.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.base.threads import on_cores

#: Commands may leave the ranges by this fraction of their width, or of as many rows' width,
#: if that is more: the largest recorded command is not quite the largest intended one.
SLACK, SLACK_ROWS = 0.05, 6.0
#: Weight of a difference of durations relative to one of speeds, each over its largest value: the
#: same motion for another time is not another motion.
TIME_WEIGHT = 0.25
#: A command is near a row within :data:`MARGIN` (more by :data:`FEW` over the number of rows) times
#: the distance within which this fraction of the rows have a neighbour.
NEIGHBOURS, MARGIN, FEW = 0.98, 1.0, 14.0
#: Number of stretches of time. Neighbours are from different ones, because rows that follow each
#: other may be similar.
STRETCHES = 24
#: Largest number of rows for distances; number of cells of a column, and of durations; largest
#: number of all cells.
_MOST_ROWS, _MOST_CELLS, _CELLS, _TIME_CELLS = 8000, 32768, 64, 8


@dataclass(frozen=True, eq=False)
class Domain:
    """The commands that a simulator has learned from.

    Attributes:
        names: names of the command's columns, [C].
        lowest, highest: of each column, [C], in the dataset's units.
        rows: number of commands.
        reach: distance below which commands count as alike; columns are divided by their largest
            magnitude, and durations multiplied by :data:`TIME_WEIGHT`.
        seen: cells [N_1, ..., N_C], uint8, 1 if a row is within reach, else 0; each column's
            cells are of equal width, from ``lowest`` to ``highest`` with the slack at both ends.

    Raises:
        ValueError: if the shapes do not fit each other, or a range is empty.
    """

    names: tuple[str, ...]
    lowest: NDArray[np.float64]
    highest: NDArray[np.float64]
    rows: int
    reach: float
    seen: NDArray[np.uint8]

    def __post_init__(self) -> None:
        count = len(self.names)
        if len(self.lowest) != count or len(self.highest) != count or self.seen.ndim != count:
            raise ValueError("names, ranges and cells of a domain do not fit each other")
        ends = np.array([self.lowest, self.highest])
        if not (np.isfinite(ends).all() and (self.lowest <= self.highest).all()):
            raise ValueError("the ranges of a domain are lowest and highest, finite")
        if self.rows < 1 or not 0.0 <= self.reach < math.inf or not self.seen.size:
            raise ValueError("a domain has rows, cells, and a reach that is finite")
        low, high = _widened(self.lowest, self.highest, self.slack)
        shape = np.array(self.seen.shape, np.float64)
        cells = np.ascontiguousarray(self.seen, np.uint8)
        # Tuples unroll the loop over columns; a cell is a byte.
        columns = low, shape / (high - low), shape - 1.0
        table = *(tuple(part.tolist()) for part in columns), cells.strides, cells.ravel()
        object.__setattr__(self, "_table", table)

    @property
    def slack(self) -> float:
        """Fraction of its width by which a range may be exceeded."""
        return slack_of(self.rows)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest of each column, by name."""
        ends = zip(self.lowest.tolist(), self.highest.tolist(), strict=True)
        return dict(zip(self.names, ends, strict=True))

    def supported(self, commands: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether commands [..., C] are like some of the data, [...]."""
        shape = commands.shape[:-1]
        flat = np.ascontiguousarray(commands, np.float64).reshape(-1, len(self.names))
        return _look_up(flat, *self._table).reshape(shape)  # type: ignore[attr-defined]

    @classmethod
    def of(
        cls, names: tuple[str, ...], commands: NDArray[np.float64], *, begins: bool = False
    ) -> Domain:
        """Find the domain of commands.

        Args:
            names: of the columns; ``duration`` (s) counts less.
            commands: [N, C] in the order of time.
            begins: whether the beginnings of commands were learned, too: then longer commands
                support shorter ones, down to 0 s.

        Raises:
            ValueError: if there is no command.
        """
        commands = np.asarray(commands, np.float64)
        if not len(commands):
            raise ValueError("a domain is of at least one command")
        timed = names.index("duration") if "duration" in names else -1
        begins = begins and timed >= 0
        largest = np.abs(commands).max(0)
        scale = np.where(largest > 0, largest, 1.0)
        if timed >= 0:
            scale[timed] /= TIME_WEIGHT
        few = commands[:: -(-len(commands) // _MOST_ROWS)] / scale
        stretch = np.arange(len(few)) * min(STRETCHES, len(few)) // len(few)
        apart = _nearest(few, few, timed if begins else -1, stretch)
        apart = apart[np.isfinite(apart)]
        margin = MARGIN + FEW / len(commands)
        reach = margin * float(np.quantile(apart, NEIGHBOURS)) if len(apart) else 0.0

        lowest, highest = commands.min(0), commands.max(0)
        if begins:
            lowest[timed] = 0.0
        low, high = _widened(lowest, highest, slack_of(len(commands)))
        shape = _shape_of(len(names), timed)
        cell = (high - low) / shape
        axes = [a + w * (np.arange(n) + 0.5) for a, w, n in zip(low, cell, shape, strict=True)]
        middles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names))
        away = _nearest(middles / scale, few, timed if begins else -1, stretch[:0])
        # A row's own cell is always marked, and most cells within its reach.
        half = 0.5 * float(np.linalg.norm(cell / scale))
        seen = (away <= max(reach + 0.5 * half, half)).reshape(shape).astype(np.uint8)
        return cls(names, lowest, highest, len(commands), reach, seen)


def slack_of(rows: int) -> float:
    """Return the fraction of its width by which a range of ``rows`` rows may be exceeded."""
    return max(SLACK, SLACK_ROWS / rows)


def _widened(
    lowest: NDArray[np.float64], highest: NDArray[np.float64], slack: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lowest and highest with the slack, which for a single value is that of this value."""
    width = highest - lowest
    width = np.where(width > 0, width, np.maximum(np.abs(lowest), np.abs(highest)))
    more = slack * np.where(width > 0, width, 1.0)
    return lowest - more, highest + more


def _shape_of(columns: int, timed: int) -> NDArray[np.int64]:
    others = columns - (timed >= 0)
    left = _MOST_CELLS // (_TIME_CELLS if timed >= 0 else 1)
    each = min(_CELLS, math.floor(left ** (1 / others) + 1e-9)) if others else 1
    shape = np.full(columns, max(each, 1))
    if timed >= 0:
        shape[timed] = _TIME_CELLS
    return shape


def _nearest(points: NDArray, rows: NDArray, timed: int, stretch: NDArray) -> NDArray:
    """Return each point's [N, C] distance from the nearest row [M, C].

    Args:
        points, rows: scaled commands.
        timed: the column in which longer rows have distance 0, or -1.
        stretch: [N] if points are the rows: rows of the same stretch do not count; else empty.
    """
    distances = np.empty(len(points))

    def part(first: int, last: int) -> None:
        own = points[first:last], stretch[first:last]
        _measure(*own, rows, stretch, timed, distances[first:last])

    on_cores(_measure, part, len(points))
    return distances


@njit(nogil=True)
def _measure(
    points: NDArray,
    own: NDArray,
    rows: NDArray,
    stretch: NDArray,
    timed: int,
    distances: NDArray,
) -> None:
    """Write the distances [N] of :func:`_nearest`; ``own`` are the stretches of the points."""
    for n in range(len(points)):
        nearest = np.inf
        for m in range(len(rows)):
            if len(own) > 0 and own[n] == stretch[m]:
                continue
            away = 0.0
            for c in range(rows.shape[1]):
                off = points[n, c] - rows[m, c]
                if c != timed or off > 0.0:
                    away += off * off
            nearest = min(nearest, away)
        distances[n] = math.sqrt(nearest)


@njit(nogil=True, error_model="numpy", fastmath={"nsz", "contract"})
def _look_up(
    commands: NDArray,
    low: tuple[float, ...],
    per_unit: tuple[float, ...],
    last: tuple[float, ...],
    step: tuple[int, ...],
    cells: NDArray,
) -> NDArray:
    """Return whether the cell of each of the commands [N, C] is marked, [N]."""
    supported = np.empty(len(commands), np.bool_)
    for n in range(len(commands)):
        place, inside = 0, True
        for c in range(len(low)):
            at = (commands[n, c] - low[c]) * per_unit[c]
            # NaN is outside, too; the upper end is inside.
            within = (at >= 0.0) & (at <= last[c] + 1.0)
            inside &= within
            at = at if within else 0.0
            place += step[c] * int(at if at < last[c] else last[c])
        supported[n] = inside & (cells[place] != 0)
    return supported
