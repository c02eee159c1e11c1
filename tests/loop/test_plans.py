"""Plans are evolved, and come with the simulator's predictions."""

import math
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from given_plans import EPISODE, GivenPlans, expected
from ideal_simulator import IdealWheels, SlippingWheels

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Trajectory
from neurosim.controllers import FixedPlan, Plan
from neurosim.evolution.genetic import GeneticSettings
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import evolve
from neurosim.loop.search import Search, new_optimiser
from neurosim.loop.settings import PLAN_GENETIC, EvolveSettings, RobustSettings
from neurosim.loop.stepped import SteppedRollouts
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Judgement
from neurosim.tasks.nine_rectangles import NineRectangles

TASK = NineRectangles()
FAMILY = Plan(slots=4)
SMALL = EvolveSettings(
    generations=12,
    runs=3,
    genetic=GeneticSettings(population=40, tournament=5),
    final_draws=64,
)


def rollout(simulator, commands, given):
    plans = GivenPlans(np.array(commands, float), np.array(given))
    return expected(SteppedRollouts(simulator, plans, EPISODE), plans, TASK.start)


def evolved(simulator, task=TASK, family=FAMILY, settings=SMALL, seed=3):
    return evolve(simulator, task, family, settings=settings, seed=seed, progress=False)


def test_a_rollout_by_hand():
    assert isinstance(IdealWheels(), Simulator)
    commands = [[[40.0, 40, 1], [50, 50, 3], [0, 26, 1]]]
    poses = rollout(IdealWheels(), commands, [[True, False, True]])
    # 20 cm up, a null command, then a turn left by 1 rad about the left wheel, 6.5 cm to the left.
    r = 0.065
    turned = [-0.8 - r + r * math.cos(1), 0.2 + r * math.sin(1), math.pi / 2 + 1]
    expected = [TASK.start, (-0.8, 0.2, math.pi / 2), (-0.8, 0.2, math.pi / 2), turned, turned]
    assert poses[0] == pytest.approx(np.array(expected))


class Loaded(IdealWheels):
    """Carries a load that differs in every drive and makes it slower; drawn at the start."""

    has_noise = True
    state_names = (*IdealWheels.state_names, "load")

    def start(self, pose, generator=None):
        load = torch.zeros(len(pose), 1, dtype=pose.dtype)
        if generator is not None:
            load = torch.rand(load.shape, generator=generator, dtype=pose.dtype)
        return torch.cat([super().start(pose), load], dim=1)

    def step(self, state, command, generator=None):
        slower = command * torch.tensor([1.0, 1.0, 0.0])
        slower = command - 0.1 * state[:, 5:] * slower
        return torch.cat([super().step(state[:, :5], slower), state[:, 5:]], dim=1)


def test_what_is_drawn_at_the_start_differs_from_outcome_to_outcome():
    plans = GivenPlans(np.array([[[40.0, 40, 1]]]), np.array([[True]]))
    drives = SteppedRollouts(Loaded(), plans, EPISODE)
    draws = drives.draw(np.tile(TASK.start, (50, 1)), 3, None)
    ends = drives.run(plans.rows, draws).poses[0, :, -1, 1]
    assert 0.18 <= ends.min() < 0.185
    assert 0.195 < ends.max() <= 0.2
    assert expected(drives, plans, TASK.start)[0, -1, 1] == pytest.approx(0.2)


class Coasting(IdealWheels):
    """Rolls on for 5 cm when its motors stop."""

    def step(self, state, command, generator=None):
        after = super().step(state, command)
        stopped = (command[:, :2] == 0).all(1) & (state[:, 3:] != 0).any(1)
        after[:, 1] += 0.05 * stopped
        return after


def test_the_pose_at_rest_is_after_the_motors_ran_down():
    poses = rollout(Coasting(), [[[40.0, 40, 1], [50, 50, 3]]], [[True, False]])
    assert poses[0, :, 1].tolist() == pytest.approx([0, 0.2, 0.2, 0.25])


def test_evolution_improves_and_says_what_the_simulator_says():
    results = evolved(IdealWheels())
    assert len(results) == 3
    fitness = [result.predicted["fitness"] for result in results]
    assert sorted(result.evolution["run"] for result in results) == [0, 1, 2]
    assert fitness == sorted(fitness, reverse=True)
    assert fitness[0] > 0
    for result in results:
        history, poses = result.evolution["history"], np.array(result.predicted["poses"])
        best = history["best"]
        assert len(best) == len(history["mean"]) == SMALL.generations
        assert best == sorted(best)
        assert best[-1] == pytest.approx(result.predicted["fitness"])
        assert all(m <= b for m, b in zip(history["mean"], best, strict=True))
        sent = [command for command in result.commands if command is not None]
        assert len(result.commands) == 4
        assert poses.shape == (len(sent) + 1, 3)
        assert poses[0].tolist() == list(TASK.start)
        for left, right, duration in sent:
            assert max(abs(left), abs(right)) <= 50
            assert 0.5 <= duration <= 3
        # Without its null commands, one by one, the plan does the same.
        again = rollout(IdealWheels(), np.reshape(sent, (1, -1, 3)), np.ones((1, len(sent)), bool))
        assert again[0, :-1] == pytest.approx(poses)
        assert again[0, -1] == pytest.approx(result.predicted["rest"])
        alone = Evaluator(IdealWheels(), TASK, FixedPlan(tuple(sent)))
        judged, _ = alone.judge(np.empty((1, 0)), alone.expectation())
        assert judged.fitness[0, 0] == pytest.approx(result.predicted["fitness"])
        assert not result.evolution["interrupted"]


def test_the_same_seed_gives_the_same_plans():
    first, second, other = (evolved(IdealWheels(), seed=seed) for seed in (3, 3, 4))
    assert [r.commands for r in first] == [r.commands for r in second]
    assert [r.evolution for r in first] == [r.evolution for r in second]
    assert [r.commands for r in first] != [r.commands for r in other]


@pytest.mark.slow
def test_a_course_is_found():
    settings = EvolveSettings(runs=4, generations=800, genetic=PLAN_GENETIC, final_draws=64)
    results = evolved(IdealWheels(), TASK, Plan(), settings, seed=2)
    best = results[0].predicted
    assert best["completes"]
    assert TASK.region(np.array(best["rest"])) == 0
    assert 63 <= best["fitness"] <= 64


@pytest.mark.parametrize("generation", [1, 4])
def test_interruption_returns_the_best_so_far(monkeypatch, generation):
    whole = evolved(IdealWheels())
    one = Search.generation

    def interrupted(self):
        if self.done == generation - 1:
            os.kill(os.getpid(), signal.SIGINT)
        return one(self)

    monkeypatch.setattr(Search, "generation", interrupted)
    results = evolved(IdealWheels())
    assert all(result.evolution["interrupted"] for result in results)
    # The interrupted generation was completed.
    assert {one.evolution["run"]: one.evolution["history"]["best"] for one in results} == {
        one.evolution["run"]: one.evolution["history"]["best"][:generation] for one in whole
    }


@pytest.mark.parametrize(
    ("make", "setting", "message"),
    [
        (EvolveSettings, {"objective": "luck"}, "no objective 'luck'; choose from fitness, "),
        (Plan, {"durations": (2.0, 1.0)}, "2 s, is above the longest, 1 s"),
    ],
)
def test_settings_out_of_range_are_named(make, setting, message):
    with pytest.raises(UserError, match=message):
        make(**setting)


def test_a_simulator_of_other_commands_is_refused():
    simulator = IdealWheels()
    simulator.command_names = ("v", "w", "duration")
    with pytest.raises(UserError, match="this simulator takes v, w, duration"):
        evolved(simulator)


class FirstRectangle(NineRectangles):
    """Done by a robot that stands in rectangle 1 at the end: a command does it."""

    def worth(self, record):
        result = super().worth(record)
        there = (self.region(record[:, 1:4]) == 1) & (result.reason == 3)
        return Judgement.of(result.fitness, there, result.reason)


@pytest.mark.parametrize("objective", ["fitness", "probability"])
def test_robust_plans_succeed_more_often_and_say_how_often(objective):
    task = FirstRectangle()
    robust = RobustSettings(
        objective, 8, draws=16, refresh=3, selection_draws=64, genetic=SMALL.genetic
    )
    family = Plan(slots=2)
    settings = replace(SMALL, final_draws=400, placing=(0.03, 0.2))
    before = evolved(SlippingWheels(), task, family, settings, seed=1)
    settings = replace(settings, robust=robust)
    after = evolved(SlippingWheels(), task, family, settings, seed=1)
    again = evolved(SlippingWheels(), task, family, settings, seed=1)
    assert [r.commands for r in after] == [r.commands for r in again]
    for result in after:
        history = result.evolution["history"]
        assert result.predicted["draws"] == 400
        assert 0 <= result.predicted["probability"] <= 1
        assert len(history["best"]) == 12
        assert len(history["robust_best"]) == len(history["robust_mean"]) == 8
    name = "expected_fitness" if objective == "fitness" else "probability"
    merit = lambda r: r.predicted[name]  # noqa: E731
    assert [merit(r) for r in after] == sorted(map(merit, after), reverse=True)
    assert merit(after[0]) >= max(map(merit, before)) - 0.02


def runs_of(task, runs, **settings):
    evaluator = Evaluator(SlippingWheels(), task, Plan(slots=2))
    how = replace(SMALL, runs=runs, genetic=GeneticSettings(population=8, tournament=3))
    search = Search(evaluator, new_optimiser(evaluator.controller, how, 2), seed=[0], **settings)
    judged, merit = [], evaluator.merit
    evaluator.merit = lambda genes, *rest: judged.append(len(genes) // 8) or merit(genes, *rest)
    return search, judged


def test_runs_end_some_time_after_they_complete_the_task():
    search, judged = runs_of(FirstRectangle(), 5, settling=2)
    kept = {}
    while not search.ended:
        search.generation()
        assert search.done < 100
        for run in np.flatnonzero(~search.running):
            kept.setdefault(run, (search.population[run].copy(), search.top[run].copy()))
    assert judged[:3] == [5] * 3
    assert 5 > judged[-1] > 0
    assert judged == sorted(judged, reverse=True)
    success = search._evaluator.judge(search.top, search._evaluator.expectation())[0].success
    assert success.all()
    for run, (population, top) in kept.items():
        np.testing.assert_array_equal(search.population[run], population)
        np.testing.assert_array_equal(search.top[run], top)


def test_the_worse_half_of_the_runs_ends_again_and_again():
    search, judged = runs_of(NineRectangles(), 5, samples=4, refresh=2, halving=3)
    running = []
    for _ in range(12):
        search.generation()
        running.append(search.running.copy())
    assert judged == [5] * 3 + [3] * 3 + [2] * 3 + [1] * 3
    lately = np.mean(search.best[:3], axis=0)
    assert lately[running[2]].min() >= lately[~running[2]].max()
    assert not search.ended


def test_a_probability_is_that_of_drives_made_one_by_one():
    settings = replace(SMALL, runs=1, final_draws=500, placing=(0.02, 0.1))
    task = FirstRectangle()
    (result,) = evolved(SlippingWheels(), task, FAMILY, settings, seed=5)
    rng, simulator = np.random.default_rng(0), SlippingWheels()
    generator = torch.Generator().manual_seed(0)
    successes = 0
    for _ in range(500):
        pose = np.array(task.start) + rng.standard_normal(3) * (0.02, 0.02, 0.1)
        state = simulator.start(torch.from_numpy(pose[None]))
        poses, commands = [state[0, :3].numpy()], []
        for command in [*(c for c in result.commands if c), (0.0, 0.0, 0.5)]:
            state = simulator.step(state, torch.tensor([command], dtype=torch.float64), generator)
            poses.append(state[0, :3].numpy())
            commands.append(command)
        given = np.arange(len(commands)) < len(commands) - 1
        driven = Trajectory(np.array(poses), np.array(commands), 1.0, active=given)
        successes += int(task.judge(driven).success)
    assert result.predicted["probability"] == pytest.approx(successes / 500, abs=0.1)


def test_robust_evolution_needs_samples_that_differ():
    with pytest.raises(UserError, match="neither noise nor an ensemble"):
        evolved(IdealWheels(), settings=replace(SMALL, robust=RobustSettings()))


def test_robust_settings_out_of_range_are_named():
    with pytest.raises(UserError, match="expected one of 'probability', 'fitness', found 'luck'"):
        RobustSettings("luck")
    with pytest.raises(UserError, match=r"placing\[0\]: expected a number from 0"):
        EvolveSettings(placing=(-1.0, 0.0))
