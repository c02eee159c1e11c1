import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurosim.base.se2 import tensors as se2
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import PursuitSettings, TrainingData
from neurosim.training.trainers.exponents import (
    ExponentsSettings,
    ExponentsTrainer,
    translation_factors,
)
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


def test_twist_and_offset_give_the_displacement():
    rng = np.random.default_rng(0)
    twist = torch.tensor(rng.normal(0, 1, (50, 3)))
    offset = torch.tensor(rng.normal(0, 0.1, (50, 2)))
    twist[:, 2] *= 5
    vx, vy, omega = twist.unbind(-1)
    chord = torch.sinc(omega / (2 * math.pi))
    cos, sin = chord * (omega / 2).cos(), chord * (omega / 2).sin()
    moved = torch.stack(
        [cos * vx - sin * vy + offset[:, 0], sin * vx + cos * vy + offset[:, 1], omega], dim=-1
    )
    factors, outputs = translation_factors(omega), torch.cat([twist[:, :2], offset], dim=1)
    mixed = torch.einsum("eon,no->en", factors, outputs)
    torch.testing.assert_close(mixed, se2.mid_turn(moved)[:, :2].T)


def test_the_trainer_s_errors_are_those_of_its_simulator(robot_data):
    inputs, outputs = map(torch.tensor, robot_data(200, 6))
    data = TrainingData([{"name": n} for n in NAMES], inputs, outputs)
    settings = ExponentsSettings(**FEW, patience=100, dead_zone=(0.0,) * 5)
    trainer = ExponentsTrainer(data, ProductSummationNetwork(5, 6, 1), settings, seed=0)
    for _ in range(3):
        errors = trainer.advance()
    (turn,) = trainer._turns
    turn._best = (turn.exponents, turn.phases)
    trainer._shift._best = (trainer._shift.exponents, trainer._shift.phases)
    moved = trainer.result().displacement(inputs)
    found = (moved - outputs)[:, 2].square().mean()
    assert found.item() == pytest.approx(errors[2].item(), rel=1e-4)


def test_no_unit_grows_far_beyond_what_it_was_on_its_rows(robot_data):
    """Where the robot was never slow, negative powers of speeds say nothing of slowness."""
    inputs, outputs = map(torch.tensor, robot_data(200, 6))
    inputs = inputs[(inputs[:, :4].abs() > 12).all(1)]
    outputs = outputs[: len(inputs)]
    data = TrainingData([{"name": n} for n in NAMES], inputs, outputs)
    settings = ExponentsSettings(**FEW, dead_zone=(0.0,) * 5, derived=Derived())
    trainer = ExponentsTrainer(data, ProductSummationNetwork(5, 6, 1), settings, seed=0)
    for _ in range(6):
        trainer.advance()
    simulator = trainer.result()
    network, w = simulator.network, simulator.network.split(simulator.genes[0])
    slow = inputs.clone()
    slow[:, :4] *= 0.05

    def units(rows, ceilings):
        return network.product_units(w.exponents, simulator.scaled(rows), w.phases, ceilings)

    counts = (w.product_weights != 0).unsqueeze(-1)
    seen, free, kept = units(inputs, None), units(slow, None), units(slow, w.ceilings)
    largest = seen.abs().amax(-1, keepdim=True)
    assert (units(inputs, w.ceilings) == seen)[counts.squeeze(-1)].all()
    assert ((free.abs() > 10 * largest) & counts).any()
    assert ((kept.abs() <= 1.2501 * largest) | ~counts).all()


def test_of_many_rows_the_turn_is_the_average_of_two_searches(robot_data, monkeypatch):
    monkeypatch.setattr("neurosim.training.trainers.exponents.MANY_ROWS", 200)
    inputs, outputs = map(torch.tensor, robot_data(200, 6))
    data = TrainingData([{"name": n} for n in NAMES], inputs, outputs)
    settings = ExponentsSettings(**FEW, patience=100, dead_zone=(0.0,) * 5, derived=Derived())
    trainer = ExponentsTrainer(data, ProductSummationNetwork(5, 6, 1), settings, seed=0)
    for _ in range(4):
        trainer.advance()
    simulator = trainer.result()
    state = trainer.state()
    said = []
    for number in range(2):  # each of them in the place of both
        own = {k.removeprefix(f"turn{number}."): v for k, v in state.items() if "turn" in k}
        both = {f"turn{n}.{k}": v for n in range(2) for k, v in own.items() if "turn" not in k}
        trainer.load({**state, **both})
        said.append(trainer.result().outputs(inputs)[..., 2])
    assert not torch.allclose(said[0], said[1])
    torch.testing.assert_close(simulator.outputs(inputs)[..., 2], (said[0] + said[1]) / 2)


@pytest.mark.parametrize(
    ("count", "derived"),
    [(299, Derived()), (300, Derived(swing=0.03)), (1000, Derived(moving=True, swing=0.03))],
)
def test_more_rows_give_more_derived_inputs(robot_data, monkeypatch, count, derived):
    monkeypatch.setattr(
        "neurosim.training.trainers.exponents.find_swing",
        lambda found, *_: replace(found, swing=0.03),
    )
    inputs, outputs = map(torch.tensor, robot_data(count, 6))
    settings = ExponentsSettings(**FEW, dead_zone=(0.06,) * 4 + (0.0,))
    data = TrainingData([{"name": n} for n in NAMES], inputs, outputs)
    trainer = ExponentsTrainer(data, ProductSummationNetwork(5, 6, 1), settings, seed=0)
    assert Derived.of(trainer.state()["derived"]) == derived


@pytest.mark.parametrize("side", [-1.0, 1.0, 0.0])
def test_a_swing_is_found_where_there_is_one(side):
    """A robot whose caster turns it by 0.1 rad for every half turn of its own."""
    columns = CommandFeatures.of(tuple(NAMES))
    x, g = rows(500)
    x[::4, 2] = x[::4, 3]
    x[::2, :2] = -0.7 * x[::2, 2:4]  # reversals
    swing = Derived(swing=0.03 * (side or 1.0)).append(columns, x, x)[:, -1]
    target = (x[:, 3] - x[:, 2]) * x[:, 4] + 0.1 * abs(side) * swing
    target = target + 0.005 * torch.randn(500, generator=g, dtype=torch.float64)
    found = find_swing(Derived(), columns, x, x, target, PursuitSettings(**FEW), 0.02)
    assert found == Derived(swing=0.03 * side if side else None)
