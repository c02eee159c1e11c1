"""What networks do in arenas that they were not evolved in, and the choice among runs by it."""

from dataclasses import replace

import numpy as np
import pytest
from khepera_data import made_up

from neurosim.controllers import make_controller
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import Evolution, evolve
from neurosim.loop.settings import EvolveSettings
from neurosim.loop.unmet import DRIVES, Unmet, in_unmet_arenas
from neurosim.simulators.tables.arena import paper_arena
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.simulator import TableSimulator
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance


@pytest.fixture(scope="module")
def evaluator():
    simulator = TableSimulator(made_up(), MotorTable.ideal(), paper_arena(), noise="none")
    task = ObstacleAvoidance(steps=200)
    return Evaluator(simulator, task, make_controller("network", simulator, task))


def vehicle(speed, gain):
    """Return genes [18] of one whose wheels are slowed by what is near on the other side."""
    weights = np.zeros((2, 9))
    weights[0, [3, 4, 5]] = weights[1, [2, 1, 0]] = -gain * np.array([1.0, 0.7, 0.4])
    weights[:, 8] = speed
    return weights.reshape(-1)


def test_who_turns_away_touches_less_than_who_drives_straight_on(evaluator):
    genes = np.stack([vehicle(1.2, 4.0), vehicle(1.2, 0.0)])
    careful, blind = in_unmet_arenas(evaluator, genes, seed=0)
    assert careful.touched <= 2
    assert blind.touched >= 0.8 * blind.drives
    assert careful.fitness > blind.fitness
    assert str(blind) == (
        "In arenas that it was not evolved in, it touches something "
        f"in {blind.touched} of {DRIVES} drives."
    )
    assert in_unmet_arenas(evaluator, genes, seed=0) == [careful, blind]


def test_other_tasks_have_no_unmet_arenas(evaluator):
    cells = Evaluator(evaluator.simulator, ObstacleAvoidance("cells"), evaluator.controller)
    assert in_unmet_arenas(cells, np.zeros((1, 18)), seed=0) is None


def test_the_choice_among_runs_goes_by_arenas_that_were_not_evolved_in(evaluator):
    settings = EvolveSettings(generations=2, runs=3)
    found = evolve(
        evaluator.simulator,
        evaluator.task,
        evaluator.controller,
        settings=settings,
        progress=False,
    )
    fitness = [one.predicted["unmet"]["fitness"] for one in found]
    assert len(set(fitness)) > 1
    assert fitness == sorted(fitness, reverse=True)
    evolution = Evolution(evaluator, settings, 0)
    known, other = (
        replace(found[0], predicted={"fitness": own, "unmet": unmet.describe()})
        for own, unmet in ((500.0, Unmet(20, 18, 30.0)), (400.0, Unmet(20, 0, 350.0)))
    )
    assert evolution._worth(other) > evolution._worth(known)
