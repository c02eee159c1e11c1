"""The robot as an environment, with the spaces of a simulator of it."""

from contextlib import contextmanager

import gymnasium
import numpy as np
import pandas as pd
import pytest
from motion_networks import random_motion_network
from simulators_of_tests import tables
from slow_camera import delay

import neurosim as ns
import neurosim.envs
import neurosim.envs.robot
from neurosim.lab import VirtualRig
from tracking.camera.camera_model import CameraModel


def test_a_khepera_is_driven_as_its_simulator_is():
    simulator, task = tables(), "neurosim/ObstacleAvoidance-v0"
    settings = {"simulator": simulator, "steps": 24, "starts": 2}
    robot = gymnasium.make(task, robot="virtual-khepera", **settings)
    model = gymnasium.make(task, **settings)
    assert robot.observation_space == model.observation_space
    assert robot.action_space == model.action_space
    with pytest.raises(ns.UserError, match="left = 500"):
        robot.reset(seed=1)
        robot.step(np.array([500.0, 0.0]))
    distances = []
    for env in (robot, model):
        seen, _ = env.reset(seed=1)
        assert seen in env.observation_space
        total, over, steps = 0.0, False, 0
        while not over:
            seen, reward, terminated, over, info = env.step(np.array([30, 30], np.float32))
            assert seen in env.observation_space
            total, steps = total + reward, steps + 1
        assert steps == 12
        assert not terminated
        assert info["progress"] == pytest.approx(total)
        distances.append(total)
    assert distances[0] == pytest.approx(distances[1], abs=3.0)  # of 3.6, had nothing been near
    assert min(distances) > 0
    robot.close()
    with pytest.raises(ns.UserError, match="closed"):
        robot.reset()


@pytest.fixture
def calibration(tmp_path):
    with VirtualRig(0, camera_size=(640, 480)) as rig:
        o = rig.camera.optics
        model = CameraModel((640, 480), o.matrix, o.distortion, o.rotation, o.translation)
    model.write(tmp_path / "calibration.json")
    return tmp_path / "calibration.json"


def test_an_nxt_is_where_the_camera_sees_it(calibration):
    settings = {"goals": [[0.3, 0.0, 0.0]], "seconds": 2.0, "step": 0.2}
    env = gymnasium.make(
        "neurosim/GoTo-v0",
        simulator=random_motion_network(),
        robot="virtual",
        calibration=calibration,
        render_mode="rgb_array",
        **settings,
    )
    seen, _ = env.reset(seed=0)
    assert seen[:2] == pytest.approx([0.3, 0.0], abs=0.02)
    before, over, steps = env.render(), False, 0
    while not over:
        _, _, terminated, truncated, info = env.step(np.array([40, 40], np.float32))
        over, steps = terminated or truncated, steps + 1
    assert steps == 10
    assert info["progress"] > 1  # it came past the goal
    assert info["missed_deadlines"] == 0
    assert (env.render() != before).any()
    env.close()


def test_a_slow_camera_shows_where_the_robot_is_and_not_where_it_was(
    tmp_path, calibration, monkeypatch
):
    opened = []
    opener = neurosim.envs.robot.open_rig

    @contextmanager
    def with_a_slow_camera(*arguments):
        with opener(*arguments) as rig:
            delay(rig.camera, frames=4)
            opened.append(rig)
            yield rig

    monkeypatch.setattr(neurosim.envs.robot, "open_rig", with_a_slow_camera)
    env = ns.envs.make_env(
        random_motion_network(), "go-to", goals=[[2.0, 0.0, 0.0]], seconds=2.0, step=0.2,
        robot="virtual", calibration=calibration,
    )  # fmt: skip
    seen, times = [env.reset(seed=0)[0]], [env.robot.clock.now()]
    for _ in range(9):
        seen.append(env.step(np.array([40, 40], np.float32))[0])
        times.append(env.robot.clock.now())
    opened[0].finish(tmp_path, 1)
    env.close()
    truth = pd.read_csv(tmp_path / "truth" / "truth-001.csv")
    x = np.interp(times, truth.time, truth.x)
    ahead = 2.0 - np.array(seen)[:, 0]
    assert np.ptp(x) > 0.2
    # 0.13 s are 2.5 cm; at first it has not yet reached the speed of its command.
    assert np.abs(ahead - x)[4:].max() < 0.01


def test_what_a_robot_lacks_is_said():
    with pytest.raises(ns.UserError, match="the position of the robot virtual is unknown"):
        gymnasium.make("neurosim/GoTo-v0", simulator=random_motion_network(), robot="virtual")
    with pytest.raises(ns.UserError, match="has no sensor_0"):
        gymnasium.make("neurosim/ObstacleAvoidance-v0", simulator=tables(), robot="virtual")
