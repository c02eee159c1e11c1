"""Many arenas instead of one: the same tables, arena by arena."""

import numpy as np
import pytest
import torch
from khepera_data import made_up

from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Draws, Episode
from neurosim.controllers import Network
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.loop.evolve import evolve
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.places import PITCH, random_arena
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance

FAMILY = Network(tuple(f"sensor_{number}" for number in range(8)))
EPISODE = Episode(0.1, 20, readings=True)


@pytest.fixture(scope="module")
def tables():
    return TableSimulator(made_up(), noise="uniform")


@pytest.fixture(scope="module")
def many(tables):
    return tables.elsewhere(5, seed=3)


def test_arenas_are_drawn_with_room_for_the_robot():
    rng = np.random.default_rng(0)
    arenas = [random_arena(rng) for _ in range(40)]
    shapes = {len(arena.outline) for arena in arenas}
    assert shapes == {4, 6}
    assert {len(arena.obstacles) for arena in arenas} >= {0, 1, 2, 3}
    assert {len(arena.walls) for arena in arenas} == {0, 1, 2}
    for arena in arenas:
        assert len(arena.free_poses(5, 0.0275, rng)) == 5
        # All objects inside can be passed on both sides.
        for x, y, radius in arena.obstacles:
            others = Place(
                arena.outline, arena.walls, tuple(o for o in arena.obstacles if o[:2] != (x, y))
            )
            assert others.clearance(np.array([x, y])) > radius + 2 * 0.0275
    again = np.random.default_rng(0)
    assert [random_arena(again) for _ in range(3)] == arenas[:3]
    with pytest.raises(UserError, match="radius lies from 1 mm"):
        random_arena(rng, 0.0)


def test_a_trial_is_in_the_arena_in_which_it_starts(many):
    rng = np.random.default_rng(1)
    starts = many.free_poses(12, rng)
    where = np.rint(starts[:, 0] / PITCH).astype(int)
    assert len(set(where.tolist())) > 2
    genes = FAMILY.first(3, torch.Generator().manual_seed(0)).numpy()
    rollouts = many.rollouts(FAMILY, EPISODE)
    draws = rollouts.draw(starts, rng)
    rolled_out = rollouts.run(genes, draws)
    assert rolled_out.shape == (3, 12)
    for one, place in enumerate(where):
        local = starts[[one]] - (PITCH * place, 0.0, 0.0)
        alone = rollouts_of(many.places[place], FAMILY, EPISODE).run(
            genes, Draws(local, noise=draws.noise[[one]])
        )
        assert rolled_out.readings[:, one] == pytest.approx(alone.readings[:, 0])
        moved = rolled_out.poses[:, one] - (PITCH * place, 0.0, 0.0)
        assert moved == pytest.approx(alone.poses[:, 0], abs=1e-9)
        assert (many.touching(rolled_out.poses[:, one]) == many.places[place].touching(moved)).all()


def test_what_is_near_counts_with_a_margin(many):
    place, own = many.places[1], many.radius
    poses = np.zeros((200, 3))
    poses[:, :2] = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    gap = place.place.clearance(poses[:, :2]) - own
    # Overlaps of less than 0.1 mm count as contacts.
    for margin in (0.0, 0.003, 0.02):
        expected = gap < margin + 1e-4
        assert place.touching(poses, margin).tolist() == expected.tolist()
        moved = poses + np.array([PITCH, 0.0, 0.0])
        assert many.touching(moved, margin).tolist() == expected.tolist()
        assert 0 < expected.sum() < 200


def test_compiled_rollouts_are_those_of_the_steps(many):
    rng = np.random.default_rng(2)
    starts = many.free_poses(6, rng)
    genes = FAMILY.first(2, torch.Generator().manual_seed(1)).numpy()
    own = rollouts_of(many, FAMILY, EPISODE)
    draws = own.draw(starts, rng)
    stepped = rollouts_of(many, FAMILY, EPISODE, stepped=True).run(genes, draws)
    rolled_out = own.run(genes, draws)
    assert rolled_out.poses == pytest.approx(stepped.poses, abs=2e-4)
    assert rolled_out.readings == pytest.approx(stepped.readings, abs=2e-3)


def test_a_contact_is_where_the_robot_was_held_up(tables):
    simulator = tables.changed(place=Place.rectangle(0.5, 0.4), noise="none")
    evaluator = Evaluator(simulator, ObstacleAvoidance(steps=60, starts=1, contacts="end"), FAMILY)
    genes = np.zeros(FAMILY.genes)
    genes[[8, 17]] = 1.0  # straight ahead, open-loop: 7.6 cm/s
    driven = evaluator.run(genes[None], Draws(np.array([[0.0, 0.0, 0.0]])))
    held = driven.poses[0, 0, 1:, 0] > 0.25 - 0.0275 - 1e-4
    assert 20 < held.sum() < 50
    assert driven.touching[0, 0].tolist() == held.tolist()


@pytest.mark.slow
def test_networks_evolve_in_many_arenas(tables, tmp_path):
    task = ObstacleAvoidance(steps=60, starts=3, contacts="end")
    how = {"generations": 3, "arenas": 4, "runs": 2, "objective": "fitness", "progress": False}
    first, second = evolve(tables, task, FAMILY, seed=5, out=tmp_path / "net", **how)
    assert first.predicted["fitness"] >= second.predicted["fitness"]
    assert first.evolution["settings"]["arenas"] == 4
    again = evolve(tables, task, FAMILY, seed=5, **how)[0]
    assert (again.genes == first.genes).all()
    # The expected path is computed in the simulator's own arena.
    assert tables.place.inside(np.array(first.predicted["poses"])[:, :2]).all()


def test_a_simulator_without_arenas_says_so():
    from motion_networks import random_motion_network

    with pytest.raises(UserError, match="of the kind motion-network has no arena"):
        random_motion_network().elsewhere(3, 0)
