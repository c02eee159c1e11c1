import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base.errors import UserError
from neurosim.networks import (
    LOG_LIMIT,
    Expanded,
    PopulationError,
    Prediction,
    ProductSummationNetwork,
    Weights,
)
from neurosim.networks.expanded import sign_patterns


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def unit(exponents, x, floor=0.02):
    network = ProductSummationNetwork(len(exponents), 1, 0, floor=floor)
    return network.product_units(tensor(exponents), tensor(x)).item()


def test_a_product_unit_multiplies_powers():
    # 0.5^2 * 0.25^-1 = 1; 0.5^3 = 0.125
    assert unit([2.0, -1.0], [0.5, 0.25]) == pytest.approx(1.0)
    assert unit([3.0, 0.0], [0.5, 0.9]) == pytest.approx(0.125)


def test_a_negative_input_gives_the_real_part_of_the_complex_power():
    assert unit([1.0], [-0.5]) == pytest.approx(-0.5)
    assert unit([2.0], [-0.5]) == pytest.approx(0.25)
    assert unit([0.5], [-0.25]) == pytest.approx(0.0, abs=1e-15)  # the root is 0.5 i
    power = (complex(-0.4) ** 1.3) * (complex(-0.7) ** 0.4) * 0.9**-0.6
    principal = 0.4**1.3 * 0.7**0.4 * 0.9**-0.6 * math.cos(math.pi * 1.7)
    assert unit([1.3, 0.4, -0.6], [-0.4, -0.7, 0.9]) == pytest.approx(principal)
    assert power.real == pytest.approx(principal)


def test_a_zero_input_counts_as_the_floor():
    assert unit([2.0], [0.0], floor=0.1) == pytest.approx(0.01)
    assert unit([-1.0], [0.0], floor=0.1) == pytest.approx(10.0)
    assert unit([0.0], [0.0]) == 1.0
    assert unit([1.0], [-0.001], floor=0.1) == pytest.approx(-0.1)  # its sign stays


def test_no_exponent_overflows():
    assert unit([1e6], [0.5]) == pytest.approx(math.exp(-LOG_LIMIT))
    assert unit([-1e6], [0.5]) == pytest.approx(math.exp(LOG_LIMIT))


def by_hand():
    network = ProductSummationNetwork(2, 1, 1)
    genes = network.join(
        Weights(
            exponents=tensor([1.0, 2.0]),
            product_weights=tensor(3.0),
            summation=tensor([0.5, -1.0]),
            summation_bias=tensor(0.25),
            summation_weights=tensor(2.0),
            bias=tensor(-0.125)[0],
        )
    )
    return network, genes.unsqueeze(0)


def test_a_whole_network_worked_by_hand():
    network, genes = by_hand()
    assert genes.tolist() == [[1.0, 2.0, 3.0, 0.5, -1.0, 0.25, 2.0, -0.125]]
    # x = (-0.5, 0.5): product -0.125, sum -0.25 - 0.5 + 0.25 = -0.5
    assert network.forward(genes, tensor([-0.5, 0.5])).item() == pytest.approx(
        3 * -0.125 + 2 * -0.5 - 0.125
    )


def test_the_papers_network_has_131_weights():
    # 10 x 5 + 10 product, 10 x 5 + 10 + 10 summation, 1 bias
    assert ProductSummationNetwork(5).genes == 131


@pytest.mark.parametrize(
    "wrong",
    [
        {"products": 0, "summations": 0},
        {"floor": 0.0},
        {"products": -1},
    ],
)
def test_impossible_networks_are_refused(wrong):
    with pytest.raises((UserError, ValueError), match=r"unit|floor|products"):
        ProductSummationNetwork(5, **wrong)


def rows_with_zeros_and_negatives(g, rows, inputs):
    x = torch.rand(rows, inputs, generator=g, dtype=torch.float64) * 2 - 1
    x[torch.rand(rows, inputs, generator=g) < 0.2] = 0.0
    return x


shapes = {
    "inputs": st.integers(1, 7),
    "products": st.integers(0, 4),
    "summations": st.integers(1, 4),
    "rows": st.integers(1, 700),
    "spread": st.sampled_from([0.5, 2.0, 30.0]),  # large enough that exponents reach the limit
    "seed": st.integers(0, 1000),
}


@pytest.mark.parametrize("kernel", [True, False])
@given(**shapes)
@settings(max_examples=20, deadline=None)
def test_the_fast_error_is_the_plain_one(kernel, inputs, products, summations, rows, spread, seed):
    g = torch.Generator().manual_seed(seed)
    network = ProductSummationNetwork(inputs, products, summations)
    x = rows_with_zeros_and_negatives(g, rows, inputs)
    targets = torch.randn(2, rows, generator=g, dtype=torch.float64)
    genes = (spread * torch.randn(2, 5, network.genes, generator=g)).float()
    fast = PopulationError(network, x, targets, kernel=kernel)(genes)
    for each_result, each, target in zip(fast, genes.double(), targets, strict=True):
        plain = network.forward(each, x) - target
        # A unit's size is exp of a sum that is rounded to single precision, relative to its terms;
        # large units may cancel.
        w = network.split(each)
        units = network.product_units(w.exponents, x)
        size = plain.abs() + (w.product_weights.unsqueeze(-1) * units).abs().sum(-2)
        allowed = 1e-6 + 2e-4 * max(1, spread) * size.square().mean(-1)
        assert ((each_result - plain.square().mean(-1)).abs() <= allowed).all()


@given(**shapes)
@settings(max_examples=20, deadline=None)
def test_fast_predictions_are_the_plain_ones(inputs, products, summations, rows, spread, seed):
    g = torch.Generator().manual_seed(seed)
    network = ProductSummationNetwork(inputs + 3, products, summations)  # on both sides of 8
    x = rows_with_zeros_and_negatives(g, rows, inputs + 3)
    genes = spread * torch.randn(3, network.genes, generator=g, dtype=torch.float64)
    plain = network.forward(genes, x).T
    torch.testing.assert_close(Prediction(network, genes)(x), plain, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(network.join(network.split(genes)), genes)


def test_patterns_of_signs():
    assert sign_patterns(2).tolist() == [[0, 0], [1, 0], [0, 1], [1, 1]]
    half = torch.tensor([[0.5, 1.0]], dtype=torch.float64)
    none = torch.zeros(1, dtype=torch.float64)
    sums = Expanded(half, none + 3.0, half[0], none[0])
    # Cosines of 0, 90, 180 and 270 degrees.
    expected = [[3.0], [0.0], [-3.0], [0.0]]
    assert sums.signed(sign_patterns(2)).numpy() == pytest.approx(np.array(expected), abs=1e-12)
