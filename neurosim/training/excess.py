"""Learning how much a measured speed counts, and how long, from errors in a log.

From each instant of a log on, the error of the prediction is compared with the error of the speed
before it, times g T (1 - exp(-t / T)), for P / R and T of a grid; see
:mod:`neurosim.simulators.motion.excess`. Then P follows from the products of both errors, which
those of poses hardly change.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.excess import Excess, variances
from neurosim.simulators.motion.noise import residual
from neurosim.training.trainers.windows import LENGTHS, OVERLAP

#: A speed is measured over these times, or longer up to a factor, s.
BEFORE, LATEST = (0.1, 0.4), 3.0
#: The ratios P / R (1/s^2) and time constants (s) that are tried.
CLARITY = tuple(10.0 ** (step / 2) for step in range(9))
LASTS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8)
#: By which fraction of its length a prediction may be longer.
LONGER = 0.25
#: Fraction of the measurements that may be shorter than the shortest that is told.
_SHORTEST = 0.1
#: Size, in medians, of the largest errors for the covariance; smallest correlation that counts, and
#: the largest one, of parts whose time constants differ by a factor at most; smallest variance,
#: where none is known; smallest ratio of the variances of errors ahead and aside.
_FAR, _LEAST_ALIKE, _MOST_ALIKE, _AS_LONG, _SMALLEST, _AS_WELL = 4.5, 0.6, 0.95, 4.0, 1e-12, 0.01
#: Smallest number of separate predictions of a length.
_FEW = 5
#: A measurement counts if it lessens errors by this fraction, and by this many standard errors.
_WORTH, _SURE = 0.02, 2.0


def fit_excess(time: Tensor, predicted: Tensor, actual: Tensor, drive: Tensor) -> Excess | None:
    """Learn how a measured speed counts; None: it tells nothing.

    Args:
        time: of instants, ascending, [M] s.
        predicted: poses then, [M, 3] m, m, rad.
        actual: poses then, [M, 3]; both paths begin anywhere.
        drive: number of the drive of each instant, ascending, [M].
    """
    kinds = itertools.product(BEFORE, LENGTHS)
    windows = [_windows(time, predicted, actual, drive, *kind) for kind in kinds]
    windows = [one for one in windows if len(one[0]) >= _FEW * OVERLAP]
    if not windows:
        return None
    shortest = min(one[1].quantile(_SHORTEST) for one in windows).reshape(1)
    best = [(0.0, 0.0, 1.0)] * 3
    for clarity, lasts in itertools.product(CLARITY, LASTS):
        gained, uncertain = torch.zeros(3), torch.zeros(3)
        for before, measured, lasted, after in windows:
            end, mean = variances(measured, torch.tensor(lasts))
            certain = clarity * measured**2
            expected = certain * end / (1.0 + certain * mean) * before
            expected = expected * lasts * -torch.expm1(-lasted / lasts)
            less = after.abs() - (after - expected).abs()
            less = less / after.abs().mean(0).clamp(min=1e-9) / len(windows)
            gained += less.mean(0)
            uncertain += less.std(0) / math.sqrt(len(less) / OVERLAP)
        for c in range(3):
            if gained[c] > max(best[c][0], _WORTH, _SURE * uncertain[c]):
                best[c] = (float(gained[c]), clarity, lasts)
    _, clear, fades = (torch.tensor(each).double() for each in zip(*best, strict=True))
    if not clear.any():
        return None
    covariance = _covariance(windows, fades) * (clear[:, None] * clear > 0)
    errors = torch.where(clear > 0, covariance.diagonal() / clear.clamp(min=CLARITY[0]), 1.0)
    # A place is seen about as well ahead as aside.
    seen = errors[1:][clear[1:] > 0]
    errors[1:] = errors[1:].clamp(min=_AS_WELL * float(seen.max()) if len(seen) else 0.0)
    order = [1, 2, 0]  # from the turn, ahead, aside
    parts = fades[order], covariance[order][:, order], errors[order]
    return Excess(*parts, shortest)


def _covariance(windows: Sequence[tuple[Tensor, ...]], lasts: Tensor) -> Tensor:
    """Return the covariance [3, 3] of an excess of time constants [3] s, from its windows."""
    total = torch.zeros(3, 3, dtype=torch.float64)
    for before, measured, lasted, after in windows:
        end = variances(measured, lasts)[0].mean(0).sqrt()
        goes_on = end * (lasts * -torch.expm1(-lasted / lasts)).mean(0)
        one, other = _limited(before / end), _limited(after / goes_on)
        total += (one.T @ other).double() / len(before) / len(windows)
    size = total.diagonal().clamp(min=_SMALLEST).sqrt()
    alike = (total + total.T) / 2.0 / (size[:, None] * size)
    apart = (lasts[:, None] / lasts).log().abs() > math.log(_AS_LONG)
    alike = torch.where((alike.abs() < _LEAST_ALIKE) | apart, 0.0, alike)
    alike = alike.clamp(-_MOST_ALIKE, _MOST_ALIKE)
    alike.fill_diagonal_(1.0)
    # Three correlations need not fit each other.
    values, vectors = torch.linalg.eigh(alike)
    alike = (vectors * values.clamp(min=1.0 - _MOST_ALIKE)) @ vectors.T
    size = size / alike.diagonal().sqrt()
    return alike * size[:, None] * size


def _limited(values: Tensor) -> Tensor:
    """Return values [W, 3] with the largest ones made smaller."""
    most = _FAR * values.abs().median(0).values
    return values.clamp(-most, most)


def _windows(
    time: Tensor, predicted: Tensor, actual: Tensor, drive: Tensor, before: float, length: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return errors of the speed before instants, and of predictions from them on, [W, 3] each.

    Each follows the times over which it was measured, [W, 1] s.
    """
    # Drives are far apart in time, so that instants are found in all of them at once.
    time = time + drive * (float(time.max() - time.min()) + 10.0 * LENGTHS[-1])
    now = torch.arange(len(time))
    since = torch.searchsorted(time, time - before + 1e-6, right=True) - 1
    until = torch.searchsorted(time, time + length - 1e-6).clamp(max=len(time) - 1)
    some = (since >= 0) & (time - time[since] < LATEST * before)
    some &= (time[until] - time > length - 1e-3) & (time[until] - time < length * (1.0 + LONGER))
    # At most a certain number begin within the length of one.
    place = (time[some] * OVERLAP / length).floor()
    first = torch.ones_like(place, dtype=torch.bool)
    first[1:] = place.diff() > 0
    some[some.clone()] = first
    since, now, until = since[some], now[some], until[some]

    def error(begin: Tensor, end: Tensor) -> Tensor:
        moved = (se2.between(path[begin], path[end]) for path in (predicted, actual))
        return residual(*moved)

    measured, lasted = time[now] - time[since], time[until] - time[now]
    off = error(since, now) / measured.unsqueeze(1)
    return off, measured.unsqueeze(1), lasted.unsqueeze(1), error(now, until)
