"""Learning the floor: from which rows, and when no floor is learned."""

import numpy as np
import pytest
import torch
from driven_robot import drive_data

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.floor import Floor
from neurosim.training.base import Within
from neurosim.training.train import learn
from neurosim.training.trainers.floor_fit import MOST_ROWS, evened, fit_floor

torch.set_num_threads(1)


def uneven(ahead, size=0.015, seed=4):
    """Return a floor of 3 m by 2 m whose lost fraction has about this standard deviation."""
    weights = torch.randn(1, 7, 10, generator=torch.Generator().manual_seed(seed)).double()
    weights = weights.expand(2, 7, 10)
    number = torch.tensor
    floor = Floor(weights, number([-1.5, -1.0]), 0.45, ahead)
    return Floor(
        size / floor.map[0, ..., 0].std() * weights, *(floor.origin, floor.length, floor.ahead)
    )


def on(floor, data, seed=0):
    """Return rows of a robot that starts anywhere on a floor."""
    g = torch.Generator().manual_seed(seed)
    start = torch.rand(len(data.x), 3, generator=g, dtype=torch.float64) - 0.5
    start = start * torch.tensor([2.4, 1.6, 6.28])
    within = data.within
    moved = floor.moved(start[within.row], within.moved)
    within = Within(within.row, within.time, moved)
    return data.__class__(data.inputs, data.x, floor.moved(start, data.y), within, start=start)


def rows(count, seed, noise=0.002):
    """Return starts, displacements and noise of curves, [N, 3] each."""
    g = torch.Generator().manual_seed(seed)
    start = torch.rand(count, 3, generator=g, dtype=torch.float64) - 0.5
    moved = torch.randn(count, 3, generator=g, dtype=torch.float64)
    size = torch.tensor([0.4, 0.01, 1.0])
    scatter = torch.randn(count, 3, generator=g, dtype=torch.float64)
    return start * torch.tensor([2.4, 1.6, 6.28]), size * moved, noise * scatter


def fitted(floor, start, moved, scatter):
    """Return the fit to rows on a floor."""
    after = floor.moved(start, moved) + scatter * torch.tensor([1.0, 1.0, 5.0])
    left = (after - moved)[:, [2, 0]]
    generator = torch.Generator().manual_seed(0)
    return fit_floor(start, after, left, torch.ones_like(left), 200, generator)


def at(floor, points, number=0):
    return torch.einsum("pk,k->p", floor.bells(points)[0], floor.weights[number].flatten())


@pytest.mark.parametrize("ahead", [0.0, 1.0])
def test_a_floor_is_learned_of_what_it_does(ahead):
    floor, (start, moved, scatter) = uneven(ahead), rows(400, 1)
    fit = fitted(floor, start, moved, scatter)
    assert float(fit.floor.ahead) == ahead
    x, y = torch.meshgrid(
        torch.linspace(-0.9, 0.9, 13), torch.linspace(-0.6, 0.6, 9), indexing="xy"
    )
    points = torch.stack([x.flatten(), y.flatten()], 1).double()
    true, known = at(floor, points), at(fit.floor, points)
    assert np.corrcoef(true, known)[0, 1] > 0.85
    # Ensemble members span the remaining uncertainty: the truth is among them.
    sampled = torch.stack([at(fit.floor, points, 1 + m) for m in range(200)])
    below = (sampled < true).double().mean(0)
    assert 0.7 < ((below > 0.05) & (below < 0.95)).double().mean() <= 1.0
    # The floor predicts other rows better, without the noise of its own rows.
    other, far, _ = rows(200, 2)
    after = floor.moved(other, far)
    error = (fit.floor.moved(other, far) - after)[:, 2].square().mean()
    assert error < 0.35 * (far - after)[:, 2].square().mean()
    seen = (fit.floor.moved(start, moved) - floor.moved(start, moved))[:, 2]
    noisy = seen - 5.0 * scatter[:, 2]
    assert (noisy + fit.unseen).square().mean() > noisy.square().mean()


def test_on_an_even_floor_none_is_learned():
    for seed in range(5):
        start, moved, scatter = rows(150, seed)
        none = Floor(torch.zeros(1, 3, 3), torch.zeros(2), 1.0, 1.0)
        assert fitted(none, start, moved, scatter) is None
    same = torch.zeros(20, 3, dtype=torch.float64)
    generator = torch.Generator()
    assert fit_floor(same, same, same[:, :2], torch.ones(20, 2), 1, generator) is None


def test_of_very_many_rows_some_are_enough_and_a_line_is_an_area():
    floor, (start, moved, scatter) = uneven(1.0), rows(3 * MOST_ROWS - 1, 5)
    fit = fitted(floor, start, moved, scatter)
    assert fit.unseen.shape == (3 * MOST_ROWS - 1,)
    assert (fit.unseen[::3] != 0).all()
    assert (fit.unseen[1::3] == 0).all()
    # Up and down a line 2 m long: no wider than a tenth of it.
    start = start[:200] * torch.tensor([1.0, 0.0, 1.0])
    narrow = fitted(floor, start, moved[:200], scatter[:200])
    assert narrow.floor.weights.shape[1:].numel() < 400


def test_rows_are_evened_by_what_the_floor_did():
    floor, (start, moved, _) = uneven(1.0), rows(50, 3)
    again = evened(floor, start, floor.moved(start, moved))
    assert (floor.moved(start, moved) - moved).abs().max() > 0.02
    assert (again - moved).abs().max() < 1e-4


@pytest.mark.slow
def test_a_simulator_learns_its_floor():
    floor = uneven(1.0)
    data = on(floor, drive_data(260, noise=0.0005), 1)
    fresh, where = (
        drive_data(100, seed=9, noise=0.0),
        on(floor, drive_data(100, seed=9, noise=0.0), 2),
    )
    settings = {"members": 3, "most_centres": 75}
    knows = learn(data, 0, **settings)
    assert knows.meta["composition"]["floor"]["ahead"] == 1.0
    assert len(knows.floor.weights) == 1 + knows.members
    plain = learn(data, 0, without=("floor",), **settings)
    assert plain.floor is None

    def error(simulator):
        moved = simulator.displacement_of(simulator.chained(fresh.x))
        moved = simulator.on_floor(where.start, moved)
        return (moved - where.y).square().mean(0).sqrt()

    assert (error(knows)[[0, 2]] < 0.8 * error(plain)[[0, 2]]).all()
    # Steps begin where the robot is.
    state = knows.start(where.start, member=-1)
    after = knows.step(state, fresh.x[:, 2:])[:, :3]
    begun = knows.start(torch.zeros(100, 3).double(), member=-1)
    even = se2.between(begun[:, :3], knows.step(begun, fresh.x[:, 2:])[:, :3])
    assert not torch.allclose(se2.between(where.start, after), even, atol=1e-4)
