"""Genetic algorithm and its operators; they know only the fitness of candidates."""

from neurosim.evolution.genetic import GeneticAlgorithm, GeneticSettings
from neurosim.evolution.operators import gaussian_mutation, sbx, tournament, truncation

__all__ = [
    "GeneticAlgorithm",
    "GeneticSettings",
    "gaussian_mutation",
    "sbx",
    "tournament",
    "truncation",
]
