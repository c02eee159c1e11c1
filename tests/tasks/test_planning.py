"""Plans are evolved, pair by pair, and what is returned is what the simulator says of them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from ideal_simulator import IdealWheels

from neurosim.base.errors import UserError
from neurosim.evolution.genetic import GeneticSettings
from neurosim.simulators.base import Simulator
from neurosim.tasks import planning
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.tasks.planning import PlanSettings, evolve_plan, pairing_keys, rollout

TASK = NineRectangles()
SMALL = PlanSettings(
    generations=12, runs=3, commands=4, genetic=GeneticSettings(population=40, tournament=5)
)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_a_rollout_by_hand():
    assert isinstance(IdealWheels(), Simulator)
    commands = torch.tensor([[[40.0, 40, 1], [50, 50, 3], [0, 26, 1]]], dtype=torch.float64)
    poses = rollout(IdealWheels(), TASK.start, commands, torch.tensor([[True, False, True]]))
    # 20 cm up, a null command, then a turn left by 1 rad about the left wheel, 6.5 cm to the left.
    r = 0.065
    turned = [-0.8 - r + r * math.cos(1), 0.2 + r * math.sin(1), math.pi / 2 + 1]
    expected = [TASK.start, (-0.8, 0.2, math.pi / 2), (-0.8, 0.2, math.pi / 2), turned, turned]
    assert poses[0].numpy() == pytest.approx(np.array(expected))


class Coasting(IdealWheels):
    """Rolls on for 5 cm when its motors stop."""

    def step(self, state, command, generator=None):
        after = super().step(state, command)
        stopped = (command[:, :2] == 0).all(1) & (state[:, 3:] != 0).any(1)
        after[:, 1] += 0.05 * stopped
        return after


def test_the_pose_at_rest_is_after_the_motors_ran_down():
    commands = torch.tensor([[[40.0, 40, 1], [50, 50, 3]]], dtype=torch.float64)
    poses = rollout(Coasting(), TASK.start, commands, torch.tensor([[True, False]]))
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
        again = rollout(
            IdealWheels(),
            TASK.start,
            torch.tensor(sent, dtype=torch.float64).view(1, -1, 3),
            torch.ones(1, len(sent), dtype=torch.bool),
        ).numpy()
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


def test_a_course_is_found():
    # The paper's settings, but for a third of its generations.
    settings = PlanSettings(runs=4, generations=300)
    results = evolve_plan(IdealWheels(), TASK, settings, seed=2, progress=False)
    best = results[0]
    assert best.completes
    assert TASK.region(best.rest) == 0
    assert 63 <= best.fitness <= 64


def test_interruption_returns_the_best_so_far(monkeypatch):
    calls = []
    generation = planning._Evolution.generation

    def interrupted(self):
        calls.append(1)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return generation(self)

    monkeypatch.setattr(planning._Evolution, "generation", interrupted)
    results = evolve_plan(IdealWheels(), TASK, SMALL, seed=3, progress=False)
    assert all(result.interrupted for result in results)
    assert len(results[0].history["best"]) == 3
    calls.extend([1] * 3)
    with pytest.raises(KeyboardInterrupt):
        evolve_plan(IdealWheels(), TASK, SMALL, seed=3, progress=False)


def test_keys_pair_the_nth_command_of_a_region_and_never_null_ones():
    region = torch.tensor([[0, 0, 1, 2, 2], [0, 1, 1, 1, 2]])
    given_ = torch.tensor([[True, True, True, True, False], [False, True, True, True, True]])
    a, b = pairing_keys(region, given_).tolist()
    assert len({*a}) == len({*b}) == 5
    assert [(i, j) for i in range(5) for j in range(5) if a[i] == b[j]] == [(2, 1), (3, 4)]


@given(st.integers(0, 10**6))
@hypothesis_settings(max_examples=50, deadline=None)
def test_crossover_changes_paired_commands_only_and_keeps_their_mean(seed):
    rng = generator(seed)
    a, b = torch.rand(2, 6, 5, 4, generator=rng, dtype=torch.float64).mul(0.2).add(0.4)
    region = torch.randint(3, (12, 5), generator=rng)
    given_ = torch.rand(12, 5, generator=rng) < 0.7
    keys_a, keys_b = pairing_keys(region, given_).view(2, 6, 5)
    child_a, child_b = planning.cross_paired(a, b, keys_a, keys_b, 2.0, rng)
    child_a, child_b = child_a.view(6, 5, 4), child_b.view(6, 5, 4)
    for n in range(6):
        for i in range(5):
            partners = [j for j in range(5) if keys_a[n, i] == keys_b[n, j]]
            if not partners:
                assert torch.equal(child_a[n, i], a[n, i])
                continue
            (j,) = partners
            both = child_a[n, i] + child_b[n, j]
            inside = ((child_a[n, i] % 1) * (child_b[n, j] % 1)) != 0  # else it was clamped
            assert torch.allclose(both[inside], (a[n, i] + b[n, j])[inside])
        for j in range(5):
            if not (keys_a[n] == keys_b[n, j]).any():
                assert torch.equal(child_b[n, j], b[n, j])


def test_mutation_hits_its_share_and_null_commands_come_back_new():
    genes = torch.rand(4000, 8, generator=generator(), dtype=torch.float64)
    mutated = planning.mutate(genes, 0.1, 0.1, generator(1))
    assert ((mutated >= 0) & (mutated <= 1)).all()
    old, new = genes.view(4000, 2, 4), mutated.view(4000, 2, 4)
    was, now = planning.is_null(old[..., 0]), planning.is_null(new[..., 0])
    assert (was != now).double().mean().item() == pytest.approx(0.1, abs=0.015)
    back = was & ~now
    assert (old[back] != new[back]).all()
    stayed = was == now
    assert (old[stayed][:, 0] == new[stayed][:, 0]).all()
    changed = (old[stayed][:, 1:] != new[stayed][:, 1:]).double().mean().item()
    assert changed == pytest.approx(0.1, abs=0.015)
    assert torch.equal(planning.mutate(genes, 0.0, 0.1, generator(1)), genes)


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
