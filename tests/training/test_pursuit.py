import pytest
import torch

from neurosim.networks import ProductSummationNetwork
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import PursuitSettings
from neurosim.training.trainers.pursuit import Pursuit, row_weights
from neurosim.training.trainers.swing import find_swing

NAMES = ("prev_left", "prev_right", "left", "right", "duration")
FEW = {"candidates": 100, "parents": 6, "children": 30}


def rows(count, seed=0):
    g = torch.Generator().manual_seed(seed)
    x = 2 * torch.rand(count, 5, generator=g, dtype=torch.float64) - 1
    x[:, 4] = 0.6 + 0.4 * x[:, 4]
    return x, g


def search(x, targets, factors=None, **settings):
    factors = torch.ones(1, 1, len(x), dtype=x.dtype) if factors is None else factors
    generator = torch.Generator().manual_seed(1)
    chosen = PursuitSettings(**{**FEW, **settings})
    return Pursuit(x, factors, targets, chosen, 6, generator, 0.02)


def test_it_finds_the_product_that_is_there():
    x, _ = rows(400)
    target = x[:, 2].sign() * x[:, 2].abs() ** 1.5 * x[:, 4] + 0.3 * x[:, 0]
    found = search(x, target[None], reweigh_at=())
    before = found.mean_squared_error.item()
    for _ in range(4):
        found.grow()
    assert found.mean_squared_error.item() < before / 1000


def test_the_readout_is_the_weighted_least_squares_solution():
    x, g = rows(200)
    factors = torch.randn(2, 3, 200, generator=g, dtype=torch.float64)
    targets = torch.randn(2, 200, generator=g, dtype=torch.float64)
    found = search(x, targets, factors, reweigh_at=(3,), ridge=1e-12)
    for _ in range(5):
        found.grow()
    weights = row_weights(x, torch.ones_like(targets))  # some weights of the same shape
    found._weights = weights
    found._solve()
    network = ProductSummationNetwork(5, 1, 1, phases=True, floor=0.02)
    columns = []
    for o in range(3):
        units = network.product_units(found.exponents[o], x, found.phases[o]).T
        features = torch.cat([units, x, torch.ones_like(x[:, :1])], dim=1)
        columns.append((factors[:, o] * weights).unsqueeze(-1) * features)
    columns = torch.cat(columns, dim=2).flatten(0, 1)
    solution = torch.linalg.lstsq(columns, (targets * weights).flatten()[:, None]).solution[:, 0]
    found_solution = torch.cat([torch.cat(part) for part in found.readout()])
    torch.testing.assert_close(columns @ found_solution, columns @ solution, rtol=1e-5, atol=1e-6)


def test_the_jacobian_is_that_of_differences():
    x, g = rows(50)
    factors = torch.randn(2, 2, 50, generator=g, dtype=torch.float64)
    found = search(x, torch.randn(2, 50, generator=g, dtype=torch.float64), factors)
    for _ in range(3):
        found.grow()
    jacobian, fitted = found._jacobian(), found._residual.clone()
    readout = [a.clone() for a, _ in found.readout()]
    step, column = 1e-6, 0
    for o, exponents in enumerate(found.exponents):
        for unit in range(len(exponents)):
            for i in range(5):
                moved = exponents.clone()
                moved[unit, i] += step
                change = found._units(moved, found.phases[o]) - found._units(
                    exponents, found.phases[o]
                )
                change = factors[:, o] * found._weights * (change @ readout[o]) / step
                torch.testing.assert_close(
                    jacobian[:, column], change.flatten(), rtol=1e-4, atol=1e-5
                )
                column += 1
    assert column == jacobian.shape[1]
    assert fitted.shape == (2, 50)


def test_noise_alone_is_not_fitted():
    x, g = rows(100)
    found = search(x, torch.randn(1, 100, generator=g, dtype=torch.float64), patience=3)
    while not found.finished:
        found.grow()
    found.settle()
    assert found.units <= 3


def test_rows_with_larger_errors_weigh_less():
    x, g = rows(2000)
    residual = torch.randn(1, 2000, generator=g, dtype=torch.float64) * x[:, 4] ** 2
    weights = row_weights(x, residual)
    assert weights.square().mean().item() == pytest.approx(1.0)
    long, short = weights[0, x[:, 4] > 0.9].mean(), weights[0, x[:, 4] < 0.3].mean()
    assert short > 1.5 * long


def test_no_unit_grows_far_beyond_what_it_was_on_its_rows():
    """Where the robot was never slow, negative powers of speeds say nothing of slowness."""
    x, _ = rows(200)
    x[:, :4] = x[:, :4].sign() * (0.3 + 0.7 * x[:, :4].abs())
    target = x[:, 4] / (x[:, 2].abs() + 0.05) + 0.2 * x[:, 3]
    found = search(x, target[None], reweigh_at=())
    for _ in range(6):
        found.grow()
    (exponents,), (phases,), (ceilings,) = found.best_units()
    network = ProductSummationNetwork(5, len(exponents), 1, phases=True, ceilings=True, floor=0.02)
    slow = x.clone()
    slow[:, :4] *= 0.05

    def units(of, bounds):
        return network.product_units(exponents, of, phases, bounds)

    seen, free, kept = units(x, None), units(slow, None), units(slow, ceilings)
    largest = seen.abs().amax(-1, keepdim=True)
    assert torch.equal(units(x, ceilings), seen)
    assert (free.abs() > 10 * largest).any()
    assert (kept.abs() <= 1.2501 * largest).all()


@pytest.mark.parametrize("side", [-1.0, 1.0, 0.0])
def test_a_swing_is_found_where_there_is_one(side):
    """A robot whose caster turns it by 0.1 rad for every half turn of its own."""
    columns = CommandFeatures.of(tuple(NAMES))
    x, g = rows(500)
    x[::4, 2] = x[::4, 3]
    x[::2, :2] = -0.7 * x[::2, 2:4]  # reversals
    swing = Derived(swing=0.03 * (side or 1.0)).append(columns, x)[:, -1]
    target = (x[:, 3] - x[:, 2]) * x[:, 4] + 0.1 * abs(side) * swing
    target = target + 0.005 * torch.randn(500, generator=g, dtype=torch.float64)
    alike = torch.ones_like(target)
    found = find_swing(columns, x, target, alike, PursuitSettings(**FEW), 0.02)
    assert found == Derived(swing=0.03 * side if side else None)
