"""Gradients flow through the step of motion networks, and are those of finite differences."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from exported import drive, given, ours, random_plans
from motion_networks import noise_model, random_motion_network

from neurosim.training.train import train
from tracking.datasets.dataset import Dataset

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    "simulator",
    [
        random_motion_network(1, products=6),
        random_motion_network(2, central=False, swing=None, noise=noise_model(2, size=-6.0)),
        random_motion_network(3, drives=False, members=1, central=False, noise=False),
    ],
    ids=["all", "average", "whole commands"],
)
@pytest.mark.slow
def test_they_are_those_of_finite_differences(simulator):
    commands = random_plans(simulator, 3, steps=3, seed=8, like=0.0)
    state, noise = given(simulator, commands)

    def poses(pose, commands):
        start = torch.cat([pose, state[:, 3:]], 1)
        return drive(ours(simulator), start, commands, noise)

    free = state[:, :3].clone().requires_grad_(), commands.clone().requires_grad_()
    assert torch.autograd.gradcheck(poses, free, eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("parts", [1, 4])
def test_they_are_finite_where_a_robot_stands(parts):
    simulator = random_motion_network(1)
    zero, go = [0.0, 0.0, 1.0], [20.0, 20.0, 1.0]
    commands = torch.tensor([[zero, go, zero], [go, zero, go], [go, go, zero]]).double()
    state, noise = given(simulator, commands)
    free = commands.requires_grad_()
    for z in (noise, None):
        (slope,) = torch.autograd.grad(
            drive(ours(simulator), state, free, z, parts).square().sum(), free
        )
        assert torch.isfinite(slope).all()
        assert slope.abs().max() > 0


@pytest.mark.slow
def test_a_policy_learns_through_them(tmp_path):
    data = Dataset.read(ROOT / "data" / "reference").part(slice(0, 300))
    data.write(tmp_path / "data")
    train(tmp_path / "data", tmp_path / "simulator", members=1, progress=False)
    program = [sys.executable, str(ROOT / "examples" / "backpropagation.py")]
    done = subprocess.run(
        [*program, str(tmp_path / "simulator")], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    away = [float(each) for each in re.findall(r": ([\d.]+) cm", done.stdout)]
    assert away[-1] < 0.2 * away[0]
