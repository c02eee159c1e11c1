"""Operators of plans: commands are crossed pair by pair, mutated by their fraction."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.evolution import command_sets as breeding
from neurosim.evolution.command_sets import (
    NOT_PAIRED,
    PlanPopulation,
    PlanSettings,
    decode,
    encode,
    pairing_keys,
)


def state(seed=0):
    return np.array([seed], np.uint64)


def test_keys_pair_the_nth_command_of_a_region_and_never_null_ones():
    region = np.array([[0, 0, 1, 2, 2], [0, 1, 1, 1, 2]])
    given_ = np.array([[True, True, True, True, False], [False, True, True, True, True]])
    a, b = pairing_keys(region, given_).tolist()
    assert a[4] == b[0] == NOT_PAIRED
    assert len({*a}) == len({*b}) == 5
    assert [(i, j) for i in range(5) for j in range(5) if a[i] == b[j] != NOT_PAIRED] == [
        (2, 1),
        (3, 4),
    ]


@given(st.integers(0, 10**6))
@settings(max_examples=50, deadline=None)
def test_crossover_changes_paired_commands_only_and_keeps_their_mean(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0.4, 0.6, (2, 5, 4))
    keys_a, keys_b = pairing_keys(rng.integers(0, 3, (2, 5)), rng.random((2, 5)) < 0.7)
    child_a, child_b = a.ravel().copy(), b.ravel().copy()
    breeding.cross(child_a, child_b, keys_a, keys_b, 2.0, state(seed))
    child_a, child_b = child_a.reshape(5, 4), child_b.reshape(5, 4)
    for i in range(5):
        partners = [j for j in range(5) if keys_a[i] == keys_b[j] != NOT_PAIRED]
        if not partners:
            assert np.array_equal(child_a[i], a[i])
            continue
        (j,) = partners
        inside = ((child_a[i] % 1) * (child_b[j] % 1)) != 0  # else it was clamped
        assert child_a[i][inside] + child_b[j][inside] == pytest.approx((a[i] + b[j])[inside])
    for j in range(5):
        if keys_b[j] == NOT_PAIRED or keys_b[j] not in keys_a:
            assert np.array_equal(child_b[j], b[j])


def test_crossover_spreads_children_as_simulated_binary_crossover_does():
    # Deb and Agrawal 1995: the spread beta has the density 0.5 (eta + 1) beta^eta below 1, and
    # half of the genes are left alone.
    eta, rng, key, betas = 3.0, state(5), np.zeros(1, np.int64), []
    for _ in range(4000):
        a, b = np.full(4, 0.45), np.full(4, 0.55)
        breeding.cross(a, b, key, key, eta, rng)
        betas.extend((b - a) / 0.1)
    betas = np.array(betas)
    crossed = betas[np.abs(betas - 1.0) > 1e-12]
    assert len(crossed) / len(betas) == pytest.approx(0.5, abs=0.02)
    assert np.mean(crossed < 1.0) == pytest.approx(0.5, abs=0.02)
    assert np.mean(crossed[crossed < 1.0]) == pytest.approx((eta + 1) / (eta + 2), abs=0.01)


def test_mutation_hits_its_share_and_null_commands_come_back_new():
    # Plans of one command, which can only come back at the same index.
    old = np.random.default_rng(0).random((8000, 4))
    new, rng = old.copy(), state(1)
    for genes in new:
        breeding.mutate(genes, 4, 0.1, 0.1, 1, rng)
    assert ((new >= 0) & (new <= 1)).all()
    old, new = old[:, None], new[:, None]
    was, now = breeding.is_null(old[..., 0]), breeding.is_null(new[..., 0])
    assert (was != now).mean() == pytest.approx(0.1, abs=0.015)
    back = was & ~now
    assert (old[back] != new[back]).all()
    stayed = was == now
    assert (old[stayed][:, 0] == new[stayed][:, 0]).all()
    assert (old[stayed][:, 1:] != new[stayed][:, 1:]).mean() == pytest.approx(0.1, abs=0.015)
    same = old[0, 0].copy()
    breeding.mutate(same, 4, 0.0, 0.1, 1, rng)
    assert np.array_equal(same, old[0, 0])


@pytest.mark.parametrize(
    ("source", "place", "expected"), [(1, 3, [0, 2, 3, 3]), (3, 0, [0, 0, 1, 2]), (2, 2, range(4))]
)
def test_commands_make_room_for_one_that_comes_back(source, place, expected):
    genes = np.repeat(np.arange(4.0), 4)
    breeding._move(genes, 4 * source, 4 * place, 4)
    assert genes.reshape(4, 4)[:, 0].tolist() == list(expected)  # that at place is new


def population(seed=0, **changes):
    genes = np.random.default_rng(0).random((2, 20, 12))
    return PlanPopulation(genes, PlanSettings(population=20, **changes), [seed])


def test_winners_are_bred_from_and_the_best_is_kept():
    # Nothing but selection: a tournament of many leaves the best plan of each run alone.
    plans = population(crossover=0.0, mutation=0.0, tournament=200)
    first, fitness = plans.genes.copy(), np.random.default_rng(1).random((2, 20))
    fitness[0, 3] = np.nan
    plans.tell(fitness, np.full((2, 20, 3), NOT_PAIRED))
    place = np.nanargmax(fitness, axis=1)
    for run in range(2):
        assert np.array_equal(plans.genes[run], np.tile(first[run, place[run]], (20, 1)))


def test_tournaments_of_two_win_as_often_as_they_should():
    # Of two drawn with replacement the best of 20 is among them with 1 - (19/20)^2.
    plans = population(crossover=0.0, mutation=0.0, tournament=2, elites=0)
    first, fitness, wins = plans.genes.copy(), np.tile(np.arange(20.0), (2, 1)), 0
    for _ in range(400):
        plans.genes = first.copy()
        plans.tell(fitness, np.full((2, 20, 3), NOT_PAIRED))
        wins += (plans.genes == first[:, 19:20]).all(-1).sum()
    assert wins / (400 * 40) == pytest.approx(1 - 0.95**2, abs=0.01)


def test_the_same_seed_breeds_the_same_children():
    fitness = np.random.default_rng(1).random((2, 20))
    keys = np.tile(np.arange(3), (2, 20, 1))
    children = []
    for seed in (3, 3, 4):
        plans = population(seed)
        plans.tell(fitness, keys)
        plans.tell(fitness, keys)
        children.append(plans.genes)
    assert np.array_equal(children[0], children[1])
    assert not np.array_equal(children[0], children[2])


def test_commands_survive_encoding():
    plan = [(50.0, -50.0, 0.5), None, (3.0, -17.0, 2.345), (0.0, 0.0, 3.0)]
    low, high = np.full(2, -50.0), np.full(2, 50.0)
    genes = encode(plan, low, high, (0.5, 3.0))
    commands, given_ = decode(genes[None], low, high, np.ones(2), 0.5, 3.0)
    assert given_[0].tolist() == [True, False, True, True]
    for each_result, expected in zip(commands[0], plan, strict=True):
        assert expected is None or each_result == pytest.approx(expected)


def test_commands_of_three_numbers_survive_encoding():
    plan = [(0.3, -0.1234, 2.0, 0.5), None, (-0.3, 0.2, -1.5, 2.0)]
    low, high = np.array([-0.3, -0.2, -2.0]), np.array([0.3, 0.2, 2.0])
    genes = encode(plan, low, high, (0.5, 3.0))
    assert genes.shape == (15,)
    commands, given_ = decode(genes[None], low, high, np.full(3, 1e4), 0.5, 3.0)
    assert given_[0].tolist() == [True, False, True]
    for each_result, expected in zip(commands[0], plan, strict=True):
        assert expected is None or each_result == pytest.approx(expected)
