"""L3: the simulator's parameters are searched until it gives the fitness that reality gave.

Zagal et al. 2004, section 5.3: ten individuals with similar fitness in reality and in the
simulator are compared; what is minimised is the norm of the ten differences.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.back_to_reality.climb import Climb, make_search
from neurosim.back_to_reality.genetic import BitSettings
from neurosim.back_to_reality.simulated import Simulated

#: Parameter sets that are kept differ by this at least: root mean square of their shares.
APART = 0.05
#: With cma the first population is spread so far, as a share of the ranges.
SPREAD = 0.2


def discrepancy(simulated: NDArray[np.float64], real: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the norm [...] of the fitness differences of individuals [..., P] and [P]."""
    return np.linalg.norm(simulated - real, axis=-1)


def similar(
    simulated: NDArray[np.float64], real: NDArray[np.float64], count: int
) -> NDArray[np.int64]:
    """Return which ``count`` individuals did most alike in both, in their order.

    Alike is by the difference as a share of the larger fitness; who failed in reality, with a
    fitness of 0 or less, comes last.
    """
    larger = np.maximum(np.maximum(np.abs(simulated), np.abs(real)), 1e-12)
    apart = np.abs(simulated - real) / larger + 2.0 * (real <= 0.0)
    return np.sort(np.argsort(apart, kind="stable")[:count])


def begin_adapting(
    simulated: Simulated,
    genes: NDArray[np.float64],
    real: NDArray[np.float64],
    start: NDArray[np.float64],
    search: str,
    genetic: BitSettings,
    seed: Any,
    before: NDArray[np.float64] | None = None,
) -> Climb:
    """Return the search for parameters, under way; its fitness is the discrepancy's negative.

    Args:
        simulated: the simulator.
        genes: [P, G] of the individuals that are compared.
        real: [P] their fitness in reality.
        start: [K] shares where the search begins.
        search: ``ga`` or ``cma``.
        genetic: the genetic algorithm; its population is that of cma, too.
        seed: of ``numpy.random.default_rng``.
        before: what :class:`Climb` goes on from.
    """

    def evaluate(sets: NDArray[np.float64]) -> NDArray[np.float64]:
        return -discrepancy(simulated.over(genes, sets), real)

    def told(fitness: NDArray[np.float64]) -> NDArray[np.float64]:
        # Selection by shares needs a fitness above 0: what the worst of the generation loses by
        # (Goldberg 1989, chapter 3).
        return fitness - fitness.min() if search == "ga" else fitness

    return Climb(make_search(search, start, genetic, SPREAD, seed), evaluate, told, before)


def kept_sets(
    climb: Climb, count: int, before: NDArray[np.float64], fitness_before: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the best parameter sets that differ, [S, K], S up to ``count``.

    Args:
        climb: the search.
        count: how many are wanted.
        before: [B, K] the sets before it, which stay where nothing better was found.
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
    simulated: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
    genes: NDArray[np.float64],
    real: NDArray[np.float64],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
) -> dict[str, Any]:
    """Return how well a simulator agrees with reality, before and after it was adapted.

    Args:
        simulated: returns the fitness [P] of individuals with parameters [K].
        genes: [P, G].
        real: [P] their fitness in reality.
        before, after: [K] shares of the parameters.

    Returns:
        ``individuals``, and for ``before`` and ``after`` the ``norm`` of the differences, their
        ``rms`` and ``median`` (absolute), and the ``rank`` correlation (Spearman; None where all
        are alike).
    """
    found: dict[str, Any] = {"individuals": len(real)}
    for name, parameters in (("before", before), ("after", after)):
        fitness = simulated(genes, parameters)
        apart = np.abs(fitness - real)
        found[name] = {
            "norm": float(np.linalg.norm(apart)),
            "rms": float(np.sqrt(np.mean(apart**2))),
            "median": float(np.median(apart)),
            "rank": _rank_correlation(fitness, real),
        }
    return found


def _rank_correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float | None:
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
