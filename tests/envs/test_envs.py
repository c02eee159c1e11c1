"""Environments: the interface of Gymnasium and learners, and the loop's result for each trial."""

import math
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from motion_networks import random_motion_network
from simulators_of_tests import Walker, motion_network, tables

import neurosim as ns
from neurosim.base.trajectory import Draws
from neurosim.controllers import Function
from neurosim.envs import TaskEnv, TaskVectorEnv, environment_id
from neurosim.loop.evaluate import Evaluator
from neurosim.robots.quadruped import standing
from neurosim.simulators.legged.simulator import LeggedSimulator

#: Short trials: kind of simulator, task, settings.
CASES = {
    "course": (random_motion_network, "nine-rectangles", {"seconds": 1.0}),
    "course, one command a step": (motion_network, "nine-rectangles", {"seconds": 1.0}),
    "go-to": (
        random_motion_network,
        "go-to",
        {"goals": [[0.06, 0.0, 0.0]], "tolerance": 0.08, "seconds": 0.9},
    ),
    "avoidance": (tables, "obstacle-avoidance", {"steps": 24, "starts": 3}),
    "avoidance, cells": (
        tables,
        "obstacle-avoidance",
        {"steps": 12, "starts": 2, "fitness": "cells"},
    ),
    "a simulator that draws its noise itself": (Walker, "go-to", {"seconds": 0.5}),
}


def single(name, **more):
    make, task, settings = CASES[name]
    return TaskEnv(make(), task, **settings, **more)


def actions_of(space, steps, seed=5):
    space.seed(seed)
    return [space.sample() for _ in range(steps)]


@pytest.mark.filterwarnings("ignore:.*normalized space.*", "ignore:.*we recommend using a symm.*")
@pytest.mark.parametrize("name", CASES)
def test_gymnasium_has_nothing_to_say_against_them(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*normalized.*")
        check_env(single(name), skip_render_check=True)


def test_environments_are_made_by_name(tmp_path):
    tables().write(tmp_path / "tables")
    name = "neurosim/ObstacleAvoidance-v0"
    assert environment_id("obstacle-avoidance") == name
    env = gymnasium.make(name, simulator=tmp_path / "tables", steps=20, starts=2)
    env.reset(seed=1)
    assert env.unwrapped.trials.face.episode.steps == 10
    assert env.step(env.action_space.sample())[0] in env.observation_space
    many = gymnasium.make_vec(name, num_envs=3, simulator=str(tmp_path / "tables"))
    assert isinstance(many, TaskVectorEnv)
    assert many.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert many.reset(seed=1)[0].shape == (3, 8)
    own = gymnasium.make("neurosim/Task-v0", simulator=tables(), task=ns.make_task("go-to"))
    assert own.observation_space.shape == (12,)


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize("name", CASES)
def test_many_are_what_single_ones_are(name, mode):
    make, task, settings = CASES[name]
    simulator, count = make(), 5
    native = TaskVectorEnv(simulator, task, num_envs=count, autoreset_mode=mode, **settings)
    single = SyncVectorEnv(
        [lambda: TaskEnv(simulator, task, **settings) for _ in range(count)], autoreset_mode=mode
    )
    assert native.metadata["autoreset_mode"] is mode
    assert native.observation_space == single.observation_space
    assert native.action_space == single.action_space
    ends = 0
    for seed in (3, [None, 7, 8, 9, 10]):
        both = native.reset(seed=seed), single.reset(seed=seed)
        if seed == 3:
            assert_same(*both)
        else:  # one of them has a random seed
            np.testing.assert_array_equal(both[0][0][1:], both[1][0][1:])
            both = native.reset(seed=11), single.reset(seed=11)
            assert_same(*both)
        for action in actions_of(native.action_space, 40):
            both = native.step(action), single.step(action)
            assert_same(*both)
            ended = both[0][2] | both[0][3]
            ends += ended.sum()
            if mode is AutoresetMode.DISABLED and ended.any():
                masks = ({"reset_mask": ended.copy()} for _ in range(2))
                assert_same(*(each.reset(options=next(masks)) for each in (native, single)))
    assert ends > count


def assert_same(native, single):
    assert len(native) == len(single)
    for one, other in zip(native, single, strict=True):
        assert_alike(one, other)


def assert_alike(one, other):
    if isinstance(other, dict):
        assert one.keys() == other.keys()
        for key in other:
            assert_alike(one[key], other[key])
    elif other.dtype == object:
        for a, b in zip(one, other, strict=True):
            assert (a is None) == (b is None)
            np.testing.assert_array_equal(a, b)
    else:
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


@pytest.mark.parametrize("noise", [False, True], ids=["expected", "drawn"])
@pytest.mark.parametrize("name", ["course", "avoidance", "go-to"])
def test_an_episode_is_a_trial_of_the_loop(name, noise):
    """The same function drives the same path, and the rewards add up to its progress."""
    make, kind, settings = CASES[name]
    if name == "go-to":
        settings = {**settings, "goals": [[0.3, 0.2, 0.0], [0.5, 0.5, 1.0]]}
    simulator, task = make(), ns.make_task(kind, **settings)
    env = TaskEnv(simulator, task, noise=noise)
    names = env.trials.face.names

    def rule(seen):
        turn = 20 * np.tanh(3 * seen[names[0]] - seen[names[1]])
        return 25 + turn, 25 - turn

    evaluator = Evaluator(simulator, task, Function(rule, names), stepped=True)
    seen, _ = env.reset(seed=4)
    trials, steps, total, over = env.trials, 0, 0.0, False
    begun = trials.face.progress[0]
    starts = trials.poses.copy()
    member = np.array([int(trials.state[0, -1])]) if simulator.members > 1 else None
    poses = [starts[0]]
    while not over:
        action = np.array(rule(dict(zip(names, seen.astype(np.float64), strict=True))), np.float32)
        seen, reward, terminated, truncated, info = env.step(action)
        total, over, steps = total + reward, terminated or truncated, steps + 1
        poses.append(trials.poses[0].copy())
    numbers = None
    if noise and simulator.has_noise:
        stepper, whole, seeds = simulator.stepper(), evaluator.steps, trials._noise.seeds
        numbers = [stepper.noise(seeds, np.full(1, step)) for step in range(whole)]
        numbers = np.stack(numbers, axis=1).astype(np.float64)
    judged, trajectory = evaluator.judge(np.zeros((1, 0)), Draws(starts, member, numbers))
    driven = trajectory.poses[0, 0]
    np.testing.assert_allclose(driven[:steps], poses[:steps], atol=1e-4)
    if truncated:  # after the motors have stopped
        np.testing.assert_allclose(driven[-1], poses[-1], atol=1e-4)
        assert total + begun == pytest.approx(task.judge(trajectory).progress[0, 0], abs=1e-3)
        assert info["is_success"] == judged.success[0, 0]
        assert info["progress"] == pytest.approx(total + begun)
    assert np.linalg.norm(driven[-1, :2] - driven[0, :2]) > 0.005


def test_a_learner_is_told_how_a_trial_ended():
    env = TaskEnv(tables(), "go-to", goals=[[0.03, 0.1, 0.0]], begin=[0.0, 0.1, 0.0], seconds=0.5)
    env.reset(seed=0)
    for step in range(5):
        *_, terminated, truncated, info = env.step(np.zeros(2, np.float32))
        assert truncated == (step == 4)
        assert not terminated
    assert info["is_success"]  # it stands within the tolerance
    assert info["progress"] > 1
    env = single("course", noise=False)
    env.reset()
    steps, terminated = 0, False
    while not terminated:  # it leaves the grid
        *_, terminated, truncated, info = env.step(np.array([50, 50], np.float32))
        steps += 1
    assert steps < 10
    assert not truncated
    assert not info["is_success"]


def test_a_robot_walks_until_it_falls():
    pytest.importorskip("mujoco")
    simulator = LeggedSimulator()
    native = TaskVectorEnv(simulator, "walking", num_envs=2, seconds=1.0)
    single = SyncVectorEnv([lambda: TaskEnv(simulator, "walking", seconds=1.0)] * 2)
    assert native.observation_space == single.observation_space
    assert native.single_action_space.shape == (12,)
    assert_same(native.reset(seed=1), single.reset(seed=1))
    stands = np.tile(standing(), (2, 1)).astype(np.float32)
    low, high = native.single_action_space.low, native.single_action_space.high
    fell = False
    for step in range(126):
        actions = stands.copy()
        actions[1] = low if step // 10 % 2 else high  # kicks about
        both = native.step(actions), single.step(actions)
        assert_same(*both)
        fell |= both[0][2][1]
        assert not both[0][2][0]
    assert fell


def test_a_simulator_of_walking_is_copied_without_its_threads():
    pytest.importorskip("mujoco")
    env = gymnasium.make("neurosim/Walking-v0", simulator=LeggedSimulator(), seconds=1.0)
    env.reset(seed=0)
    env.step(standing().astype(np.float32))
    again = env.spec.make()
    again.reset(seed=0)
    assert env.observation_space == again.observation_space


def test_spaces_have_the_limits_of_what_was_recorded():
    env = single("course")
    limit = 50.0 if env.trials.face.simulator.known is None else None
    assert env.action_space.high.tolist() == [limit, limit]
    assert np.isfinite(env.observation_space.low).all()
    sensors = single("avoidance").observation_space
    assert (sensors.low == 0).all()
    assert (sensors.high == 1).all()


def test_what_is_observed_can_be_chosen():
    env = single("avoidance", observe=["sensor_2", "time", "x"])
    seen, _ = env.reset(seed=0)
    assert seen.shape == (3,)
    assert seen[1] == 0
    assert env.step(np.zeros(2, np.float32))[0][1] == pytest.approx(0.1)


def test_a_goal_is_observed_in_polar_coordinates_too():
    env = single("go-to", observe=["goal_x", "goal_y", "goal_distance", "goal_bearing"])
    for seed in range(3):
        seen, _ = env.reset(seed=seed)
        for _ in range(3):
            ahead, left, distance, bearing = seen.tolist()
            side = 1.0 if ahead >= 0.0 else -1.0
            assert distance == pytest.approx(side * math.hypot(ahead, left), abs=1e-6)
            assert bearing == pytest.approx(math.atan2(side * left, side * ahead), abs=1e-5)
            assert env.observation_space.contains(seen)
            seen = env.step(np.array([40.0, -10.0], np.float32))[0]


def test_the_same_seed_gives_the_same_and_episodes_differ():
    env, other = single("avoidance"), single("avoidance")
    first, again = env.reset(seed=9)[0], other.reset(seed=9)[0]
    assert np.array_equal(first, again)
    assert np.array_equal(env.reset()[0], other.reset()[0])
    assert not np.array_equal(env.reset()[0], first)
    assert np.array_equal(env.reset(seed=9)[0], first)


WRONG = {
    "shape": (lambda env: env.step(np.zeros(3, np.float32)), r"shape \(2,\) \(left, right\), got"),
    "NaN": (lambda env: env.step(np.array([0, np.nan])), "right = nan; expected a number of -50"),
    "range": (lambda env: env.step([70.0, 0.0]), "left = 70; expected a number of -50 to 50"),
    "words": (lambda env: env.step("ahead"), "actions must be numbers"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_actions_are_refused_with_a_sentence(what):
    call, words = WRONG[what]
    env = single("course")
    env.reset(seed=0)
    with pytest.raises(ns.UserError, match=words):
        call(env)


def test_wrong_actions_of_many_name_the_environment():
    envs = TaskVectorEnv(random_motion_network(), num_envs=3)
    with pytest.raises(ns.UserError, match="reset"):
        envs.step(np.zeros((3, 2)))
    envs.reset(seed=0)
    actions = np.zeros((3, 2))
    actions[2, 1] = np.nan
    with pytest.raises(ns.UserError, match="the action of environment 2 has right = nan"):
        envs.step(actions)
    with pytest.raises(ns.UserError, match=r"shape \(3, 2\)"):
        envs.step(np.zeros((2, 2)))
    envs.close()
    with pytest.raises(ns.UserError, match="closed"):
        envs.reset()


def test_what_does_not_fit_is_refused(tmp_path):
    with pytest.raises(ns.UserError, match="needs the readings of sensors"):
        TaskEnv(random_motion_network(), "obstacle-avoidance")
    with pytest.raises(ns.UserError, match="no such simulator"):
        TaskEnv(tmp_path / "nothing")
    with pytest.raises(ns.UserError, match="there is no task 'x'"):
        TaskEnv(tables(), "x")
    with pytest.raises(ns.UserError, match="goal_x cannot be observed"):
        TaskEnv(tables(), "obstacle-avoidance", observe=["goal_x"])
    with pytest.raises(ns.UserError, match="render_mode is one of"):
        TaskEnv(tables(), "obstacle-avoidance", render_mode="ansi")
    with pytest.raises(ns.UserError, match="autoreset_mode is one of"):
        TaskVectorEnv(tables(), "obstacle-avoidance", autoreset_mode="never")
    envs = TaskVectorEnv(
        tables(), "obstacle-avoidance", steps=1, starts=1, autoreset_mode="Disabled"
    )
    envs.reset()
    envs.step(np.zeros((1, 2)))
    with pytest.raises(ns.UserError, match="environment 0 has ended its trial"):
        envs.step(np.zeros((1, 2)))
    env = single("course")
    with pytest.raises(ns.UserError, match="call reset"):
        env.step(np.zeros(2))
    env.close()
    with pytest.raises(ns.UserError, match="closed"):
        env.reset()


def test_trials_are_drawn():
    env = single("course", render_mode="rgb_array")
    env.reset(seed=1)
    before = env.render()
    env.step(np.array([40, 10], np.float32))
    after = env.render()
    assert before.dtype == np.uint8
    assert before.shape == after.shape
    assert (before != after).any()
    envs = TaskVectorEnv(
        tables(), "obstacle-avoidance", num_envs=2, render_mode="rgb_array", noise=False
    )
    envs.reset(seed=1)
    pictures = envs.render()
    assert len(pictures) == 2
    assert (pictures[0] != pictures[1]).any()
    with pytest.raises(ns.UserError, match="render_mode"):
        single("course").render()


@pytest.mark.filterwarnings("ignore:.*no display.*")
def test_a_window_shows_them(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    env = single("course", render_mode="human")
    env.reset(seed=1)
    env.step(np.array([40, 10], np.float32))
    assert env.render() is None
    env.close()
