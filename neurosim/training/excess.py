"""Learning how much a measured speed counts, and how long, from errors in a log.

From each instant of a log on, the error of the prediction is compared with the error of the speed
before it, times g T (1 - exp(-t / T)), for P / R and T of a grid; see
:mod:`neurosim.simulators.motion.excess`.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.excess import Excess
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
        tried = Excess(torch.full((3,), lasts), torch.full((3,), clarity), shortest)
        gained, uncertain = torch.zeros(3), torch.zeros(3)
        for before, measured, lasted, after in windows:
            expected, _ = tried.faded(tried.believed(measured) * before, lasted)
            less = after.abs() - (after - expected).abs()
            less = less / after.abs().mean(0).clamp(min=1e-9) / len(windows)
            gained += less.mean(0)
            uncertain += less.std(0) / math.sqrt(len(less) / OVERLAP)
        for c in range(3):
            if gained[c] > max(best[c][0], _WORTH, _SURE * uncertain[c]):
                best[c] = (float(gained[c]), clarity, lasts)
    if not any(clarity for _, clarity, _ in best):
        return None
    _, clear, fades = zip(*(best[c] for c in (1, 2, 0)), strict=True)
    return Excess(torch.tensor(fades).double(), torch.tensor(clear).double(), shortest)


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
