"""Workers that judge: errors, and the same judgement in parts as in one piece.

A real cluster judges in tests/extras.
"""

import sys

import numpy as np
import pytest
from motion_networks import noise_model, random_motion_network

from neurosim.base.errors import UserError
from neurosim.controllers import Plan
from neurosim.loop import evaluate as module
from neurosim.loop.evaluate import Evaluator, evaluate
from neurosim.loop.workers import workers_named
from neurosim.tasks.nine_rectangles import NineRectangles


def test_refusals(monkeypatch):
    with pytest.raises(UserError, match="choose local or ray"):
        workers_named("spark")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"neurosim\[ray\]"):
        evaluate(random_motion_network(1), NineRectangles(), Plan(slots=2), workers="ray")


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
