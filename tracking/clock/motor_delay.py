"""The dead time and the lag of a robot's motors, from the seen answers to its commands.

A wheel that gets another speed continues as before for a dead time d (the radio's, the
brick's) and then approaches the new speed as exp(-t / T). The path and the heading around the
instant of a command are therefore

    a + b t + c g(t - d),    g(t) = t - T (1 - exp(-t / T)) for t > 0, else 0,

with a, b, c of each command's own and d and T shared. a, b and c are linear and drop out
(variable projection, Golub and Pereyra 1973), d and T are searched on a grid over all commands
together. Commands that follow each other too fast for that, such as a closed-loop controller's, are
answered by sums of such g: there windows of the path replace single commands, with one c for all
changes in a window. The spread of d comes from leaving out one command (or
window) after the other (the jackknife), not from the residuals, which are far from independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Seconds of track before and after a command in which its answer is searched.
BEFORE, AFTER = 0.2, 0.45
#: A change of the forward or of the turning speed below this (percent) is no
#: event; and shortest duration of a command (s) that separates its answer from the next one's.
LEAST_CHANGE, LEAST_DURATION = 8.0, 0.45
#: Length of a window where commands follow each other faster, s.
WINDOW = 1.2
#: Smallest number of answers for a delay; and of windows, each with many commands.
FEWEST, FEWEST_WINDOWS = 5, 3
#: Dead times that are tried, s, and motor lags.
REACH, STEP = 0.15, 0.002
LAGS = tuple(0.02 * i for i in range(1, 16))

#: Error of the answer's shape, s: for wheels of known dead time and lag the result is 1 to 2 ms
#: off, with any number of commands.
SYSTEMATIC = 0.002


class MotorLine(Protocol):
    """A line of a command log that changes the forward and turning speed (percent); see
    ``Recording.commands``."""

    time: float
    forward: float
    turn: float


@dataclass(frozen=True)
class Delay:
    """The time from a command to the motors' answer, on the clock of the track.

    Attributes:
        delay: dead time in seconds, before the motors' own lag begins.
        sd: its standard deviation, from leaving out one answer after the other.
        lag: of the motors, time constant in seconds.
        answers: number of changes of speed for this result.
    """

    delay: float
    sd: float
    lag: float
    answers: int


@dataclass(frozen=True)
class Answers:
    """Misfits [K, D, T] of K answers at every dead time and lag; their times [K].

    ``fewest`` is the smallest number for a delay.
    """

    misfit: NDArray
    times: NDArray
    fewest: int = FEWEST


def motion_delay(times: ArrayLike, poses: ArrayLike, lines: Iterable[MotorLine]) -> Delay | None:
    """Find the delay of the motors' answers to their commands.

    Args:
        times: [N] of the poses, on the clock of the commands, s.
        poses: [N, 3], m, m, unwrapped rad; NaN where the robot was not seen.
        lines: commands sent to the motors, in order.

    Returns:
        The delay, within 0.15 s of the commands' times; None if too few commands changed the
        speeds, or the answers are beyond the searched range.
    """
    answers = answers_to(*signals_of(times, poses), changes_of(lines))
    delay = None if answers is None else delay_of(answers)
    return None if delay is None or abs(delay.delay) >= REACH - STEP else delay


def signals_of(times: ArrayLike, poses: ArrayLike) -> tuple[NDArray, NDArray]:
    """Return the times [N] and the signed path (m) and heading (rad) [N, 2] where seen."""
    times, poses = np.asarray(times, float), np.asarray(poses, float)
    seen = np.isfinite(poses).all(axis=1)
    times, poses = times[seen], poses[seen]
    if len(times) == 0:
        return times, np.empty((0, 2))
    steps = np.diff(poses, axis=0)
    heading = (poses[1:, 2] + poses[:-1, 2]) / 2
    along = steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading)
    return times, np.column_stack([np.concatenate([[0.0], np.cumsum(along)]), poses[:, 2]])


def changes_of(lines: Iterable[MotorLine]) -> NDArray:
    """Return [K, 4]: time of each change of speed, change of forward and turning speed, room.

    The room is the time until the next line; a change right after another one has none.
    """
    rows = [(line.time, line.forward, line.turn) for line in lines]
    if not rows:
        return np.empty((0, 4))
    table = np.array(rows, float)
    before = np.vstack([[0.0, 0.0], table[:-1, 1:]])
    change = table[:, 1:] - before
    length = np.append(np.diff(table[:, 0]), np.inf)
    room = np.where(np.append(np.inf, length[:-1]) < LEAST_DURATION, 0.0, length)
    return np.column_stack([table[:, 0], change, room])


def answers_to(times: NDArray, signals: NDArray, changes: NDArray) -> Answers | None:
    """Return the misfit of every seen answer, over dead times and lags."""
    if len(times) < 2 or not len(changes):
        return None
    answers, fewest = [*_single(times, signals, changes)], FEWEST
    if len(answers) < fewest:
        answers, fewest = [*_in_windows(times, signals, changes)], FEWEST_WINDOWS
    if not answers:
        return None
    when, misfits = zip(*answers, strict=True)
    return Answers(np.array(misfits), np.array(when), fewest)


def _single(
    times: NDArray, signals: NDArray, changes: NDArray
) -> Iterator[tuple[float, NDArray[np.float64]]]:
    """Give time and misfit [D, T] of the answer to every change that has room."""
    interval = float(np.median(np.diff(times)))
    delays, lags = np.arange(-REACH, REACH + STEP / 2, STEP), np.array(LAGS)
    for time, *sizes, room in changes:
        if room < LEAST_DURATION:
            continue
        rows = slice(*np.searchsorted(times, [time - BEFORE, time + AFTER]))
        around = times[rows] - time
        if not _seen_in(around, BEFORE + AFTER, interval):
            continue
        late = (around - delays[:, None])[..., None]
        shape = np.where(late > 0, late - lags * -np.expm1(-np.maximum(late, 0) / lags), 0)
        for signal, size in enumerate(sizes):
            if abs(size) >= LEAST_CHANGE:
                yield time, _misfit(around, signals[rows, signal], shape)


def _in_windows(
    times: NDArray, signals: NDArray, changes: NDArray
) -> Iterator[tuple[float, NDArray[np.float64]]]:
    """Give time and misfit [D, T] of the answers to all changes in every window of the path."""
    interval = float(np.median(np.diff(times)))
    begin = changes[0, 0] - BEFORE
    end = max(changes[-1, 0] + AFTER, begin + WINDOW)  # one window at least
    reach = round(REACH / STEP)
    grid = begin + STEP * np.arange(-reach - 1, math.ceil((end - begin) / STEP) + reach + 2)
    commanded = np.zeros((len(grid), 2))
    np.add.at(commanded, np.searchsorted(grid, changes[:, 0]), changes[:, 1:3])
    commanded = np.cumsum(commanded, axis=0)
    keep = np.exp(-STEP / np.array(LAGS))[:, None]
    speeds = np.zeros((len(grid), len(LAGS), 2))
    for i in range(1, len(grid)):
        speeds[i] = commanded[i - 1] + (speeds[i - 1] - commanded[i - 1]) * keep
    paths = np.cumsum(speeds, axis=0) * STEP
    for number in range(max(int((end - begin) / WINDOW), 1)):
        first = begin + number * WINDOW
        rows = slice(*np.searchsorted(times, [first, first + WINDOW]))
        around = times[rows] - first
        if not _seen_in(around, WINDOW, interval):
            continue
        # Dead times are whole steps of the grid; a frame lies between two of its points.
        place = (times[rows] - grid[0]) / STEP
        below = place.astype(int)
        at = below - np.arange(-reach, reach + 1)[:, None]
        part = (place - below)[:, None]
        inside = (grid >= first) & (grid <= first + WINDOW)
        for signal in range(2):
            if np.ptp(commanded[inside, signal]) >= LEAST_CHANGE:
                path = paths[..., signal]
                shape = path[at] * (1.0 - part) + path[at + 1] * part
                yield first + WINDOW / 2, _misfit(around, signals[rows, signal], shape)


def _seen_in(around: NDArray, length: float, interval: float) -> bool:
    """Return whether frames cover a duration, s.

    A dropped frame or two do no harm; a robot that is out of sight does.
    """
    if len(around) < max(6, 0.7 * length / interval):
        return False
    return bool(np.diff(around).max() <= 0.25 * BEFORE + AFTER)


def _misfit(around: NDArray, seen: NDArray, shape: NDArray) -> NDArray[np.float64]:
    """Return a signal less a straight line and a multiple of a shape, [D, T].

    Args:
        around: times [N] of the signal, s.
        seen: the signal [N].
        shape: of its answer, [D, N, T].
    """
    line = np.linalg.qr(np.column_stack([np.ones_like(around), around]))[0]
    rest = seen - line @ (line.T @ seen)
    shape = shape - np.einsum("nk,dkt->dnt", line, np.einsum("nk,dnt->dkt", line, shape))
    power = np.maximum((shape**2).sum(axis=1), 1e-12)
    misfit = float(rest @ rest) - np.einsum("n,dnt->dt", rest, shape) ** 2 / power
    # In units of the signal, so that a small one counts less.
    noise = max(misfit.min() / max(len(around) - 5, 1), 1e-12)
    return misfit / noise


def delay_of(answers: Answers) -> Delay | None:
    """Return dead time and lag of all answers together, or None where they are too few."""
    count = len(answers.misfit)
    if count < answers.fewest:
        return None
    total = answers.misfit.sum(axis=0)
    delay, lag = _least(total)
    without = np.array([_least(total - one)[0] for one in answers.misfit])
    sd = float(np.sqrt((count - 1) / count * ((without - without.mean()) ** 2).sum()))
    return Delay(delay, math.hypot(sd, SYSTEMATIC), lag, count)


def _least(misfit: NDArray) -> tuple[float, float]:
    """Return dead time and lag of the least misfit [D, T], both to a part of their steps."""
    column = int(misfit.min(axis=0).argmin())
    column = min(max(column, 1), misfit.shape[1] - 2)
    rows, least = zip(*(_dip(misfit[:, c]) for c in (column - 1, column, column + 1)), strict=True)
    # The dead time bends with the lag: a parabola through the three best ones.
    aside = _vertex(*least)
    place = rows[1] + aside * (rows[2] - rows[0]) / 2
    place += aside**2 * (rows[2] - 2 * rows[1] + rows[0]) / 2
    return -REACH + STEP * place, LAGS[0] * (column + 1 + aside)


def _dip(values: NDArray) -> tuple[float, float]:
    """Return position and value of the minimum of some values, by the parabola through three."""
    place = min(max(int(values.argmin()), 1), len(values) - 2)
    low, middle, high = (float(v) for v in values[place - 1 : place + 2])
    aside = _vertex(low, middle, high)
    return place + aside, middle - aside * (low - high) / 4


def _vertex(low: float, middle: float, high: float) -> float:
    """Return where, in steps from the middle one, the parabola through three values is least."""
    bend = low - 2 * middle + high
    return float(np.clip(0.5 * (low - high) / bend, -1.0, 1.0)) if bend > 0 else 0.0
