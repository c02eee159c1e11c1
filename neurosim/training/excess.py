"""Learning how much a measured speed counts, and how long, from errors in a log.

From each instant of a log on, the error of the prediction is compared with the error of the speed
just before it, times g T (1 - exp(-t / T)), for g and T of a grid.
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

#: A speed is measured over this time, or a little more, up to a limit, s.
BEFORE, LATEST = 0.1, 0.3
#: The gains and time constants (s) that are tried.
GAINS = (0.25, 0.5, 0.75, 1.0)
LASTS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
#: By which fraction of its length a prediction may be longer.
LONGER = 0.25
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
    windows = [_windows(time, predicted, actual, drive, length) for length in LENGTHS]
    windows = [one for one in windows if len(one[0]) >= _FEW * OVERLAP]
    if not windows:
        return None
    best = [(0.0, 0.0, 1.0)] * 3
    for gain, lasts in itertools.product(GAINS, LASTS):
        gained, uncertain = torch.zeros(3), torch.zeros(3)
        for before, lasted, after in windows:
            expected = gain * lasts * (1.0 - torch.exp(-lasted / lasts)) * before
            less = after.abs() - (after - expected).abs()
            less = less / after.abs().mean(0).clamp(min=1e-9) / len(windows)
            gained += less.mean(0)
            uncertain += less.std(0) / math.sqrt(len(less) / OVERLAP)
        for c in range(3):
            if gained[c] > max(best[c][0], _WORTH, _SURE * uncertain[c]):
                best[c] = (float(gained[c]), gain, lasts)
    if not any(gain for _, gain, _ in best):
        return None
    _, gains, fades = zip(*(best[c] for c in (1, 2, 0)), strict=True)
    return Excess(torch.tensor(fades).double(), torch.tensor(gains).double())


def _windows(
    time: Tensor, predicted: Tensor, actual: Tensor, drive: Tensor, length: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return errors of the speed before instants [W, 3], predictions' lengths and errors [W, 3]."""
    # Drives are far apart in time, so that instants are found in all of them at once.
    time = time + drive * (float(time.max() - time.min()) + 10.0 * LENGTHS[-1])
    now = torch.arange(len(time))
    since = torch.searchsorted(time, time - BEFORE + 1e-6, right=True) - 1
    until = torch.searchsorted(time, time + length - 1e-6).clamp(max=len(time) - 1)
    some = (since >= 0) & (time - time[since] < LATEST)
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

    before = error(since, now) / (time[now] - time[since]).unsqueeze(1)
    return before, (time[until] - time[now]).unsqueeze(1), error(now, until)
