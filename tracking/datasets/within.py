"""Poses at instants within commands, next to the displacement at each command's end.

A camera sees the robot in every frame, also during a command: its acceleration, and the direction
of its turn. ``within.csv`` in the folder of a dataset has a few of these poses for each command,
with the columns ``row, time, dx, dy, dtheta``:

- ``row``: the place of the command in dataset.csv, from 0, never decreasing;
- ``time``: seconds since the command's beginning, above 0, at most the command's duration, and
  increasing within a row;
- ``dx, dy`` (m), ``dtheta`` (rad): the displacement since the command's beginning, in the
  robot's frame at that beginning (REP 103, headings not wrapped), like a row's outputs. A
  command's end is in dataset.csv and not repeated here.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neurosim.base import files, se2

COLUMNS = ("row", "time", "dx", "dy", "dtheta")

#: Largest number of instants of a command; half of them are in its first EARLY seconds, in which
#: the motors accelerate.
WITHIN, EARLY = 8, 0.5

#: Times and poses are kept to a microsecond, a micrometre and a microradian.
_DIGITS = 6


def choose_instants(times: NDArray, duration: float) -> NDArray:
    """Choose the instants within a command whose poses are kept; no random numbers.

    Half of :data:`WITHIN` instants are spread evenly over the first :data:`EARLY` seconds, half
    over the whole command. Of each, the nearest time at which the robot was seen is taken, once.

    Args:
        times: (N,) increasing, when the robot was seen, s since the command's beginning; those that
            are not within the command are ignored.
        duration: of the command, s.

    Returns:
        (K,) places in ``times``, increasing, K at most WITHIN.
    """
    # Rounded, they must still be above 0 and before the end.
    margin = 10.0**-_DIGITS
    usable = np.flatnonzero((times > margin) & (times < duration - margin))
    if len(usable) == 0:
        return usable
    half = WITHIN // 2
    early = min(EARLY, duration) * np.arange(1, half + 1) / half
    whole = duration * np.arange(1, half + 1) / (half + 1)
    wanted = np.concatenate([early, whole])
    nearest = np.abs(times[usable][None, :] - wanted[:, None]).argmin(axis=1)
    return usable[np.unique(nearest)]


def poses_within(times: NDArray, start: NDArray, poses: NDArray) -> list[dict[str, float]]:
    """Return the ``within`` of a dataset's row.

    Args:
        times: (K,) s since the command's beginning.
        start: (3,) pose at the command's beginning, m, m, rad.
        poses: (K, 3) poses at ``times``, in the same frame.

    Returns:
        K dicts with time, dx, dy, dtheta.
    """
    moved = np.column_stack([times, se2.between(start, poses)]).round(_DIGITS)
    return [dict(zip(COLUMNS[1:], map(float, values), strict=True)) for values in moved]


def table_of(within: Sequence[Sequence[dict[str, float]]]) -> pd.DataFrame:
    """Return the table of the poses of all rows, given row by row."""
    rows = [{"row": row, **pose} for row, poses in enumerate(within) for pose in poses]
    return _table({name: [each[name] for each in rows] for name in COLUMNS})


def none_within() -> pd.DataFrame:
    """Return a table without poses."""
    return table_of(())


def part_of(within: pd.DataFrame, first: int, last: int) -> pd.DataFrame:
    """Return the poses of a run of rows of a dataset, numbered again from 0.

    Args:
        within: the poses of the whole dataset.
        first: the first row that is kept.
        last: the row after the last one that is kept.
    """
    kept = within[within["row"].between(first, last, inclusive="left")]
    return kept.assign(row=kept["row"] - first).reset_index(drop=True)


def rows_of(within: pd.DataFrame, kept: NDArray[np.bool_]) -> pd.DataFrame:
    """Return the poses of the rows of a dataset that are kept, numbered again from 0.

    Args:
        within: the poses of the whole dataset.
        kept: (N,) whether each row is kept.
    """
    place = np.cumsum(kept) - 1
    row = within["row"].to_numpy()
    rows = within[kept[row]]
    return rows.assign(row=place[rows["row"].to_numpy()]).reset_index(drop=True)


def write(path: Path, within: pd.DataFrame) -> None:
    """Write within.csv."""
    files.write_csv(path, {name: within[name].to_numpy() for name in COLUMNS})


def read(path: Path, expected: Any, table: pd.DataFrame) -> pd.DataFrame:
    """Read and check within.csv; without the file and a count of its poses there are none.

    Args:
        path: of within.csv.
        expected: number of poses by dataset.json, None if it has none.
        table: the rows of the dataset.

    Raises:
        FileError: naming the wrong line and field, or if poses are missing.
    """
    if not path.exists() and not expected:
        return none_within()
    columns = {"row": files.integer} | dict.fromkeys(COLUMNS[1:], files.number)
    within = files.read_csv(path, columns, rows=expected)
    row, time = within["row"].to_numpy(), within["time"].to_numpy()
    same = np.diff(row, prepend=-1) == 0
    outside = (row < 0) | (row >= len(table))
    refuse = partial(files.refuse_lines, path, within)
    refuse(outside, f"expected a row of dataset.csv, 0 to {len(table) - 1}", "row")
    refuse(np.diff(row, prepend=0) < 0, "expected rows in order", "row")
    refuse(time <= 0, "expected a number above 0", "time")
    if "duration" in table:
        late = time > table["duration"].to_numpy()[row]
        refuse(late, "expected at most the duration of the command", "time")
    backwards = same & (np.diff(time, prepend=0.0) <= 0)
    refuse(backwards, "expected times that increase within a row", "time")
    return within.reset_index(drop=True)


def _table(columns: dict[str, list]) -> pd.DataFrame:
    kinds = {name: np.int64 if name == "row" else np.float64 for name in COLUMNS}
    return pd.DataFrame({name: np.array(columns[name], kinds[name]) for name in COLUMNS})
