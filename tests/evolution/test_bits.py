"""The genetic algorithm of bit strings, by hand-worked numbers."""

import numpy as np
import pytest

from neurosim.evolution.bits import (
    BitGenetic,
    BitSettings,
    decode,
    encode,
    linear_scaling,
)


def test_bit_strings_by_hand():
    strings = encode(np.array([0.0, 1.0, 5.0 / 7.0]), 3)
    assert strings.astype(int).tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 1]
    np.testing.assert_allclose(decode(strings, 3), [0.0, 1.0, 5.0 / 7.0])
    fractions = np.random.default_rng(0).random((4, 6))
    assert np.abs(decode(encode(fractions, 8), 8) - fractions).max() <= 0.5 / 255 + 1e-12


def test_linear_scaling_by_hand():
    """Mean 2, best 4: with a multiple of 1.5 the slope is 0.5 * 2 / 2, the worst gets 1.5."""
    assert linear_scaling(np.array([1.0, 1.0, 4.0]), 1.5) == pytest.approx([1.5, 1.5, 3.0])
    # With a multiple of 3 the worst would be negative: it gets 0, and the mean stays.
    assert linear_scaling(np.array([0.0, 3.0, 3.0]), 3.0) == pytest.approx([0.0, 3.0, 3.0])
    assert linear_scaling(np.array([2.0, 2.0]), 2.0) == pytest.approx([1.0, 1.0])


def started_from(population, settings, seed):
    search = BitGenetic(population[0], settings, seed)
    search._strings = encode(np.asarray(population, float), settings.bits)
    return search


def test_selection_is_in_proportion_to_scaled_fitness():
    settings = BitSettings(population=4000, crossover=0.0, mutation=0.0, first_mutation=0.0)
    half = np.arange(4000) % 2 == 0
    search = started_from(half[:, None], settings, 1)
    fitness = np.where(search.ask()[:, 0] > 0.5, 3.0, 1.0)  # scaled: 4 and 0 would be; 4 : 0
    search.tell(fitness)
    assert search.ask().mean() == 1.0
    search = started_from(half[:, None], BitSettings(4000, 8, 0.0, 0.0, 1.5, 0.0), 1)
    search.tell(fitness)  # scaled to 3 and 1
    assert search.ask().mean() == pytest.approx(0.75, abs=0.03)


def test_mutation_flips_each_bit_with_its_probability_and_the_first_individual_is_the_start():
    settings = BitSettings(population=500, first_mutation=0.05)
    start = np.zeros(20)
    search = BitGenetic(start, settings, 2)
    assert (search.ask()[0] == 0.0).all()
    flipped = encode(search.ask()[1:], 8).mean()
    assert flipped == pytest.approx(0.05, abs=0.003)


def test_two_point_crossover_exchanges_one_stretch():
    settings = BitSettings(population=200, crossover=1.0, mutation=0.0, first_mutation=0.0)
    search = started_from(np.tile([[0.0] * 5, [1.0] * 5], (100, 1)), settings, 3)
    search.tell(np.ones(200))
    strings = encode(search.ask(), 8).astype(int)
    changes = np.abs(np.diff(strings, axis=1)).sum(axis=1)
    assert changes.max() == 2
    assert (changes > 0).mean() > 0.3


def test_the_best_is_not_kept():
    settings = BitSettings(population=10, mutation=0.5)
    search = BitGenetic(np.full(3, 0.5), settings, 4)
    asked = search.ask()
    search.tell(np.arange(10.0))
    assert not (search.ask() == asked[9]).all(axis=1).any()


def test_it_climbs_a_hill_and_takes_negative_fitness():
    top = np.array([0.2, 0.9, 0.5])
    search = BitGenetic(np.full(3, 0.5), BitSettings(population=30, mutation=0.02), 5)
    away = []
    for _ in range(150):
        away.append(np.linalg.norm(search.ask() - top, axis=1))
        search.tell(-away[-1])
    assert np.min(away) < 0.05
