import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.networks import Expanded, ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.training.trainers.averaging import average, mean, widened
from neurosim.training.uncertainty.ensemble import searches

INPUTS = [{"name": name, "unit": ""} for name in ("prev_left", "prev_right", "left", "right")]


def simulators(count, phases, seed, silent):
    generator = torch.Generator().manual_seed(seed)
    network = ProductSummationNetwork(4, products=3, summations=2, phases=phases, ceilings=phases)
    found = []
    for _ in range(count):
        genes = 0.5 * torch.randn(5, network.genes, generator=generator, dtype=torch.float64)
        weights = network.split(genes).product_weights  # views
        weights[torch.rand(weights.shape, generator=generator) < silent] = 0.0
        scale = 0.5 + torch.rand(5, generator=generator, dtype=torch.float64)
        found.append(
            MotionNetwork(INPUTS, network, genes, torch.ones(4), scale, coordinates="twist-offset")
        )
    return found


@settings(deadline=None, max_examples=50)
@given(
    count=st.integers(1, 4),
    phases=st.booleans(),
    seed=st.integers(0, 1000),
    silent=st.sampled_from([0.0, 0.5, 1.0]),
)
def test_the_averages_outputs_are_the_average_outputs(count, phases, seed, silent):
    found = simulators(count, phases, seed, silent)
    x = 2.0 * torch.rand(20, 4, dtype=torch.float64) - 1.0
    x[:3] = 0.0
    mean = torch.stack([simulator.outputs(x) for simulator in found]).mean(0)
    one = average(found)
    torch.testing.assert_close(one.outputs(x), mean, rtol=1e-9, atol=1e-9)
    assert 3 <= one.network.products <= 3 * count


def test_units_that_count_for_nothing_take_no_room():
    found = simulators(4, True, 0, 1.0)
    assert average(found).network.products == 3


def test_the_mean_of_functions_worked_by_hand():
    exponents = torch.tensor([[2.0, 0.0], [0.0, 1.0]])
    phases = torch.tensor([[0.0, 0.0], [0.0, 1.0]])
    product = Expanded(
        exponents, phases, ceilings=torch.tensor([-1.0, math.log(0.4)]),
        weights=torch.tensor([3.0, 5.0]), linear=torch.tensor([7.0, 0.0]), bias=torch.tensor(1.0),
    )  # fmt: skip
    plain = Expanded(
        exponents[:0], phases[:0], torch.zeros(0), torch.zeros(0), torch.tensor([0.0, 2.0]),
        bias=torch.tensor(-1.0),
    )  # fmt: skip
    network = ProductSummationNetwork(2, 3, 2, floor=0.01, phases=True, ceilings=True)
    genes = network.pack(mean([product, plain], scales=[1.0, 4.0]))
    x = torch.tensor([[-0.5, 0.5], [0.5, -0.25]])
    # (3 x1^2 + 5 x2 + 7 x1 + 1 + 4 (2 x2 - 1)) / 2, where |x2| counts up to 0.4 in 5 x2
    torch.testing.assert_close(network.forward(genes[None], x)[0], torch.tensor([0.125, -1.0]))


def test_wider_networks_say_the_same():
    simulator = simulators(1, True, 5, 0.0)[0]
    genes = widened(simulator.network, simulator.genes, 7)
    network = ProductSummationNetwork(4, products=7, summations=2, phases=True, ceilings=True)
    wide = MotionNetwork(
        INPUTS, network, genes, torch.ones(4), simulator.output_scale, coordinates="twist-offset"
    )
    x = torch.rand(10, 4, dtype=torch.float64) - 0.5
    assert torch.allclose(wide.outputs(x), simulator.outputs(x))


@pytest.mark.parametrize(
    ("rows", "count"), [(5000, 1), (2001, 1), (2000, 2), (1000, 4), (600, 6), (30, 8)]
)
def test_fewer_rows_are_searched_more_often(rows, count):
    assert searches(rows) == count
