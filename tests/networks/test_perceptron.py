import pytest
import torch

from neurosim.base.errors import UserError
from neurosim.networks import Perceptron


def test_the_same_as_torch_layers():
    g = torch.Generator().manual_seed(0)
    network = Perceptron(3, 4, 2)
    genes = torch.randn(2, network.genes, generator=g, dtype=torch.float64)
    x = torch.randn(7, 3, generator=g, dtype=torch.float64)
    for row, found in zip(genes, network.forward(genes, x), strict=True):
        layers = torch.nn.Sequential(
            torch.nn.Linear(3, 4),
            torch.nn.Tanh(),
            torch.nn.Linear(4, 2),
            torch.nn.Tanh(),
            torch.nn.Linear(2, 1),
        ).double()
        torch.nn.utils.vector_to_parameters(row, layers.parameters())
        torch.testing.assert_close(found, layers(x).squeeze(1).detach())


def test_first_weights_are_within_glorots_bounds_and_biases_zero():
    network = Perceptron(3, 4, 2)
    genes = network.initial(50, torch.Generator().manual_seed(0))
    weights, biases = genes[:, :12], genes[:, 12:16]
    assert weights.abs().max().item() == pytest.approx((6 / 7) ** 0.5, rel=0.02)
    assert (biases == 0).all()
    with pytest.raises(UserError, match="first: expected a whole number from 1"):
        Perceptron(3, 0, 2)
