"""Datasets from tables of numbers in CSV files: logs, and lists of commands.

There are two forms of files. A **log** has a line for every sample: the time, the pose, and the
active command. :mod:`tracking.datasets.logs` cuts it into rows. A file of **rows** has a line for
every command: the command, its duration, and the robot's displacement, or its poses before and
after.

The first line names the columns. Fields are separated by commas, semicolons, tabs or blanks;
numbers have a decimal point. Lengths, angles and times are converted to SI and frames to REP 103 (x
forward, y left, heading counter-clockwise); commands keep their units.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files, se2
from neurosim.base.errors import FileError, UserError, counted
from tracking.datasets import logs, suspicious
from tracking.datasets.clocks import in_step
from tracking.datasets.dataset import OUTPUTS, Dataset, make
from tracking.datasets.sessions import check_labels, sessions_of, without_lost
from tracking.datasets.suspicious import TIMES, Conventions

#: Columns of a log, in addition to the commands.
LOG = ("time", "x", "y", "heading")
#: Columns of a command's duration and displacement in a file of rows.
LASTED = ("duration",), ("start", "end")
MOVED = tuple(OUTPUTS)
POSES = ("x0", "y0", "heading0", "x1", "y1", "heading1")
_RESERVED = {*LOG, "duration", "start", "end", *MOVED, *POSES}
#: Columns that every dataset has.
_TAKEN = {"recording", "command", "quality", "row"}

#: Names of command columns that are used by default, and their units.
_USUAL = (("v", "w"), ("left", "right"))
_USUAL_UNITS = {"v": "m/s", "w": "rad/s"}

#: Reason for leaving out a line of a file of rows.
ROW_REASONS = {"not seen": "the displacement, or a pose before or after, is not known"}

#: Rate of a counter, in multiples of nearly all others, from which on it was set anew.
_RESET = 5.0
#: Longest time between samples, s: more is another unit.
_APART = 1e5
#: Largest number in a file; a larger one is a mistake, and results from it may not be finite.
_LARGEST = 1e30

_ABSENT = {"", "nan", "na", "n/a", "null", "none"}


def import_csv(
    paths: Sequence[str | Path] | str | Path,
    out: str | Path,
    *,
    columns: Mapping[str, str] | Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    rows: bool | None = None,
    from_rest: bool = False,
    conventions: Conventions | None = None,
    settings: logs.Settings | None = None,
    session: str | None = None,
    counters: Sequence[str] = (),
) -> Dataset:
    """Turn logs, or files with a line for each command, into a dataset.

    Args:
        paths: the files, all of one shape and with the same columns, in the order of their
            recording.
        out: the folder to write; inputs are those of the command before (``prev_...``), the
            command's, and the duration.
        columns: neurosim's name -> the file's name of a column. The names are time, x, y, heading
            for a log; for rows duration (or start, end), and dx, dy, dtheta (or x0, y0, heading0,
            x1, y1, heading1). A name without an entry is itself the column. Any other name is a
            command's, in this order; in a file of rows, ``prev_`` and such a name is the previous
            command. Without commands, v, w or left, right are used. Names alone, ``("speed",
            "steer")``, are their own columns.
        units: command's name -> its unit, for people to read; by default m/s of v, rad/s of w.
        rows: whether a line is a command rather than a sample; by default the columns decide.
        from_rest: for rows: the robot stood before each command. Otherwise the previous command is
            that of the line above, and the robot stood before the first.
        conventions: units and frames.
        settings: of the conversion of a log to rows.
        session: the file's name of a column with the drive of each line of a log; without it,
            another drive begins where the clock starts again or is silent for long.
        counters: commands whose columns in a log are counters, as of wheels; how fast they count
            is the command.

    Returns:
        The dataset; ``meta["warnings"]`` has a sentence for each suspicious finding.

    Raises:
        FileError: naming the file, and the missing or wrong line and column.
        UserError: if columns or units make no sense, no row is left, or ``out`` exists.

    Example:
        >>> lines = ["duration,v,w,dx,dy,dtheta"]
        >>> lines += [f"1.0,0.{n},0,0.{n},0,0" for n in range(1, 10)]
        >>> _ = Path("rows.csv").write_text(chr(10).join(lines))
        >>> len(ns.import_csv("rows.csv", "dataset-of-rows"))
        9
    """
    conventions, settings = conventions or Conventions(), settings or logs.Settings()
    if columns is not None and not isinstance(columns, Mapping):
        columns = {name: name for name in ([columns] if isinstance(columns, str) else columns)}
    columns, units = dict(columns or {}), dict(units or {})
    files.check_new_folder(out)
    inputs = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    names = _names_of(inputs)
    tables = [_Table(path, columns) for path in inputs]
    shape = _shape(tables[0], rows)
    commands = _commands(tables[0], shape)
    for what, given in (("unit", units), ("counter", counters)):
        for name in given:
            if name not in commands:
                which = name or "an empty name"
                raise UserError(
                    f"a {what} is given for {which}, which is not a command; {_listed(commands)}"
                )
    units = dict.fromkeys(counters, "1/s") | units
    units = {name: units.get(name, _USUAL_UNITS.get(name, "")) for name in commands}
    if shape == "rows" and counters:
        raise UserError("--counters is for logs; in a file of rows a command is a number")
    if shape == "log" and from_rest:
        raise UserError("a log contains the command before each command; leave out --from-rest")
    if shape == "rows" and session is not None:
        raise UserError(
            "--session is for logs; in a file of rows the columns prev_... have the command before"
        )
    if conventions.frame == "world" and (shape == "log" or not tables[0].has_any(MOVED)):
        raise UserError(
            "--frame world is for files of rows with dx, dy; poses are in the world frame anyway"
        )
    left_out: dict[str, int] = Counter()
    made: list[dict[str, Any]] = []
    windows = False
    warnings: list[str] = []
    read, degrees = conventions, shape == "rows"
    if shape == "log":
        drives: list[logs.Log] = []
        for name, table in zip(names, tables, strict=True):
            of_file, notes = _logs(table, name, commands, conventions, settings, session, counters)
            drives += of_file
            warnings += [f"{table.path}: {sentence}" for sentence in notes]
        drives, notes = in_step(drives, settings.delay)
        warnings += notes
        settings, notes = settings.fitted(drives)
        warnings += notes
        made, left_out, windows = logs.any_rows_of(drives, commands, settings)
        if not made:
            _explain(tables[0].path, drives[0], left_out, settings)
        moved = suspicious.moved_in(drives)
        degrees = conventions.angle == "rad" and any(_turns_widely(table) for table in tables)
        likely = degrees and any(_in_degrees(table) for table in tables)
        advice = suspicious.suspicions(moved, commands, units, conventions) if degrees else []
        if likely or any("--angle" in sentence for sentence in advice):
            other = replace(conventions, angle="deg")
            both = zip(names, tables, strict=True)
            in_degrees = [
                drive
                for name, table in both
                for drive in _logs(table, name, commands, other, settings, session, counters)[0]
            ]
            turned = suspicious.moved_in(in_degrees)
            # Fast turns in radians have large steps, too, but fit the way.
            degrees = suspicious.fit_better(turned, moved, commands)
            if degrees and likely:
                drives, moved, read = in_degrees, turned, other
        counting = suspicious.counting(moved, commands)
        sent = [name for name in commands if name not in counters]
        warnings += counting or suspicious.always_changing(drives, commands, sent)
    else:
        for name, table in zip(names, tables, strict=True):
            part, out_of_it = _rows(table, name, commands, from_rest, conventions)
            made += part
            left_out["not seen"] += out_of_it["not seen"]
    dataset = make(
        made,
        logs.inputs_of(units),
        sources=[{"path": path.name, "sha256": files.sha256(path)} for path in inputs],
        left_out=left_out,
        settings={
            "shape": shape,
            "columns": columns,
            **asdict(conventions),
            **({"counters": list(counters)} if counters else {}),
            **(asdict(settings) if shape == "log" else {"from_rest": from_rest}),
        },
        reasons=logs.REASONS if shape == "log" else ROW_REASONS,
        windows=windows,
    )
    if shape == "rows":
        duration = dataset.table["duration"].to_numpy()
        moved = suspicious.of_rows(
            dataset.table[commands].to_numpy(float), duration, dataset.output_array()
        )
        warnings += _wrapped(moved, duration)
    warnings += suspicious.suspicions(moved, commands, units, conventions, read, degrees)
    dataset.meta["warnings"] = warnings
    dataset.write(out)
    return dataset


def _names_of(paths: Sequence[Path]) -> list[str]:
    """Return a unique name for each file, its stem if these differ."""
    if not paths:
        raise UserError("name at least one file")
    resolved = [path.resolve() for path in paths]
    for place, path in enumerate(resolved):
        if path in resolved[:place]:
            raise UserError(f"{paths[place]} is named twice; its commands would count double")
    stems = [path.stem for path in paths]
    return stems if len(set(stems)) == len(stems) else [str(path) for path in paths]


def _listed(names: Sequence[str]) -> str:
    return f"commands are {', '.join(names)}"


# The two forms


def _shape(table: _Table, rows: bool | None) -> str:
    """Return ``log`` or ``rows``."""
    if rows is not None:
        return "rows" if rows else "log"
    mapped = set(table.columns) & _RESERVED
    if mapped and not mapped & set(LOG):
        return "rows"
    if all(table.has(name) for name in LOG) or mapped & set(LOG):
        return "log"
    if table.has_any(MOVED) or table.has_any(POSES):
        return "rows"
    if any(table.has(name) for name in LOG):
        return "log"
    raise FileError(
        table.path,
        "expected a log with time, x, y, heading, or a line for each command with duration, dx, "
        f"dy, dtheta; found {table.column_names()}: say which column is which, such as --columns "
        "time=t,x=pos_x",
        line=table.header_line,
    )


def _commands(table: _Table, shape: str) -> list[str]:
    """Return the names of the commands' columns."""
    names = [name for name in table.columns if name not in _RESERVED]
    before = [name for name in names if name.startswith("prev_")]
    names = [name for name in names if name not in before]
    other = set(LOG) if shape == "rows" else _RESERVED - set(LOG)
    for name in table.columns:
        if name in other:
            what = "with a line for each command" if shape == "rows" else "that is a log"
            raise UserError(f"{name} is not a column of a file {what}; leave it out of --columns")
        if name in _TAKEN:
            raise UserError(f"a command cannot be called {name}; give it another name")
    for name in before:
        if shape == "log":
            raise UserError(f"a log contains the command before each command; leave out {name}")
        if names and name.removeprefix("prev_") not in names:
            raise UserError(
                f"{name} is the command before, but its command has no column; {_listed(names)}"
            )
    if names:
        return names
    for usual in _USUAL:
        if all(table.has(name) for name in usual):
            return list(usual)
    raise FileError(
        table.path,
        f"which columns are the command? found {table.column_names()}; name them, such as "
        "--columns left=speed_l,right=speed_r of wheels, or v=speed,w=omega",
        line=table.header_line,
    )


def _logs(
    table: _Table,
    name: str,
    commands: Sequence[str],
    conventions: Conventions,
    settings: logs.Settings,
    session: str | None,
    counters: Sequence[str],
) -> tuple[list[logs.Log], list[str]]:
    """Read a log; return its drives, and sentences on findings."""
    time = table.numbers("time") * TIMES[conventions.time]
    values = table.array(commands)
    poses = conventions.poses(table.array(LOG[1:], optional=True))
    if len(time) < 2:
        raise FileError(
            table.path, f"holds {counted(len(time), 'sample')}; a log needs two or more"
        )
    apart = float(np.median(np.abs(np.diff(time))))
    if apart > _APART:
        raise UserError(f"{table.path}: samples are {apart:g} s apart: check --time")
    still = np.diff(time, prepend=-np.inf) == 0
    if still.mean() > 0.5:
        repeated = "most lines repeat the time of the line before: name another column by --columns"
        table.refuse(still, "time", repeated)
    seen = np.isfinite(poses).all(axis=1)
    if not seen.any():
        raise FileError(table.path, "no line has a pose: x, y and heading are never all given")
    for place in (commands.index(name) for name in counters):
        values[:, place] = _rate(time, values[:, place])
    labels = None if session is None else table.texts(session)
    if labels is not None:
        check_labels(table.path, session or "", labels)
    drives, warnings = sessions_of(name, time, values, poses, settings, labels)
    if not drives:
        raise FileError(table.path, "no drive in it has two samples and a pose")
    return drives, warnings


def _rate(time: NDArray, counts: NDArray) -> NDArray:
    """Return how fast a counter (N,) counts from each sample to the next, 1/s.

    Counters of 16 and 32 bits begin again at their end. Where time does not go on, or a counter was
    set back, the rate is that of before.
    """
    steps, lasts = np.diff(counts), np.diff(time)
    for size in (2.0**16, 2.0**32):
        again = np.abs(np.abs(steps) / size - 1.0) < 0.1
        steps = np.where(again, steps - np.copysign(size, steps), steps)
    # Where a counter was set to 0, it has no rate.
    fast = np.abs(steps) / np.where(lasts > 0, lasts, 1.0)
    goes_on = (lasts > 0) & (fast <= _RESET * np.quantile(fast, 0.95))
    known = np.append(goes_on, False)
    rate = np.append(steps / np.where(lasts > 0, lasts, 1.0), 0.0)
    before = np.maximum.accumulate(np.where(known, np.arange(len(time)), 0))
    return np.where(known[before], rate[before], 0.0)


def _turns_widely(table: _Table) -> bool:
    """Return whether a log's headings exceed one turn in radians."""
    heading = np.abs(table.array(LOG[3:], optional=True))
    return bool(np.nanmax(heading, initial=0.0) > suspicious.ONE_TURN)


def _in_degrees(table: _Table) -> bool:
    """Return whether a log's headings look as if they were in degrees."""
    poses, _ = without_lost(table.array(LOG[1:], optional=True))
    seen = np.isfinite(poses).all(axis=1)
    return suspicious.like_degrees(table.numbers("time")[seen], poses[seen, 2])


def _explain(
    path: Path, log: logs.Log, left_out: Mapping[str, int], settings: logs.Settings
) -> None:
    """Give the reason why a whole log gives no row, if there is a single one.

    Raises:
        UserError: if so.
    """
    apart = float(np.median(np.diff(log.time)))
    if apart > settings.gap:
        raise UserError(
            f"{path}: samples are {apart:g} s apart, more than --longest-gap "
            f"{settings.gap:g}: check --time, or give a longer --longest-gap"
        )
    if (lasts := log.time[-1] - log.time[0]) < settings.shortest:
        raise UserError(
            f"{path}: no command is held for {settings.shortest:g} s, because the log lasts "
            f"{lasts:g} s: check --time, or give a lower --shortest"
        )
    if left_out["too short"] > sum(left_out.values()) / 2:
        raise UserError(
            f"{path}: no command is held for {settings.shortest:g} s: name the columns of the "
            "sent commands, not of measured speeds; check --time, or give a lower --shortest"
        )


def _rows(
    table: _Table,
    recording: str,
    commands: Sequence[str],
    from_rest: bool,
    conventions: Conventions,
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """Read a file with a line for each command."""
    values = table.array(commands)
    before = _before(table, commands, values, from_rest)
    duration = _duration(table, conventions)
    moved = _displacement(table, conventions)
    seen = np.isfinite(moved).all(axis=1)
    rows = [
        {
            "recording": recording,
            "command": line + 1,
            **dict(zip((f"prev_{name}" for name in commands), before[line], strict=True)),
            **dict(zip(commands, values[line], strict=True)),
            "duration": duration[line],
            **dict(zip(MOVED, moved[line], strict=True)),
            "quality": 1.0,
        }
        for line in np.flatnonzero(seen).tolist()
    ]
    return rows, {"not seen": int((~seen).sum())}


def _before(table: _Table, commands: Sequence[str], values: NDArray, from_rest: bool) -> NDArray:
    """Return the previous command of each line (N, C)."""
    names = [f"prev_{name}" for name in commands]
    if table.has_any(names):
        if from_rest:
            raise UserError(
                f"{table.path} has the command before each command ({', '.join(names)}); leave "
                "out --from-rest"
            )
        return table.array(names)
    before = np.zeros_like(values)
    if not from_rest:
        before[1:] = values[:-1]
    return before


def _duration(table: _Table, conventions: Conventions) -> NDArray:
    """Return the duration of each line's command (N,), s."""
    scale = TIMES[conventions.time]
    lasted, timed = LASTED
    if table.has_any(lasted) or not table.has_any(timed):
        duration = table.numbers("duration") * scale
        table.refuse(duration <= 0, "duration", "expected a number above 0")
        return duration
    start, end = (table.numbers(name) * scale for name in timed)
    table.refuse(end <= start, "end", "a command must end after its start")
    table.check_increasing("start", start)
    return np.round(end - start, 6)


def _displacement(table: _Table, conventions: Conventions) -> NDArray:
    """Return the displacement by each line's command (N, 3), NaN if unknown."""
    if table.has_any(MOVED) or not table.has_any(POSES):
        moved = conventions.poses(table.array(MOVED, optional=True))
        if conventions.frame == "world":
            angle = table.numbers("heading0", optional=True)
            origin = np.column_stack([np.zeros((len(angle), 2)), angle])
            turned = conventions.poses(origin)
            ahead = np.column_stack([moved[:, :2], turned[:, 2] + moved[:, 2]])
            return se2.between(turned, ahead)
        return moved
    before, after = (
        conventions.poses(table.array(names, optional=True)) for names in (POSES[:3], POSES[3:])
    )
    headings = np.concatenate([before[:, 2], after[:, 2]])
    headings = headings[np.isfinite(headings)]
    if headings.size and np.ptp(headings) <= 2 * np.pi + 1e-3:
        # Headings within one turn are wrapped: the robot turned the shorter way.
        turn = after[:, 2] - before[:, 2]
        after[:, 2] -= 2 * np.pi * np.round(turn / (2 * np.pi))
    return se2.between(before, after)


def _wrapped(moved: suspicious.Moved, duration: NDArray) -> list[str]:
    """Return a sentence if rows probably turned over half a turn, but have the shorter turn."""
    count = suspicious.wrapped(moved, duration)
    if not count:
        return []
    return [
        f"{count} of {len(duration)} commands turned by more than half a turn, by the turn of the "
        "others, and the file has the shorter way round: write headings that run on, or dtheta"
    ]


# Files


class _Table:
    """The lines of a file, and its columns.

    Attributes:
        path: the file.
        columns: neurosim's name -> the file's name.
        header_line: number of the line with the names, from 1.
    """

    def __init__(self, path: Path, columns: Mapping[str, str]):
        self.path, self.columns = path, columns
        lines = [
            (place, line)
            for place, line in enumerate(_text(path).splitlines(), start=1)
            if line.strip()
        ]
        if not lines:
            raise FileError(path, "is empty; expected a line with the names of the columns", line=1)
        first = _header_place([line for _, line in lines])
        self.header_line, header = lines[first]
        header = header.removeprefix("#").strip()
        delimiter = next((mark for mark in ("\t", ";", ",") if mark in header), " ")
        kept = {place: line for place, line in lines[first + 1 :] if not line.startswith("#")}
        self._fields = files.table_of_lines(path, header, kept, delimiter)
        self._header = list(self._fields.columns)
        if all(_is_number(name) for name in self._header if name):
            raise FileError(
                path,
                "expected a line with the names of the columns, found numbers; write one above "
                "them, such as time,x,y,heading,v,w",
                line=self.header_line,
            )
        if self._fields.empty:
            raise FileError(path, "holds the names of columns and no line of numbers")

    def column_names(self) -> str:
        """Return the names of the file's columns, for messages."""
        return ", ".join(name for name in self._header if name)

    def has(self, name: str) -> bool:
        """Return whether there is a column for a name of neurosim."""
        return self.columns.get(name, name) in self._header

    def has_any(self, names: Sequence[str]) -> bool:
        """Return whether any of these names has a column, in the file or by --columns."""
        return any(name in self.columns or self.has(name) for name in names)

    def array(self, names: Sequence[str], *, optional: bool = False) -> NDArray:
        """Return columns (N, len(names))."""
        return np.column_stack([self.numbers(name, optional=optional) for name in names])

    def numbers(self, name: str, *, optional: bool = False) -> NDArray:
        """Return a column (N,) by neurosim's name; NaN for a missing number, if that is allowed.

        Raises:
            FileError: if the column is missing or doubled, or a field is not a number.
        """
        theirs = self.columns.get(name, name)
        if theirs not in self._header:
            of = "" if theirs == name else f" ({name})"
            raise FileError(
                self.path,
                f"there is no such column{of}; found {self.column_names()}: say which it is, with "
                f"--columns {name}=NAME",
                line=self.header_line,
                field=theirs,
            )
        if self._header.count(theirs) > 1:
            raise FileError(
                self.path, "there are two such columns", line=self.header_line, field=theirs
            )
        try:  # all at once, if all are valid
            values = self._fields[theirs].to_numpy().astype(float)
        except ValueError:
            values = np.full(1, math.nan)
        if (np.abs(values) <= _LARGEST).all():
            return values
        parse, nothing = (_optional, " or nothing") if optional else (_number, "")
        expected = f"a number such as 0.25{nothing}"
        return np.array(files.parsed(self.path, self._fields[theirs], parse, expected))

    def texts(self, column: str) -> list[str]:
        """Return a column (N,) of text by the file's name."""
        if column not in self._header:
            raise FileError(
                self.path,
                f"there is no such column; found {self.column_names()}: give one to --session",
                line=self.header_line,
                field=column,
            )
        return self._fields[column].str.strip().tolist()

    def refuse(self, wrong: NDArray, name: str, what: str) -> None:
        """Raise a FileError at the first line that is wrong (N,), if any is."""
        files.refuse_lines(self.path, self._fields, wrong, what, self.columns.get(name, name))

    def check_increasing(self, name: str, times: NDArray) -> None:
        """Raise an error for times (N,) that do not increase."""
        steps = np.diff(times, prepend=-np.inf)
        self.refuse(steps == 0, name, "the same time stands in two lines")
        self.refuse(steps < 0, name, "the clock goes backwards")


def _text(path: Path) -> str:
    # With or without a byte order mark.
    text = files.read_text(
        path, "a CSV file", encoding="utf-8-sig", not_text="save it as CSV in UTF-8"
    )
    if "\0" in text:
        raise FileError(path, "is not text; save it as CSV in UTF-8")
    return text


def _header_place(lines: Sequence[str]) -> int:
    """Return the number of the line of names: the first, or the last remark before numbers."""
    place = 0
    while place < len(lines) - 1 and lines[place].startswith("#"):
        place += 1
    if place and all(map(_is_number, re.split(r"[,;\s]+", lines[place].strip(" ,;\t")))):
        place -= 1
    return place


def _number(text: str) -> float:
    value = float(text)
    if not abs(value) <= _LARGEST:
        raise ValueError
    return value


def _optional(text: str) -> float:
    return math.nan if text.strip().lower() in _ABSENT else _number(text)


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
