"""Clock sync by flash: the mapping from the camera's clock to the robot's.

The robot's lamp is switched at known times of the robot's clock (section 6.1 of Pretorius et
al. 2009). The lamp's brightness in the video, frame by frame, is compared with the pattern of these
times: coarsely by sliding the pattern along the video, then to a fraction of a frame by the part of
each frame's exposure with the lamp on. A flash at the start fixes the offset,
a second one at the end the drift.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError

#: Seconds of lamp off before and after a flash that belong to its pattern.
CONTEXT = 0.6
#: Pulses further apart than this are separate flashes.
GROUP_GAP = 5.0
#: Two flashes fix the drift only if they are this many seconds apart.
DRIFT_SPAN = 20.0
#: Clocks differ by less than this fraction, and by this many seconds over a short time.
MOST_DRIFT, SLACK = 2e-3, 0.1
#: Smallest correlation of a flash with its pattern, and smallest increase of brightness (of 255).
LEAST_CORRELATION, LEAST_CONTRAST = 0.75, 2.0
#: Fraction of the best fit at a second position that makes the result ambiguous.
AMBIGUOUS = 0.75

# Exposure times that are tried, as fractions of the time between frames.
_EXPOSURES = (0.05, 0.25, 0.5, 0.75, 1.0)
# Largest error of a frame's fraction of full brightness, because of saturation.
_FRACTION_NOISE = 0.08


class LampLine(Protocol):
    """A line of a command log; see ``Recording.commands``."""

    kind: str
    time: float


@dataclass(frozen=True)
class ClockFit:
    """robot time = offset + (1 + drift) * camera time, in seconds.

    Attributes:
        offset: in seconds.
        drift: of the robot's clock against the camera's; 0 unless two flashes were far apart.
        residual: of the lamp's single edges, root of the mean square in seconds.
        flashes: camera times in seconds at which the flashes begin.
        sd: standard deviation, in seconds, of the robot time of a flash (or, without flashes,
            of the middle of the motion).
        drift_sd: standard deviation of the drift; 0 where no drift was fitted.
    """

    offset: float
    drift: float
    residual: float
    flashes: tuple[float, ...]
    sd: float = 0.0
    drift_sd: float = 0.0

    def to_robot(self, camera_time: ArrayLike) -> NDArray:
        """Return robot times of camera times, in seconds."""
        return self.offset + (1.0 + self.drift) * np.asarray(camera_time, float)


def pulses(lines: Iterable[LampLine]) -> list[tuple[float, float]]:
    """Return (on, off) robot times of the lamp in one session's command lines."""
    flashes, on = [], None
    for line in lines:
        if line.kind == "lamp-on" and on is None:
            on = line.time
        elif line.kind == "lamp-off" and on is not None:
            if line.time > on:
                flashes.append((on, line.time))
            on = None
    return flashes


def fit_clock(
    times: ArrayLike, brightness: ArrayLike, lamp: Sequence[tuple[float, float]]
) -> ClockFit:
    """Find when the lamp flashed, and from that the mapping between the clocks.

    Args:
        times: camera time [N] of every frame, in seconds, increasing.
        brightness: of the lamp [N], any scale up to 255; NaN where the robot was not found.
        lamp: (on, off) times on the robot's clock.

    Raises:
        UserError: if the lamp was never switched, no flash is seen, or several places in the
            video fit equally well.
    """
    times, brightness = np.asarray(times, float), np.asarray(brightness, float)
    if not lamp:
        raise UserError(
            "the lamp was never switched on, so the video cannot be matched with the commands; "
            "record with the lamp, or find the clock from the motion with --sync motion"
        )
    if np.isfinite(brightness).sum() < 3:
        raise UserError("no flash found: the robot is hardly ever seen in the video")
    groups = _groups(lamp)
    shift = _coarse(times, brightness, groups)
    fitted = []
    for group in groups:
        # The pattern is searched again near its position by the first flash.
        slack = SLACK + MOST_DRIFT * abs(group[0][0] - groups[0][0][0])
        near = _near(times, brightness, group, shift, slack)
        if near is not None:
            fitted.append((group, *_fine(times, brightness, group, near)))
    if not fitted:
        raise UserError(_NO_FLASH)
    first, last = fitted[0], fitted[-1]
    drift = drift_sd = 0.0
    begin, end = first[0][0][0] - first[1], last[0][0][0] - last[1]
    if end - begin >= DRIFT_SPAN:
        drift = (last[1] - first[1]) / (end - begin)
        drift_sd = math.hypot(first[2], last[2]) / (end - begin)
    offset = first[1] - drift * begin
    fit = ClockFit(offset, drift, 0.0, ())
    edges = [edge for group, *_ in fitted for edge in _edge_misfits(times, brightness, group, fit)]
    residual = float(np.sqrt(np.mean(np.square(edges)))) if edges else 0.0
    starts = tuple((group[0][0] - offset) / (1.0 + drift) for group, *_ in fitted)
    sd = max(each[2] for each in fitted)
    return ClockFit(offset, drift, residual, starts, sd, drift_sd)


_NO_FLASH = (
    "no flash found in the video: the lamp must be seen between the markers while it flashes; "
    "is this the video of this recording, and was the robot in view from the start?"
)


def _groups(lamp: Sequence[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    groups = [[lamp[0]]]
    for pulse in lamp[1:]:
        if pulse[0] - groups[-1][-1][1] > GROUP_GAP:
            groups.append([])
        groups[-1].append(pulse)
    return groups


def _coarse(times: NDArray, brightness: NDArray, groups: list[list[tuple[float, float]]]) -> float:
    """Return the shift (robot minus camera time) that explains all flashes best."""
    matches = [_slide(times, brightness, group) for group in groups]
    candidates = [shift for match in matches for shift in _peaks(*match)]
    if not candidates:
        raise UserError(_NO_FLASH)
    rated = []
    for shift in candidates:
        rating = 0.0
        for (shifts, score), group in zip(matches, groups, strict=True):
            slack = SLACK + MOST_DRIFT * abs(group[0][0] - shift - times[0])
            near = np.abs(shifts - shift) <= slack
            rating += float(score[near].max(initial=0.0))
        # A position at which most of the video would have no commands is less likely.
        begin, end = groups[0][0][0], groups[-1][-1][1]
        shared = min(times[-1] + shift, end) - max(times[0] + shift, begin)
        possible = min(times[-1] - times[0], end - begin)
        rating *= 0.5 + 0.5 * float(np.clip(shared / max(possible, 1e-9), 0, 1))
        rated.append((rating, shift))
    rated.sort(reverse=True)
    best = rated[0]
    apart = 0.3 + MOST_DRIFT * (groups[-1][0][0] - groups[0][0][0])
    for rating, shift in rated[1:]:
        if abs(shift - best[1]) > apart and rating > AMBIGUOUS * best[0]:
            raise UserError(
                "the flash is ambiguous: the lamp's pattern fits the video at "
                f"{groups[0][0][0] - best[1]:.2f} s and at {groups[0][0][0] - shift:.2f} s; "
                "cut the video so that only one remains"
            )
    return best[1]


def _slide(
    times: NDArray, brightness: NDArray, group: list[tuple[float, float]]
) -> tuple[NDArray, NDArray]:
    """Slide a flash's pattern along the video: shifts, and a score (contrast times fit) each."""
    step = float(np.median(np.diff(times))) / 2
    begin, end = group[0][0] - CONTEXT, group[-1][1] + CONTEXT
    kernel_times = begin + step * np.arange(int((end - begin) / step) + 1)
    pattern = _fraction_lit(kernel_times, 2 * step, group)
    # Beyond both ends by the context, so that a flash right at the start can be found.
    pad = int(CONTEXT / step) + len(kernel_times)
    grid = times[0] + step * np.arange(-pad, int((times[-1] - times[0]) / step) + pad + 1)
    seen = np.isfinite(brightness)
    values = np.interp(grid, times[seen], brightness[seen])
    # Beyond one and a half frames from a seen one, the brightness is unknown.
    weight = (np.abs(grid - _nearest(times[seen], grid)) < 3 * step).astype(float)
    values = np.where(weight > 0, values - np.median(brightness[seen]), 0.0)

    def correlate(series: NDArray, kernel: NDArray) -> NDArray:
        size = 1 << (len(series) + len(kernel) - 1).bit_length()
        spectrum = np.fft.rfft(series, size) * np.conj(np.fft.rfft(kernel, size))
        return np.fft.irfft(spectrum, size)[: len(series) - len(kernel) + 1]

    ones = np.ones(len(pattern))
    n = np.maximum(correlate(weight, ones), 1e-9)
    lit = correlate(weight, pattern)
    cov = correlate(values, pattern) - lit * correlate(values, ones) / n
    power = np.maximum(correlate(values**2, ones) - correlate(values, ones) ** 2 / n, 1e-9)
    spread = np.maximum(correlate(weight, pattern**2) - lit**2 / n, 1e-9)
    correlation = cov / np.sqrt(power * spread)
    contrast = cov / spread
    usable = (
        (lit > 0.8 * pattern.sum())
        & (n - lit > 0.4 * (len(pattern) - pattern.sum()))
        & (correlation > LEAST_CORRELATION)
        & (contrast > _least_contrast(brightness))
    )
    score = np.where(usable, contrast * correlation**2, 0.0)
    return begin - grid[: len(score)], score


def _least_contrast(brightness: NDArray) -> float:
    changes = np.abs(np.diff(brightness[np.isfinite(brightness)]))
    return max(LEAST_CONTRAST, 5.0 * 1.4826 * float(np.median(changes)) / np.sqrt(2))


def _nearest(times: NDArray, grid: NDArray) -> NDArray:
    right = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    left = times[right - 1]
    return np.where(grid - left < times[right] - grid, left, times[right])


def _peaks(shifts: NDArray, score: NDArray, most: int = 6) -> list[float]:
    score, peaks = score.copy(), []
    while len(peaks) < most and score.max(initial=0.0) > 0:
        place = int(score.argmax())
        peaks.append(float(shifts[place]))
        score[np.abs(shifts - shifts[place]) < 0.3] = 0.0
    return peaks


def _near(
    times: NDArray,
    brightness: NDArray,
    group: list[tuple[float, float]],
    shift: float,
    slack: float,
) -> float | None:
    """Return the best shift of one flash near a given one, or None if it is not seen."""
    begin, end = group[0][0] - 2 * CONTEXT, group[-1][1] + 2 * CONTEXT
    rows = (times + shift > begin - slack) & (times + shift < end + slack)
    if np.isfinite(brightness[rows]).sum() < 3:
        return None
    shifts, score = _slide(times[rows], brightness[rows], group)
    score = np.where(np.abs(shifts - shift) <= slack, score, 0.0)
    return float(shifts[score.argmax()]) if score.max(initial=0.0) > 0 else None


def _fine(
    times: NDArray, brightness: NDArray, group: list[tuple[float, float]], shift: float
) -> tuple[float, float]:
    """Return mean and standard deviation of the shift, weighted by the fit of the light.

    If an edge is between two exposures, a range of shifts fits the frames equally well; the mean is
    in its middle.
    """
    begin, end = group[0][0] - CONTEXT, group[-1][1] + CONTEXT
    rows = (times + shift > begin) & (times + shift < end) & np.isfinite(brightness)
    seen, values = times[rows], brightness[rows]
    frame = float(np.median(np.diff(times)))
    shifts = shift + frame * np.linspace(-2.5, 2.5, 501)
    misfit = np.empty((len(_EXPOSURES), len(shifts)))
    for i, exposure in enumerate(_EXPOSURES):
        fraction = _fraction_lit(seen + shifts[:, None], exposure * frame, group)
        centred = fraction - fraction.mean(axis=1, keepdims=True)
        dark = values - values.mean()
        gain = (centred @ dark) / np.maximum((centred**2).sum(axis=1), 1e-9)
        rest = (dark - gain[:, None] * centred) / np.maximum(gain, 1e-9)[:, None]
        misfit[i] = np.where(gain > 0, (rest**2).sum(axis=1), np.inf)
    likelihood = np.exp(-(misfit - misfit.min()) / (2 * _FRACTION_NOISE**2))
    likelihood /= likelihood.sum()
    mean = float((likelihood * shifts).sum())
    return mean, float(np.sqrt((likelihood * (shifts - mean) ** 2).sum()))


def _fraction_lit(times: NDArray, exposure: float, group: Iterable[tuple[float, float]]) -> NDArray:
    """Return the fraction of exposures, centred on robot times, during which the lamp is on."""
    fraction = np.zeros(np.shape(times))
    for on, off in group:
        lit = np.minimum(times + exposure / 2, off) - np.maximum(times - exposure / 2, on)
        fraction += np.clip(lit / exposure, 0.0, 1.0)
    return fraction


def _edge_misfits(
    times: NDArray, brightness: NDArray, group: list[tuple[float, float]], fit: ClockFit
) -> list[float]:
    """Return the delay, in seconds, of each seen edge of the lamp relative to the fit.

    The time of an edge comes from the area under the brightness, from dark to light or back.
    """
    frame = float(np.median(np.diff(times)))
    robot = fit.to_robot(times)
    seen = np.isfinite(brightness)
    fraction = _fraction_lit(robot, frame, group)
    near = seen & (robot > group[0][0] - CONTEXT) & (robot < group[-1][1] + CONTEXT)
    lit, dark = near & (fraction > 0.99), near & (fraction < 0.01)
    if not lit.any() or not dark.any():
        return []
    base = np.median(brightness[dark])
    level = (brightness - base) / (np.median(brightness[lit]) - base)
    instants = sorted(instant for pulse in group for instant in pulse)
    room = min([CONTEXT, 4 * frame, *(0.5 * np.diff(instants))])
    misfits = []
    for on, off in group:
        for edge, rising in ((on, True), (off, False)):
            fine = edge + room * np.linspace(-1, 1, 201)
            if fine[0] < robot[0] or fine[-1] > robot[-1]:
                continue
            mean = float(np.interp(fine, robot[seen], level[seen]).mean())
            misfits.append(room * (1 - 2 * mean) * (1 if rising else -1))
    return misfits
