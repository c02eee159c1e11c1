"""Rows of a dataset from a log: commands sampled over time, and poses beside them.

A command is held from its sample to the first sample that differs. Such a run, cut from its
beginning into pieces of at most 3 s, gives one row for every piece of at least 0.5 s; the
previous command of a piece is that of the sample just before its first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import Checked, Delay, Seconds
from neurosim.base.errors import UserError
from tracking.datasets.within import choose_instants, poses_within

#: Why a piece of a log is left out of a dataset.
REASONS = {
    "too short": "the command changed again too soon",
    "first": "the command before the first one is not known",
    "gap": "no sample or no pose for too long",
}

#: Times are written to the millisecond; a piece of 60 samples at 20 Hz lasts 3 s give or take one.
_ROUNDING = 1e-3


@dataclass(frozen=True)
class Settings(Checked):
    """How runs of equal commands become rows.

    Attributes:
        shortest: shortest piece that gives a row, s.
        longest: longest piece, s.
        longest_gap: a piece is left out if samples or poses are silent for longer within it, s.
        keep: poses whose headings do not fit the motion are kept.
        delay: by how much poses are late beside the commands, s; None: found from the motion, and
            corrected where no robot can be so late or so early.
    """

    shortest: Seconds = 0.5
    longest: Seconds = 3.0
    longest_gap: Seconds = 0.5
    keep: bool = False
    delay: Delay | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shortest > self.longest:
            raise UserError(
                f"the shortest piece ({self.shortest:g} s) is longer than the longest one "
                f"({self.longest:g} s)"
            )


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
        before: (C,) the command before the first one, where it is known.
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
    """Return the inputs of a dataset, name -> unit, whose commands have these names and units."""
    before = {f"prev_{name}": unit for name, unit in commands.items()}
    return before | commands | {"duration": "s"}


def rows_of(
    log: Log, names: Sequence[str], settings: Settings
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """Turn a log into rows of a dataset.

    Args:
        log: commands and poses.
        names: of the C columns of its commands.
        settings: how runs become rows.

    Returns:
        rows: as :func:`tracking.datasets.dataset.make` takes them, with poses within.
        left_out: reason -> count of the pieces that gave no row.
    """
    left_out = Counter(dict.fromkeys(REASONS, 0))
    kept = []
    for start, end in pieces(log.time, log.commands, settings.longest):
        if log.time[end] - log.time[start] < settings.shortest - _ROUNDING:
            left_out["too short"] += 1
        elif start == 0 and log.before is None:
            left_out["first"] += 1
        elif _has_gap(log.time[start : end + 1], log.pose_time, settings.longest_gap):
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
                "within": within,
            }
        )
    return rows, dict(left_out)


def pieces(time: NDArray, commands: NDArray, longest: float) -> Iterator[tuple[int, int]]:
    """Yield first and end sample of every piece of equal commands, the short ones too.

    Args:
        time: (N,) s. The last sample only ends the run before it: nobody knows how long it was
            held itself.
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


def is_known(pose_times: NDArray, begins: NDArray, lasts: float) -> NDArray[np.bool_]:
    """Return whether there are poses (M,) all along spans that begin at (K,) and last so long, s.

    They are if none is missing for longer than half of the span.
    """
    silent = np.flatnonzero(np.diff(pose_times) > lasts / 2)
    first = np.searchsorted(pose_times[silent + 1], begins, side="right")
    last = np.searchsorted(pose_times[silent], begins + lasts, side="left")
    inside = (begins >= pose_times[0]) & (begins + lasts <= pose_times[-1])
    return (last <= first) & inside


def _has_gap(samples: NDArray, pose_times: NDArray, longest: float) -> bool:
    if (np.diff(samples) > longest).any():
        return True
    first = int(np.searchsorted(pose_times, samples[0], side="right")) - 1
    last = int(np.searchsorted(pose_times, samples[-1], side="left"))
    if first < 0 or last >= len(pose_times):
        return True
    return bool((np.diff(pose_times[first : last + 1]) > longest).any())
