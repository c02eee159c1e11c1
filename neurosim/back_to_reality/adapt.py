"""L3: a search for parameters with which the simulator gives the results of reality.

Zagal et al. 2004, section 5.3: ten individuals with similar fitness in reality and in the
simulator are compared; the search minimises the norm of the ten differences. Where reality tracked
some, their poses are compared instead, which say more than one number a trial.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.back_to_reality.simulated import Simulated
from neurosim.base import se2
from neurosim.evolution.climb import Climb

#: Parameter sets that are kept differ at least by this root mean square of their fractions.
APART = 0.05
#: Standard deviation of cma's first population, as a fraction of the ranges.
SPREAD = 0.2
#: Where poses are compared, metres that count as much as a radian of heading.
HEADING_LENGTH = 0.3
#: Distance from reality of a missing simulated pose (the robot fell, or numbers blew up), m.
NOWHERE = 10.0


def discrepancy(simulated: NDArray[np.float64], real: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the norm [...] of the fitness differences of individuals [..., P] and [P]."""
    return np.linalg.norm(simulated - real, axis=-1)


def poses_apart(simulated: NDArray[np.float64], real: NDArray[np.float64]) -> float:
    """Return the root mean square distance (m) of poses [..., 3] where reality's are finite.

    A pose of the simulator that is not finite counts as :data:`NOWHERE`.
    """
    apart = simulated - real
    turn = HEADING_LENGTH * se2.wrapped(apart[..., 2])
    square = apart[..., 0] ** 2 + apart[..., 1] ** 2 + turn**2
    square = square[np.isfinite(real).all(axis=-1)]
    return float(np.sqrt(np.where(np.isfinite(square), square, NOWHERE**2).mean()))


@dataclass(frozen=True, eq=False)
class Compared:
    """Individuals that were evaluated in reality.

    Attributes:
        simulated: the simulator.
        genes: [P, G] of them.
        fitness: [P] in reality.
        poses: [P, K, 3] in reality, NaN where not seen; None if none was tracked.
    """

    simulated: Simulated
    genes: NDArray[np.float64]
    fitness: NDArray[np.float64]
    poses: NDArray[np.float64] | None = None

    def discrepancy(self, sets: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the difference from reality of the simulator with sets [S, K], [S].

        It is in metres where poses are compared.
        """
        if self.poses is None:
            return discrepancy(self.simulated.over(self.genes, sets), self.fitness)
        each = [self.simulated.poses(self.genes, one) for one in sets]
        return np.array([poses_apart(one, self.poses) for one in each])


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


def kept_sets(
    climb: Climb, count: int, before: NDArray[np.float64], fitness_before: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the best parameter sets that differ, [S, K], S up to ``count``.

    Args:
        climb: the search.
        count: how many are wanted.
        before: [B, K] the earlier sets, which are kept if the search did not find better ones.
        fitness_before: [B] the negative of their discrepancy.
    """
    sets = np.concatenate([before, *climb.asked])
    fitness = np.concatenate([fitness_before, *climb.fitness])
    kept: list[NDArray[np.float64]] = []
    for place in np.argsort(-fitness, kind="stable"):
        apart = [np.sqrt(np.mean((sets[place] - one) ** 2)) for one in kept]
        if not kept or min(apart) >= APART:
            kept.append(sets[place])
        if len(kept) == count:
            break
    return np.stack(kept)


def agreement(
    compared: Compared, before: NDArray[np.float64], after: NDArray[np.float64]
) -> dict[str, Any]:
    """Return how well a simulator agrees with reality, before and after it was adapted.

    Args:
        compared: the individuals.
        before, after: [K] fractions of the parameters.

    Returns:
        ``individuals``, and for ``before`` and ``after`` the ``norm`` of the differences, their
        ``rms`` and ``median`` (absolute), and the ``rank`` correlation (Spearman; None where all
        are equal); ``poses`` (m, root mean square) where they were tracked.
    """
    real = compared.fitness
    result: dict[str, Any] = {"individuals": len(real)}
    for name, parameters in (("before", before), ("after", after)):
        fitness = compared.simulated.fitness(compared.genes, parameters)
        apart = np.abs(fitness - real)
        result[name] = {
            "norm": float(np.linalg.norm(apart)),
            "rms": float(np.sqrt(np.mean(apart**2))),
            "median": float(np.median(apart)),
            "rank": rank_correlation(fitness, real),
        }
        if compared.poses is not None:
            result[name]["poses"] = float(compared.discrepancy(parameters[None])[0])
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
