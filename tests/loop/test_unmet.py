"""Networks in arenas in which they were not evolved; the run that does best there is chosen."""

from dataclasses import replace

import numpy as np
import pytest
from khepera_data import made_up

from neurosim.base.place import paper_arena
from neurosim.controllers import make_controller
from neurosim.controllers.network import braitenberg
from neurosim.loop import unmet
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import Evolution, evolve
from neurosim.loop.settings import EvolveSettings
from neurosim.loop.unmet import Unmet, in_unmet_arenas
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.simulator import TableSimulator
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(unmet, "ARENAS", 40)
    monkeypatch.setattr(unmet, "DRIVES", 120)


@pytest.fixture(scope="module")
def evaluator():
    simulator = TableSimulator(made_up(), MotorTable.ideal(), paper_arena(), noise="none")
    task = ObstacleAvoidance(steps=200)
    return Evaluator(simulator, task, make_controller("network", simulator, task))


def test_who_turns_away_touches_less_than_who_drives_straight_on(evaluator):
    simulator = evaluator.simulator
    genes = np.stack(
        [braitenberg(simulator.reading_names, simulator.bearings, gain=gain)[1] for gain in (4, 0)]
    )
    careful, open_loop = in_unmet_arenas(evaluator, genes, seed=0)
    assert careful.touched <= 0.1 * careful.drives
    assert open_loop.touched >= 0.8 * open_loop.drives
    assert careful.fitness > open_loop.fitness
    assert careful.vehicle == open_loop.vehicle == careful.touched  # the vehicle is careful
    assert in_unmet_arenas(evaluator, genes, seed=0) == [careful, open_loop]


def test_a_sensor_slows_the_wheel_on_the_other_side():
    network, genes = braitenberg("abcd", np.array([0.5, -1.0, np.nan, np.pi]), speed=1.0, gain=2.0)
    left, right = genes.reshape(network.shapes[0])
    assert left == pytest.approx([0, -2 * np.cos(1.0), 0, 0, 1.0])
    assert right == pytest.approx([-2 * np.cos(0.5), 0, 0, 0, 1.0])


def test_one_that_touches_more_than_a_hand_written_vehicle_is_not_passed_off_as_good():
    bad = "In arenas that it was not evolved in, it touches something in 18 of 20 drives"
    hint = "evolve with --arenas 100 --contacts end, or more --runs."
    vehicle = "more often than a hand-written vehicle"
    assert str(Unmet(20, 18, 30.0, 2)) == f"{bad}, {vehicle} (in 2 of them); {hint}"
    assert str(Unmet(20, 18, 30.0, 0)) == f"{bad}, {vehicle} (in none of them); {hint}"
    assert str(Unmet(20, 18, 30.0, 18)) == str(Unmet(20, 18, 30.0)) == f"{bad}."
    assert str(Unmet(20, 0, 30.0, 0)).endswith("it touches something in no drive.")
    assert not Unmet(20, 18, 30.0).worse
    assert not Unmet(200, 4, 30.0, 1).worse  # may be chance
    assert Unmet(200, 9, 30.0, 1).worse


def test_other_tasks_have_no_unmet_arenas(evaluator):
    cells = Evaluator(evaluator.simulator, ObstacleAvoidance("cells"), evaluator.controller)
    assert in_unmet_arenas(cells, np.zeros((1, 18)), seed=0) is None


def test_the_choice_among_runs_goes_by_arenas_that_were_not_evolved_in(evaluator):
    settings = EvolveSettings(generations=2, runs=3)
    evolved = evolve(
        evaluator.simulator,
        evaluator.task,
        evaluator.controller,
        settings=settings,
        progress=False,
    )
    fitness = [one.predicted["unmet"]["fitness"] for one in evolved]
    assert len(set(fitness)) > 1
    assert fitness == sorted(fitness, reverse=True)
    evolution = Evolution(evaluator, settings, 0)
    known, other = (
        replace(evolved[0], predicted={"fitness": own, "unmet": there.describe()})
        for own, there in ((500.0, Unmet(20, 18, 30.0)), (400.0, Unmet(20, 0, 350.0)))
    )
    assert evolution._worth(other) > evolution._worth(known)
