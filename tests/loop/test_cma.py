"""CMA-ES of pycma as an optimiser by name."""

import numpy as np
import pytest
from ideal_simulator import SlippingWheels

from neurosim.controllers import Network, Plan
from neurosim.loop.evolve import evolve
from neurosim.loop.search import new_optimiser
from neurosim.loop.settings import EvolveSettings, default_settings
from neurosim.tasks.go_to import GoTo

pytest.importorskip("cma", reason="pip install 'neurosim[cma]'")

TASK = GoTo(goals=((0.3, 0.1, 0.0),), seconds=2.0)


def test_it_finds_the_top_of_a_hill_in_every_run():
    family = Network(("x", "y"))
    optimiser = new_optimiser(family, EvolveSettings("cma", runs=2), 3)
    top = np.arange(family.genes) / 3.0
    for _ in range(120):
        genes = optimiser.ask()
        assert genes.shape[0] == 2
        assert genes.shape[2] == family.genes
        optimiser.tell(-((genes - top) ** 2).sum(-1))
    assert optimiser.ask().mean(axis=1) == pytest.approx(np.stack([top, top]), abs=1e-3)


def test_plans_stay_within_the_range_of_their_genes():
    family = Plan(slots=2)
    optimiser = new_optimiser(family, EvolveSettings("cma"), 1)
    for _ in range(20):
        genes = optimiser.ask()
        assert genes.min() >= 0.0
        assert genes.max() <= 1.0
        optimiser.tell(genes.sum(-1))  # better the further out


def test_a_fitness_that_is_no_number_is_the_worst():
    optimiser = new_optimiser(Network(("x",)), EvolveSettings("cma"), 1)
    optimiser.tell(np.full(optimiser.ask().shape[:2], np.nan))
    assert np.isfinite(optimiser.ask()).all()


def test_it_evolves_and_the_seed_decides(tmp_path):
    family = Network(("goal_x", "goal_y"))
    settings = default_settings(
        family, TASK, optimiser="cma", generations=15, samples=2, selection=3, final_draws=8
    )

    def run(seed, out=None):
        how = {"settings": settings, "seed": seed, "progress": False}
        return evolve(SlippingWheels(), TASK, family, out=out, **how)[0]

    first, again, other = run(1, tmp_path / "net"), run(1), run(2)
    assert (first.genes == again.genes).all()
    assert (first.genes != other.genes).any()
    history = first.evolution["history"]["mean"]
    assert np.mean(history[-3:]) > np.mean(history[:3])
    assert not (tmp_path / "net.checkpoint").exists()
