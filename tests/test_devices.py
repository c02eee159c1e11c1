"""Tensors on another device: the same numbers as on the CPU, and nothing left behind there."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from khepera_data import made_up, made_up_lights
from motion_networks import random_motion_network

import neurosim as ns
from neurosim.base import se2
from neurosim.envs import TaskVectorEnv
from neurosim.simulators import TableSimulator
from neurosim.simulators.registry import read_simulator, write_simulator
from tracking.datasets.csv_files import import_csv
from tracking.datasets.dataset import Dataset

DATA = Path(__file__).resolve().parents[1] / "data" / "reference"

gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
DEVICES = ["cpu", pytest.param("cuda", marks=gpu)]


def motion(**options):
    return random_motion_network(1, floor=True, **options)


def tables(**options):
    return TableSimulator(made_up(), lights=made_up_lights(), noise="none", **options)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "options", [{}, {"drives": False}, {"members": 1, "central": False}], ids=str
)
def test_a_motion_network_steps(device, options, tmp_path):
    write_simulator(motion(**options), tmp_path / "simulator")
    here = read_simulator(tmp_path / "simulator")
    there = read_simulator(tmp_path / "simulator", device)
    rng = np.random.default_rng(0)
    poses = torch.from_numpy(rng.uniform(-0.5, 0.5, (64, 3)))
    expected, result = here.start(poses), there.start(poses.to(device))
    if here.members > 1:
        member = torch.arange(64) % (here.members + 1) - 1
        expected, result = (
            here.start_as(poses, member),
            there.start_as(poses.to(device), member.to(device)),
        )
    for _ in range(5):
        command = torch.from_numpy(np.c_[rng.uniform(-50, 50, (64, 2)), rng.uniform(0.1, 3, 64)])
        z = torch.from_numpy(rng.standard_normal((64, 4)))
        expected = here.step(expected, command, z=z)
        result = there.step(result, command.to(device), z=z.to(device))
        assert result.device.type == torch.device(device).type
        torch.testing.assert_close(result.cpu(), expected, atol=1e-9, rtol=1e-9)
    command = torch.tensor([[20.0, 10.0, 1.0]], dtype=torch.float64, device=device)
    command.requires_grad_()
    start = there.start(torch.zeros(1, 3, dtype=torch.float64, device=device))
    (slope,) = torch.autograd.grad(there.step(start, command)[0, 0], command)
    assert slope.abs().sum() > 0
    generator = torch.Generator(device).manual_seed(0)
    noisy = there.step(
        there.start(poses.to(device), generator), command.detach().expand(64, 3), generator
    )
    assert torch.isfinite(noisy).all()


@pytest.mark.parametrize("device", DEVICES)
def test_tables_step_and_sense(device, tmp_path):
    write_simulator(tables(), tmp_path / "simulator")
    here = read_simulator(tmp_path / "simulator")
    there = read_simulator(tmp_path / "simulator", device)
    rng = np.random.default_rng(0)
    poses = torch.from_numpy(here.free_poses(64, rng))
    expected, result = here.start(poses), there.start(poses.to(device))
    for _ in range(10):
        command = torch.from_numpy(np.c_[rng.uniform(-80, 80, (64, 2)), np.full(64, 0.1)])
        expected, result = here.step(expected, command), there.step(result, command.to(device))
        torch.testing.assert_close(result.cpu(), expected, atol=1e-9, rtol=1e-9)
        readings = there.sense(result)
        assert readings.device.type == torch.device(device).type
        torch.testing.assert_close(readings.cpu(), here.sense(expected), atol=1e-6, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("build", [motion, tables])
def test_controllers_are_judged_and_evolved(device, build, tmp_path):
    write_simulator(build(), tmp_path / "simulator")
    here = read_simulator(tmp_path / "simulator")
    there = read_simulator(tmp_path / "simulator", device)
    task = "nine-rectangles" if build is motion else "obstacle-avoidance"
    expected, result = ns.evaluate(here, task), ns.evaluate(there, task)
    genes = np.random.default_rng(0).random((20, expected.genes))
    np.testing.assert_allclose(result(genes), expected(genes), rtol=1e-6)
    best = [
        ns.evolve(each, task, generations=2, runs=1, progress=False)[0].predicted["fitness"]
        for each in (here, there)
    ]
    assert best[1] == pytest.approx(best[0], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("trainer", "settings"),
    [("combined", {"members": 2}), ("ga", {"generations": 3, "population": 20})],
)
def test_simulators_are_trained(device, trainer, settings, tmp_path):
    Dataset.read(DATA).part(slice(0, 300)).write(tmp_path / "data")
    simulator = ns.train(
        tmp_path / "data",
        tmp_path / "simulator",
        trainer=trainer,
        device=device,
        progress=False,
        **settings,
    )
    same_when_read(simulator, tmp_path / "simulator", [30.0, 20.0, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_a_slow_robot_is_learned_from_a_log(device, tmp_path):
    rng, pose, speed = np.random.default_rng(0), np.zeros(3), np.zeros(3)
    commands, log = rng.uniform([0.0, -1.0], [0.3, 1.0], (400, 2)).repeat(4, 0), []
    for n, (forward, turn) in enumerate(commands):
        log.append([0.05 * n, *pose, forward, turn])
        speed += (np.array([forward, 0.0, turn]) - speed) * 0.05 / 0.5
        pose = se2.compose(pose, se2.exp(speed * 0.05))
    columns = ["time", "x", "y", "heading", "v", "w"]
    pd.DataFrame(log, columns=columns).to_csv(tmp_path / "log.csv", index=False)
    assert import_csv(tmp_path / "log.csv", tmp_path / "data").joined.mean() > 0.9
    simulator = ns.train(
        tmp_path / "data", tmp_path / "simulator", members=2, device=device, progress=False
    )
    assert float(simulator.drive.lag.cpu().mean()) == pytest.approx(0.5, abs=0.1)
    same_when_read(simulator, tmp_path / "simulator", [0.2, 0.5, 1.0])


def same_when_read(simulator, folder, command):
    """Check that a simulator predicts the same as it does on the CPU when it is read."""
    pose = torch.zeros(1, 3, dtype=torch.float64, device=simulator.device)
    command = torch.tensor([command], dtype=torch.float64, device=simulator.device)
    there = simulator.step(simulator.start(pose), command)
    again = read_simulator(folder)
    here = again.step(again.start(pose.cpu()), command.cpu())
    torch.testing.assert_close(there.cpu(), here, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_environments_step(device, tmp_path):
    write_simulator(tables(), tmp_path / "simulator")
    results = []
    for simulator in (ns.load(tmp_path / "simulator"), ns.load(tmp_path / "simulator", device)):
        env = TaskVectorEnv(simulator, "obstacle-avoidance", num_envs=8)
        env.reset(seed=0)
        for _ in range(20):
            seen, reward, *_ = env.step(np.full((8, 2), 0.3, np.float32))
        results.append((seen, reward))
        env.close()
    for here, there in zip(*results, strict=True):
        np.testing.assert_allclose(there, here, atol=1e-6)
