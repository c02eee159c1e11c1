"""Evaluations of controllers in reality, in their order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The estimate of an individual's fitness after an evaluation.

    Attributes:
        genes: [G] of it.
        fitness: mean over all its evaluations so far.
        count: number of these evaluations.
    """

    genes: NDArray[np.float64]
    fitness: float
    count: int = 1


class Evaluations:
    """All evaluations in reality, in their order.

    Attributes:
        all: one for each evaluation.
    """

    def __init__(self) -> None:
        self.all: list[Evaluation] = []

    def __len__(self) -> int:
        return len(self.all)

    def add(self, genes: NDArray[np.float64], fitness: NDArray[np.float64]) -> None:
        """Add first evaluations of those of individuals [P, G] that are new, their fitness [P]."""
        known = self.known
        for one, value in zip(genes, fitness.tolist(), strict=True):
            if one.tobytes() not in known:
                known.add(one.tobytes())
                self.all.append(Evaluation(one, value))

    @property
    def known(self) -> set[bytes]:
        """The genes, as bytes, of all individuals that were evaluated."""
        return {one.genes.tobytes() for one in self.all}

    def latest(self, first: int | None = None) -> list[Evaluation]:
        """Return the estimate for each individual after the first ``count`` evaluations."""
        known = {one.genes.tobytes(): one for one in self.all[:first]}
        return list(known.values())

    def leader(self) -> Evaluation:
        """Return the individual with the highest mean, after any number of trials."""
        return max(self.latest(), key=lambda one: one.fitness)

    def believed(self, confirm: int = 1, first: int | None = None) -> Evaluation:
        """Return the best individual that was tried often enough; if none was, the leader.

        Args:
            confirm: number of evaluations that are enough.
            first: number of first evaluations to look at.
        """
        known = self.latest(None if first is None else max(first, 1))
        enough = [one for one in known if one.count >= confirm]
        return max(enough or known, key=lambda one: one.fitness)
