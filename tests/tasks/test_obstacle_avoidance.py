"""Fitness of trajectories by hand, and networks that learn to avoid obstacles."""

import numpy as np
import pytest
from khepera_data import made_up
from neurosim.loop.evolve_networks import choose, evolve_networks
from neurosim.loop.network_evolution import (
    TOGETHER,
    NetworkEvolution,
    NetworkSettings,
    TableTrials,
)
from neurosim.loop.rollouts import rollouts
from neurosim.loop.write_plans import evolve

from neurosim.base.errors import FileError, UserError
from neurosim.controllers import NetworkController, Plan, read_controller
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.arena import Arena
from neurosim.simulators.tables.sensor_table import SensorTable
from neurosim.tasks.base import make_task
from neurosim.tasks.obstacle_avoidance import (
    FITNESS,
    ObstacleAvoidance,
    Trajectory,
    avoidance,
    cells_visited,
)


def test_equation_1_by_hand():
    readings = np.zeros((3, 8))
    readings[1, 4] = 0.25
    readings[2, [0, 7]] = 0.5, 1.0
    commands = np.array([[100, 100], [50, -100], [100, 100]])
    # 1 * 1 * 1, then V 0.75, DV 0.75, I 0.25, then against something.
    expected = 1 + 0.75 * (1 - 0.75**2) * 0.75
    assert avoidance(Trajectory(readings, commands)) == pytest.approx(expected)
    both = Trajectory(readings[None, None].repeat(2, 1), commands[None, None].repeat(2, 1))
    assert avoidance(both) == pytest.approx(np.full((1, 2), expected))
    backwards = Trajectory(readings[:1], -commands[:1])
    assert avoidance(backwards) == pytest.approx(1)  # absolute speeds: backwards counts alike


def test_cells_visited_by_hand():
    poses = np.array([[0.01, 0.01, 0], [0.04, 0.02, 0], [0.06, 0.02, 0], [-0.01, 0.01, 0]])
    still = np.zeros((4, 3))
    trajectory = Trajectory(np.zeros((2, 3, 8)), np.zeros((2, 3, 2)), np.stack([poses, still]))
    assert cells_visited(trajectory).tolist() == [3, 1]
    assert cells_visited(trajectory, size=0.02).tolist() == [4, 1]
    with pytest.raises(UserError, match="without the robot's poses"):
        cells_visited(Trajectory(np.zeros((3, 8)), np.zeros((3, 2))))


def test_task_settings():
    task = make_task("obstacle-avoidance", steps=300, starts=3)
    assert task.steps_a_start == 100
    assert make_task(**{"name": task.name, **task.describe()["settings"]}) == task
    for settings in ({"steps": 100, "starts": 3}, {"fitness": "beauty"}, {"duration": 0.0}):
        with pytest.raises(UserError):
            make_task("obstacle-avoidance", **settings)


def test_a_network_that_only_drives_ahead_against_one_that_turns_away():
    sim = TableSimulator(made_up(), noise="none", arena=Arena.rectangle(0.6, 0.35))
    ahead = np.array([[0] * 8 + [2.0], [0] * 8 + [2.0]])
    away = ahead.copy()
    away[1, :4], away[0, 2:6] = -6.0, -1.0  # sees something in front: turn to the right
    trials = TableTrials(sim, ObstacleAvoidance())
    start = np.array([[-0.2, -0.05, 0.3], [0.1, 0.05, 1.0]])
    driven = trials.drive(np.stack([ahead.ravel(), away.ravel()]), start, steps=200)
    fitness = avoidance(driven).mean(axis=1)
    assert fitness[1] > 1.5 * fitness[0]
    for genes, index in ((ahead, 0), (away, 1)):
        commands = NetworkController(genes, {"name": "x"}).commands(driven.readings[index])
        assert commands == pytest.approx(driven.commands[index], abs=1e-3)


def test_evolution_learns_and_is_repeatable(tmp_path):
    sim = TableSimulator(made_up())
    task = ObstacleAvoidance(steps=250)
    settings = NetworkSettings(generations=40)
    found = evolve_networks(sim, tmp_path / "net", task, settings, seed=3, progress=False)
    history = found.evolution["history"]
    assert len(history["best"]) == len(history["mean"]) == 40
    first, last = np.mean(history["mean"][:3]), np.mean(history["mean"][-5:])
    assert last > 1.5 * first
    assert found.predicted["fitness"] > 0.55 * task.steps
    again = evolve_networks(sim, tmp_path / "again", task, settings, seed=3, progress=False)
    assert (again.weights == found.weights).all()
    read = read_controller(tmp_path / "net")
    assert isinstance(read, NetworkController)
    assert (read.weights == found.weights).all()
    assert read.task == task.describe()
    with pytest.raises(UserError, match="not empty"):
        found.write(tmp_path / "net")
    with pytest.raises(FileError, match="expected 'plan', found 'network'"):
        Plan.read(tmp_path / "net")


def test_every_parent_has_as_many_children():
    # Without crossover and mutation the next population is copies of the best.
    settings = NetworkSettings(population=20, parents=4, crossover=0, mutation=0)
    evolution = NetworkEvolution(settings, seed=0)
    first = evolution.population.copy()
    evolution.generation(lambda genes, rng: np.arange(20.0))
    copies = (evolution.population[:, None] == first[None]).all(-1).sum(0)
    assert copies.tolist() == [0] * 16 + [5] * 4


def test_networks_driven_part_by_part_are_driven_alike():
    trials = TableTrials(TableSimulator(made_up()), ObstacleAvoidance(steps=50))
    genes = np.random.default_rng(0).normal(0, 1, (2 * TOGETHER + 7, 18))
    starts = trials.simulator.arena.free_poses(5, 0.0275, np.random.default_rng(1))
    at_once = trials.task.evaluate(trials.drive(genes, starts, np.random.default_rng(2)))
    assert (trials.fitness(genes, starts, np.random.default_rng(2)) == at_once).all()
    fitness, merit = trials.judge(genes, starts, np.random.default_rng(2))
    few, few_merit = trials.judge(genes[-9:], starts, np.random.default_rng(2))
    assert (fitness[-9:] == few).all()
    assert (merit[-9:] == few_merit).all()
    assert (merit <= fitness).all()
    assert (merit < fitness).any()


def test_of_two_that_are_as_fit_the_steadier_has_the_better_chances(monkeypatch):
    trials = TableTrials(TableSimulator(made_up()), ObstacleAvoidance(steps=50))
    genes = np.random.default_rng(0).normal(0, 1, (20, 18))
    starts = trials.simulator.arena.free_poses(5, 0.0275, np.random.default_rng(1))
    for fitness in (-1.0, 1.0):
        monkeypatch.setitem(
            FITNESS,
            "avoidance",
            lambda driven, worth=fitness: np.full(driven.poses.shape[:2], worth),
        )
        found, merit = trials.judge(genes, starts, np.random.default_rng(2))
        twice = [trials.drive(genes, starts, np.random.default_rng(s)).poses for s in (3, 4)]
        assert (found == 5 * fitness).all()
        assert (merit <= found).all()
        apart = np.median(np.linalg.norm((twice[0] - twice[1])[..., :2], axis=-1), axis=(1, 2))
        assert merit[apart.argmin()] > merit[apart.argmax()]
    alone = TableTrials(trials.simulator, trials.task, apart=np.inf)
    found, merit = alone.judge(genes, starts, np.random.default_rng(2))
    assert (found == merit).all()


def test_the_choice_is_not_the_lucky_one():
    trials = TableTrials(TableSimulator(made_up()), ObstacleAvoidance())
    away = np.array([[0, 0, -1, -1, -1, -1, 0, 0, 2], [-6, -6, -6, -6, 0, 0, 0, 0, 2.0]]).ravel()
    still = np.zeros(18)
    genes, fitness, spread = choose(trials, np.stack([still, away]), 0)
    assert (genes == away).all()
    assert fitness > 200
    assert 0 < spread < fitness


def test_a_plan_runs_in_tables_as_in_any_simulator():
    sim = TableSimulator(made_up(), noise="none", arena=Arena.rectangle(2, 2))
    commands = np.array([[[100.0, 100.0, 2.0], [50.0, -50.0, 0.5]]])
    path = rollouts(sim, (0, 0, 0)).expected(commands, np.ones((1, 2), bool))
    assert path[0, 1] == pytest.approx([0.2, 0, 0])
    assert path[0, 2] == pytest.approx([0.2, 0, -0.1 / 0.053 * 0.5])


def test_plans_are_not_evolved_for_it(tmp_path):
    (tmp_path / "sim").mkdir()
    TableSimulator(made_up()).write(tmp_path / "sim")
    with pytest.raises(UserError, match="takes a network"):
        evolve(tmp_path / "sim", tmp_path / "out", "obstacle-avoidance")


def test_obstacle_avoidance_in_the_samples_of_a_real_robot(shared_data):
    files = sorted((shared_data / "khepera").glob("*.sample"))
    trials = TableTrials(TableSimulator(SensorTable.from_files(files)), ObstacleAvoidance())
    evolution = NetworkEvolution(NetworkSettings(), seed=0)
    for _ in range(40):
        evolution.generation(trials)
    genes, fitness, _ = choose(trials, evolution.population, 0)
    assert evolution.mean[0] < 150
    assert fitness > 300
    # It keeps off: from most starts it never stands against anything for long.
    starts = trials.simulator.arena.free_poses(20, 0.0275, np.random.default_rng(5))
    driven = trials.drive(genes[None], starts, np.random.default_rng(6), steps=300)
    touching = trials.simulator.arena.clearance(driven.poses[0, :, :, :2]) < 0.0275 + 1e-4
    assert np.median(touching.mean(axis=1)) < 0.05
    assert np.median(cells_visited(driven)[0]) > 15
