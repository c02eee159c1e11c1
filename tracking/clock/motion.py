"""Clock sync by motion: the times in a video at which a robot answers its commands.

The seen speeds are shifted along the commanded ones; then the answers to single commands
(:mod:`tracking.clock.motor_delay`) fix the clock, and check that of the flashes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from tracking.clock.motor_delay import (
    FEWEST,
    REACH,
    STEP,
    MotorLine,
    answers_to,
    changes_of,
    delay_of,
    signals_of,
)
from tracking.clock.sync import ClockFit

#: Duration of the commands that are searched in a video, s.
TEMPLATE = 120.0
#: Smallest part of the commands that is in a video: a small one would agree with any motion. Of a
#: video that was recorded with the commands only its very ends may be missing.
IN_VIDEO, IN_WHOLE = 0.5, 0.9
#: Smallest correlation of motion and commands, and largest fraction of it at a second position in
#: the video.
LEAST_AGREEMENT, AMBIGUOUS = 0.6, 0.85
#: Smallest number of changes of speed for the clock: a start, a stop, and one between them.
LEAST_CHANGES = 3
#: Time over which answers are combined before the next ones are predicted from them, s.
STRETCH = 60.0
#: Largest difference of flashes and motion, s, which includes a radio's delay.
MOST_APART = 0.06


def fit_clock_to_motion(
    times: ArrayLike, poses: ArrayLike, lines: Sequence[MotorLine], *, whole: bool = False
) -> ClockFit:
    """Find the robot's clock from commands and motion alone, without any flash.

    On this clock the motors begin to answer at the time of their command. The seen speeds are first
    compared with the commanded ones at all possible positions in the video; then the answers to
    single commands fix the clock, stretch by stretch, so that a drift does not add up.

    Args:
        times: camera times [N] of the frames, s.
        poses: [N, 3], m, m, unwrapped rad; NaN where the robot was not seen.
        lines: commands sent to the motors in this session, in order.
        whole: whether all of them are in the video, as in one that was recorded with them.

    Raises:
        UserError: if too few commands change the speeds, the motion does not follow the
            commands, or it does so at several places in the video.
    """
    times, signals = signals_of(times, poses)
    changes = changes_of(lines)
    if len(times) < 10 or len(changes) < LEAST_CHANGES:
        raise UserError(
            f"the clock cannot be found from the motion: {len(changes)} commands and {len(times)} "
            "frames with the robot are too few"
        )
    shift, drift = _place(times, signals, lines, IN_WHOLE if whole else IN_VIDEO), 0.0
    offsets: list[tuple[float, float, float]] = []  # robot time, shift, its standard deviation
    begin, last = float(changes[0, 0]), float(changes[-1, 0])
    while begin <= last:
        near = changes[(changes[:, 0] >= begin) & (changes[:, 0] < begin + STRETCH)]
        begin += STRETCH
        for _ in range(2):  # once more with the answers in the middle of the searched range
            answers = answers_to(times + shift, signals, near)
            delay = None if answers is None else delay_of(answers)
            if delay is None or abs(delay.delay) >= REACH - STEP:
                delay = None
                break
            shift -= delay.delay
        if delay is not None:
            offsets.append((float(answers.times.mean()), shift, delay.sd))
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


def _place(times: NDArray, signals: NDArray, lines: Sequence[MotorLine], in_video: float) -> float:
    """Return the shift (robot minus camera time) at which seen and commanded speeds agree best.

    At least the part ``in_video`` of the commands is in the video.
    """
    step = max(float(np.median(np.diff(times))), 0.01)
    grid = np.arange(times[0], times[-1], step)
    seen = _speeds(times, signals, grid)
    # A wrong frame must not outweigh all others.
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
    for moved, wanted_speed in zip(seen, wanted, strict=True):
        wanted_power, moved_power = float(wanted_speed @ wanted_speed), slide(moved**2, whole)
        if wanted_power < 1e-9 or not moved.any():
            continue
        covered = slide(ones, wanted_speed**2)
        enough = covered > in_video * wanted_power
        power = np.maximum(covered * moved_power, 1e-12 * wanted_power * (moved @ moved))
        agreement += np.where(enough, slide(moved, wanted_speed) / np.sqrt(power), 0.0)
        channels += 1
    if channels == 0:
        raise UserError(_NO_MOTION)
    agreement /= channels
    best = int(agreement.argmax())
    if agreement[best] < LEAST_AGREEMENT:
        raise UserError(_NO_MOTION)
    shifts = first - (times[0] + step * (np.arange(len(agreement)) - length + 1))
    others = np.where(_beyond(agreement, best), agreement, 0.0)
    if others.max() > AMBIGUOUS * agreement[best]:
        rival = int(others.argmax())
        raise UserError(
            f"the clock is ambiguous: the motion fits the video at {first - shifts[best]:.2f} s "
            f"and at {first - shifts[rival]:.2f} s; record with the lamp, or cut the video"
        )
    return float(shifts[best])


def _beyond(agreement: NDArray, best: int) -> NDArray[np.bool_]:
    """Return whether positions [N] in the video are not on the flanks of the best one.

    Long, similar commands have long flanks. They end at a valley, after which the agreement rises
    again by a tenth of the best.
    """
    beyond = np.ones(len(agreement), np.bool_)
    rise = 0.1 * agreement[best]
    for direction in (1, -1):
        side = agreement[best::direction]
        up = np.flatnonzero(side > np.minimum.accumulate(side) + rise)
        end = int(up[0]) if len(up) else len(side)
        beyond[best::direction][: int(side[:end].argmin()) + 1] = False
    return beyond


def follows_commands(times: ArrayLike, poses: ArrayLike, lines: Sequence[MotorLine]) -> bool:
    """Return whether a stretch of a track moves as it was commanded, so that it is the robot's.

    Args:
        times: [N] of the poses, s, on the clock of the commands.
        poses: [N, 3], m, m, unwrapped rad; NaN where nothing was seen.
        lines: commands sent to the motors in this session, in order.
    """
    times, signals = signals_of(times, poses)
    if len(times) < 10 or not lines:
        return False
    begin, end = max(float(times[0]), lines[0].time), float(times[-1])
    changes = changes_of(lines)[:, 0]
    if ((changes > begin) & (changes < end)).sum() < FEWEST:
        return False
    step = max(float(np.median(np.diff(times))), 0.01)
    wanted = _commanded(lines, begin, end, step)
    grid = begin + step * np.arange(wanted.shape[1])
    agreements = []
    for moved, wanted_speed in zip(_speeds(times, signals, grid), wanted, strict=True):
        if np.ptp(wanted_speed) > 1e-9:
            agreements.append(
                np.corrcoef(moved, wanted_speed)[0, 1] if np.ptp(moved) > 1e-9 else 0.0
            )
    return bool(np.mean(agreements) >= LEAST_AGREEMENT)


def _speeds(times: NDArray, signals: NDArray, grid: NDArray) -> NDArray:
    """Return the derivatives [2, G] of signals [N, 2] on an even grid of times."""
    step = grid[1] - grid[0]
    return np.gradient(
        np.stack([np.interp(grid, times, signals[:, i]) for i in range(2)]), step, axis=1
    )


def _commanded(lines: Sequence[MotorLine], begin: float, end: float, step: float) -> NDArray:
    """Return [2, N] the commanded forward and turning speeds, after a lag of 0.1 s."""
    grid = np.arange(begin, end + 0.5, step)
    current = np.searchsorted([line.time for line in lines], grid, side="right") - 1
    profile = np.array([(line.forward, line.turn) for line in lines], float)[current].T
    lag = np.exp(-np.arange(0.0, 0.6, step) / 0.1)
    lag /= lag.sum()
    return np.stack([np.convolve(row, lag)[: profile.shape[1]] for row in profile])


def disagreement(
    clock: ClockFit,
    times: ArrayLike,
    poses: ArrayLike,
    lines: Sequence[MotorLine],
    *,
    whole: bool = False,
) -> str | None:
    """Return a sentence about the difference between the clocks of flashes and motion, if any.

    A radio's delay is accepted: 60 ms, and four standard deviations.

    Args:
        clock: by the flashes.
        times, poses, lines, whole: as in :func:`fit_clock_to_motion`.
    """
    try:
        motion = fit_clock_to_motion(times, poses, lines, whole=whole)
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
