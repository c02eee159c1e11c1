"""Rows of a dataset from a log: commands sampled over time, and poses next to them.

A command is held from its sample to the first sample that differs. Such a run, cut from its
beginning into pieces of at most 3 s, gives one row for every piece of at least 0.5 s; the
previous command of a piece is that of the sample just before its first.

Where commands change sooner, as a person's or a controller's do, few rows or none are left. Then
the whole log becomes rows that follow one another (:func:`chained_rows_of`): pieces of equal
commands; pieces shorter than 0.1 s are joined to this length, with their mean command. Training
composes them to windows of the log with all their commands.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import Checked, Delay, Seconds
from neurosim.base.errors import UserError
from tracking.datasets.within import choose_instants, poses_within

#: Reasons for leaving a piece of a log out of a dataset.
REASONS = {
    "too short": "the command changed again too soon",
    "first": "the command before the first one is not known",
    "gap": "no sample or no pose for too long",
}

#: Number of held commands below which rows may follow one another, the fraction of the time that
#: held commands take below which they may, and smallest number of such rows.
FEW, MOST_OF_IT, LEAST = 100, 0.75, 20
#: Longest gap by default, s. Where samples or poses are farther apart than this, up to the second
#: number, s, it is a multiple of their distance.
_GAP, _RAREST, _GAPS = 0.5, 2.0, 2.5
#: Time between poses within such rows, s.
_WITHIN = 0.25
#: Duration of the motion that determines the command before the first one, s.
_AT_FIRST = 0.2

#: Times are written to the millisecond; a piece of 60 samples at 20 Hz lasts 3 s give or take one.
_ROUNDING = 1e-3


@dataclass(frozen=True)
class Settings(Checked):
    """Settings of the conversion of a log to rows.

    Attributes:
        shortest: shortest piece that gives a row, s.
        longest: longest piece, s.
        longest_gap: a piece is left out if samples or poses are silent for longer within it, s;
            None: 0.5, or more where they are rarer, see :meth:`fitted`.
        step: where rows follow one another, commands shorter than this, s, make one row.
        windows: whether rows follow one another, to be learned from by windows; None: where
            there are few held commands (:func:`any_rows_of`).
        keep: poses whose headings do not fit the motion are kept.
        delay: delay of the poses relative to the commands, s; None: found from the motion, and
            corrected where no robot can be so late or so early.
    """

    shortest: Seconds = 0.5
    longest: Seconds = 3.0
    longest_gap: Seconds | None = None
    step: Seconds = 0.1
    windows: bool | None = None
    keep: bool = False
    delay: Delay | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shortest > self.longest:
            raise UserError(
                f"the shortest piece ({self.shortest:g} s) is longer than the longest one "
                f"({self.longest:g} s)"
            )

    @property
    def gap(self) -> float:
        """The longest gap, s."""
        return _GAP if self.longest_gap is None else self.longest_gap

    def fitted(self, logs: Sequence[Log]) -> tuple[Settings, list[str]]:
        """Return the settings with the longest gap that logs need, and a sentence if it is longer.

        A ship's place is often known once in a second.
        """
        every = (log.time for log in logs), (log.pose_time for log in logs)
        steps = [np.concatenate([np.diff(times) for times in kind]) for kind in every]
        apart = max(float(np.median(each)) if len(each) else 0.0 for each in steps)
        if self.longest_gap is not None or not _GAP < apart <= _RAREST:
            return replace(self, longest_gap=self.gap), []
        gap = round(_GAPS * apart, 3)
        return replace(self, longest_gap=gap), [
            f"samples or poses are {apart:.3g} s apart, so gaps of up to {gap:g} s are allowed "
            "(--longest-gap); if that time is wrong, check --time"
        ]


@dataclass(frozen=True)
class Log:
    """Commands and poses of one robot over time, on one clock.

    Attributes:
        name: of the recording, for the rows.
        time: (N,) of the samples of commands, s, never decreasing.
        commands: (N, C).
        seen: (N,) whether a pose within a command may be taken at this sample.
        pose_time: (M,) of the poses, s, increasing.
        poses: (M, 3) x, y in m, unwrapped heading in rad, none of them NaN; REP 103.
        before: (C,) the command before the first one, if known.
    """

    name: str
    time: NDArray
    commands: NDArray
    seen: NDArray
    pose_time: NDArray
    poses: NDArray
    before: NDArray | None = None

    def pose_at(self, times: NDArray) -> NDArray:
        """Return poses (K, 3) at times (K,), interpolated linearly."""
        columns = [np.interp(times, self.pose_time, column) for column in self.poses.T]
        return np.stack(columns, axis=-1)


def inputs_of(commands: dict[str, str]) -> dict[str, str]:
    """Return the inputs of a dataset, name -> unit: previous command, command and duration.

    ``commands`` are names and units of a command's numbers.
    """
    before = {f"prev_{name}": unit for name, unit in commands.items()}
    return before | commands | {"duration": "s"}


def rows_of(
    log: Log, names: Sequence[str], settings: Settings
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """Turn a log into rows of a dataset.

    Args:
        log: commands and poses.
        names: of the C columns of its commands.
        settings: of the conversion to rows.

    Returns:
        rows: as :func:`tracking.datasets.dataset.make` takes them, with poses within.
        left_out: reason -> count of the pieces that gave no row.
    """
    left_out = Counter(dict.fromkeys(REASONS, 0))
    cut = np.array(list(pieces(log.time, log.commands, settings.longest)), np.int64).reshape(-1, 2)
    gaps = _gaps(log, log.time[cut[:, 0]], log.time[cut[:, 1]], settings.gap)
    kept = []
    for (start, end), gap in zip(cut.tolist(), gaps.tolist(), strict=True):
        if log.time[end] - log.time[start] < settings.shortest - _ROUNDING:
            left_out["too short"] += 1
        elif start == 0 and log.before is None:
            left_out["first"] += 1
        elif gap:
            left_out["gap"] += 1
        else:
            kept.append((start, end))
    if not kept:
        return [], dict(left_out)
    poses = log.pose_at(log.time)
    starts, ends = np.array(kept).T
    moved = se2.between(poses[starts], poses[ends])
    rows = []
    for number, (start, end, displacement) in enumerate(
        zip(starts, ends, moved, strict=True), start=1
    ):
        duration = round(float(log.time[end] - log.time[start]), 6)
        samples = np.arange(start, end + 1)[log.seen[start : end + 1]]
        times = log.time[samples] - log.time[start]
        chosen = choose_instants(times, duration)
        within = poses_within(times[chosen], poses[start], poses[samples[chosen]])
        before = log.commands[start - 1] if start > 0 or log.before is None else log.before
        rows.append(
            {
                "recording": log.name,
                "command": number,
                **dict(zip((f"prev_{name}" for name in names), before, strict=True)),
                **dict(zip(names, log.commands[start], strict=True)),
                "duration": duration,
                **dict(zip(("dx", "dy", "dtheta"), displacement, strict=True)),
                "quality": 1.0,
                "start": poses[start],
                "within": within,
            }
        )
    return rows, dict(left_out)


def pieces(time: NDArray, commands: NDArray, longest: float) -> Iterator[tuple[int, int]]:
    """Yield first and end sample of every piece of equal commands, the short ones too.

    Args:
        time: (N,) s. The last sample only ends the previous run, because its own duration is
            unknown.
        commands: (N, C).
        longest: the longest piece, s.
    """
    changes = np.flatnonzero((np.diff(commands, axis=0) != 0).any(axis=1)) + 1
    ends = [*changes.tolist(), len(time) - 1]
    start = 0
    for run_end in ends:
        while start < run_end:
            reach = time[start] + longest + _ROUNDING
            end = min(int(np.searchsorted(time, reach, side="right")) - 1, run_end)
            end = max(end, start + 1)  # a single step longer than a piece: a gap
            yield start, end
            start = end


def _gaps(log: Log, begins: NDArray, ends: NDArray, longest: float) -> NDArray[np.bool_]:
    """Return whether samples or poses are silent for longer (s) within spans of time (K,)."""
    samples = _silent(log.time, begins, ends, longest)
    poses = log.pose_time
    outside = (begins < poses[0]) | (ends > poses[-1])
    return samples | _silent(poses, begins, ends, longest) | outside


def _silent(times: NDArray, begins: NDArray, ends: NDArray, longest: float) -> NDArray[np.bool_]:
    """Return whether two times that follow each other are farther apart within spans (K,)."""
    apart = np.flatnonzero(np.diff(times) > longest)
    over = np.searchsorted(times[apart + 1], begins, side="right")
    begun = np.searchsorted(times[apart], ends, side="left")
    return begun > over


def is_known(pose_times: NDArray, begins: NDArray, lasts: float) -> NDArray[np.bool_]:
    """Return whether poses (M,) cover spans that begin at (K,) and have these durations, s.

    They do if no gap is longer than half of the span.
    """
    inside = (begins >= pose_times[0]) & (begins + lasts <= pose_times[-1])
    return inside & ~_silent(pose_times, begins, begins + lasts, lasts / 2)


def off_axis(direction: NDArray) -> NDArray:
    """Return the angles, 0 to pi/2, between directions (K,) of motion and the robot's axis.

    Args:
        direction: rad, in the robot's frame; forwards and backwards are both along the axis.
    """
    return np.abs((direction + np.pi / 2) % np.pi - np.pi / 2)


# Rows that follow one another


def any_rows_of(
    logs: Sequence[Log], names: Sequence[str], settings: Settings
) -> tuple[list[dict[str, Any]], dict[str, int], bool]:
    """Turn logs into rows: of held commands, or rows that follow one another.

    By default, rows follow one another if fewer than :data:`FEW` commands were held for long
    enough, or these took less than :data:`MOST_OF_IT` of the time, and if this gives at least twice
    as many rows, and :data:`LEAST`.

    Returns:
        rows and left_out as in :func:`rows_of`, and whether rows follow one another.
    """
    if settings.windows:
        return (*_joined(chained_rows_of(log, names, settings) for log in logs), True)
    held, left_out = _joined(rows_of(log, names, settings) for log in logs)
    lasted = sum(row["duration"] for row in held)
    all_of_it = sum(float(log.pose_time[-1] - log.pose_time[0]) for log in logs)
    if settings.windows is None and (len(held) < FEW or lasted < MOST_OF_IT * all_of_it):
        rows, others = _joined(chained_rows_of(log, names, settings) for log in logs)
        if len(rows) >= max(2 * len(held), LEAST):
            return rows, others, True
    return held, left_out, False


def _joined(
    parts: Iterable[tuple[list[dict[str, Any]], dict[str, int]]],
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    rows: list[dict[str, Any]] = []
    left_out: Counter[str] = Counter()
    for own, without in parts:
        rows += own
        left_out.update(without)
    return rows, dict(left_out)


def chained_rows_of(
    log: Log, names: Sequence[str], settings: Settings
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """Turn a log into rows that follow one another, as :func:`rows_of`.

    A row whose ``command`` is one more than that of the row above begins where that one ended. The
    command before the first is inferred from the robot's motion: it stood, or followed the first
    command.
    """
    first = log.before if log.before is not None else _first(log)
    # From the first pose to the last one.
    begin = int(np.searchsorted(log.time, log.pose_time[0]))
    last = int(np.searchsorted(log.time, log.pose_time[-1], side="right"))
    if begin > 0:
        first = log.commands[begin - 1]
    time, commands, seen = log.time[begin:last], log.commands[begin:last], log.seen[begin:last]
    if len(time) < 2:
        return [], {}
    starts = np.array(_steps(time, commands, settings), np.int64)
    if len(starts) < 2:
        return [], {}
    begins, ends = time[starts[:-1]], time[starts[1:]]
    spent = np.concatenate([np.zeros((1, len(names))), commands[:-1] * np.diff(time)[:, None]])
    spent = np.cumsum(spent, axis=0)
    lasts = np.round(ends - begins, 6)
    mean = (spent[starts[1:]] - spent[starts[:-1]]) / (ends - begins)[:, None]
    # The mean of equal commands is exactly that command.
    changes = np.concatenate([[0], np.cumsum((np.diff(commands, axis=0) != 0).any(axis=1))])
    same = changes[starts[1:] - 1] == changes[starts[:-1]]
    commanded = np.where(same[:, None], commands[starts[:-1]], mean)
    before = np.concatenate([first[None], commanded[:-1]])
    poses = log.pose_at(time[starts])
    moved = se2.between(poses[:-1], poses[1:])
    gaps = _gaps(log, begins, ends, settings.gap)
    rows = []
    for number in np.flatnonzero(~gaps).tolist():
        within: list[dict[str, float]] = []
        if lasts[number] > _WITHIN:
            samples = np.arange(starts[number], starts[number + 1] + 1)
            samples = samples[seen[samples]]
            times = time[samples] - begins[number]
            chosen = _spread(times, float(lasts[number]))
            at = log.pose_at(time[samples[chosen]])
            within = poses_within(times[chosen], poses[number], at)
        rows.append(
            {
                "recording": log.name,
                "command": number + 1,
                **dict(zip((f"prev_{name}" for name in names), before[number], strict=True)),
                **dict(zip(names, commanded[number], strict=True)),
                "duration": float(lasts[number]),
                **dict(zip(("dx", "dy", "dtheta"), moved[number], strict=True)),
                "quality": 1.0,
                "start": poses[number],
                "within": within,
            }
        )
    return rows, {**dict.fromkeys(REASONS, 0), "gap": int(gaps.sum())}


def _spread(times: NDArray, duration: float) -> NDArray:
    """Return those of the times (N,) within a command that are nearest to multiples of _WITHIN."""
    wanted = np.arange(_WITHIN, duration - _WITHIN / 2, _WITHIN)
    if not len(times) or not len(wanted):
        return np.zeros(0, np.int64)
    places = np.unique(np.abs(times[None, :] - wanted[:, None]).argmin(axis=1))
    return places[(times[places] > _ROUNDING) & (times[places] < duration - _ROUNDING)]


def _steps(time: NDArray, commands: NDArray, settings: Settings) -> list[int]:
    """Return the samples at which rows begin, and the last one ends."""
    changes = np.flatnonzero((np.diff(commands, axis=0) != 0).any(axis=1)) + 1
    runs, moments = [*changes.tolist(), len(time) - 1], time.tolist()
    starts, run = [0], 0
    while starts[-1] < len(moments) - 1:
        start = starts[-1]
        while runs[run] <= start:
            run += 1
        if moments[runs[run]] - moments[start] >= settings.step - _ROUNDING:
            reach = moments[start] + settings.longest + _ROUNDING
            end = max(min(bisect_right(moments, reach) - 1, runs[run]), start + 1)
        else:
            end = bisect_left(moments, moments[start] + settings.step - _ROUNDING)
            if end >= len(moments):
                break
        starts.append(end)
    return starts


def _first(log: Log) -> NDArray:
    """Return the command before the first one: the same, or a stop if the robot stood."""
    changes = (np.diff(log.commands, axis=0) != 0).any(axis=1)
    end = int(np.argmax(changes)) if changes.any() else len(log.time) - 1
    span = min(_AT_FIRST, (log.time[end] - log.time[0]) / 3)
    if span <= 0.0:
        return log.commands[0]
    times = np.array([log.time[0], log.time[0] + span, log.time[end] - span, log.time[end]])
    poses = log.pose_at(times)
    moved = np.abs(se2.between(poses[::2], poses[1::2]))
    stood = (moved[0] <= 0.4 * moved[1]).all()
    return np.zeros_like(log.commands[0]) if stood else log.commands[0]
