"""Plans are evolved, and what is returned is what the simulator says of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from ideal_simulator import IdealWheels
from neurosim.loop.plans import PlanSettings, RobustSettings, evolve_plan, improve_plans
from neurosim.loop.rollouts import SteppedRollouts

from neurosim.base.errors import UserError
from neurosim.evolution.genetic import GeneticSettings
from neurosim.loop import plans as planning
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Evaluation
from neurosim.tasks.nine_rectangles import NineRectangles

TASK = NineRectangles()
SMALL = PlanSettings(
    generations=12,
    runs=3,
    commands=4,
    genetic=GeneticSettings(population=40, tournament=5),
    final_draws=64,
)


def rollout(simulator, commands, given):
    return SteppedRollouts(simulator, TASK.start).expected(np.array(commands), np.array(given))


def test_a_rollout_by_hand():
    assert isinstance(IdealWheels(), Simulator)
    commands = [[[40.0, 40, 1], [50, 50, 3], [0, 26, 1]]]
    poses = rollout(IdealWheels(), commands, [[True, False, True]])
    # 20 cm up, a null command, then a turn left by 1 rad about the left wheel, 6.5 cm to the left.
    r = 0.065
    turned = [-0.8 - r + r * math.cos(1), 0.2 + r * math.sin(1), math.pi / 2 + 1]
    expected = [TASK.start, (-0.8, 0.2, math.pi / 2), (-0.8, 0.2, math.pi / 2), turned, turned]
    assert poses[0] == pytest.approx(np.array(expected))


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
    results = evolve_plan(IdealWheels(), TASK, SMALL, seed=3, progress=False)
    assert len(results) == 3
    assert sorted(result.run for result in results) == [0, 1, 2]
    assert [r.fitness for r in results] == sorted((r.fitness for r in results), reverse=True)
    assert results[0].fitness > 0
    for result in results:
        best = result.history["best"]
        assert len(best) == len(result.history["mean"]) == SMALL.generations
        assert best == sorted(best)
        assert best[-1] == pytest.approx(result.fitness)
        assert all(m <= b for m, b in zip(result.history["mean"], best, strict=True))
        sent = [command for command in result.commands if command is not None]
        assert len(result.commands) == 4
        assert result.poses.shape == (len(sent) + 1, 3)
        assert result.poses[0].tolist() == list(TASK.start)
        for left, right, duration in sent:
            assert max(abs(left), abs(right)) <= 50
            assert 0.5 <= duration <= 3
        # Without its null commands, one by one, the plan does the same.
        again = rollout(IdealWheels(), np.reshape(sent, (1, -1, 3)), np.ones((1, len(sent)), bool))
        assert again[0, :-1] == pytest.approx(result.poses)
        assert again[0, -1] == pytest.approx(result.rest)
        given_ = np.array([[True] * len(sent) + [False]])
        assert TASK.fitness(again, given_)[0] == pytest.approx(result.fitness)
        assert not result.interrupted


def test_the_same_seed_gives_the_same_plans():
    first = evolve_plan(IdealWheels(), TASK, SMALL, seed=3, progress=False)
    second = evolve_plan(IdealWheels(), TASK, SMALL, seed=3, progress=False)
    other = evolve_plan(IdealWheels(), TASK, SMALL, seed=4, progress=False)
    assert [r.commands for r in first] == [r.commands for r in second]
    assert [r.history for r in first] == [r.history for r in second]
    assert [r.commands for r in first] != [r.commands for r in other]


@pytest.mark.slow
def test_a_course_is_found():
    settings = PlanSettings(runs=4, generations=800, final_draws=64)
    results = evolve_plan(IdealWheels(), TASK, settings, seed=2, progress=False)
    best = results[0]
    assert best.completes
    assert TASK.region(best.rest) == 0
    assert 63 <= best.fitness <= 64


def test_interruption_returns_the_best_so_far(monkeypatch):
    calls = []
    generation = planning.Evolution.generation

    def interrupted(self):
        calls.append(1)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return generation(self)

    monkeypatch.setattr(planning.Evolution, "generation", interrupted)
    results = evolve_plan(IdealWheels(), TASK, SMALL, seed=3, progress=False)
    assert all(result.interrupted for result in results)
    assert len(results[0].history["best"]) == 3
    calls.extend([1] * 3)
    with pytest.raises(KeyboardInterrupt):
        evolve_plan(IdealWheels(), TASK, SMALL, seed=3, progress=False)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"commands": 0}, "commands must be at least 1"),
        ({"runs": 0}, "runs must be at least 1"),
        ({"max_speed": 120.0}, "in 0 to 100 %, not 120"),
        ({"durations": (2.0, 1.0)}, "in order, not 2 to 1"),
    ],
)
def test_settings_out_of_range_are_named(setting, message):
    with pytest.raises(UserError, match=message):
        PlanSettings(**setting)


def test_a_simulator_of_other_commands_is_refused():
    simulator = IdealWheels()
    simulator.command_names = ("v", "w", "duration")
    with pytest.raises(UserError, match="this simulator takes v, w, duration"):
        evolve_plan(simulator, TASK, seed=0, progress=False)


class SlippingWheels(IdealWheels):
    """Wheels whose speed is off by a few percent, drawn for every command."""

    def step(self, state, command, generator=None):
        if generator is None:
            return super().step(state, command)
        scale = torch.ones_like(command)
        slip = torch.randn(len(command), 2, generator=generator, dtype=command.dtype)
        scale[:, :2] += 0.03 * slip
        return super().step(state, command * scale)


class FirstRectangle(NineRectangles):
    """Done by a robot that stands in rectangle 1 at the end: a command does it."""

    def evaluate(self, poses, given):
        result = super().evaluate(poses, given)
        there = (self.region(np.asarray(poses)[:, -1]) == 1) & (result.reason == 3)
        return Evaluation(result.fitness, there, result.reason, result.segment, result.detail)


@pytest.mark.parametrize("objective", ["fitness", "probability"])
def test_robust_plans_succeed_more_often_and_say_how_often(objective):
    task = FirstRectangle()
    robust = RobustSettings(
        objective, 8, draws=16, refresh=3, selection_draws=64, genetic=SMALL.genetic
    )
    settings = replace(SMALL, commands=2, final_draws=400, placing=(0.03, 0.2))
    before = evolve_plan(SlippingWheels(), task, settings, seed=1, progress=False)
    settings = replace(settings, robust=robust)
    after = evolve_plan(SlippingWheels(), task, settings, seed=1, progress=False)
    again = evolve_plan(SlippingWheels(), task, settings, seed=1, progress=False)
    assert [r.commands for r in after] == [r.commands for r in again]
    for result in after:
        assert result.draws == 400
        assert 0 <= result.probability <= 1
        assert len(result.history["best"]) == 12
        assert len(result.history["robust_best"]) == len(result.history["robust_mean"]) == 8
    merit = (lambda r: r.expected_fitness) if objective == "fitness" else (lambda r: r.probability)
    assert [merit(r) for r in after] == sorted(map(merit, after), reverse=True)
    assert merit(after[0]) >= max(map(merit, before)) - 0.02
    improved = improve_plans(SlippingWheels(), task, before, settings, seed=1, progress=False)
    assert len(improved) == 3
    assert list(improved[0].history) == ["robust_best", "robust_mean"]


def test_a_probability_is_that_of_drives_made_one_by_one():
    settings = replace(SMALL, runs=1, final_draws=500, placing=(0.02, 0.1))
    task = FirstRectangle()
    (result,) = evolve_plan(SlippingWheels(), task, settings, seed=5, progress=False)
    rng, simulator = np.random.default_rng(0), SlippingWheels()
    generator = torch.Generator().manual_seed(0)
    successes = 0
    for _ in range(500):
        pose = np.array(task.start) + rng.standard_normal(3) * (0.02, 0.02, 0.1)
        state = simulator.start(torch.from_numpy(pose[None]))
        poses, given = [state[0, :3].numpy()], []
        for command in [*(c for c in result.commands if c), (0.0, 0.0, 0.5)]:
            state = simulator.step(state, torch.tensor([command], dtype=torch.float64), generator)
            poses.append(state[0, :3].numpy())
            given.append(command[0] != 0.0 or command[1] != 0.0)
        successes += task.evaluate(np.array([poses]), np.array([given])).completes[0]
    assert result.probability == pytest.approx(successes / 500, abs=0.1)


def test_robust_settings_out_of_range_are_named():
    with pytest.raises(UserError, match="for fitness or probability, not 'luck'"):
        RobustSettings("luck")
    with pytest.raises(UserError, match="draws must be at least 1"):
        RobustSettings(draws=0)
    with pytest.raises(UserError, match="must not be negative"):
        PlanSettings(placing=(-1.0, 0.0))
