"""L3: a search for parameters with which the simulator gives the results of reality.

Zagal et al. 2004, section 5.3: ten individuals with similar fitness in reality and in the
simulator are compared; the search minimises the norm of the ten differences. Where reality tracked
some, their paths are compared instead, which say more than one number a trial: displacements in the
robot's frame, so that an early difference does not count again and again, and a mean over robots
rather than a sum of squares, because some gaits are unpredictable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.back_to_reality.simulated import Simulated
from neurosim.base import se2
from neurosim.evolution.climb import Climb

#: Standard deviation of cma's first population, as a fraction of the ranges.
SPREAD = 0.2
#: Where poses are compared, metres that count as much as a radian of heading.
HEADING_LENGTH = 0.3
#: Displacements that are compared: over this time, or a step if that is longer, and over as many
#: times as long; s. And the number of them that begin within the shorter one.
WINDOW, LONGER, OVERLAP = 0.25, 4, 8
#: Paths are compared up to this fraction of the radius of the circle where a trial ends.
NEAR = 0.95


def discrepancy(simulated: NDArray[np.float64], real: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the norm [...] of the fitness differences of individuals [..., P] and [P]."""
    return np.linalg.norm(simulated - real, axis=-1)


def paths_apart(
    simulated: NDArray[np.float64],
    real: NDArray[np.float64],
    window: int = 1,
    circle: float = 0.0,
) -> float:
    """Return how far a simulated path is from real ones of the same controller, m in a window.

    It is the root mean square of differences of displacements, over windows and over
    :data:`LONGER` times as long ones, divided by that. A robot that has no pose until the end has
    fallen or was stopped, and stands from then on; but a path that has come near the circle where a
    trial ends is unknown from there on. Paths without a window that is known at both ends do not
    differ. Headings count by :data:`HEADING_LENGTH`.

    Args:
        simulated: poses of a path after each step, first that at the start, [K + 1, 3].
        real: those of R paths, [R, K + 1, 3]; NaN: not seen.
        window: number of steps of a window.
        circle: radius of that circle around the start, m; 0: there is none.
    """
    simulated, real = _until(simulated[None], circle), _until(real, circle)
    total = []
    for span in {min(window, len(simulated[0]) - 1), min(LONGER * window, len(simulated[0]) - 1)}:
        first = np.arange(0, simulated.shape[1] - span, max(window // OVERLAP, 1))
        moved = [se2.between(path[:, first], path[:, first + span]) for path in (simulated, real)]
        apart = moved[0] - moved[1]
        turn = HEADING_LENGTH * se2.wrapped(apart[..., 2])
        square = apart[..., 0] ** 2 + apart[..., 1] ** 2 + turn**2
        known = square[np.isfinite(square)]
        if len(known):
            total.append(np.sqrt(known.mean()) * window / span)
    return float(np.mean(total)) if total else 0.0


def _until(paths: NDArray[np.float64], circle: float) -> NDArray[np.float64]:
    """Return paths [R, K, 3] whose last pose remains until the end, up to :data:`NEAR` a circle."""
    seen = np.asarray(np.isfinite(paths).all(axis=-1))
    last = paths.shape[1] - 1 - seen[:, ::-1].argmax(axis=1)
    after = np.arange(paths.shape[1]) > last[:, None]
    rest = np.take_along_axis(paths, last[:, None, None], axis=1)
    paths = np.where(after[..., None], rest, paths)
    if not circle:
        return paths
    away = np.nan_to_num(np.linalg.norm(paths[..., :2] - paths[:, :1, :2], axis=-1), nan=0.0)
    arrived = np.logical_or.accumulate(away >= NEAR * circle, axis=1)
    return np.where(arrived[..., None], np.nan, paths)


@dataclass(frozen=True, eq=False)
class Compared:
    """Individuals that were evaluated in reality.

    Attributes:
        simulated: the simulator.
        genes: [P, G] of them.
        fitness: [P] in reality.
        poses: of each, [R, K, 3] in its R tracked trials, NaN where not seen; None: only the
            fitness is compared.
    """

    simulated: Simulated
    genes: NDArray[np.float64]
    fitness: NDArray[np.float64]
    poses: list[NDArray[np.float64]] | None = None

    def discrepancy(self, sets: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the difference from reality of the simulator with sets [S, K], [S].

        Where paths are compared, it is the mean of :func:`paths_apart`.
        """
        if self.poses is None:
            return discrepancy(self.simulated.over(self.genes, sets), self.fitness)
        seen = [paths[np.isfinite(paths).any(axis=(1, 2))] for paths in self.poses]
        tracked = [place for place, paths in enumerate(seen) if len(paths)]
        window, circle = self.simulated.steps_in(WINDOW), self.simulated.circle
        steps, result = min((one.shape[1] for one in self.poses), default=0), []
        for one in sets:
            paths, each = self.simulated.poses(self.genes[tracked], one, steps), []
            for path, place in zip(paths, tracked, strict=True):
                start = np.broadcast_to(path[0], (len(seen[place]), 1, 3))
                real = np.concatenate([start, seen[place]], axis=1)
                each.append(paths_apart(path, real, window, circle))
            result.append(np.mean(each))
        return np.array(result)


def similar(
    simulated: NDArray[np.float64], real: NDArray[np.float64], count: int
) -> NDArray[np.int64]:
    """Return the sorted indices of the ``count`` individuals with the most similar results.

    The ranking is by the difference as a fraction of the larger fitness. Individuals that failed in
    reality, with a fitness of 0 or less, come last.
    """
    larger = np.maximum(np.maximum(np.abs(simulated), np.abs(real)), 1e-12)
    apart = np.abs(simulated - real) / larger + 2.0 * (real <= 0.0)
    return np.sort(np.argsort(apart, kind="stable")[:count])


def best_set(compared: Compared, climb: Climb, before: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the best parameter set [K] of a search, or that of before, [K], if none is better."""
    sets = np.concatenate([before[None], *climb.asked])
    fitness = np.concatenate([-compared.discrepancy(before[None]), *climb.fitness])
    best: NDArray[np.float64] = sets[fitness.argmax()]
    return best


def agreement(
    compared: Compared, before: NDArray[np.float64], after: NDArray[np.float64]
) -> dict[str, Any]:
    """Return how well a simulator agrees with reality, before and after it was adapted.

    Args:
        compared: the individuals.
        before, after: [S, K] fractions of the parameters; the fitness that the simulator predicts
            is the mean over these sets, and paths are those of the first one.

    Returns:
        ``individuals``; their ``real`` fitness, ``simulated_before`` and ``simulated_after``; and
        for ``before`` and ``after`` the ``norm`` of the differences, their ``rms`` and ``median``
        (absolute), and the ``rank`` correlation (Spearman; None where all are equal); ``poses``
        (m, of :func:`paths_apart`) where they were tracked.
    """
    real = compared.fitness
    result: dict[str, Any] = {"individuals": len(real), "real": real.tolist()}
    for name, sets in (("before", before), ("after", after)):
        fitness = compared.simulated.expected(compared.genes, sets)
        apart = np.abs(fitness - real)
        result[f"simulated_{name}"] = fitness.tolist()
        result[name] = {
            "norm": float(np.linalg.norm(apart)),
            "rms": float(np.sqrt(np.mean(apart**2))),
            "median": float(np.median(apart)),
            "rank": rank_correlation(fitness, real),
        }
        if compared.poses is not None:
            result[name]["poses"] = float(compared.discrepancy(sets[:1])[0])
    return result


def rank_correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float | None:
    """Return Spearman's correlation of values [P] and [P]; None where all of one are equal."""
    ranks = np.stack([_ranks(one), _ranks(other)])
    if np.ptp(ranks, axis=1).min() == 0.0:
        return None
    away = ranks - ranks.mean(axis=1, keepdims=True)
    return float(away[0] @ away[1] / np.linalg.norm(away, axis=1).prod())


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ranks [P], the mean of them where values are equal."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - 0.5 * (counts - 1))[inverse]
