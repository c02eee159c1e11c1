"""A simulator of each kind, small: a motion network, tables, and one of a user's own."""

import numpy as np
import torch

from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork, TableSimulator
from neurosim.simulators.base import Simulator
from neurosim.simulators.motion.noise import NoiseModel
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable


class Walker(Simulator):
    """Takes the place of a legged robot: its state has a gait's phase, its feet are sensors."""

    kind = "walker"
    state_names = ("x", "y", "theta", "phase")
    command_names = ("left", "right", "duration")
    reading_names = ("foot_left", "foot_right")
    has_noise = True

    def start(self, pose, generator=None):
        return torch.cat([pose, torch.zeros(len(pose), 1, dtype=pose.dtype)], dim=1)

    def step(self, state, command, generator=None):
        x, y, theta, phase = state.unbind(1)
        left, right, duration = command.unbind(1)
        stride = 0.002 * (left + right) / 2 * duration * (1 + 0.2 * phase.cos())
        if generator is not None:
            stride = stride + 0.002 * torch.randn(len(x), generator=generator, dtype=stride.dtype)
        turn = 0.01 * (right - left) * duration
        moved = [x + stride * theta.cos(), y + stride * theta.sin(), theta + turn]
        return torch.stack([*moved, phase + 6.0 * duration], dim=1)

    def sense(self, state, generator=None):
        return torch.stack([state[:, 3].sin() > 0, state[:, 3].sin() <= 0], dim=1).to(state)


def motion_network():
    """Return an ensemble of three random networks near a wheeled robot, with noise."""
    network = ProductSummationNetwork(5, 4, 2)
    names = ("prev_left", "prev_right", "left", "right", "duration")
    generator = torch.Generator().manual_seed(1)
    genes = 0.1 * torch.randn(3, 3, network.genes, generator=generator, dtype=torch.float64)
    noise = {name: torch.zeros(shape) for name, shape in NoiseModel.SHAPES.items()}
    noise["unit"] = torch.tensor([0.5, 0.2, 0.2])
    noise["log_scale"][:, 0] = -5.0
    return MotionNetwork(
        [{"name": name, "unit": "%"} for name in names],
        network,
        genes,
        torch.tensor([50.0, 50.0, 50.0, 50.0, 3.0]),
        torch.tensor([0.3, 0.2, 2.0]),
        noise=NoiseModel(**noise),
    )


def tables():
    """Return tables of formulas for eight sensors."""
    bearing = -2 * np.pi * np.arange(36) / 36
    looks = np.radians([90.0, 45.0, 10.0, -10.0, -45.0, -90.0, -170.0, 170.0])
    seen = np.maximum(np.cos(bearing[:, None] - looks), 0) ** 4
    near = np.exp(-np.arange(10) / 3)[:, None, None]
    sample = Samples(0.02 + 0.7 * near * seen, 0.005, 0.005)
    return TableSimulator(SensorTable.from_samples({"wall": [sample], "cylinder": [sample]}))
