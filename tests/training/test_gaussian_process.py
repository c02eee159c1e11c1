"""The likelihood that is maximised to learn a Gaussian process."""

from __future__ import annotations

import json
import math

import pytest
import torch
from processes import finished, process
from torch.distributions import MultivariateNormal

from neurosim.training.base import minimise
from neurosim.training.trainers.gaussian_process import unlikelihood


def rows(seed: int = 0) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    y = torch.randn(20, 2, generator=generator, dtype=torch.float64)
    trust = 0.5 + torch.rand(20, 2, generator=generator, dtype=torch.float64)
    return x, y, trust, x.std(0)


def test_two_rows_by_hand():
    """Lengths 2 and the spread 1: both inputs are 2 apart, so that the covariance is exp(-1/2)."""
    x = torch.tensor([[0.0], [2.0]], dtype=torch.float64)
    y, trust = torch.tensor([[1.0], [-1.0]]).double(), torch.ones(2, 1, dtype=torch.float64)
    log_length = torch.tensor(2.0, dtype=torch.float64).log()
    result = torch.tensor([log_length, 0.0, 0.0], dtype=torch.float64)
    value, _ = unlikelihood(result, x, y, trust, torch.ones(1, dtype=torch.float64))
    shared = float(torch.tensor(-0.5).exp())
    # The matrix [[2, s], [s, 2]] has determinant 4 - s^2; (1, -1) is its eigenvector of 2 - s.
    expected = 1.0 / (2.0 - shared) + 0.5 * float(torch.tensor(4.0 - shared**2).log())
    assert value == pytest.approx(expected + 0.1 * (float(log_length) - 0.7) ** 2, abs=1e-5)


def test_the_value_is_that_of_normal_distributions():
    x, y, trust, spread = rows()
    result = torch.tensor([0.7, 0.7, 0.7, 0.0, 0.0, -0.4, 0.2], dtype=torch.float64)
    value, _ = unlikelihood(result, x, y, trust, spread)
    lengths = result[0].exp() * spread
    shared = torch.exp(-0.5 * torch.cdist(x / lengths, x / lengths).square())
    constant = 10.0 * math.log(2.0 * math.pi)  # of 20 rows, which the likelihood leaves out
    expected = 0.0
    for f in range(2):
        noise = torch.diag((2.0 * result[5 + f]).exp() / trust[:, f])
        normal = MultivariateNormal(torch.zeros(20, dtype=torch.float64), shared + noise)
        expected -= float(normal.log_prob(y[:, f])) + constant
    assert value == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_is_that_of_differences(seed):
    x, y, trust, spread = rows(seed)
    result = 0.5 * torch.randn(
        7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    _, gradient = unlikelihood(result, x, y, trust, spread)
    for k, step in enumerate(1e-5 * torch.eye(7, dtype=torch.float64)):
        above, below = (unlikelihood(result + s * step, x, y, trust, spread)[0] for s in (1, -1))
        assert float(gradient[k]) == pytest.approx((above - below) / 2e-5, abs=1e-4)


@pytest.mark.slow
def test_the_search_finds_a_minimum_without_pytorchs_compiler():
    program = (
        "import sys, torch\n"
        "from neurosim.training.base import minimise\n"
        "x = torch.zeros(2, dtype=torch.float64, requires_grad=True)\n"
        "def loss():\n"
        "    x.grad = None\n"
        "    value = (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2  # Rosenbrock\n"
        "    value.backward()\n"
        "    return value\n"
        "minimise([x], loss, steps=200)\n"
        "print(x.tolist(), 'torch._dynamo' in sys.modules)\n"
    )
    done = finished(process(program))
    values, imported = done.stdout.rsplit(" ", 1)
    assert json.loads(values) == pytest.approx([1.0, 1.0], abs=1e-3), done.stderr
    assert imported == "False\n"


@pytest.mark.parametrize("limit", [3.0, 30.0, 300.0])
def test_a_search_that_steps_over_a_limit_comes_back(limit):
    """Of -x - 0.5 ln(limit - x), which does not exist beyond it: the minimum is 0.5 before it."""
    x = torch.zeros(1, dtype=torch.float64)

    def loss():
        x.grad = 0.5 / (limit - x) - 1.0
        return (-x - 0.5 * (limit - x).log()).sum()

    minimise([x], loss, steps=100)
    assert x.item() == pytest.approx(limit - 0.5, abs=1e-3)
