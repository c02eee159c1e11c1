"""The delay of a log's poses relative to its commands.

A robot answers a command a little later, never earlier. If poses are stamped by another clock, or
by the time at which they arrived, they seem to answer much later, or before. The motion is
regressed on earlier commands, through lags of several sizes; the time shift with which commands
best explain the motion at other times is the poses' delay (delay by cross-correlation: Knapp and
Carter 1976). Short logs are explained by chance at some shift, but not at other times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from tracking.datasets.logs import Log, is_known

#: Largest delay of a robot itself, s, which training estimates.
ROBOTS = 0.5
#: Earliness of poses that counts as none, s, because a command is sent within a step of a log.
_EARLY = 0.1
#: Largest delay of poses (s), the grid, tried lags (s), and number of steps. Alternate stretches of
#: this length (s) are explained by the others.
_EARLIEST, _LATEST, _STEP, _MOST, _STRETCH = -2.0, 3.0, 0.05, 4000, 4.0
_LAGS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
#: Largest remaining fraction of the motion's variance, and of the remainder at a robot's best
#: possible delay.
_LEFT, _BETTER = 0.5, 0.8
#: Shortest step of a log, s, at which it matters whether a line's pose is the one before or after
#: its command; and the remainder of one after it, as a fraction of that of one before, that tells.
_FINEST, _CLEARLY = 0.02, 0.5


class Lateness(NamedTuple):
    """The delay of poses, s, and the remaining fraction of the motion's variance."""

    delay: float
    left: float


def in_step(logs: Sequence[Log], delay: float | None = None) -> tuple[list[Log], list[str]]:
    """Return logs whose poses are on the clock of the commands, and a sentence if they were not.

    Args:
        logs: drives of one robot and one clock.
        delay: delay of the poses, s; None: it is estimated, and corrected if it is longer than any
            robot's, or if the poses are early.
    """
    warning = ""
    if delay is None:
        delay, warning = _estimated(logs)
    if delay != 0.0:
        logs = [replace(log, pose_time=log.pose_time - delay) for log in logs]
    return list(logs), [warning] if warning else []


def _estimated(logs: Sequence[Log]) -> tuple[float, str]:
    """Return the delay of poses that is to be corrected, s, and why; 0 and nothing: none."""
    late = lateness(logs)
    if late is not None and not -_EARLY <= late.delay <= ROBOTS:
        much = f"{abs(late.delay):.2f} s {'after' if late.delay > 0 else 'before'}"
        return late.delay, (
            f"poses follow {much} their commands, as no robot does: their clocks differ; "
            f"corrected; --delay {late.delay:.2f} says so, --delay 0 leaves them"
        )
    if step := _step_early(logs):
        return -step, (
            "the pose of a line is the one after its command, as where a simulator is "
            "logged after each step; read so; --delay 0 takes it for the one before"
        )
    return 0.0, ""


def lateness(logs: Sequence[Log]) -> Lateness | None:
    """Return the delay of the poses of logs of one clock; None if commands explain too little."""
    step = max(_STEP, 2.0 * _step_of(logs))
    shifts = np.arange(round(_EARLIEST / step), round(_LATEST / step) + 1)
    left = _unexplained_by(logs, step, shifts)
    if left is None:
        return None
    best = int(left.argmin())
    if left[best] > _LEFT:
        return None
    robots = np.flatnonzero((shifts * step >= -_EARLY) & (shifts * step <= ROBOTS))
    limits = -np.inf, np.inf
    # Where the last shift is the best one, a slow body answers for longer than that.
    if best == len(left) - 1 or left[best] > _BETTER * left[robots].min():
        best, limits = int(robots[left[robots].argmin()]), (-_EARLY, ROBOTS)
    delay = np.clip((shifts[best] + _between(left, best)) * step, *limits)
    return Lateness(float(delay), float(left[best]))


def _step_early(logs: Sequence[Log]) -> float:
    """Return the step of logs (s) whose lines have the pose after their command; if not, 0.

    A robot that answers later than within a step hides it, and is learned all the same.
    """
    step = _step_of(logs)
    if step < _FINEST or not all(np.isin(log.pose_time, log.time).all() for log in logs):
        return 0.0
    left = _unexplained_by(logs, step, np.arange(-1, round(ROBOTS / step) + 1))
    if left is None or left[0] > _LEFT or left[0] > _CLEARLY * left[1:].min():
        return 0.0
    return step


def _step_of(logs: Sequence[Log]) -> float:
    return float(np.median(np.concatenate([np.diff(log.time) for log in logs])))


def _unexplained_by(logs: Sequence[Log], step: float, shifts: NDArray) -> NDArray | None:
    """Return the fraction of the motion that commands do not explain at each shift, (S,).

    None: there is too little motion.

    Args:
        logs: drives of one robot and one clock.
        step: of the grid, s.
        shifts: of the motion, steps.
    """
    parts, count = [], 0
    for log in sorted(logs, key=lambda log: -len(log.pose_time)):
        # With what is unknown before and after it, no shift joins two logs.
        begin = max(log.time[0], log.pose_time[0]) - _LATEST
        end = min(log.time[-1], log.pose_time[-1]) + _LATEST
        grid = np.arange(begin, end, step)[: _MOST - count]
        if len(grid):
            parts.append(_sampled(log, grid, step))
            count += len(grid)
    if count < 40:
        return None
    twist, known, commands, given = (np.concatenate(part) for part in zip(*parts, strict=True))
    half = np.arange(count) * step // _STRETCH % 2
    lefts = np.full((len(_LAGS), len(shifts), twist.shape[1]), np.inf)
    for number, lag in enumerate(_LAGS):
        features = _features(_lagged(commands, step, lag))
        for place, shift in enumerate(shifts.tolist()):
            lefts[number, place] = _unexplained(features, given, twist, known, half, shift)
    # A heavy body, as that of a boat, follows more slowly forward than in a turn, or less.
    least = lefts.min(0)
    moves = (~np.isnan(least)).sum(1)
    left = np.where(moves > 0, np.nansum(least, axis=1) / np.maximum(moves, 1), np.inf)
    return left if np.isfinite(left).any() else None


def _sampled(log: Log, grid: NDArray, step: float) -> tuple[NDArray, ...]:
    """Return the motion in steps from times (K,), whether it is known, commands, and whether given.

    The motion, forward and turn, is (K, 2), commands are (K, C).
    """
    twist = se2.mid_turn(se2.between(log.pose_at(grid), log.pose_at(grid + step)))[:, [0, 2]]
    known = is_known(log.pose_time, grid, 4.0 * step)
    place = np.searchsorted(log.time, grid + step / 2, side="right") - 1
    given = (place >= 0) & (grid + step / 2 <= log.time[-1])
    return twist, known, log.commands[np.clip(place, 0, len(log.time) - 1)], given


def _between(left: NDArray, best: int) -> float:
    """Return where between its neighbours a minimum lies, by a parabola, -0.5 to 0.5."""
    if not 0 < best < len(left) - 1:
        return 0.0
    before, at, after = left[best - 1 : best + 2]
    curve = before - 2 * at + after
    if not np.isfinite(curve) or curve <= 0:
        return 0.0
    # At the best of some shifts, not of all, the parabola's minimum may be far away.
    return float(np.clip((before - after) / (2 * curve), -0.5, 0.5))


def _lagged(commands: NDArray, step: float, lag: float) -> NDArray:
    """Return commands (K, C) through a first-order lag, s."""
    if lag == 0.0:
        return commands
    keep, lagged = np.exp(-step / lag), commands.copy()
    for place in range(1, len(lagged)):
        lagged[place] = keep * lagged[place - 1] + (1.0 - keep) * commands[place]
    return lagged


def _features(speeds: NDArray) -> NDArray:
    """Return the regressors of motion: a constant, speeds (K, C), and their products."""
    count = speeds.shape[1]
    speeds = speeds / np.maximum(np.abs(speeds).max(0), 1e-30)
    pairs = [speeds[:, i] * speeds[:, j] for i in range(count) for j in range(i, count)]
    return np.column_stack([np.ones(len(speeds)), speeds, *pairs])


def _unexplained(
    features: NDArray,
    given: NDArray,
    twist: NDArray,
    known: NDArray,
    half: NDArray,
    shift: int,
) -> NDArray:
    """Return the fraction of each motion's variance that earlier commands leave unexplained.

    Each half of the motion is explained as the other half was. It is infinite where too little is
    known, and NaN for a motion that does not vary.
    """
    count = len(twist)
    late = slice(max(shift, 0), count + min(shift, 0))
    early = slice(max(-shift, 0), count - max(shift, 0))
    usable = known[late] & given[early]
    parts = [usable & (half[late] == number) for number in (0, 1)]
    if min(part.sum() for part in parts) < max(20, 0.12 * min(known.sum(), given.sum())):
        return np.full(twist.shape[1], np.inf)
    x, y = features[early], twist[late] - twist[late][usable].mean(0)
    spread = (y[usable] ** 2).sum(0)
    moves, error = spread > 1e-12, np.zeros(twist.shape[1])
    for learned, other in (parts, parts[::-1]):
        square = x[learned].T @ x[learned] + 1e-6 * learned.sum() * np.eye(x.shape[1])
        weights = np.linalg.solve(square, x[learned].T @ y[learned])
        error += ((y[other] - x[other] @ weights) ** 2).sum(0)
    return np.where(moves, error / np.where(moves, spread, 1.0), np.nan)
