"""Workers that judge: errors, and the same judgement in parts as in one piece.

A real cluster judges in tests/extras.
"""

import sys
from contextlib import contextmanager

import numba
import numpy as np
import pytest
from khepera_data import made_up
from motion_networks import noise_model, random_motion_network

from neurosim.base.errors import UserError
from neurosim.controllers import Plan
from neurosim.controllers.registry import make_controller
from neurosim.loop import evaluate as module
from neurosim.loop.evaluate import Evaluator, evaluate
from neurosim.loop.workers import workers_named
from neurosim.simulators import TableSimulator
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance


def test_refusals(monkeypatch):
    with pytest.raises(UserError, match="choose local or ray"):
        workers_named("spark")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"neurosim\[ray\]"):
        evaluate(random_motion_network(1), NineRectangles(), Plan(slots=2), workers="ray")


@pytest.mark.parametrize("kind", ["plan", "network"])
def test_two_cores_judge_as_one_does(kind):
    simulator = random_motion_network(1, noise=noise_model(1, size=-6.0))
    task = NineRectangles(seconds=2.0)
    evaluator = Evaluator(simulator, task, make_controller(kind, simulator, task))
    genes = np.random.default_rng(0).random((37, evaluator.controller.genes))
    draws = evaluator.draw(30, 1)
    merits = []
    for cores in (1, 2, 2):  # the third uses the memory of the second
        with threads(cores):
            merits.append(evaluator.merit(genes, draws, "progress")[0])
    assert len(np.unique(merits[0].merit)) > 5
    np.testing.assert_array_equal(merits[1], merits[0])
    np.testing.assert_array_equal(merits[2], merits[0])


def test_two_cores_judge_in_many_arenas_as_one_does():
    task = ObstacleAvoidance(steps=120, starts=6, contacts="end")
    arenas = TableSimulator(made_up(2, 0.01)).elsewhere(3, 0)
    evaluator = Evaluator(arenas, task, make_controller("network", arenas, task))
    genes = np.random.default_rng(0).normal(size=(9, evaluator.controller.genes))
    merits = []
    for cores in (1, 2):
        with threads(cores):
            merits.append(evaluator.merit(genes, evaluator.draw(1, 1))[0].merit)
    assert len(np.unique(merits[0])) > 5
    np.testing.assert_array_equal(*merits)


@contextmanager
def threads(count):
    before = numba.get_num_threads()
    if count > numba.config.NUMBA_NUM_THREADS:
        pytest.skip(f"this machine has fewer than {count} cores")
    numba.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def test_parts_are_judged_as_the_whole_is(monkeypatch):
    simulator = random_motion_network(1, noise=noise_model(1, size=-6.0))
    plan = Plan(slots=4)
    genes = np.random.default_rng(0).random((37, plan.genes))
    evaluator = Evaluator(simulator, NineRectangles(), plan)
    draws = evaluator.draw(3, 1)
    whole, keys = evaluator.merit(genes, draws, hints=("keys",))
    sizes = []

    def backwards(evaluator, parts, draws, how):
        parts = list(parts)
        sizes.extend(map(len, parts))
        merit = [evaluator.merit_of(part, draws, *how) for part in reversed(parts)]
        return iter(reversed(merit))

    evaluator.workers = backwards
    monkeypatch.setattr(module, "POSES_AT_ONCE", 5 * 3 * (evaluator.steps + 1))
    merit, other = evaluator.merit(genes, draws, hints=("keys",))
    assert sizes == [5] * 7 + [2]
    np.testing.assert_array_equal(merit, whole)
    np.testing.assert_array_equal(other["keys"], keys["keys"])
