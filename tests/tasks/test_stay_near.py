"""Phototaxis and discrimination by hand: time near the target, starts, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from khepera_data import BRIGHT, made_up, made_up_lights

import neurosim as ns
from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Trajectory
from neurosim.simulators import TableSimulator
from neurosim.tasks.stay_near import Discrimination, Phototaxis

ROOM = Place.rectangle(1.0, 1.0)
LIT = replace(ROOM, lights=((0.2, 0.1),))
TWO = Place.rectangle(1.0, 1.0, [(0.2, 0.1, 0.0125), (-0.2, 0.1, 0.0275)])
FAR = (0.45, -0.4)


def judged(task, *paths, touching=None):
    """Judge drives of steps of 1 s along places; they begin at the first."""
    poses = np.zeros((len(paths), len(paths[0]), 3))
    poses[..., :2] = paths
    commands = np.zeros((len(paths), len(paths[0]) - 1, 2))
    return task.judge(Trajectory(poses, commands, 1.0, touching=touching))


@pytest.fixture(scope="module")
def tables():
    near = made_up(bright={**BRIGHT, "cylinder-12.5mm": 0.2})
    return TableSimulator(near, lights=made_up_lights(), noise="none")


def test_the_time_near_a_light_counts():
    task = Phototaxis(LIT, within=0.1, stay=3)
    near, nowhere = (0.2, 0.05), (np.nan, np.nan)
    judgement = judged(
        task,
        [FAR, FAR, near, near, near],
        [FAR, near, near, near, FAR],
        [FAR, near, FAR, near, near],
        [FAR, FAR, FAR, FAR, FAR],
        [FAR, near, near, nowhere, nowhere],  # it stays where it was seen last
    )
    assert judgement.fitness == pytest.approx([0.75, 0.75, 0.75, 0.0, 1.0])
    assert judgement.success.tolist() == [True, False, False, False, True]
    assert [task.why(reason) for reason in judgement.reason[1:4]] == [
        "did not stay near it",
        "did not stay near it",
        "never came near the target",
    ]
    # 0.2 m away is half as good as near, for optimisers that need a slope.
    assert judged(task, [FAR, (0.2, 0.3)]).progress == pytest.approx([0.5])


def test_the_nearest_of_several_lights_counts():
    task = Phototaxis(replace(LIT, lights=((0.2, 0.1), (-0.3, -0.3))), stay=1)
    assert judged(task, [FAR, (0.2, 0.12), (-0.3, -0.25)]).fitness == pytest.approx([1.0])


def test_another_obstacle_counts_against_it():
    task = Discrimination(TWO, within=0.05, stay=1)
    target, other = (0.2, 0.16), (-0.2, 0.17)  # 47.5 and 42.5 mm from the surfaces
    judgement = judged(
        task,
        [FAR, target, target, FAR, FAR],
        [FAR, target, other, other, target],
        [FAR, other, other, other, other],
    )
    assert judgement.fitness == pytest.approx([0.5, 0.0, -1.0])
    assert judgement.detail["wrong"] == pytest.approx([0.0, 0.5, 1.0])
    assert judgement.success.tolist() == [False, True, False]
    large = Discrimination(TWO, target=0.0275, within=0.05)
    assert judged(large, [FAR, other]).fitness == pytest.approx([1.0])


def test_nothing_counts_after_a_contact_that_ends_a_trial():
    near = [FAR, (0.2, 0.16), (0.2, 0.16), (0.2, 0.16), (0.2, 0.16)]
    touching = np.array([[False, False, True, False]])
    free, end = (Discrimination(TWO, stay=1, contacts=which) for which in ("free", "end"))
    assert judged(free, near, touching=touching).fitness == pytest.approx([1.0])
    judgement = judged(end, near, touching=touching)
    assert judgement.fitness == pytest.approx([0.5])
    assert not judgement.success
    assert end.why(judgement.reason[0]) == "touched something"
    assert (free.episode.contacts, end.episode.contacts) == (False, True)


def test_trials_start_away_from_targets(tables):
    for task in (Phototaxis(LIT), Discrimination(TWO), Phototaxis(), Discrimination()):
        starts = task.draw_starts(task.placed(tables), 200, np.random.default_rng(0))
        assert starts.shape == (200, 3)
        assert task.place.clearance(starts[:, :2]).min() > 0.0275
        for where in (starts, np.array([task.start])):
            targets = task.targets
            away = np.linalg.norm(where[:, None, :2] - targets[:, :2], axis=-1) - targets[:, 2]
            assert away.min() > task.within
        assert np.ptp(starts[:, 2]) > 6.0
    assert Phototaxis(replace(LIT, start=(0.0, 0.0, 1.0))).start == (0.0, 0.0, 1.0)


def test_a_task_says_which_sensors_there_are(tables):
    def inputs(name, **settings):
        task = ns.make_task(name, **settings)
        return {one.split("_")[0] for one in ns.make_controller("network", tables, task).inputs}

    assert inputs("phototaxis") == {"light"}
    assert inputs("phototaxis", sees="both") == {"sensor", "light"}
    assert inputs("discrimination") == inputs("obstacle-avoidance") == {"sensor"}
    task = ns.make_task("phototaxis")
    network = ns.make_controller("network", tables, task)
    assert ns.evaluate(tables, task, network)(np.zeros((1, 18)))[0] == 0.0  # it stands still


def test_a_place_or_tables_that_lack_something_are_refused(tables):
    with pytest.raises(UserError, match="this place has no light: add one to it"):
        Phototaxis(ROOM).targets  # noqa: B018
    with pytest.raises(UserError, match="no obstacle of 20 mm radius"):
        Discrimination(TWO, target=0.02).targets  # noqa: B018
    bare = replace(tables, lights=None)
    with pytest.raises(UserError, match=r"no readings of light: sample a light"):
        ns.make_controller("network", bare, Phototaxis())
    task = Phototaxis(LIT)
    with pytest.raises(UserError, match="phototaxis needs its own place: leave out --arenas"):
        task.draw_starts(task.placed(tables).elsewhere(3, 0), 10, np.random.default_rng(0))
    everywhere = Phototaxis(LIT, within=2.0)
    with pytest.raises(UserError, match="everywhere in this place is near a target"):
        everywhere.draw_starts(everywhere.placed(tables), 1, np.random.default_rng(0))
