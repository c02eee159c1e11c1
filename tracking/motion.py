"""Clock sync by motion: when a robot was seen to answer its commands.

A wheel that is told another speed goes on as before for a dead time d (the radio's, the
brick's) and then approaches the new speed as exp(-t / T). The path and the heading around the
instant of a command are therefore

    a + b t + c g(t - d),    g(t) = t - T (1 - exp(-t / T)) for t > 0, else 0,

with a, b, c of each command's own and d and T shared. a, b and c are linear and drop out
(variable projection, Golub and Pereyra 1973), d and T are searched on a grid over all commands
together. The spread of d comes from leaving out one command after the other (the jackknife),
not from the residuals, which are far from independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from tracking.sync import ClockFit

#: Seconds of track before and after a command that its answer is sought in.
BEFORE, AFTER = 0.2, 0.45
#: A change of the mean or of half the difference of the speeds below this (percent) is no
#: event; one command must last this long (s) for the next one's answer to be told from its own.
LEAST_CHANGE, LEAST_DURATION = 8.0, 0.45
#: Fewer answers than this fix no delay.
FEWEST = 5
#: Dead times that are tried, s, and motor lags.
REACH, STEP = 0.15, 0.002
LAGS = tuple(0.02 * i for i in range(1, 16))

#: What the shape of the answer is wrong by, s: wheels of a known dead time and lag come out 1 to
#: 2 ms off however many commands there are.
SYSTEMATIC = 0.002

#: The commands of the first so many seconds are looked for in a video.
TEMPLATE = 120.0
#: The motion agrees with the commands at least so well (a correlation), and no second place in
#: the video does so to this share of the best.
LEAST_AGREEMENT, AMBIGUOUS = 0.6, 0.85
#: Answers are put together over this long before the next ones are predicted from them, s.
STRETCH = 60.0

#: Flashes and motion may differ by this, s: a radio takes some of it.
MOST_APART = 0.06


class MotorLine(Protocol):
    """A line of a command log that changes the motors' speeds (percent); see ``CommandLine``."""

    time: float
    left: float
    right: float


@dataclass(frozen=True)
class Delay:
    """How long after a command's time, on the clock of the track, the motors answered.

    Attributes:
        delay: dead time in seconds, before the motors' own lag begins.
        sd: its standard deviation, from leaving out one answer after the other.
        lag: of the motors, time constant in seconds.
        answers: how many changes of speed it rests on.
    """

    delay: float
    sd: float
    lag: float
    answers: int


@dataclass(frozen=True)
class _Answers:
    """Misfits [K, D, T] of K answers at every dead time and lag; their times [K]."""

    misfit: NDArray
    times: NDArray


def motion_delay(times: ArrayLike, poses: ArrayLike, lines: Iterable[MotorLine]) -> Delay | None:
    """Find how late the motors answered their commands.

    Args:
        times: [N] of the poses, on the clock of the commands, s.
        poses: [N, 3], m, m, unwrapped rad; NaN where the robot was not seen.
        lines: what was sent to the motors, in order.

    Returns:
        The delay, within 0.15 s of the commands' times; None if too few commands changed the
        speeds to tell, or the answers lie beyond what is looked for.
    """
    answers = _answers(*_signals(times, poses), _changes(lines))
    found = None if answers is None else _delay(answers)
    return None if found is None or abs(found.delay) >= REACH - STEP else found


def disagreement(
    clock: ClockFit, times: ArrayLike, poses: ArrayLike, lines: Sequence[MotorLine]
) -> str | None:
    """Say by how much the clock of the flashes and that of the motion differ, if they do.

    A radio's delay is within what is let pass: 60 ms, and four standard deviations.

    Args:
        clock: by the flashes.
        times, poses, lines: as :func:`fit_clock_to_motion` takes them.
    """
    try:
        motion = fit_clock_to_motion(times, poses, lines)
    except UserError:
        return None
    first = float(np.asarray(times, float)[0])
    begin, moved = (
        (lines[0].time - fit.offset) / (1 + fit.drift) - first for fit in (clock, motion)
    )
    apart = moved - begin
    if abs(apart) <= max(MOST_APART, 4 * math.hypot(clock.sd, motion.sd)):
        return None
    return (
        f"the flashes say that the first command was sent {begin:.2f} s into the video, the "
        f"motion says {moved:.2f} s, {1000 * abs(apart):.0f} ms "
        f"{'later' if apart > 0 else 'earlier'}; use --sync motion if the flashes are mistaken"
    )


def _signals(times: ArrayLike, poses: ArrayLike) -> tuple[NDArray, NDArray]:
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


def _changes(lines: Iterable[MotorLine]) -> NDArray:
    """Return [K, 4]: time of each change of speed, change of mean and half difference, room.

    The room is the time until the next line; a change right after another one has none.
    """
    rows = [(line.time, line.left, line.right) for line in lines]
    if not rows:
        return np.empty((0, 4))
    table = np.array(rows, float)
    before = np.vstack([[0.0, 0.0], table[:-1, 1:]])
    change = table[:, 1:] - before
    length = np.append(np.diff(table[:, 0]), np.inf)
    room = np.where(np.append(np.inf, length[:-1]) < LEAST_DURATION, 0.0, length)
    mean, half = change.mean(axis=1), (change[:, 1] - change[:, 0]) / 2
    return np.column_stack([table[:, 0], mean, half, room])


def _answers(times: NDArray, signals: NDArray, changes: NDArray) -> _Answers | None:
    """Return the misfit of every answer that is seen, over dead times and lags."""
    if len(times) < 2:
        return None
    interval = float(np.median(np.diff(times)))
    delays = np.arange(-REACH, REACH + STEP / 2, STEP)
    misfits, when = [], []
    for time, *sizes, room in changes:
        if room < LEAST_DURATION:
            continue
        rows = slice(*np.searchsorted(times, [time - BEFORE, time + AFTER]))
        around = times[rows] - time
        # A dropped frame or two do no harm; a robot that is out of sight does.
        expected = (BEFORE + AFTER) / interval
        if len(around) < max(6, 0.7 * expected) or np.diff(around).max() > 0.25 * BEFORE + AFTER:
            continue
        line = np.linalg.qr(np.column_stack([np.ones_like(around), around]))[0]
        late = around - delays[:, None]
        for signal, size in enumerate(sizes):
            if abs(size) < LEAST_CHANGE:
                continue
            seen = signals[rows, signal]
            rest = seen - line @ (line.T @ seen)
            total = float(rest @ rest)
            misfit = np.empty((len(delays), len(LAGS)))
            for i, lag in enumerate(LAGS):
                shape = np.where(late > 0, late - lag * -np.expm1(-np.maximum(late, 0) / lag), 0)
                shape = shape - (shape @ line) @ line.T
                power = np.maximum((shape**2).sum(axis=1), 1e-12)
                misfit[:, i] = total - (shape @ rest) ** 2 / power
            # In units of the signal that there was to explain, so that a small one counts less.
            noise = max(misfit.min() / max(len(around) - 5, 1), 1e-12)
            misfits.append(misfit / noise)
            when.append(time)
    if not misfits:
        return None
    return _Answers(np.array(misfits), np.array(when))


def _delay(answers: _Answers) -> Delay | None:
    count = len(answers.misfit)
    if count < FEWEST:
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
    """Return place and value of the least of some values, by the parabola through three."""
    place = min(max(int(values.argmin()), 1), len(values) - 2)
    low, middle, high = (float(v) for v in values[place - 1 : place + 2])
    aside = _vertex(low, middle, high)
    return place + aside, middle - aside * (low - high) / 4


def _vertex(low: float, middle: float, high: float) -> float:
    """Return where, in steps from the middle one, the parabola through three values is least."""
    bend = low - 2 * middle + high
    return float(np.clip(0.5 * (low - high) / bend, -1.0, 1.0)) if bend > 0 else 0.0


def fit_clock_to_motion(times: ArrayLike, poses: ArrayLike, lines: Sequence[MotorLine]) -> ClockFit:
    """Find the robot's clock from commands and motion alone, without any flash.

    On this clock the motors begin to answer at the time of their command. The speeds that were
    seen are first compared with those that were commanded wherever the commands may lie in the
    video; the answers to the single commands then fix the clock, stretch by stretch, so that a
    drift does not add up.

    Args:
        times: camera times [N] of the frames, s.
        poses: [N, 3], m, m, unwrapped rad; NaN where the robot was not seen.
        lines: what was sent to the motors in this session, in order.

    Raises:
        UserError: if too few commands change the speeds, the motion does not follow the
            commands, or it does so at several places in the video.
    """
    times, signals = _signals(times, poses)
    changes = _changes(lines)
    if len(times) < 10 or len(changes) < FEWEST:
        raise UserError(
            f"the clock cannot be found from the motion: {len(changes)} commands and {len(times)} "
            "frames in which the robot was found are too few"
        )
    shift, drift = _place(times, signals, lines), 0.0
    offsets: list[tuple[float, float, float]] = []  # robot time, shift, its standard deviation
    begin, last = float(changes[0, 0]), float(changes[-1, 0])
    while begin <= last:
        near = changes[(changes[:, 0] >= begin) & (changes[:, 0] < begin + STRETCH)]
        begin += STRETCH
        for _ in range(2):  # once more with the answers in the middle of what is tried
            answers = _answers(times + shift, signals, near)
            found = None if answers is None else _delay(answers)
            if found is None or abs(found.delay) >= REACH - STEP:
                found = None
                break
            shift -= found.delay
        if found is not None:
            offsets.append((float(answers.times.mean()), shift, found.sd))
    if not offsets:
        raise UserError(
            "the clock cannot be found from the motion: too few commands are seen to change the "
            "robot's speed; record more of them, or with the lamp"
        )
    at, shifts, sds = np.array(offsets).T
    middle, drift_sd = float(np.average(at, weights=sds**-2)), 0.0
    if at[-1] - at[0] >= STRETCH:
        drift, shift = (float(c) for c in np.polyfit(at - middle, shifts, 1, w=1 / sds))
        drift_sd = float(1 / np.sqrt((((at - middle) / sds) ** 2).sum()))
    else:
        shift = float(np.average(shifts, weights=sds**-2))
    # robot = camera + shift + drift (robot - middle), solved for the robot's time.
    offset = (shift - drift * middle) / (1 - drift)
    rest = shifts - shift - drift * (at - middle)
    return ClockFit(
        offset,
        drift / (1 - drift),
        float(np.sqrt(np.mean(rest**2))),
        (),
        sd=float(1 / np.sqrt((sds**-2.0).sum())),
        drift_sd=drift_sd,
    )


_NO_MOTION = (
    "the motion in the video does not follow the commands; is this the video of this recording, "
    "and was the robot in view?"
)


def _place(times: NDArray, signals: NDArray, lines: Sequence[MotorLine]) -> float:
    """Return the shift (robot minus camera time) at which seen and commanded speeds agree best."""
    step = max(float(np.median(np.diff(times))), 0.01)
    grid = np.arange(times[0], times[-1], step)
    seen = np.gradient(
        np.stack([np.interp(grid, times, signals[:, i]) for i in range(2)]), step, axis=1
    )
    # What a mistaken frame gives must not outweigh all the rest.
    most = np.quantile(np.abs(seen), 0.99, axis=1, keepdims=True) * 1.2
    seen = np.clip(seen, -most, most)
    first = lines[0].time
    wanted = _commanded(lines, first, min(lines[-1].time, first + TEMPLATE), step)
    length = wanted.shape[1]
    size = 1 << (len(grid) + 2 * length).bit_length()

    def slide(series: NDArray, kernel: NDArray) -> NDArray:
        """Return the sum of products at every overlap, the kernel's start at -length + 1 + i."""
        spectrum = np.fft.rfft(series, size) * np.conj(np.fft.rfft(kernel, size))
        return np.roll(np.fft.irfft(spectrum, size), length - 1)[: len(grid) + length - 1]

    ones, whole = np.ones(len(grid)), np.ones(length)
    agreement, channels = np.zeros(len(grid) + length - 1), 0
    for moved, told in zip(seen, wanted, strict=True):
        told_power, moved_power = float(told @ told), slide(moved**2, whole)
        if told_power < 1e-9 or not moved.any():
            continue
        covered = slide(ones, told**2)
        # Little of the commands in the video would agree with anything.
        enough = covered > 0.5 * told_power
        power = np.maximum(covered * moved_power, 1e-12 * told_power * (moved @ moved))
        agreement += np.where(enough, slide(moved, told) / np.sqrt(power), 0.0)
        channels += 1
    if channels == 0:
        raise UserError(_NO_MOTION)
    agreement /= channels
    best = int(agreement.argmax())
    if agreement[best] < LEAST_AGREEMENT:
        raise UserError(_NO_MOTION)
    shifts = first - (times[0] + step * (np.arange(len(agreement)) - length + 1))
    others = np.where(np.abs(shifts - shifts[best]) > 1.0, agreement, 0.0)
    if others.max() > AMBIGUOUS * agreement[best]:
        rival = int(others.argmax())
        raise UserError(
            "the clock cannot be found from the motion: it follows the commands from "
            f"{first - shifts[best]:.2f} s and from {first - shifts[rival]:.2f} s of the video; "
            "record with the lamp, or cut the video"
        )
    return float(shifts[best])


def _commanded(lines: Sequence[MotorLine], begin: float, end: float, step: float) -> NDArray:
    """Return [2, N] mean and half difference of the commanded speeds, behind a lag of 0.1 s."""
    grid = np.arange(begin, end + 0.5, step)
    current = np.searchsorted([line.time for line in lines], grid, side="right") - 1
    speeds = np.array([(line.left, line.right) for line in lines], float)[current]
    profile = np.stack([speeds.mean(axis=1), (speeds[:, 1] - speeds[:, 0]) / 2])
    lag = np.exp(-np.arange(0.0, 0.6, step) / 0.1)
    lag /= lag.sum()
    return np.stack([np.convolve(row, lag)[: profile.shape[1]] for row in profile])
