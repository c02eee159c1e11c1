"""Decides by its motion whether the pair that is seen after a loss is the one from before.

A twin of the robot, of the same colours, sizes and separation, can be distinguished from it by its
place only: the robot continues from where it was lost.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: A pair within this many separations of the place of the loss is the robot: two do not fit there.
STAYED = 1.0
#: Time (s) for which it may have driven on, at most FASTER times as fast as its fastest seen
#: motion, or at SLOW separations per second, whichever is more. After that it may be anywhere.
DROVE_FOR, FASTER, SLOW = 2.0, 2.0, 3.0
#: Speeds are measured over this time, s: over single frames they are noise.
_SPAN = 0.2


def doubtful(time: NDArray, front: NDArray, rear: NDArray) -> NDArray:
    """Return the frames in which a pair may be another than in the first frame that shows it.

    It is followed from frame to frame. If it reappears after a loss farther away than it can drive,
    it may be another, until it is seen at its last certain place.

    Args:
        time: [N] of the frames, s, increasing.
        front, rear: [N, 2] pixels; NaN where the pair was not found.

    Returns:
        [N] bool, with the frames in which it was lost for a moment.
    """
    seen = np.flatnonzero(np.isfinite(front).all(axis=1) & np.isfinite(rear).all(axis=1))
    result = np.zeros(len(time), bool)
    if len(seen) < 2:
        return result
    when, middle = time[seen], (front[seen] + rear[seen]) / 2
    middle = middle / np.median(np.hypot(*(front[seen] - rear[seen]).T))
    gaps, distances = np.diff(when), np.hypot(*np.diff(middle, axis=0).T)
    speeds = _speeds(when, middle)
    begin, known, certain, top = 0, 0, True, 0.0
    for last in [*np.flatnonzero(distances > _reach(gaps, 0.0)), len(seen) - 1]:
        # From begin to last it was followed without a jump.
        if certain:
            fresh = np.flatnonzero(when[begin : last + 1] - when[begin] >= _SPAN) + begin
            top, known = max(top, speeds[fresh].max(initial=0.0)), last
        result[seen[begin] : seen[last] + 1] = not certain
        if last + 1 < len(seen) and distances[last] > _reach(gaps[last], top):
            distance = np.hypot(*(middle[last + 1] - middle[known]))
            certain = bool(distance <= _reach(when[last + 1] - when[known], top))
        begin = last + 1
    return result


def _reach(gap: ArrayLike, top: float) -> NDArray:
    """Return how far a robot can drive, in separations, in gaps of time, s, at a highest speed."""
    drove = FASTER * max(top, SLOW) * np.asarray(gap)
    return STAYED + np.where(np.asarray(gap) <= DROVE_FOR, drove, 0.0)


def _speeds(when: NDArray, middle: NDArray) -> NDArray:
    """Return the pair's speed towards each place, in separations per second."""
    since = np.maximum(np.searchsorted(when, when - _SPAN, side="right") - 1, 0)
    gap = np.maximum(when - when[since], _SPAN)
    return np.hypot(*(middle - middle[since]).T) / gap
