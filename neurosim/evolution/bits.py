"""The genetic algorithm of L1 and L3: Zagal et al. 2004, section 5.1.3.

"A conventional genetic algorithm employing fitness-proportional selection with linear scaling,
no-elitism scheme, two-point crossover and mutation with a certain probability per bit." The
probability is 0.005 (section 5.3). The paper does not give the bits of a parameter (8 here), the
probability of crossover and the constant of the scaling; those two are Goldberg's usual ones
(Genetic Algorithms in Search, Optimization and Machine Learning, 1989).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Checked, Fraction


@dataclass(frozen=True)
class BitSettings(Checked):
    """Settings of the genetic algorithm of bit strings.

    Attributes:
        population: Individuals of a generation.
        bits: Bits of a parameter.
        mutation: Probability that a bit is flipped.
        crossover: Probability that a pair of parents is crossed.
        scaling: Ratio of the best individual's chance of selection to the mean's.
        first_mutation: Probability that a bit is flipped in the first generation, which has copies
            of the start; one copy is left unchanged.
    """

    population: Annotated[int, Meta(ge=2, le=1000000)] = 15
    bits: Annotated[int, Meta(ge=1, le=30)] = 8
    mutation: Fraction = 0.005
    crossover: Fraction = 0.6
    scaling: Annotated[float, Meta(gt=1, le=1000)] = 2.0
    first_mutation: Fraction = 0.05


def encode(fractions: NDArray[np.float64], bits: int) -> NDArray[np.bool_]:
    """Return bit strings [..., G bits] of fractions [..., G] in 0..1, the highest bit first."""
    levels = 2**bits - 1
    whole = np.rint(np.clip(fractions, 0.0, 1.0) * levels).astype(np.int64)
    encoded = (whole[..., None] >> np.arange(bits)[::-1]) & 1
    return encoded.astype(np.bool_).reshape(*fractions.shape[:-1], -1)


def decode(strings: NDArray[np.bool_], bits: int) -> NDArray[np.float64]:
    """Return the fractions [..., G] of bit strings [..., G bits]; undoes :func:`encode`."""
    parts = strings.reshape(*strings.shape[:-1], -1, bits)
    return (parts @ (1 << np.arange(bits)[::-1])) / (2**bits - 1)


def linear_scaling(fitness: NDArray[np.float64], multiple: float) -> NDArray[np.float64]:
    """Return the fitness [P] scaled linearly (Goldberg 1989, chapter 4).

    The mean stays, the best gets ``multiple`` times the mean. If this would make the worst
    negative, the worst gets 0 and the best less.
    """
    mean, best, worst = fitness.mean(), fitness.max(), fitness.min()
    if best - worst <= 1e-12 * max(abs(best), abs(worst), 1e-300):
        return np.ones_like(fitness)
    slope = (multiple - 1.0) * mean / (best - mean)
    if mean + slope * (worst - mean) < 0.0:
        slope = mean / (mean - worst)
    return np.maximum(mean + slope * (fitness - mean), 0.0)


class BitGenetic:
    """A genetic algorithm of bit strings, ask and tell; it maximises."""

    def __init__(self, start: NDArray[np.float64], settings: BitSettings, seed: Any):
        """Begin with mutations of the start.

        Args:
            start: [G] fractions in 0..1.
            settings: of the algorithm.
            seed: of ``numpy.random.default_rng``.
        """
        self._settings, self._rng = settings, np.random.default_rng(seed)
        copies = np.tile(encode(start, settings.bits), (settings.population, 1))
        flips = self._rng.random(copies.shape) < settings.first_mutation
        flips[0] = False
        self._strings = copies ^ flips

    def ask(self) -> NDArray[np.float64]:
        """Return the population [P, G], fractions in 0..1."""
        return decode(self._strings, self._settings.bits)

    def tell(self, fitness: NDArray[np.float64]) -> None:
        """Take the population's fitness [P], the higher the better, and make the next population.

        Selection is in proportion to fitness. If one is negative, as in L3, the worst counts as 0
        (Goldberg 1989, chapter 3).
        """
        rng, settings, count = self._rng, self._settings, len(fitness)
        scaled = linear_scaling(fitness - min(fitness.min(), 0.0), settings.scaling)
        parents = self._strings[rng.choice(count, count + count % 2, p=scaled / scaled.sum())]
        length = parents.shape[1]
        for first, second in zip(parents[::2], parents[1::2], strict=True):
            if rng.random() < settings.crossover:
                low, high = np.sort(rng.choice(length + 1, 2, replace=False))
                swapped = first[low:high].copy()
                first[low:high], second[low:high] = second[low:high], swapped
        self._strings = parents[:count] ^ (rng.random((count, length)) < settings.mutation)
