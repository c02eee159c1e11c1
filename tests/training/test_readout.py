import numpy as np
import pytest
import torch
from synthetic_robot import synthetic

from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData
from neurosim.training.trainers.readout import Readout

INPUTS = [
    {"name": name, "unit": ""} for name in ("prev_left", "prev_right", "left", "right", "duration")
]


@pytest.mark.parametrize("weighted", [False, True])
def test_a_readout_is_the_least_squares_solution_of_numpy(weighted):
    x, y = synthetic(120, seed=3)
    data = TrainingData(INPUTS, torch.tensor(x), torch.tensor(y))
    network = ProductSummationNetwork(inputs=5, products=3, summations=1, ceilings=True)
    generator = torch.Generator().manual_seed(1)
    genes = 0.5 * torch.randn(3, network.genes, generator=generator, dtype=torch.float64)
    simulator = MotionNetwork(INPUTS, network, genes, data.input_scale, torch.ones(3))
    weights = torch.rand(120, generator=generator, dtype=torch.float64)
    weights = weights if weighted else torch.ones_like(weights)
    readout = Readout(data, simulator, ridge=0.0)
    fitted = readout.simulator(readout.genes(weights)).displacement(data.x).numpy()
    # The features from the formula: prod |x|^w, as far as its ceiling, times
    # cos(pi sum of w over the negative x); x and one.
    scaled = x / np.abs(x).max(0)
    size = np.maximum(np.abs(scaled), network.floor)
    root = np.sqrt(weights.numpy())[:, None]
    for o in range(3):
        w = network.split(genes).exponents[o].numpy()
        units = [
            np.minimum(np.prod(size**row, axis=1), np.exp(ceiling))
            * np.cos(np.pi * ((scaled < 0) * row).sum(1))
            for row, ceiling in zip(w, network.split(genes).ceilings[o].numpy(), strict=True)
        ]
        columns = np.column_stack([*units, scaled, np.ones(120)])
        solution = np.linalg.lstsq(root * columns, root[:, 0] * y[:, o], rcond=None)[0]
        assert fitted[:, o] == pytest.approx(columns @ solution, abs=1e-7)
