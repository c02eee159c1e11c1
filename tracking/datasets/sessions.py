"""The drives of a log: cuts between drives, and poses that are left out.

A file may hold several drives, one after the other. A new one begins by a column, when the clock
starts again or is silent for long, or when the pose jumps because the robot was carried. Commands
continue across a jump of the pose. Single poses that jump away and back are left out, and so are
stretches in which the headings do not fit the direction of motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.errors import FileError
from tracking.datasets.logs import Log, Settings, is_known, off_axis

#: A robot stood if its pose stayed for more than this multiple of the usual time.
_STOOD = 3.0
#: Silence of the clock, in multiples of the longest gap, that separates drives.
_SILENCE = 10.0
#: Speed of a jump, in multiples of the speed of all but 5 % of the steps, of that of all but 1 % of
#: the steps after a median over 7, and of that of the three steps before and after it.
_JUMP, _OVER_NEIGHBOURS = 4.0, 8.0
#: Number of jumps to exactly the same place from which on it is the sign of a robot that is lost.
_LOST = 5
#: Duration over which courses are computed, s; largest difference of headings from them, rad.
_COURSE, _FITS = 0.5, 0.6
#: Largest median difference, rad, at which other headings count as wrong.
_MOST_FIT = 0.15
#: Shortest stretch that does not fit, s; most of it must not fit.
_STRETCH = 1.0
#: A heading is turned round if it differs by half a turn, up to this, rad, from one line to the
#: next; the other steps must be smaller than this.
_ROUND = 0.5


def sessions_of(
    name: str,
    time: NDArray,
    commands: NDArray,
    poses: NDArray,
    settings: Settings,
    labels: Sequence[str] | None = None,
) -> tuple[list[Log], list[str]]:
    """Cut a log into drives.

    Args:
        name: of the recording.
        time: (N,) of the samples, s.
        commands: (N, C).
        poses: (N, 3) x, y in m, heading in rad, NaN where the robot was not seen.
        settings: longest gap of samples, and whether all poses are kept.
        labels: (N,) names of the drives, if there is a column.

    Returns:
        The drives with at least two samples and a pose, and a sentence for each finding.
    """
    warnings: list[str] = []
    if not settings.keep:
        poses, warnings = without_lost(poses)
    begins = _begins(time, settings, labels)
    parts = np.split(np.arange(len(time)), begins)
    if labels is None and len(begins):
        back = int((np.diff(time)[begins - 1] < 0).sum())
        why = [f"the clock starts again {_times(back)}"] * (back > 0)
        silent = len(begins) - back
        why += [f"it is silent for long {_times(silent)}"] * (silent > 0)
        warnings.append(
            f"{len(parts)} drives in one file: {' and '.join(why)}; --session COLUMN says otherwise"
        )
    disordered = repeated = 0
    jumps: list[float] = []
    logs: list[Log] = []
    for number, part in enumerate(parts, start=1):
        moment = time[part]
        disordered += int((np.diff(moment) < 0).sum())
        part = part[np.argsort(moment, kind="stable")]
        fresh = np.diff(time[part], prepend=-np.inf) > 0
        repeated += int((~fresh).sum())
        part = part[fresh]
        label = number if labels is None else labels[part[0]]
        own = name if len(parts) == 1 and labels is None else f"{name}/{label}"
        drives = list(_drives(own, time[part], commands[part], poses[part], settings))
        jumps += [drive.time[0] for drive in drives[1:]]
        logs += drives
    if disordered:
        warnings.append(
            f"{disordered} lines are earlier than the line before; they are put in order"
        )
    if repeated:
        warnings.append(f"{repeated} lines have the time of another line; one of each counts")
    if jumps:
        at = ", ".join(f"{moment:.2f}" for moment in jumps[:3]) + ", ..." * (len(jumps) > 3)
        warnings.append(f"the pose jumps {_times(len(jumps))} (at {at} s); the log is cut there")
    if settings.keep:
        return logs, warnings
    logs, turned = map(list, zip(*map(_facing, logs), strict=True)) if logs else ([], [])
    if count := sum(turned):
        warnings.append(
            f"headings turn round from one line to the next, as where markers are mistaken for "
            f"each other: {count} lines, fewer than the others, are left out; --keep keeps them"
        )
    kept = [_fitting(log) for log in logs]
    wrong = [stretch for _, stretches in kept for stretch in stretches]
    if wrong:
        listed = ", ".join(f"{start:.1f} to {end:.1f}" for start, end in wrong[:5])
        warnings.append(
            f"headings do not fit the way that the robot goes from {listed}"
            f"{', ...' * (len(wrong) > 5)} s; left out; --keep keeps them"
        )
    return [log for log, _ in kept if len(log.pose_time)], warnings


def without_lost(poses: NDArray) -> tuple[NDArray, list[str]]:
    """Return poses (N, 3) with NaN where they say that the robot is lost, and a sentence on it.

    Many trackers then write the same place, such as 0, 0. The robot seems to jump there, and back
    to where it was, unlike one that drives past.

    Args:
        poses: x, y in m, and heading.
    """
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    moves = steps[steps > 0]
    if len(moves) < 8:
        return poses, []
    jumps = 1 + np.flatnonzero(steps > _OVER_NEIGHBOURS * np.median(moves))
    places, times = np.unique(poses[jumps, :2], axis=0, return_counts=True)
    if times.max(initial=0) < _LOST:
        return poses, []
    place = places[times.argmax()]
    there = (poses[:, :2] == place).all(axis=1)
    edges = np.diff(there.astype(int))
    before, after = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) + 1
    after = after[int(there[0]) :]  # of the others, each has a row before
    first, last = (poses[rows[: len(after)], :2] for rows in (before, after))
    away, back = (np.hypot(*(first - other).T) for other in (place, last))
    if (back < away / 2).sum() <= len(before) / 2:
        return poses, []
    return np.where(there[:, None], np.nan, poses), [
        f"{there.sum()} lines have the robot at exactly {place[0]:g}, {place[1]:g} m, where it "
        f"jumps {_times(len(before))}: it counts as not seen there; --keep keeps them"
    ]


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _begins(time: NDArray, settings: Settings, labels: Sequence[str] | None) -> NDArray:
    """Return the samples at which another drive begins, without the first."""
    if labels is not None:
        names = np.asarray(labels)
        return np.flatnonzero(names[1:] != names[:-1]) + 1
    steps, gap = np.diff(time), settings.gap
    return np.flatnonzero((steps < -gap) | (steps > max(_SILENCE * gap, 100.0 * _usual(steps)))) + 1


def _usual(steps: NDArray) -> float:
    return float(np.median(steps)) if len(steps) else 0.0


def _drives(
    name: str, time: NDArray, commands: NDArray, poses: NDArray, settings: Settings
) -> Iterator[Log]:
    """Yield the drives of a part with increasing times, cut at jumps of the pose."""
    seen = np.isfinite(poses).all(axis=1)
    seen &= ~_old(time, poses, settings.gap)
    places = np.flatnonzero(seen)
    if len(time) < 2 or not len(places):
        return
    poses = poses.copy()
    poses[places, 2] = np.unwrap(poses[places, 2])
    away, jumps = _jumps(time[places], poses[places], settings.gap)
    seen[places[away]] = False
    cuts = [0, *(places[~away])[jumps].tolist(), len(time)]
    for number, (start, end) in enumerate(pairwise(cuts)):
        own = np.flatnonzero(seen[start:end]) + start
        if end - start < 2 or not len(own):
            continue
        yield Log(
            name if number == 0 else f"{name}/{number + 1}",
            time[start:end],
            commands[start:end],
            seen[start:end],
            time[own],
            poses[own],
            commands[start - 1] if start else None,
        )


def _old(time: NDArray, poses: NDArray, longest: float) -> NDArray[np.bool_]:
    """Return whether poses (N, 3) repeat the previous line, for poses at a lower rate.

    They do if most lines repeat the previous one, except while the robot stood for longer, s, and
    longer than poses usually stay.
    """
    again = np.zeros(len(time), np.bool_)
    again[1:] = (poses[1:] == poses[:-1]).all(axis=1)
    fresh = np.flatnonzero(~again)
    lasted = np.append(time[fresh[1:]], time[-1]) - time[fresh]
    stood = lasted > max(longest, _STOOD * float(np.median(lasted)))
    stands = np.repeat(stood, np.diff(np.append(fresh, len(time))))
    moving = ~stands
    if again[moving].sum() <= moving.sum() / 2:
        return np.zeros_like(again)
    return again & moving


def _jumps(time: NDArray, poses: NDArray, longest: float) -> tuple[NDArray, NDArray]:
    """Return which poses (M,) are away from those around them, and where, of those left, it jumps.

    Args:
        time: (M,) s, increasing.
        poses: (M, 3).
        longest: longest time away, s.
    """
    away = np.zeros(len(time), bool)
    jumps = _fast(time, poses)
    for first, second in pairwise(jumps):
        back = np.hypot(*(poses[second, :2] - poses[first - 1, :2]))
        out = np.hypot(*(poses[first, :2] - poses[first - 1, :2]))
        if time[second] - time[first] <= longest and back < out / 2 and not away[first - 1]:
            away[first:second] = True
    left = ~away
    return away, _fast(time[left], poses[left])


def _fast(time: NDArray, poses: NDArray) -> NDArray:
    """Return the poses that are reached by a jump."""
    if len(time) < 8:
        return np.zeros(0, np.int64)
    steps = np.diff(time)
    # The noise between two close samples, such as an additional one at a command, is not a jump.
    steps = np.maximum(steps, np.median(steps) / 2)
    speed = np.hypot(*np.diff(poses[:, :2], axis=0).T) / steps
    around = sliding_window_view(np.pad(speed, 3, mode="edge"), 7)
    lasting = max(np.quantile(speed, 0.95), np.quantile(np.median(around, axis=1), 0.99))
    limit = _JUMP * min(lasting, np.quantile(speed, 0.99))
    jumps = []
    for place in np.flatnonzero(speed > max(limit, 1e-9)).tolist():
        neighbours = [*speed[max(place - 3, 0) : place], *speed[place + 1 : place + 4]]
        if speed[place] > _OVER_NEIGHBOURS * np.median(neighbours):
            jumps.append(place + 1)
    return np.array(jumps, np.int64)


def _facing(log: Log) -> tuple[Log, int]:
    """Return a log without the poses whose headings are turned round, and their number.

    The heading changes by half a turn there and back; the fewer poses count as wrong.
    """
    time, heading = log.pose_time, log.poses[:, 2]
    if len(time) < 8:
        return log, 0
    turns = np.abs((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi)
    lasts = np.diff(time)
    follows = lasts <= 3.0 * np.median(lasts)
    rounds = follows & (turns > np.pi - _ROUND)
    if not rounds.any() or np.quantile(turns[follows & ~rounds], 0.95) > _ROUND:
        return log, 0
    side = np.append(0, np.cumsum(rounds)) % 2
    run = np.append(0, np.cumsum(~follows))
    more = np.bincount(run, side) > np.bincount(run) / 2
    kept = side == more[run]
    poses = log.poses[kept].copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    seen = log.seen & ~np.isin(log.time, time[~kept])
    return replace(log, seen=seen, pose_time=time[kept], poses=poses), int((~kept).sum())


def _fitting(log: Log) -> tuple[Log, list[tuple[float, float]]]:
    """Return a log without the poses whose headings do not fit the motion, and their times.

    A robot that drives forwards or backwards does so most of the time; the log of an
    omnidirectional one is not changed.
    """
    time, poses = log.pose_time, log.poses
    grid = np.arange(time[0], time[-1] - _COURSE, _COURSE / 4)
    if len(grid) < 8:
        return log, []
    moved = se2.between(log.pose_at(grid), log.pose_at(grid + _COURSE))
    distance = np.hypot(moved[:, 0], moved[:, 1])
    size = np.quantile(distance, 0.95)
    usable = (distance > 0.2 * size) & (np.abs(moved[:, 2]) < 1.0) & is_known(time, grid, _COURSE)
    off = off_axis(np.arctan2(moved[:, 1], moved[:, 0]) - moved[:, 2] / 2)
    if usable.sum() < 8 or np.median(off[usable]) > _MOST_FIT:
        return log, []
    stretches = []
    places = np.flatnonzero(usable)
    wrong = off[places] > _FITS
    edges = np.flatnonzero(np.diff(wrong.astype(int), prepend=0, append=0))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        start, end = grid[places[first]], grid[places[last - 1]] + _COURSE
        if end - start >= _STRETCH + _COURSE:
            stretches.append((float(start), float(end)))
    if not stretches:
        return log, []
    kept = ~np.any([(time >= a) & (time <= b) for a, b in stretches], axis=0)
    seen = log.seen & ~np.any([(log.time >= a) & (log.time <= b) for a, b in stretches], axis=0)
    return replace(log, seen=seen, pose_time=time[kept], poses=poses[kept]), stretches


def check_labels(path: Path, column: str, labels: Sequence[str]) -> None:
    """Raise an error for a column with another drive on nearly every line.

    Raises:
        FileError: naming it.
    """
    changes = sum(before != after for before, after in pairwise(labels))
    if changes > len(labels) / 3:
        what = "names another drive on nearly every line; --session is for one that stays the same"
        raise FileError(path, what, field=column)
