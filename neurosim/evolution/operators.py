"""Operators of real-coded genetic algorithms, as plain functions on tensors.

Every function draws its random numbers from the given generator, and works on the device of its
tensors. Leading dimensions are independent runs.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def tournament(fitness: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """Return the winners of ``count`` tournaments, each among ``size`` drawn with replacement.

    Args:
        fitness: [..., P]; the higher wins.
        size: individuals in a tournament.
        count: tournaments.
        generator: source of the draws, on the device of ``fitness``.

    Returns:
        Indices of the winners, [..., count].

    Source: Goldberg and Deb, A comparative analysis of selection schemes used in genetic
    algorithms, FOGA 1991.
    """
    *runs, population = fitness.shape
    entrants = torch.randint(
        population, (*runs, count, size), generator=generator, device=fitness.device
    )
    entrants_fitness = torch.take_along_dim(fitness, entrants.flatten(-2), -1).view(entrants.shape)
    best = entrants_fitness.argmax(-1, keepdim=True)
    return torch.take_along_dim(entrants, best, -1).squeeze(-1)


def truncation(fitness: Tensor, best: int, count: int, generator: torch.Generator) -> Tensor:
    """Return parents from the best individuals only, equally often each, in random order.

    Args:
        fitness: [..., P]; the higher is the better.
        best: number of parents.
        count: number of indices to return; if ``best`` does not divide it, the better ones get one
            more.
        generator: source of the order, on the device of ``fitness``.

    Returns:
        Indices of parents, [..., count].

    Source: Lund and Miglino 1996, where the best 20 of 100 have 5 children each.
    """
    chosen = fitness.topk(best, dim=-1).indices
    parents = chosen[..., torch.arange(count, device=fitness.device) % best]
    keys = torch.rand(parents.shape, generator=generator, device=fitness.device)
    return torch.take_along_dim(parents, keys.argsort(-1), -1)


def sbx(
    a: Tensor,
    b: Tensor,
    eta: float,
    generator: torch.Generator,
    *,
    gene_probability: float = 0.5,
) -> tuple[Tensor, Tensor]:
    """Return two children of each pair of parents by simulated binary crossover.

    The children of a gene lie about the parents' mean, ``beta`` times as far apart as the
    parents, where ``beta`` is drawn so that near children are as likely as one-point crossover
    of binary strings makes them.

    Args:
        a, b: parents, [..., G].
        eta: distribution index; the larger, the nearer the children to their parents.
        generator: source of the draws.
        gene_probability: chance that a gene is crossed; other genes pass from each parent to its
            child unchanged (Deb and Agrawal cross half of the genes).

    Returns:
        Children, each [..., G].

    Source: Deb and Agrawal, Simulated binary crossover for continuous search space, Complex
    Systems 9, 1995.
    """
    u = torch.rand(a.shape, generator=generator, device=a.device, dtype=a.dtype)
    crossed = torch.rand(a.shape, generator=generator, device=a.device, dtype=a.dtype)
    # u is below 1, so that neither branch divides by zero.
    beta = torch.where(u <= 0.5, 2.0 * u, 0.5 / (1.0 - u)).pow_(1.0 / (eta + 1.0))
    # As a shift from each parent, not about their mean: equal parents have exactly equal
    # children, however large the numbers.
    shift = 0.5 * (1.0 - beta) * (b - a) * (crossed < gene_probability)
    return a + shift, b - shift


def gaussian_mutation(
    genes: Tensor,
    probability: float,
    scale: Tensor | float,
    generator: torch.Generator,
) -> Tensor:
    """Return ``genes`` with normally distributed noise added to some of them.

    Args:
        genes: [..., G].
        probability: chance of each gene to be changed.
        scale: standard deviation of the change, one for all or one a gene, [G].
        generator: source of the draws.
    """
    draws: dict[str, Any] = {"generator": generator, "device": genes.device, "dtype": genes.dtype}
    changed = torch.rand(genes.shape, **draws) < probability
    return genes + torch.randn(genes.shape, **draws) * scale * changed
