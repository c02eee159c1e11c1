"""Fitness of trajectories by hand, and networks that learn to avoid obstacles."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from given_plans import EPISODE, GivenPlans, expected
from khepera_data import made_up

from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.controllers import Network, read_controller
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.loop.evolve import Evolution, evolve
from neurosim.loop.search import new_optimiser
from neurosim.loop.settings import NETWORK_GENETIC, EvolveSettings, default_settings
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.sensor_table import SensorTable
from neurosim.tasks.base import Judgement
from neurosim.tasks.obstacle_avoidance import (
    ObstacleAvoidance,
    avoidance,
)
from neurosim.tasks.registry import make_task

FAMILY = Network(tuple(f"sensor_{number}" for number in range(8)))


def test_equation_1_by_hand():
    readings = np.zeros((3, 8))
    readings[1, 4] = 0.25
    readings[2, [0, 7]] = 0.5, 1.0
    commands = np.array([[100, 100], [50, -100], [100, 100]])
    # 1 * 1 * 1, then V 0.75, DV 0.75, I 0.25, then against something.
    expected_ = 1 + 0.75 * (1 - 0.75**2) * 0.75
    assert avoidance(Trajectory(None, commands, 0.1, readings)) == pytest.approx(expected_)
    twice = [values[None, None].repeat(2, 1) for values in (commands, readings)]
    both = Trajectory(None, twice[0], 0.1, twice[1])
    assert avoidance(both) == pytest.approx(np.full((1, 2), expected_))
    backwards = Trajectory(None, -commands[:1], 0.1, readings[:1])
    assert avoidance(backwards) == pytest.approx(1)  # absolute speeds: backwards counts alike
    # A step that lasts for so many counts so often.
    uneven = Trajectory(None, commands, np.array([0.2, 0.4, 0.1]), readings)
    assert avoidance(uneven, 0.1) == pytest.approx(2 + 4 * (expected_ - 1))
    with pytest.raises(UserError, match="needs the sensors' readings"):
        avoidance(Trajectory(None, commands, 0.1))


def test_what_comes_after_a_contact_counts_nothing_where_it_is_known():
    readings, commands = np.zeros((2, 4, 8)), np.full((2, 4, 2), 100.0)
    touching = np.array([[False, True, False, False], [False] * 4])
    driven = Trajectory(None, commands, 0.1, readings, touching=touching)
    assert avoidance(driven).tolist() == [1.0, 4.0]
    each = np.full((2, 4), 0.2)  # of steps twice as long
    uneven = Trajectory(None, commands, each, readings, touching=touching)
    assert avoidance(uneven, 0.1).tolist() == [2.0, 8.0]
    assert ObstacleAvoidance(steps=20, contacts="end").episode.contacts
    assert not ObstacleAvoidance(steps=20).episode.contacts
    with pytest.raises(UserError, match="contacts: expected one of 'free', 'end', found 'soft'"):
        ObstacleAvoidance(contacts="soft")
    with pytest.raises(UserError, match="needs fitness='avoidance'"):
        ObstacleAvoidance(fitness="cells", contacts="end")


def cells_visited(trajectory):
    steps = trajectory.commands.shape[-2]
    return ObstacleAvoidance("cells", steps=steps, starts=1).judge(trajectory).fitness


def test_cells_visited_by_hand():
    poses = np.array([[0.01, 0.01, 0], [0.04, 0.02, 0], [0.06, 0.02, 0], [-0.01, 0.01, 0]])
    still = np.zeros((4, 3))
    trajectory = Trajectory(np.stack([poses, still]), np.zeros((2, 3, 2)), 0.1)
    assert cells_visited(trajectory).tolist() == [3, 1]
    with pytest.raises(UserError, match="needs the robot's poses"):
        cells_visited(Trajectory(None, np.zeros((3, 2)), 0.1))


def test_a_trial_succeeds_where_the_fitness_is_enough():
    readings = np.zeros((2, 4, 8))
    readings[1, :, 5] = 0.8
    driven = Trajectory(None, np.full((2, 4, 2), 100.0), 0.1, readings)
    judged = ObstacleAvoidance(steps=20).judge(driven)  # 4 steps from each of 5 starts
    assert judged.fitness.tolist() == avoidance(driven).tolist() == pytest.approx([4.0, 0.8])
    assert judged.success.tolist() == [True, False]
    assert judged.segment.tolist() == [3, 3]
    assert ObstacleAvoidance(steps=20, enough=0.7).judge(driven).success.all()
    # All starts of a trial count together.
    assert ObstacleAvoidance(starts=2).whole(np.array([[1.0, 2.0]])).tolist() == [3.0]


def test_task_settings():
    task = make_task("obstacle-avoidance", steps=300, starts=3)
    assert task.episode.steps == 100
    assert task.trial_starts == 3
    assert make_task(task.describe()) == task
    for settings in ({"steps": 100, "starts": 3}, {"fitness": "beauty"}, {"duration": 0.0}):
        with pytest.raises(UserError):
            make_task("obstacle-avoidance", **settings)


def test_a_network_that_only_drives_ahead_against_one_that_turns_away():
    sim = TableSimulator(made_up(), noise="none", place=Place.rectangle(0.6, 0.35))
    ahead = np.array([[0] * 8 + [2.0], [0] * 8 + [2.0]])
    away = ahead.copy()
    away[1, :4], away[0, 2:6] = -6.0, -1.0  # sees something in front: turn to the right
    genes = np.stack([ahead.ravel(), away.ravel()])
    start = np.array([[-0.2, -0.05, 0.3], [0.1, 0.05, 1.0]])
    drives = rollouts_of(sim, FAMILY, Episode(0.1, 200, readings=True))
    driven = drives.run(genes, Draws(start))
    fitness = avoidance(driven).mean(axis=1)
    assert fitness[1] > 1.5 * fitness[0]
    for index in range(2):
        seen = torch.from_numpy(driven.readings[index].reshape(-1, 8).astype(float))
        rows = torch.from_numpy(genes[[index]]).expand(len(seen), -1)
        commands, _ = FAMILY.act(rows, seen, FAMILY.start(len(seen)))
        given = driven.commands[index].reshape(-1, 2)
        assert commands.numpy() == pytest.approx(given, abs=1e-3)


@pytest.mark.slow
def test_evolution_learns_and_is_repeatable(tmp_path):
    sim = TableSimulator(made_up())
    task = ObstacleAvoidance(steps=250)
    how = {"generations": 40, "seed": 3, "progress": False}
    (evolved,) = evolve(sim, task, out=tmp_path / "net", **how)
    history = evolved.evolution["history"]
    assert len(history["best"]) == len(history["mean"]) == 40
    first, last = np.mean(history["mean"][:3]), np.mean(history["mean"][-5:])
    assert last > 1.5 * first
    assert evolved.predicted["fitness"] > 0.55 * task.steps
    # Where the task needs sensors, the controller is a network of all that there are.
    assert evolved.controller.inputs == FAMILY.inputs
    assert evolved.genes.shape == (FAMILY.genes,)
    (again,) = evolve(sim, task, "network", out=tmp_path / "again", **how)
    assert (again.genes == evolved.genes).all()
    read = read_controller(tmp_path / "net")
    assert read.controller == evolved.controller
    assert (read.genes == evolved.genes).all()
    assert read.task == task.describe()
    with pytest.raises(UserError, match="not empty"):
        evolved.write(tmp_path / "net")


def test_every_parent_has_as_many_children():
    # Without crossover and mutation the next population is copies of the best.
    genetic = replace(NETWORK_GENETIC, population=20, parents=4, crossover=0, mutation=0)
    optimiser = new_optimiser(FAMILY, EvolveSettings(genetic=genetic), 0)
    first = optimiser.ask()[0].copy()
    optimiser.tell(np.arange(20.0)[None])
    copies = (optimiser.ask()[0][:, None] == first[None]).all(-1).sum(0)
    assert copies.tolist() == [0] * 16 + [5] * 4


def test_networks_driven_part_by_part_are_driven_alike(monkeypatch):
    monkeypatch.setattr("neurosim.loop.evaluate.POSES_AT_ONCE", 110_000)
    evaluator = Evaluator(TableSimulator(made_up()), ObstacleAvoidance(steps=50), FAMILY)
    genes = np.random.default_rng(0).normal(0, 1, (407, 18))
    # Five trials, each from five starts, all of them met twice.
    draws = evaluator.draw(5, np.random.default_rng(1), 2)
    assert len(draws) == 50
    assert (draws.starts[:25] == draws.starts[25:]).all()
    assert len(list(evaluator._parts(len(genes), len(draws)))) == 3
    judged, _ = evaluator.judge(genes, draws)
    at_once = judged.fitness.reshape(len(genes), 10, 5).sum(2).mean(1)
    merit, _ = evaluator.merit(genes, draws, "fitness")
    assert (merit.merit == at_once).all()
    steady, _ = evaluator.merit(genes, draws, "steady")
    few, _ = evaluator.merit(genes[-9:], draws, "steady")
    assert (steady.shown == at_once).all()
    assert (steady.shown[-9:] == few.shown).all()
    assert (steady.merit[-9:] == few.merit).all()
    assert (steady.merit <= steady.shown).all()
    assert (steady.merit < steady.shown).any()


def test_of_two_that_are_as_fit_the_steadier_has_the_better_chances(monkeypatch):
    evaluator = Evaluator(TableSimulator(made_up()), ObstacleAvoidance(steps=50), FAMILY)
    genes = np.random.default_rng(0).normal(0, 1, (20, 18))
    draws = evaluator.draw(1, 2, 2)
    for fitness in (-1.0, 1.0):
        monkeypatch.setattr(
            ObstacleAvoidance,
            "worth",
            lambda task, record, worth=fitness: Judgement.of(
                np.full(len(record), worth), np.zeros(len(record), np.bool_)
            ),
        )
        merit, _ = evaluator.merit(genes, draws, "steady")
        poses = evaluator.run(genes, draws).poses
        assert (merit.shown == 5 * fitness).all()
        assert (merit.merit <= merit.shown).all()
        between = (poses[:, :5] - poses[:, 5:])[..., :2]
        apart = np.median(np.linalg.norm(between, axis=-1), axis=(1, 2))
        assert merit.merit[apart.argmin()] > merit.merit[apart.argmax()]
        assert merit.merit == pytest.approx(5 * fitness - 5 * np.minimum(apart / 0.2, 1.0))
    alone, _ = evaluator.merit(genes, draws, "fitness")
    assert (alone.shown == alone.merit).all()


class Fixed:
    """An optimiser that asks for the same two networks again and again."""

    away = np.array([[0, 0, -1, -1, -1, -1, 0, 0, 2], [-6, -6, -6, -6, 0, 0, 0, 0, 2.0]]).ravel()

    def __init__(self, space):
        pass

    def ask(self):
        return np.stack([np.zeros(18), self.away])[None]

    def tell(self, fitness):
        assert fitness.shape == (1, 2)


@pytest.mark.slow
def test_the_choice_is_not_the_lucky_one(monkeypatch):
    monkeypatch.setitem(OPTIMISERS._registered, "fixed", Fixed)
    evaluator = Evaluator(TableSimulator(made_up()), ObstacleAvoidance(), FAMILY)
    settings = default_settings(FAMILY, evaluator.task, optimiser="fixed", generations=1)
    evolution = Evolution(evaluator, settings, 0)
    evolution.run(progress=False)
    # In its generation the one that stands still had luck.
    evolution.stages[0].top[:] = 0.0
    evolution.stages[0].merit[:] = [[500.0, 0.0]]
    (result,) = evolution.results(False)
    assert (result.genes == Fixed.away).all()
    assert result.predicted["fitness"] > 200
    assert 0 < result.predicted["spread"] < result.predicted["fitness"]


def test_a_plan_runs_in_tables_as_in_any_simulator():
    sim = TableSimulator(made_up(), noise="none", place=Place.rectangle(2, 2))
    plans = GivenPlans(np.array([[[100.0, 100.0, 2.0], [50.0, -50.0, 0.5]]]), np.ones((1, 2), bool))
    path = expected(sim.rollouts(plans, EPISODE), plans, (0, 0, 0))
    assert path[0, 1] == pytest.approx([0.2, 0, 0])
    assert path[0, 2] == pytest.approx([0.2, 0, -0.1 / 0.053 * 0.5])


@pytest.mark.slow
def test_obstacle_avoidance_in_the_samples_of_a_real_robot(shared_data):
    files = sorted((shared_data / "khepera").glob("*.sample"))
    sim = TableSimulator(SensorTable.from_files(files))
    (evolved,) = evolve(sim, ObstacleAvoidance(), generations=40, seed=0, progress=False)
    assert evolved.evolution["history"]["mean"][0] < 150
    assert evolved.predicted["fitness"] > 300
    # It keeps off: from most starts it never stands against anything for long.
    drives = rollouts_of(sim, FAMILY, Episode(0.1, 300, readings=True))
    starts = sim.place.free_poses(20, 0.0275, np.random.default_rng(5))
    driven = drives.run(evolved.genes[None], drives.draw(starts, np.random.default_rng(6)))
    touching = sim.place.clearance(driven.poses[0, :, :, :2]) < 0.0275 + 1e-4
    assert np.median(touching.mean(axis=1)) < 0.05
    assert np.median(cells_visited(driven)[0]) > 15
