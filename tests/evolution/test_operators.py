import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.evolution import gaussian_mutation, sbx, tournament, truncation


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@given(st.integers(1, 40), st.integers(1, 60), st.integers(1, 20), st.integers(0, 2**32))
def test_a_tournament_picks_the_best_of_its_draw(population, size, count, seed):
    fitness = torch.randn(population, generator=seeded(seed + 1))
    winners = tournament(fitness, size, count, seeded(seed))
    random = torch.randint(population, (count, size), generator=seeded(seed))
    for winner, draw in zip(winners.tolist(), random.tolist(), strict=True):
        assert winner in draw
        assert fitness[winner] == max(fitness[i] for i in draw)


def test_a_tournament_of_k_picks_the_best_of_p_as_often_as_theory_says():
    # The best of 10 is not among 5 drawn with replacement with a chance of 0.9^5.
    winners = tournament(torch.arange(10.0), 5, 20_000, seeded())
    assert (winners == 9).double().mean().item() == pytest.approx(1 - 0.9**5, abs=0.012)


def test_independent_runs_hold_tournaments_of_their_own():
    fitness = torch.stack([torch.arange(6.0), -torch.arange(6.0)])
    winners = tournament(fitness, 60, 8, seeded())
    assert (winners[0] == 5).all()
    assert (winners[1] == 0).all()


@given(
    st.integers(0, 2**32),
    st.floats(0, 100),
    st.floats(1e-3, 1e6),
)
@settings(max_examples=50)
def test_children_of_sbx_have_their_parents_mean(seed, eta, size):
    g = seeded(seed)
    a, b = size * torch.randn(2, 7, 5, generator=g, dtype=torch.float64)
    first, second = sbx(a, b, eta, g)
    spread = (first - second).abs() + (a - b).abs()
    assert torch.isfinite(first).all()
    assert ((first + second - a - b).abs() <= 1e-12 * (spread + a.abs() + b.abs())).all()


def test_children_of_equal_parents_are_exactly_the_parents():
    a = torch.tensor([[1e30, -0.1, 3.0]])
    first, second = sbx(a, a.clone(), 2.0, seeded())
    assert torch.equal(first, a)
    assert torch.equal(second, a)


def test_sbx_spreads_as_the_paper_says():
    # Deb and Agrawal 1995, equation for beta: the chance of a contracting crossover is 1/2, and
    # P(beta <= b) = b^(eta+1) / 2 below 1.
    eta = 3.0
    a, b = torch.zeros(100_000, 1), torch.ones(100_000, 1)
    first, second = sbx(a, b, eta, seeded(), gene_probability=1.0)
    beta = (second - first).abs()
    assert (beta <= 1).double().mean().item() == pytest.approx(0.5, abs=0.01)
    assert (beta <= 0.8).double().mean().item() == pytest.approx(0.8**4 / 2, abs=0.01)
    assert (beta <= 1.25).double().mean().item() == pytest.approx(1 - 0.8**4 / 2, abs=0.01)


def test_sbx_crosses_the_given_share_of_genes():
    a, b = torch.zeros(1000, 20), torch.ones(1000, 20)
    first, _ = sbx(a, b, 2.0, seeded(), gene_probability=0.3)
    assert (first != 0).double().mean().item() == pytest.approx(0.3, abs=0.02)


def test_mutation_changes_the_given_share_by_the_given_scale():
    scale = torch.tensor([0.1, 2.0])
    change = gaussian_mutation(torch.zeros(50_000, 2), 0.05, scale, seeded())
    changed = change != 0
    assert changed.double().mean(0).tolist() == pytest.approx([0.05, 0.05], abs=0.004)
    for gene in (0, 1):
        spread = change[changed[:, gene], gene].std().item()
        assert spread == pytest.approx(scale[gene].item(), rel=0.05)


def test_truncation_gives_each_of_the_best_as_many_children():
    fitness = torch.randn(3, 100, generator=seeded(5))
    parents = truncation(fitness, 20, 100, seeded())
    for run in range(3):
        best = set(fitness[run].topk(20).indices.tolist())
        chosen, times = parents[run].unique(return_counts=True)
        assert set(chosen.tolist()) == best
        assert (times == 5).all()
    uneven = truncation(fitness[0], 3, 7, seeded())
    order = fitness[0].topk(3).indices
    assert [(uneven == i).sum().item() for i in order] == [3, 2, 2]
    assert not torch.equal(parents[0], parents[0].sort().values)
