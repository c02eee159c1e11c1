"""Any simulator with any controller at any task, by the one loop: evolved, checked, resumed.

An impossible pair (a task that needs sensors, a simulator without) is an error of one sentence.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from motion_networks import random_motion_network
from simulators_of_tests import Walker, motion_network, tables

import neurosim as ns
from neurosim.base.trajectory import Draws
from neurosim.controllers import Function, Network, Plan, Recurrent
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.search import Search
from neurosim.loop.settings import RobustSettings, default_settings

SIMULATORS = {
    "tables": tables,
    "motion-network": motion_network,
    "motion-network, driven": random_motion_network,
    "walker": Walker,
}


def controller(kind, simulator, task):
    """Return a family of each kind that fits a simulator and a task."""
    if kind == "plan":
        return Plan(slots=4, durations=(0.2, 0.6))
    if kind == "function":

        def rule(seen, genes):
            return 40 + 20 * np.tanh(genes[:, 0] * seen["x"]), 40 + 20 * np.tanh(genes[:, 1])

        return Function(rule, ("x",), genes=2)
    inputs = (*simulator.reading_names, "x", "cos_heading", "time")
    if task.episode.goals is not None:
        inputs += ("goal_x", "goal_y", "goal_sin")
    return Network(inputs, (3,)) if kind == "network" else Recurrent(inputs, 3, "ctrnn")


@dataclass(frozen=True)
class Far(ns.Task):
    """A user's own task: get away from the start, ``far`` metres."""

    far: float = 0.3
    name: ClassVar[str] = "far"
    reasons: ClassVar[tuple[str, ...]] = ("stayed near its start",)
    start: ClassVar[tuple[float, float, float]] = (0.1, 0.1, 0.5)

    @property
    def episode(self):
        return ns.Episode(step=0.2, steps=8, rest=0.3)

    def worth(self, record):
        gone = np.linalg.norm(record[:, 4:6] - record[:, 1:3], axis=-1)
        return ns.Judgement.of(gone, gone > self.far)


TASKS = {
    "nine-rectangles": lambda: ns.make_task("nine-rectangles", seconds=1.0, step=0.2),
    "obstacle-avoidance": lambda: ns.make_task("obstacle-avoidance", steps=12, starts=3),
    "go-to": lambda: ns.make_task(
        "go-to", goals=[[0.2, 0.1, 0.0]], begin=[0.1, 0.1, 0.0], seconds=1.2
    ),
    "far": Far,
}


def combined(simulator, kind, task):
    sim, goal = SIMULATORS[simulator](), TASKS[task]()
    return sim, goal, controller(kind, sim, goal)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("kind", ["plan", "network", "recurrent", "function"])
@pytest.mark.parametrize("simulator", SIMULATORS)
def test_every_combination_is_evolved_and_judged(simulator, kind, task):
    sim, goal, family = combined(simulator, kind, task)
    if task == "obstacle-avoidance" and not sim.reading_names:
        with pytest.raises(ns.UserError, match="needs the readings of sensors"):
            ns.evaluate(sim, goal, family)
        return
    fitness = ns.evaluate(sim, goal, family, samples=2, seed=1)
    genes = family.first(5, torch.Generator().manual_seed(2))
    values = fitness(genes.numpy())
    assert values.shape == (5,)
    assert np.isfinite(values).all()
    assert np.array_equal(values, fitness(genes.numpy()))
    assert torch.equal(fitness(genes), torch.from_numpy(values))
    evolved = ns.evolve(
        sim,
        goal,
        family,
        settings=default_settings(family, goal, runs=1, final_draws=8, selection=3),
        generations=2,
        seed=3,
        progress=False,
    )
    assert 0 <= evolved[0].predicted["probability"] <= 1
    assert len(evolved[0].evolution["history"]["best"]) == 2
    trajectory = ns.rollout(sim, evolved[0], task=goal, samples=3)
    assert trajectory.poses.shape[0] == 3
    checked = ns.check(evolved[0], sim, goal, draws=16)
    assert 0 <= checked.probability <= 1


@pytest.mark.parametrize("task", ["nine-rectangles", "obstacle-avoidance", "go-to", "far"])
@pytest.mark.parametrize("kind", ["plan", "network", "recurrent"])
@pytest.mark.parametrize("simulator", ["tables", "motion-network", "motion-network, driven"])
def test_compiled_rollouts_are_the_stepped_ones(simulator, kind, task):
    sim, goal, family = combined(simulator, kind, task)
    if task == "obstacle-avoidance" and (not sim.reading_names or kind == "plan"):
        pytest.skip("there is nothing compiled of this kind")
    compiled = Evaluator(sim, goal, family)
    stepped = Evaluator(sim, goal, family, stepped=True)
    assert type(compiled.rollouts) is not type(stepped.rollouts)
    genes = family.first(4, torch.Generator().manual_seed(4)).numpy()
    for draws in (compiled.draw(2, 5), compiled.expectation()):
        a, b = compiled.run(genes, draws), stepped.run(genes, draws)
        np.testing.assert_allclose(a.poses, b.poses, atol=2e-4 if sim.reading_names else 1e-9)
        np.testing.assert_allclose(a.commands, b.commands, atol=0.05 if sim.reading_names else 1e-6)
        np.testing.assert_allclose(a.times, b.times)


def test_the_same_samples_for_all():
    """Two equal individuals meet the same noise, in a batch of any size."""
    sim, goal, family = combined("motion-network", "network", "far")
    evaluator = Evaluator(sim, goal, family)
    genes = family.first(3, torch.Generator().manual_seed(4)).numpy()
    draws = evaluator.draw(6, 7)
    alone = evaluator.run(genes[[1]], draws).poses[0]
    among = evaluator.run(genes[[1, 0, 1, 2]], draws).poses
    assert np.array_equal(among[0], among[2])
    np.testing.assert_allclose(alone, among[0], atol=1e-12)


def test_a_task_of_ones_own_is_made_robust():
    sim, goal, family = combined("motion-network", "plan", "far")
    robust = RobustSettings(generations=2, draws=3, refresh=1, selection_draws=8)
    settings = default_settings(family, goal, runs=2, generations=2, robust=robust, final_draws=16)
    evolved = ns.evolve(sim, goal, family, settings=settings, seed=1, progress=False)
    assert len(evolved) == 2
    assert evolved[0].predicted["probability"] >= evolved[1].predicted["probability"]
    assert len(evolved[0].evolution["history"]["robust_best"]) == 2


def test_what_does_not_fit_is_refused():
    walker, goal = Walker(), TASKS["go-to"]()
    with pytest.raises(ns.UserError, match="needs sensor_3, and the simulator does not have it"):
        ns.evaluate(walker, goal, Network(("sensor_3",)))
    with pytest.raises(ns.UserError, match="the task gives no goals"):
        ns.evaluate(walker, Far(), Network(("goal_x",)))
    with pytest.raises(ns.UserError, match="gives up, down, but this simulator takes left, right"):
        ns.evaluate(walker, goal, Network(("x",), outputs=("up", "down")))
    fitness = ns.evaluate(walker, goal, Network(("x",)))
    with pytest.raises(ns.UserError, match=r"expected genes \[P, 4\]"):
        fitness(np.zeros((2, 5)))
    with pytest.raises(ns.UserError, match="finite"):
        fitness([[0.0, 0.0, np.nan, 0.0]])
    still = tables().changed(noise="none")
    with pytest.raises(ns.UserError, match="neither noise nor an ensemble"):
        ns.evolve(
            still, goal, Plan(), settings=default_settings(Plan(), goal, robust=RobustSettings())
        )


def test_commands_outside_of_the_domain_are_refused():
    sim = motion_network()
    assert ns.rollout(sim, [[20.0, 30.0, 1.0]] * 3).poses.shape == (4, 3)
    batch = torch.full((2, 3, 3), 2.0, dtype=torch.float64)
    assert isinstance(ns.rollout(sim, batch).poses, torch.Tensor)
    assert ns.rollout(sim, batch, samples=4).poses.shape == (2, 4, 4, 3)
    for wrong, says in (
        ([20.0, 30.0, -1.0], "duration = -1"),
        ([20.0, 30.0, 0.0], "duration = 0"),
        ([20.0, np.nan, 1.0], "right = nan"),
        ([90.0, 30.0, 1.0], r"left = 90 lies outside of .*\(-50 to 50\)"),
        ([20.0, 30.0], "2 columns"),
    ):
        with pytest.raises(ns.UserError, match=says):
            ns.rollout(sim, [wrong])


def test_the_expected_motion_has_no_noise():
    sim = motion_network()
    evaluator = Evaluator(sim, Far(), Plan(slots=3, durations=(0.2, 0.6)))
    genes = np.full((1, 12), 0.4)
    a = evaluator.run(genes, evaluator.expectation()).poses
    assert np.array_equal(a, evaluator.run(genes, Draws(np.array([Far.start]))).poses)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_fitness_that_is_not_finite_names_its_task(wrong, tmp_path):
    class Wrong(Far):
        def worth(self, record):
            judged = super().worth(record)
            return replace(judged, fitness=np.where(judged.fitness < 0.01, judged.fitness, wrong))

    sim = motion_network()
    with pytest.raises(ns.UserError, match="the task far gives a trial a fitness that is not fin"):
        ns.evolve(sim, Wrong(), Plan(slots=4), generations=2, out=tmp_path / "o", progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("genes", "message"),
    [
        (np.zeros((1, 10, 3)), r"finite genes \[\.\.\., 16\]; it asked for \[1, 10, 3\]$"),
        (np.full((1, 10, 16), np.nan), r"asked for \[1, 10, 16\], some of them nan or inf"),
    ],
)
def test_an_optimiser_that_asks_for_other_genes_is_told(genes, message):
    class Asks:
        def ask(self):
            return genes

        def tell(self, merit):
            raise AssertionError("nothing was judged")

    evaluator = Evaluator(motion_network(), Far(), Plan(slots=4))
    with pytest.raises(ns.UserError, match=message):
        Search(evaluator, Asks(), seed=[0]).generation()
