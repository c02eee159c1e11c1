"""The genetic operators of plans, compiled: Pretorius et al. (2009), section 6.2.

A chromosome has a constant number of commands, each of four genes in 0..1: whether it is null (not
given), left and right speed, duration. Crossover pairs commands that were given in the same
rectangle: the n-th command that one parent was given in a rectangle is paired with the n-th of the
other parent there, at any index in the two command sets. Each such pair is crossed
by simulated binary crossover; commands without a counterpart, and null ones, pass unchanged. The
paper does not describe the encoding of a null command, the pairing of several commands in a
rectangle, and mutation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.compiled import njit
from neurosim.base.errors import UserError
from neurosim.base.random import GOLDEN, normal, uniform
from neurosim.base.threads import WORTH_SHARING, on_cores
from neurosim.evolution.genetic import GeneticSettings

#: Fraction of a first generation's commands that are null.
NULL_FRACTION = 0.2
#: Key of a command that crossover leaves alone.
NOT_PAIRED = np.iinfo(np.int64).min


@dataclass(frozen=True)
class PlanSettings(GeneticSettings):
    """Settings of the genetic algorithm of plans.

    Attributes:
        insertion: whether null commands come back at any index, see :func:`mutate`.
    """

    insertion: bool = True


class PlanPopulation:
    """Several independent runs of a generational genetic algorithm of plans, ask and tell.

    Like :class:`neurosim.evolution.GeneticAlgorithm`, with operators for commands.

    Attributes:
        genes: [N, P, G K] in 0..1, the population of each of N runs; treat as read-only.
        hints: arguments of :meth:`tell` in addition to the fitness.
    """

    hints = ("keys",)

    def __init__(
        self,
        genes: NDArray[np.float64],
        settings: PlanSettings,
        seed: Sequence[int],
    ):
        """Start from a first population.

        Args:
            genes: [N, P, G K] in 0..1.
            settings: sizes and probabilities.
            seed: the same seed makes the same children.
        """
        if settings.parents:
            raise UserError(
                "plans are selected by tournaments, not by truncation: set parents to 0"
            )
        self.genes = np.ascontiguousarray(genes, np.float64)
        self._settings = settings
        self._seed = [*seed, 0xB4EED]
        self._rng = np.random.default_rng(self._seed)
        self._generation = 0

    def ask(self) -> NDArray[np.float64]:
        """Return the plans [N, P, G K] to evaluate; treat them as read-only."""
        return self.genes

    def state(self) -> dict[str, NDArray]:
        """Return all values on which the next generations depend, far less than all answers."""
        return {"genes": self.genes, "generation": np.array([self._generation])}

    def load(self, state: Mapping[str, NDArray]) -> None:
        """Continue from a result of :meth:`state`.

        Raises:
            KeyError, ValueError: if it is the state of another search.
        """
        if state["genes"].shape != self.genes.shape:
            raise ValueError("the state is of another population or number of genes")
        self.genes = np.ascontiguousarray(state["genes"])
        self._generation = int(state["generation"][0])
        self._rng = np.random.default_rng(self._seed)
        self._rng.integers(2**63, size=self._generation)  # drop the earlier draws

    def tell(self, fitness: NDArray[np.float64], keys: NDArray[np.int64]) -> None:
        """Take the fitness [N, P] of the population, the higher the better, and make the next.

        Args:
            fitness: NaN is worse than anything.
            keys: [N, P, K] of :func:`pairing_keys`.
        """
        fitness = np.where(np.isnan(fitness), -np.inf, fitness)
        s = self._settings
        children = np.empty_like(self.genes)
        if s.elites > 0:
            order = np.argsort(-fitness, axis=1, kind="stable")[:, : s.elites]
            children[:, : s.elites] = np.take_along_axis(self.genes, order[..., None], axis=1)
        counts = s.tournament, s.elites, int(s.insertion)
        rates = s.crossover, s.mutation, s.mutation_scale, s.eta
        seed = self._rng.integers(2**63)
        runs, population, _ = children.shape

        def part(first: int, last: int) -> None:
            _breed(first, last, self.genes, keys, fitness, counts, rates, seed, children)

        on_cores(_breed, part, runs * _pairs(population, s.elites), WORTH_SHARING)
        self.genes = children
        self._generation += 1


@njit
def _uniform(state):
    state[0] += GOLDEN
    return uniform(state[0])


@njit
def _normal(state):
    return normal(_uniform(state), _uniform(state))


@njit
def _winner(fitness, size, state):
    """Return the fittest of ``size`` drawn with replacement."""
    best = int(_uniform(state) * len(fitness))
    for _ in range(size - 1):
        other = int(_uniform(state) * len(fitness))
        if fitness[other] > fitness[best]:
            best = other
    return best


@njit
def cross(a, b, keys_a, keys_b, eta, state):
    """Cross the commands of two plans that have the same key, in place.

    Args:
        a, b: [G K] genes of two parents; they become their children.
        keys_a, keys_b: [K]; no key but NOT_PAIRED twice in a parent.
        eta: distribution index of simulated binary crossover, with which half of a pair's
            genes are crossed: see :func:`neurosim.evolution.operators.sbx`.
        state: [1] uint64 of the random generator, advanced.
    """
    width = len(a) // len(keys_a)
    for i in range(len(keys_a)):
        for j in range(len(keys_b)):
            if keys_a[i] != keys_b[j] or keys_a[i] == NOT_PAIRED:
                continue
            for g in range(width):
                if _uniform(state) < 0.5:
                    continue
                u = _uniform(state)
                beta = (2.0 * u if u <= 0.5 else 0.5 / (1.0 - u)) ** (1.0 / (eta + 1.0))
                one, other = a[width * i + g], b[width * j + g]
                shift = 0.5 * (1.0 - beta) * (other - one)
                a[width * i + g] = min(max(one + shift, 0.0), 1.0)
                b[width * j + g] = min(max(other - shift, 0.0), 1.0)
            break


@njit
def mutate(genes, width, probability, scale, insertion, state):
    """Change each gene of a plan with ``probability``, in place.

    A speed or duration gets normally distributed noise or is drawn again, with equal chances. A
    command whose null gene is hit becomes null. A null command comes back as a random one, because
    its former values were not under selection. With ``insertion`` it comes back at any index of the
    plan, and the others move: a missing command may belong anywhere.

    Args:
        genes: [G K] in 0..1.
        width: G, genes of a command.
        probability: chance of each gene.
        scale: standard deviation of the noise.
        insertion: 1; or 0: null commands come back at their own index.
        state: [1] uint64 of the random generator, advanced.
    """
    for first in range(0, len(genes), width):
        for g in range(first + 1, first + width):
            if _uniform(state) < probability:
                if _uniform(state) < 0.5:
                    genes[g] = min(max(genes[g] + scale * _normal(state), 0.0), 1.0)
                else:
                    genes[g] = _uniform(state)
        if _uniform(state) < probability:
            if is_null(genes[first]):
                place = first
                if insertion:
                    place = width * int(_uniform(state) * (len(genes) // width))
                    _move(genes, first, place, width)
                genes[place] = _uniform(state) * (1.0 - NULL_FRACTION)
                for g in range(place + 1, place + width):
                    genes[g] = _uniform(state)
            else:
                genes[first] = 1.0 - 0.5 * NULL_FRACTION * _uniform(state)


@njit
def _move(genes, source, place, width):
    """Move the command whose genes begin at ``source`` to ``place``; those between them shift."""
    if source < place:
        for g in range(source, place):
            genes[g] = genes[g + width]
    for g in range(source - 1, place - 1, -1):
        genes[g + width] = genes[g]


@njit
def is_null(gene):
    """Return whether a command's first gene says that it is not given."""
    return gene > 1.0 - NULL_FRACTION


@njit
def _pairs(population, elites):
    """Return the number of pairs of children in a generation of one run."""
    return (population - elites + 1) // 2


@njit(nogil=True)
def _breed(first_job, last_job, genes, keys, fitness, counts, rates, seed, children):
    """Fill some pairs, counted through all runs, of ``children`` [N, P, G] after the elites."""
    population, width = genes.shape[1:]
    tournament, elites, insertion = counts
    crossover, mutation, scale, eta = rates
    pairs = _pairs(population, elites)
    for job in range(first_job, last_job):
        run, pair = job // pairs, job % pairs
        state = np.empty(1, np.uint64)
        # Streams far apart: the generator's own increment separates draws within one.
        state[0] = np.uint64(seed) + np.uint64(job) * np.uint64(0xD1342543DE82EF95)
        first = _winner(fitness[run], tournament, state)
        second = _winner(fitness[run], tournament, state)
        # Rows that are assigned whole bring in Numba's messages about shapes: four seconds.
        both = np.empty((2, width))
        for g in range(width):
            both[0, g], both[1, g] = genes[run, first, g], genes[run, second, g]
        if _uniform(state) < crossover:
            cross(both[0], both[1], keys[run, first], keys[run, second], eta, state)
        for child in range(2):
            place = elites + 2 * pair + child
            if place < population:
                mutate(both[child], width // keys.shape[2], mutation, scale, insertion, state)
                for g in range(width):
                    children[run, place, g] = both[child, g]


@njit
def decode(genes, low, high, steps, shortest, longest):
    """Return commands [B, K, C + 1] (their numbers, s) and which are given [B, K].

    They are rounded as they will be sent: to ``steps`` in a unit, and to whole milliseconds.

    Args:
        genes: [B, G K] in 0..1, G = C + 2: null above 1 - NULL_FRACTION, the numbers, duration.
        low, high: limits of each number, [C].
        steps: in a unit of each number, [C].
        shortest, longest: limits of a command's duration, s.
    """
    numbers = len(low)
    width = numbers + 2
    batch, count = len(genes), genes.shape[1] // width
    commands = np.empty((batch, count, numbers + 1))
    given = np.empty((batch, count), np.bool_)
    for b in range(batch):
        for k in range(count):
            part = genes[b, width * k : width * (k + 1)]
            given[b, k] = not is_null(part[0])
            for n in range(numbers):
                middle, half = 0.5 * (low[n] + high[n]), 0.5 * (high[n] - low[n])
                value = middle + (2.0 * part[1 + n] - 1.0) * half
                commands[b, k, n] = np.rint(value * steps[n]) / steps[n]
            duration = shortest + (longest - shortest) * part[numbers + 1]
            commands[b, k, numbers] = np.rint(1000.0 * duration) / 1000.0
    return commands, given


@njit
def pairing_keys(region, given):
    """Return a key [B, K] per command, equal in two plans for commands to be paired.

    The n-th command that was given in a region has the same key in every plan, and no other
    command of its plan has it. Null commands have the key NOT_PAIRED.

    Args:
        region: [B, K] the robot's region when each command was given, small whole numbers.
        given: [B, K] bool.
    """
    batch, count = region.shape
    keys = np.empty((batch, count), np.int64)
    for b in range(batch):
        for k in range(count):
            if not given[b, k]:
                keys[b, k] = NOT_PAIRED
                continue
            rank = 0
            for before in range(k):
                rank += given[b, before] and region[b, before] == region[b, k]
            keys[b, k] = region[b, k] * count + rank
    return keys


def encode(
    commands, low: ArrayLike, high: ArrayLike, durations: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the genes [G K] of a command set; undoes :func:`decode`.

    Args:
        commands: K of (numbers, duration s), or None for a null command.
        low, high: limits of each number, [C].
        durations: shortest and longest command, s.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    shortest, longest = durations
    genes = np.full((len(commands), len(low) + 2), 1.0 - 0.5 * NULL_FRACTION)
    for place, command in enumerate(commands):
        if command is not None:
            *numbers, duration = command
            fractions = (np.array(numbers) - low) / np.where(high > low, high - low, 1.0)
            fraction = (duration - shortest) / (longest - shortest) if longest > shortest else 0.0
            genes[place] = [0.5 * (1.0 - NULL_FRACTION), *fractions, fraction]
    return genes.ravel()
