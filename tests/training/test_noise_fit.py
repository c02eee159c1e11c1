"""The learned noise, compared with the known noise of the rows."""

import math

import pytest
import torch

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.noise import (
    HEAVIEST,
    SCALE_FEATURES,
    CommandFeatures,
    NoiseModel,
    disturb,
    features,
    heaviness,
    in_motion,
)
from neurosim.training.noise import USUAL_SPREAD, _log_likelihood, fit_noise, fit_spread

NAMES = ("prev_left", "prev_right", "left", "right", "duration")


def typical_size(noise, columns, inputs, mean):
    """Return the root mean square [B, 3] of the sizes S."""
    scale, tail = features(noise.unit, columns, inputs, mean)
    tau = heaviness(tail, noise.tail.to(mean)).unsqueeze(-1)
    log_s = scale @ noise.log_scale.to(mean).T
    moving = in_motion(noise.unit, noise.sources, mean).diagonal(dim1=1, dim2=2)
    return ((2.0 * (log_s + tau.square())).exp() + moving).sqrt()


def recorded(rows, seed=0, **planted):
    """Return inputs, displacements, their mean, and the known noise."""
    generator = torch.Generator().manual_seed(seed)
    command = torch.rand(rows, 3, generator=generator, dtype=torch.float64) * 2.0 - 1.0
    command[:, 2] = 0.6 + 0.4 * command[:, 2]
    x = torch.cat([command.roll(1, 0)[:, :2], command], dim=1)
    x[::4, :2] = 0.0
    left, right, time = (command * torch.tensor([0.12, 0.12, 3.0])).unbind(-1)
    twist = torch.stack([(left + right) / 2, 0.0 * left, (right - left) / 0.13], -1)
    mean = se2.exp(twist * time.unsqueeze(-1))
    numbers = {name: torch.zeros(shape) for name, shape in NoiseModel.SHAPES.items()}
    numbers["unit"] = torch.tensor([1.0, 0.1, 0.05])
    numbers["log_scale"][:, 0] = torch.tensor([0.02, 0.001, 0.0005]).log()
    numbers["tail"][0] = -2.0
    noise = NoiseModel(**numbers | planted)
    z = noise.draw(1, rows, generator)[0]
    y = disturb(noise, CommandFeatures.of(NAMES), x, mean, z)
    return x, y, mean, noise


@pytest.mark.slow
def test_the_size_is_found_again_in_all_its_parts():
    sources = torch.zeros(NoiseModel.SHAPES["sources"])
    # Wheels that slip by 2 % on their own, and something to the side.
    for wheel, side in enumerate((-1.0, 1.0)):
        travel = torch.tensor([side * 1.0 * 0.13 / 2.0, 0.1, 0.0])
        sources[wheel] = 0.02 * torch.outer(torch.tensor([side / 0.13, 0.5, 0.0]), travel)
    sources[2, 2, 0] = 0.001
    x, y, mean, noise = recorded(6000, sources=sources)
    columns = CommandFeatures.of(NAMES)
    fitted_noise = fit_noise(columns, x, mean, y)
    sizes = [typical_size(model, columns, x, mean) for model in (noise, fitted_noise)]
    ratio = (sizes[1] / sizes[0]).log()
    assert ratio.square().mean(0).sqrt().max() < 0.15
    # Straight ahead, where noise added to the chord would be too small.
    ahead = (mean[:, 2].abs() < 0.1) & (mean[:, 0].abs() > 0.1)
    assert ahead.sum() > 20
    assert ratio[ahead].exp().median(0).values.tolist() == pytest.approx([1.0] * 3, abs=0.15)


def test_what_starts_from_rest_strays_more_where_it_does():
    """The caster may then point in any direction, and no input gives this direction."""
    log_scale = torch.zeros(NoiseModel.SHAPES["log_scale"])
    log_scale[:, 0] = torch.tensor([0.02, 0.001, 0.0005]).log()
    log_scale[:, SCALE_FEATURES.index("before")] = -0.4
    x, y, mean, noise = recorded(3000, log_scale=log_scale)
    columns = CommandFeatures.of(NAMES)
    fitted_noise = fit_noise(columns, x, mean, y)
    sizes = [typical_size(model, columns, x, mean) for model in (noise, fitted_noise)]
    rest = (x[:, :2] == 0.0).all(1)
    wider = [(size[rest].log().mean(0) - size[~rest].log().mean(0)).exp() for size in sizes]
    assert wider[0].min() > 2.5
    assert wider[1].tolist() == pytest.approx(wider[0].tolist(), rel=0.1)


def test_what_strays_at_its_start_is_found_again():
    """A command that moves nothing is far more exact than others; a long one adds little."""
    log_scale = torch.zeros(NoiseModel.SHAPES["log_scale"])
    log_scale[:, 0] = torch.tensor([0.05, 0.005, 0.002]).log()
    log_scale[:, SCALE_FEATURES.index("moved")] = 1.0
    x, y, mean, noise = recorded(3000, log_scale=log_scale)
    columns = CommandFeatures.of(NAMES)
    fitted_noise = fit_noise(columns, x, mean, y)
    size = mean[:, :2].norm(dim=1) / 0.1 + mean[:, 2].abs()
    for low, high in ((0.3, 0.5), (1.0, 2.0), (2.0, 4.0)):
        some = (size > low) & (size < high)
        assert some.sum() > 50
        sizes = [typical_size(model, columns, x, mean)[some] for model in (noise, fitted_noise)]
        ratio = (sizes[1] / sizes[0]).log().mean(0).exp()
        assert ratio.tolist() == pytest.approx([1.0] * 3, abs=0.15)


@pytest.mark.slow
def test_the_likelihood_and_its_derivatives_are_those_of_a_mixture_of_normal_distributions():
    generator = torch.Generator().manual_seed(3)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    rows, places = 40, torch.tensor([-1.7, 0.0, 1.7], dtype=torch.float64)
    fractions = torch.tensor([1.0, 4.0, 1.0], dtype=torch.float64)
    scale, tail, arc, jacobian = (
        normal(rows, 5),
        normal(rows, 3),
        normal(rows, 3),
        normal(rows, 3, 3),
    )
    error, weight = normal(rows, 3), normal(rows).abs()
    searched = [0.3 * normal(3, 5), 0.5 * normal(3), 0.4 * normal(3, 3, 3)]
    w, h, u = (part.clone().requires_grad_() for part in searched)
    log_s = (scale @ w.T)[:, None] + heaviness(tail, h)[:, None, None] * places[:, None]
    moved = torch.einsum("nac,kcb,nb->nka", jacobian, u, arc)
    covariance = torch.diag_embed((2.0 * log_s).exp()) + (moved.mT @ moved)[:, None]
    each = torch.distributions.MultivariateNormal(torch.zeros(3).double(), covariance)
    mixed = (each.log_prob(error[:, None]) + (fractions / fractions.sum()).log()).logsumexp(1)
    expected = (weight * mixed).sum()
    expected.backward()
    assert (heaviness(tail, h) == HEAVIEST).any()

    slopes = [torch.full_like(part, 9.0) for part in searched]
    given = (places, fractions, scale, tail, arc, jacobian, error, torch.zeros(3).double(), weight)
    value = _log_likelihood(*(part.numpy() for part in (*given, *searched, *slopes)))
    constant = 1.5 * math.log(2.0 * math.pi) * weight.sum()
    assert value == pytest.approx(float(expected.detach() + constant), rel=1e-9)
    for slope, searched_part in zip(slopes, (w, h, u), strict=True):
        torch.testing.assert_close(slope, searched_part.grad, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("of_noise", "of_members"), [(1.0, 1.0), (0.5, 2.0), (2.0, 0.5)])
def test_short_and_long_windows_are_within_the_spread(of_noise, of_members):
    generator = torch.Generator().manual_seed(5)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    # Windows of 1, 2, 4, ... rows: noise of rows adds up like a random walk, members' errors do not
    # change within a window.
    rows = 2.0 ** (torch.arange(900) % 6)[:, None]
    size = torch.tensor([0.02, 0.01, 0.005], dtype=torch.float64)
    noise = rows.sqrt() * size * normal(100, 900, 3)
    members = 0.3 * rows * size * normal(8, 1, 3)
    common = 0.3 * rows * size * normal(900, 3)
    error = of_noise * rows.sqrt() * size * normal(900, 3) + of_members * common
    first, second = fit_spread(error, noise, members, torch.ones(900, dtype=torch.float64))
    spread = (first * size).square() * rows + second.square() * members.square().mean(0)
    held = (error.abs() < 1.2816 * spread.sqrt()).double()
    for some in (rows <= 2.0, rows >= 16.0):
        for of_output in held[some[:, 0]].mean(0).tolist():
            assert of_output == pytest.approx(0.8, abs=0.06)
    # Few windows change the usual factors little.
    few = error[:4], noise[:, :4], members[:, :4], torch.full((4,), 0.01).double()
    for usual in (USUAL_SPREAD, 3.0):
        first, second = fit_spread(*few, usual)
        assert first.tolist() == pytest.approx([1.0] * 3, abs=0.05)
        assert second.tolist() == pytest.approx([usual] * 3, abs=0.05)
