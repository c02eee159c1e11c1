"""Commands unlike any recorded one: the warnings, and how evolution treats them."""

import numpy as np
import pytest
from click.testing import CliRunner
from motion_networks import random_motion_network
from synthetic_robot import random_commands

import neurosim as ns
from neurosim.base.errors import UserError
from neurosim.cli.plan_check import plan_check
from neurosim.controllers import FixedPlan, Plan, SavedController, make_controller
from neurosim.loop.check import check
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import evolve
from neurosim.loop.settings import default_settings
from neurosim.simulators.motion.domain import Domain
from neurosim.simulators.motion.files import write_motion
from neurosim.tasks.nine_rectangles import NineRectangles

TASK = NineRectangles()
NAMES = ("left", "right", "duration")


def simulator(**changes):
    """Return a simulator that was trained without commands that drive straight ahead."""
    rows = random_commands(np.random.default_rng(0), 4000)
    result = random_motion_network(**changes)
    result.known = Domain.of(NAMES, rows[~(rows[:, :2] > 5.0).all(1)])
    return result


def saved(*commands):
    return SavedController(
        controller=FixedPlan(commands),
        genes=np.empty(0),
        task=TASK.describe(),
        start=TASK.start,
        predicted={
            "poses": [list(TASK.start)] * (len(commands) + 1),
            "rest": list(TASK.start),
            "fitness": 0.0,
            "completes": False,
        },
    )


def test_the_share_is_of_time_and_of_given_commands():
    plan = Plan(slots=3)
    genes = plan.encode([(-20.0, -20.0, 2.0), None, (30.0, 30.0, 1.0)])
    measure = ns.evaluate(simulator(), TASK, plan)
    assert measure.unsupported(genes) == pytest.approx(1 / 3)
    assert measure.unsupported(np.stack([genes, genes])) == pytest.approx([1 / 3] * 2)
    checked = check(saved((-20.0, -20.0, 2.0), (30.0, 30.0, 1.0)), simulator(), draws=50)
    assert checked.unsupported == pytest.approx(1 / 3)


def test_who_relies_on_them_ranks_behind():
    plan, sim = Plan(slots=2), simulator()
    evaluator = Evaluator(sim, TASK, plan)
    genes = np.stack(
        [
            plan.encode([(30.0, 30.0, 1.0), (30.0, 30.0, 1.0)]),
            plan.encode([(30.0, 30.0, 0.5), (-20.0, -20.0, 2.0)]),
            plan.encode([(-20.0, -20.0, 1.0), (20.0, -20.0, 1.0)]),
        ]
    )
    draws = evaluator.expectation()
    plain, _ = evaluator.merit(genes, draws)
    ranked, _ = evaluator.merit(genes, draws, unsupported=0.1)
    assert ranked.merit[0] < ranked.merit[1] < ranked.merit[2] == plain.merit[2]
    assert (ranked.shown == plain.shown).all()
    lenient, _ = evaluator.merit(genes, draws, unsupported=1.0)
    assert (lenient.merit == plain.merit).all()
    sim.known = None
    unknowing, _ = evaluator.merit(genes, draws, unsupported=0.0)
    assert (unknowing.merit == plain.merit).all()


def test_evolution_keeps_to_what_was_recorded():
    sim, plan = simulator(), Plan(slots=4)
    settings = default_settings(plan, TASK, generations=15, runs=2, final_draws=64)
    best = evolve(sim, TASK, plan, settings=settings, progress=False)
    assert all(one.predicted["unsupported"] <= 0.1 for one in best)
    wide = Plan(slots=4, max_speed=80.0)
    outside = r"the commands of plans.* lies outside .*--max-speed.* --extrapolate$"
    with pytest.raises(UserError, match=outside):
        evolve(sim, TASK, wide, settings=settings, progress=False)
    free = default_settings(wide, TASK, generations=2, runs=1, final_draws=64, extrapolate=True)
    (evolved,) = evolve(sim, TASK, wide, settings=free, progress=False)
    assert evolved.predicted["unsupported"] > 0.0


def test_of_a_network_steps_count():
    sim = simulator(drives=False)
    network = make_controller("network", sim, TASK)
    genes = np.zeros((2, network.genes))
    measure = ns.evaluate(sim, TASK, network)
    # Without a drive model commands of 0.1 s are not supported.
    assert measure.unsupported(genes) == pytest.approx([1.0, 1.0])
    rows = random_commands(np.random.default_rng(0), 400)
    sim.known = Domain.of(NAMES, rows, begins=True)
    assert measure.unsupported(genes) == pytest.approx([0.0, 0.0])


def test_plan_check_warns_and_refuses(tmp_path):
    (tmp_path / "simulator").mkdir()
    write_motion(simulator(), tmp_path / "simulator")
    saved((30.0, 30.0, 1.0)).write(tmp_path / "gap")
    saved((-80.0, -80.0, 1.0)).write(tmp_path / "outside")

    def run(plan, *more):
        words = [str(tmp_path / plan), str(tmp_path / "simulator"), "--draws", "50", *more]
        return CliRunner().invoke(plan_check, words)

    result = run("gap")
    assert result.exit_code == 0
    assert "learned from: 100.0 % of the time" in result.output
    assert "100 % of the commands (by time) are unlike any" in result.stderr
    assert isinstance(run("outside").exception, UserError)
    allowed = run("outside", "--extrapolate")
    assert allowed.exit_code == 0
    assert "record --guided" in allowed.stderr
