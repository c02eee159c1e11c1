"""The genetic algorithm of Pretorius et al. 2009 (Table 1), ask and tell.

It knows only fitness: the caller asks for a population, evaluates it in any way, and returns its
fitness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base.declared import Checked, Count, CountOrNone, Fraction
from neurosim.base.errors import UserError
from neurosim.evolution.operators import gaussian_mutation, sbx, tournament, truncation

#: Largest size of a population.
LARGEST = 100_000_000


@dataclass(frozen=True)
class GeneticSettings(Checked):
    """Settings of a genetic algorithm; the defaults are Table 1 of Pretorius et al. 2009.

    The paper does not give ``eta``, ``mutation_scale`` and ``elites``; ``parents`` is for
    truncation selection (Lund and Miglino 1996), which it does not use.

    Attributes:
        population: Individuals of a population.
        crossover: Probability that a pair of parents is crossed; the others are copied.
        mutation: Probability that a gene of a child is changed.
        tournament: Individuals in a tournament.
        eta: Distribution index of simulated binary crossover.
        mutation_scale: Standard deviation of a gene's change.
        elites: Best individuals that are kept unchanged: with one, the best fitness never falls.
        parents: Number of the best individuals that have children, equally many each, without
            tournaments; 0: tournaments.
    """

    population: Annotated[int, Meta(ge=2, le=LARGEST)] = 250
    crossover: Fraction = 0.8
    mutation: Fraction = 0.05
    tournament: Count = 50
    eta: Annotated[float, Meta(ge=0, le=1000)] = 15.0
    mutation_scale: Annotated[float, Meta(ge=0, le=1000)] = 0.1
    elites: CountOrNone = 1
    parents: CountOrNone = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.parents > self.population:
            raise UserError(f"a population of {self.population} cannot have {self.parents} parents")
        if self.elites >= self.population:
            raise UserError("elites must be fewer than the population")


class GeneticAlgorithm:
    """A generational genetic algorithm, one run or several independent ones at once.

    ::

        ga = GeneticAlgorithm(initial, GeneticSettings(), generator)
        for _ in range(generations):
            ga.tell(fitness(ga.ask()))
        ga.best

    Attributes:
        best: the best individual so far, [..., G].
        best_fitness: its fitness, [...], float64.
    """

    def __init__(
        self,
        initial: Tensor,
        settings: GeneticSettings,
        generator: torch.Generator,
    ):
        """Start from a first population.

        Args:
            initial: [..., P, G]; leading dimensions are independent runs.
            settings: sizes and probabilities.
            generator: source of all random numbers, on the device of ``initial``.
        """
        if initial.shape[-2] != settings.population:
            raise ValueError(f"expected {settings.population} individuals, got {initial.shape[-2]}")
        self.settings = settings
        self.best = initial[..., 0, :].clone()
        self.best_fitness = torch.full(
            initial.shape[:-2], -torch.inf, dtype=torch.float64, device=initial.device
        )
        self._population = initial.clone()
        self._generator = generator

    def ask(self) -> Tensor:
        """Return the population to evaluate, [..., P, G]; treat it as read-only."""
        return self._population

    def tell(self, fitness: Tensor) -> None:
        """Take the fitness of the last population, [..., P], and make the next one.

        Higher is better; NaN is the worst.
        """
        fitness = fitness.to(self.best_fitness)
        if fitness.shape != self._population.shape[:-1]:
            raise ValueError(
                f"expected fitness of shape {tuple(self._population.shape[:-1])}, "
                f"got {tuple(fitness.shape)}"
            )
        fitness = torch.where(fitness.isnan(), -torch.inf, fitness)
        self._remember_best(fitness)
        self._population = self._next_population(fitness)

    def _remember_best(self, fitness: Tensor) -> None:
        top, place = fitness.max(-1)
        individual = _pick(self._population, place.unsqueeze(-1)).squeeze(-2)
        better = top > self.best_fitness
        self.best = torch.where(better.unsqueeze(-1), individual, self.best)
        self.best_fitness = torch.where(better, top, self.best_fitness)

    def _next_population(self, fitness: Tensor) -> Tensor:
        settings = self.settings
        pairs = (settings.population - settings.elites + 1) // 2
        parents = self._parents(fitness, 2 * pairs)
        first = _pick(self._population, parents[..., :pairs])
        second = _pick(self._population, parents[..., pairs:])
        crossed_a, crossed_b = sbx(first, second, settings.eta, self._generator)
        cross = (
            torch.rand(first.shape[:-1], generator=self._generator, device=fitness.device)
            < settings.crossover
        ).unsqueeze(-1)
        children = torch.cat(
            [torch.where(cross, crossed_a, first), torch.where(cross, crossed_b, second)], dim=-2
        )
        children = gaussian_mutation(
            children, settings.mutation, settings.mutation_scale, self._generator
        )
        elites = fitness.topk(settings.elites, dim=-1).indices
        children = children[..., : settings.population - settings.elites, :]
        return torch.cat([_pick(self._population, elites), children], dim=-2)

    def _parents(self, fitness: Tensor, count: int) -> Tensor:
        settings = self.settings
        if settings.parents:
            return truncation(fitness, settings.parents, count, self._generator)
        return tournament(fitness, settings.tournament, count, self._generator)


def _pick(population: Tensor, indices: Tensor) -> Tensor:
    """Return the individuals [..., N, G] of ``population`` [..., P, G] at ``indices`` [..., N]."""
    return torch.take_along_dim(population, indices.unsqueeze(-1), -2)
