import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_networks import NAMES, noise_model, normal, random_motion_network
from numba import njit

from neurosim.base.errors import FileError
from neurosim.base.se2 import tensors as se2
from neurosim.simulators import read_simulator
from neurosim.simulators.motion import kernels
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.motion.noise import (
    DRAWS,
    HEAVIEST,
    SCALE_FEATURES,
    CommandFeatures,
    NoiseModel,
    cholesky,
    components,
    disturb,
    features,
    heaviness,
    in_motion,
    residual,
)

SEEDS = st.integers(0, 2**31 - 1)
STILL = torch.zeros(1, 3, dtype=torch.float64)


def commands(seed, rows):
    random = np.random.default_rng(seed).uniform((-50, -50, 0.5), (50, 50, 3), (rows, 3))
    random[0, :2] = 0.0
    random[-1, 0] = 2.0  # within the dead band
    return torch.from_numpy(random)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_without_a_generator_the_answer_is_the_mean(seed):
    quiet, noisy = random_motion_network(seed, noise=False), random_motion_network(seed)
    start = normal(seed, 6, 3)
    states = [s.step(s.start(start), commands(seed, 6)) for s in (quiet, noisy)]
    assert torch.equal(*states)


@settings(max_examples=20, deadline=None)
@given(SEEDS, SEEDS)
def test_the_same_seed_gives_the_same_and_another_one_another(seed, other):
    noisy = random_motion_network()

    def driven(seed):
        generator = torch.Generator().manual_seed(seed)
        state = noisy.start(normal(0, 6, 3), generator)
        return noisy.step(state, commands(0, 6), generator)

    assert torch.equal(driven(seed), driven(seed))
    if seed != other:
        assert not torch.equal(driven(seed), driven(other))


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_a_trajectory_keeps_its_member(seed):
    noisy = random_motion_network()
    generator = torch.Generator().manual_seed(seed)
    place = noisy.state_names.index("member")
    state = noisy.start(normal(seed, 30, 3), generator)
    member = state[:, place].clone()
    assert set(member.tolist()) <= {0.0, 1.0, 2.0}
    for step in range(4):
        state = noisy.step(state, commands(step, 30), generator)
        assert torch.equal(state[:, place], member)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_draws_of_zero_are_the_mean(seed):
    noisy = random_motion_network(noise=noise_model(seed))
    x = noisy.scaled(torch.cat([30.0 * normal(seed, 5, 2), commands(0, 5)], 1))
    mean = noisy.displacement_of(x)
    moved = noisy.disturbed(x, mean, torch.zeros(5, DRAWS, dtype=torch.float64))
    assert torch.allclose(moved, mean, rtol=0, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_draws_are_found_again_in_what_they_made(seed):
    noise, columns = noise_model(seed), CommandFeatures.of(NAMES)
    noise = replace(noise, tail=torch.tensor([-40.0, 0.0, 0.0]))  # almost no tails
    x, mean = normal(seed, 8, 5).clamp(-1, 1), 0.3 * normal(seed + 1, 8, 3)
    z = normal(seed, 8, DRAWS)
    made = residual(mean, disturb(noise, columns, x, mean, z))
    lower = torch.linalg.cholesky(covariance(noise, columns, x, mean))
    result = torch.linalg.solve_triangular(lower, made.unsqueeze(-1), upper=False)
    assert torch.allclose(result.squeeze(-1), z[:, :3], atol=1e-8)


def covariance(noise, columns, x, mean):
    """Return the covariance [B, 3, 3] at the width without tails."""
    scale, _ = features(noise.unit, columns, x, mean)
    moving = in_motion(noise.unit, noise.sources, mean)
    return torch.diag_embed((2.0 * scale @ noise.log_scale.T).exp()) + moving


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.floats(0.1, 10.0))
def test_larger_noise_has_a_larger_covariance(seed, factor):
    noise, columns = noise_model(seed), CommandFeatures.of(NAMES)
    x, mean = normal(seed, 4, 5).clamp(-1, 1), 0.3 * normal(seed + 1, 4, 3)
    larger = covariance(noise.times(factor), columns, x, mean)
    assert torch.allclose(larger, factor**2 * covariance(noise, columns, x, mean))


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.floats(-6.0, 6.0))
def test_the_covariance_is_positive_definite_whatever_the_numbers(seed, size):
    noise, columns = noise_model(seed, size), CommandFeatures.of(NAMES)
    x, mean = normal(seed, 1, 5).clamp(-1, 1), 0.3 * normal(seed + 1, 1, 3)
    result = covariance(noise, columns, x, mean)[0]
    assert (torch.linalg.eigvalsh(result / result.diagonal().max()) > 0).all()
    half = result.diagonal() / 2.0
    rows = cholesky(result - torch.diag(half), half.unbind())
    lower = torch.stack([torch.stack([*row, *[STILL[0, 0]] * (3 - len(row))]) for row in rows])
    assert torch.allclose(lower, torch.linalg.cholesky(result))
    # The map from random numbers to noise is linear at a fixed width; unit vectors give its rows.
    small = 1e-4 / max(1.0, float(lower.abs().max()))
    unit = small * torch.eye(3, DRAWS, dtype=torch.float64)
    moved = disturb(noise, columns, x.expand(3, -1), mean.expand(3, -1), unit)
    made = residual(mean.expand(3, -1), moved) / small
    assert torch.allclose(made.T, lower, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_noise_of_the_motion_is_that_of_twists(seed):
    """Against small twists that are added, and the displacements that these make."""
    noise = noise_model(seed)
    twist = normal(seed, 1, 3) * torch.tensor([0.3, 0.1, 1.5])
    mean, unit = se2.exp(twist), noise.unit
    assert abs(float(twist[0, 2])) < 5.9  # well below a full circle
    commanded = (twist[0].roll(1) / unit).double()
    expected = torch.zeros(3, 3, dtype=torch.float64)
    for source in noise.sources:
        step = 1e-6 * (source @ commanded)
        ends = [se2.exp(twist + direction * step.roll(-1)) for direction in (1.0, -1.0)]
        moved = (residual(mean, ends[0]) - residual(mean, ends[1]))[0] / 2e-6
        expected += torch.outer(moved, moved)
    assert torch.allclose(in_motion(unit, noise.sources, mean)[0], expected, rtol=1e-5, atol=1e-9)


def test_noise_worked_by_hand():
    shapes = NoiseModel.SHAPES
    numbers = {name: torch.zeros(shape) for name, shape in shapes.items()}
    numbers["unit"] = torch.ones(3)
    numbers["log_scale"][:, 0] = torch.tensor([0.1, 0.02, 0.03]).log()
    numbers["tail"][0] = math.log(0.5)
    noise, columns = NoiseModel(**numbers), CommandFeatures.of(NAMES)
    mean = torch.tensor([[0.2, 0.0, 0.0]], dtype=torch.float64)
    z = torch.tensor([[0.0, 1.0, -2.0, 2.0]], dtype=torch.float64)
    x = torch.tensor([[0.0, 0.0, 0.5, 0.5, 0.5]], dtype=torch.float64)
    # No turn: 0.02 ahead and 0.06 to the right, times e^(0.5 * 2).
    moved = disturb(noise, columns, x, mean, z)
    assert moved[0].tolist() == pytest.approx([0.2 + 0.02 * math.e, -0.06 * math.e, 0.0])
    # A larger turn turns the displacement with it.
    turned = disturb(noise, columns, x, mean, torch.eye(1, DRAWS).double())
    expected = [0.2 * math.cos(0.05), 0.2 * math.sin(0.05), 0.1]
    assert turned[0].tolist() == pytest.approx(expected)


def test_what_happens_in_the_motion_worked_by_hand():
    numbers = {name: torch.zeros(shape) for name, shape in NoiseModel.SHAPES.items()}
    numbers["unit"] = torch.ones(3)
    numbers["log_scale"][:, 0] = -30.0
    numbers["sources"][0, 1, 1] = 0.1
    x = torch.tensor([[0.0, 0.0, 0.5, 0.5, 0.5]], dtype=torch.float64)
    columns = CommandFeatures.of(NAMES)
    # A tenth of the distance ahead, at any width.
    ahead = torch.tensor([[0.5, 0.0, 0.0]], dtype=torch.float64)
    z = torch.tensor([[0.0, 1.0, 0.0, 5.0]], dtype=torch.float64)
    moved = disturb(NoiseModel(**numbers), columns, x, ahead, z)
    assert moved[0].tolist() == pytest.approx([0.55, 0.0, 0.0])
    # Of a half circle, 2 across and pi long, the chord is 2 / pi of the arc.
    circle = torch.tensor([[0.0, 2.0, math.pi]], dtype=torch.float64)
    moved = disturb(NoiseModel(**numbers), columns, x, circle, z)
    assert moved[0].tolist() == pytest.approx([0.0, 2.2, math.pi])
    # A turn that is larger by a tenth of itself bends the arc: the chord loses 2 / pi of that.
    numbers["sources"][0] = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    moved = disturb(NoiseModel(**numbers), columns, x, circle, torch.eye(1, DRAWS).double())
    assert residual(circle, moved)[0].tolist() == pytest.approx([0.1 * math.pi, -0.2, 0.0])


def test_what_the_start_adds_is_complete_after_a_while_worked_by_hand():
    numbers = {name: torch.zeros(shape) for name, shape in NoiseModel.SHAPES.items()}
    numbers["unit"] = torch.tensor([1.0, 0.1, 0.1])
    numbers["log_scale"][:, 0], numbers["tail"][0] = math.log(0.01), -40.0
    numbers["log_scale"][0, SCALE_FEATURES.index("moved")] = 1.0
    noise, columns = NoiseModel(**numbers), CommandFeatures.of(NAMES)
    x = torch.tensor([[0.0, 0.0, 0.5, 0.5, 0.5]], dtype=torch.float64).expand(4, -1)
    ahead = torch.tensor([[0.0], [0.1], [0.2], [20.0]], dtype=torch.float64)
    mean = torch.cat([ahead, 0.0 * ahead, 0.0 * ahead], dim=1)
    made = residual(mean, disturb(noise, columns, x, mean, torch.ones(4, DRAWS).double()))
    # Of m units moved, m / (m + 2) + 0.02: 0, 1, 2 and 200 units. Only the turn depends on them.
    expected = [0.01 * 0.02, 0.01 * (1 / 3 + 0.02), 0.01 * 0.52, 0.01 * (200 / 202 + 0.02)]
    assert made[:, 0].tolist() == pytest.approx(expected)
    assert made[:, 1:].flatten().tolist() == pytest.approx([0.01] * 8)


def test_tails_have_a_limit():
    far = torch.tensor([[1.0, 100.0, 0.0]], dtype=torch.float64)
    assert heaviness(far, torch.tensor([0.0, 1.0, 0.0]).double()).item() == HEAVIEST


@njit
def compiled_noise(arrays, x, mean, z, size):
    """Return a displacement [3] disturbed by the noise z [Z] of inputs x [I]."""
    kernels.own_spread(arrays, x, size)
    kernels.spread(arrays, (size[0], size[1], size[2], size[9]), mean, size)
    return kernels.shake(mean[0], mean[1], mean[2], size, z[0], z[1], z[2], z[3])


@pytest.mark.parametrize("drives", [False, True])
@pytest.mark.parametrize("central", [False, True])
@pytest.mark.slow
def test_compiled_noise_is_that_of_tensors(central, drives):
    noisy = random_motion_network(central=central, drives=drives)
    arrays, before = noisy.compiled(), normal(5, 12, 2) * 30.0
    x = noisy.scaled(torch.cat([before, commands(3, 12)], 1))
    z = normal(4, 12, DRAWS)
    for member in (-1, 0, 2):
        mean = noisy.displacement_of(x, member)
        expected = noisy.disturbed(x, mean, z).numpy()
        per_row = noisy.displacement_of(x, torch.full((12,), member))
        assert torch.allclose(mean, per_row, rtol=1e-12, atol=1e-12)
        for n in range(12):
            size = np.empty(kernels.SIZES)
            moved = compiled_noise(arrays, *(part[n].numpy() for part in (x, mean, z)), size)
            assert moved == pytest.approx(expected[n], rel=1e-9, abs=1e-12)


def test_the_mean_is_a_network_of_its_own_or_the_members_average():
    own, average = random_motion_network(), random_motion_network(members=4, central=False)
    assert (own.members, average.members) == (3, 4)
    x = torch.cat([torch.zeros(5, 2), commands(1, 5)], 1).double()
    assert torch.equal(own.genes, average.genes)
    assert torch.allclose(own.displacement(x), average.displacement(x, 0))
    assert torch.allclose(own.displacement(x, 1), average.displacement(x, 2))
    mean = average.from_outputs(average.outputs(x).mean(1), average.scaled(x))
    assert torch.allclose(average.displacement(x), mean)
    assert own.outputs(x).shape == (5, 3, 3)


def test_ensembles_and_noise_are_written_and_read(tmp_path):
    noisy = random_motion_network()
    write_motion(noisy, tmp_path)
    again = read_simulator(tmp_path)
    assert again.central
    assert again.members == 3
    x = torch.cat([torch.zeros(5, 2), commands(1, 5)], 1).double()
    z = normal(1, 5, DRAWS)
    for member in (-1, 2):
        mean = noisy.displacement(x, member)
        assert torch.equal(again.displacement(x, member), mean)
        moved = [s.disturbed(s.scaled(x), mean, z) for s in (noisy, again)]
        assert torch.equal(*moved)


def test_a_noise_model_of_another_kind_is_refused(tmp_path):
    write_motion(random_motion_network(), tmp_path)
    path = tmp_path / "simulator.json"
    content = json.loads(path.read_text())
    content["noise"]["kind"] = "lasting-cholesky-lognormal"
    path.write_text(json.dumps(content))
    message = r"'noise': is not a noise model.*train the simulator again"
    with pytest.raises(FileError, match=message):
        read_simulator(tmp_path)


def test_the_components_of_a_half_circle():
    moved = torch.tensor([[0.0, 2.0, math.pi]], dtype=torch.float64)
    assert components(moved)[0].tolist() == pytest.approx([math.pi, 2.0, 0.0])
