import pytest
import torch

from neurosim.base.errors import UserError
from neurosim.evolution import GeneticAlgorithm, GeneticSettings

SMALL = GeneticSettings(population=21, tournament=4, mutation=0.2, mutation_scale=0.3)


def sphere(population):
    return -(population - 1.5).square().sum(-1)


def first_population(seed=0, runs=(), genes=4, size=21):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(*runs, size, genes, generator=g), g


def evolve(ga, generations):
    for _ in range(generations):
        ga.tell(sphere(ga.ask()))


def test_the_defaults_are_table_1():
    defaults = GeneticSettings()
    assert (defaults.population, defaults.crossover, defaults.mutation, defaults.tournament) == (
        250,
        0.8,
        0.05,
        50,
    )


def test_it_finds_the_top_of_a_hill():
    ga = GeneticAlgorithm(first_population()[0], SMALL, torch.Generator().manual_seed(1))
    evolve(ga, 150)
    assert ga.best.tolist() == pytest.approx([1.5] * 4, abs=0.15)
    assert ga.best_fitness.item() == pytest.approx(sphere(ga.best).item())


def test_with_an_elite_the_best_never_falls_and_stays_in_the_population():
    ga = GeneticAlgorithm(*_with(SMALL))
    top = -torch.inf
    for _ in range(30):
        fitness = sphere(ga.ask())
        assert fitness.max() >= top
        top = fitness.max()
        ga.tell(fitness)
        assert (ga.ask() == ga.best).all(-1).any()


def _with(settings, runs=()):
    initial, g = first_population(runs=runs)
    return initial, settings, g


def test_what_is_not_a_number_is_never_the_best():
    ga = GeneticAlgorithm(*_with(SMALL))
    fitness = torch.full((21,), torch.nan)
    fitness[7] = -3.0
    seventh = ga.ask()[7].clone()
    ga.tell(fitness)
    assert torch.equal(ga.best, seventh)
    assert ga.best_fitness.item() == -3.0


def test_without_crossover_and_mutation_all_children_are_parents():
    plain = GeneticSettings(population=20, tournament=3, crossover=0.0, mutation=0.0, elites=0)
    initial, g = first_population(size=20)
    ga = GeneticAlgorithm(initial, plain, g)
    ga.tell(sphere(initial))
    for child in ga.ask():
        assert (initial == child).all(-1).any()


def test_with_parents_the_best_alone_have_children_each_as_many():
    plain = GeneticSettings(population=20, parents=4, crossover=0.0, mutation=0.0, elites=0)
    initial, g = first_population(size=20)
    ga = GeneticAlgorithm(initial, plain, g)
    fitness = sphere(initial)
    ga.tell(fitness)
    for place in range(20):
        children = (ga.ask() == initial[place]).all(-1).sum()
        assert children == (5 if place in fitness.topk(4).indices else 0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"population": 1},
        {"population": 2**63},
        {"elites": 250},
        {"mutation": 1.5},
        {"tournament": 0},
        {"parents": 251},
    ],
)
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(UserError, match=r"population|elites|mutation|tournament|parents"):
        GeneticSettings(**wrong)


def test_fitness_of_another_shape_is_refused():
    ga = GeneticAlgorithm(*_with(SMALL))
    with pytest.raises(ValueError, match="expected fitness"):
        ga.tell(torch.zeros(20))
