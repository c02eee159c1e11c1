"""Stable-Baselines3 accepts and trains in the environments (``make test-extras``)."""

import warnings

import numpy as np
import pytest
from motion_networks import random_motion_network
from simulators_of_tests import tables

import neurosim as ns
from neurosim.envs import TaskEnv, TaskVectorEnv, sb3

pytest.importorskip("stable_baselines3")

CASES = {
    "nine-rectangles": (random_motion_network, {"seconds": 1.0}),
    "obstacle-avoidance": (tables, {"steps": 24, "starts": 3}),
}


@pytest.mark.parametrize("task", CASES)
def test_its_checker_has_nothing_to_say_against_them(task):
    from stable_baselines3.common.env_checker import check_env

    make, settings = CASES[task]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*normalized.*")
        check_env(TaskEnv(make(), task, **settings), skip_render_check=True)


@pytest.mark.parametrize("task", CASES)
def test_many_are_what_it_makes_of_single_ones(task):
    from stable_baselines3.common.vec_env import DummyVecEnv

    make, settings = CASES[task]
    simulator, count = make(), 4
    many = TaskVectorEnv(simulator, task, num_envs=count, autoreset_mode="SameStep", **settings)
    native = sb3(many)
    single = DummyVecEnv([lambda: TaskEnv(simulator, task, **settings) for _ in range(count)])
    assert native.observation_space == single.observation_space
    assert native.action_space == single.action_space
    for each in (native, single):
        each.seed(3)
    np.testing.assert_array_equal(native.reset(), single.reset())
    rng, ends = np.random.default_rng(0), 0
    low, high = native.action_space.low, native.action_space.high
    for _ in range(25):
        actions = rng.uniform(low, high, (count, 2)).astype(np.float32)
        one, other = native.step(actions), single.step(actions)
        np.testing.assert_allclose(one[0], other[0], atol=1e-12)
        np.testing.assert_allclose(one[1], other[1], atol=1e-6)
        assert np.array_equal(one[2], other[2])
        ends += one[2].sum()
        for row in np.flatnonzero(one[2]):
            a, b = one[3][row], other[3][row]
            assert a.keys() == b.keys()
            np.testing.assert_array_equal(
                a.pop("terminal_observation"), b.pop("terminal_observation")
            )
            assert a == pytest.approx(b)
    assert ends > count


def test_another_autoreset_is_refused():
    with pytest.raises(ns.UserError, match="SameStep"):
        sb3(TaskVectorEnv(tables(), "obstacle-avoidance"))
