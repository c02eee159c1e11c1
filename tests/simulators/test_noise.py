import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_networks import NAMES, noise_model, normal, random_motion_network
from safetensors.numpy import load_file, save_file

from neurosim.base.errors import FileError
from neurosim.simulators import read_simulator
from neurosim.simulators.motion import kernels
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.motion.noise import (
    DRAWS,
    HEAVIEST,
    CommandFeatures,
    NoiseModel,
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
    drawn = np.random.default_rng(seed).uniform((-50, -50, 0.5), (50, 50, 3), (rows, 3))
    drawn[0, :2] = 0.0
    drawn[-1, 0] = 2.0  # within the dead zone
    return torch.from_numpy(drawn)


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
    noise = replace(noise, tail=torch.tensor([-40.0, 0.0, 0.0]))  # no tails to speak of
    x, mean = normal(seed, 8, 5).clamp(-1, 1), 0.3 * normal(seed + 1, 8, 3)
    z = normal(seed, 8, DRAWS)
    made = residual(mean, disturb(noise, columns, x, mean, z))
    scale, coupling, _ = features(noise.unit, columns, x, mean)
    s = ((2.0 * scale @ noise.log_scale.T).exp() + in_motion(noise, mean)).sqrt()
    c = coupling @ noise.coupling.T
    turn, forward, sideways = (made / s).unbind(-1)
    forward = forward - c[:, 0] * turn
    found = [turn, forward, sideways - c[:, 1] * turn - c[:, 2] * forward]
    assert torch.allclose(torch.stack(found, dim=-1), z[:, :3], atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.floats(-6.0, 6.0))
def test_the_covariance_is_positive_definite_whatever_the_numbers(seed, size):
    noise, columns = noise_model(seed, size), CommandFeatures.of(NAMES)
    x, mean = normal(seed, 1, 5).clamp(-1, 1), 0.3 * normal(seed + 1, 1, 3)
    # The map from draws to noise is linear at a fixed width; its rows are those of unit draws.
    unit = torch.eye(3, DRAWS, dtype=torch.float64)
    scale, coupling, _ = features(noise.unit, columns, x, mean)
    s, c = (2.0 * scale @ noise.log_scale.T).exp()[0], (coupling @ noise.coupling.T)[0]
    s = (s + in_motion(noise, mean)[0]).sqrt()
    lower = torch.diag(s)
    lower[1, 0], lower[2, 0], lower[2, 1] = s[1] * c[0], s[2] * c[1], s[2] * c[2]
    assert (torch.linalg.eigvalsh(lower @ lower.T / s.square().max()) > 0).all()
    small = 1e-4 / max(1.0, float(s.max()))
    moved = disturb(noise, columns, x.expand(3, -1), mean.expand(3, -1), small * unit)
    turn = (moved[:, 2] - mean[:, 2]) / small
    assert torch.allclose(turn, torch.tensor([float(s[0]), 0.0, 0.0]).double(), atol=1e-6)


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
    # A turn that came out larger carries the robot round with it.
    turned = disturb(noise, columns, x, mean, torch.eye(1, DRAWS).double())
    expected = [0.2 * math.cos(0.05), 0.2 * math.sin(0.05), 0.1]
    assert turned[0].tolist() == pytest.approx(expected)


def test_what_happens_in_the_motion_worked_by_hand():
    numbers = {name: torch.zeros(shape) for name, shape in NoiseModel.SHAPES.items()}
    numbers["unit"] = torch.ones(3)
    numbers["log_scale"][:, 0] = -40.0
    numbers["motion"][1] = torch.tensor([0.03, 0.0, 1.0])
    noise, columns = NoiseModel(**numbers), CommandFeatures.of(NAMES)
    x = torch.tensor([[0.0, 0.0, 0.5, 0.5, 0.5]], dtype=torch.float64)
    ahead = torch.tensor([[0.1, 0.0, 0.0]], dtype=torch.float64)
    # r_f^2 = 0.03 + 0.1^2, whatever the width.
    z = torch.tensor([[0.0, 1.0, 0.0, 5.0]], dtype=torch.float64)
    assert disturb(noise, columns, x, ahead, z)[0].tolist() == pytest.approx([0.3, 0.0, 0.0])


def test_tails_have_a_limit():
    far = torch.tensor([[1.0, 100.0, 0.0]], dtype=torch.float64)
    assert heaviness(far, torch.tensor([0.0, 1.0, 0.0]).double()).item() == HEAVIEST


@pytest.mark.parametrize("drives", [False, True])
@pytest.mark.parametrize("central", [False, True])
def test_compiled_noise_is_that_of_tensors(central, drives):
    noisy = random_motion_network(central=central, drives=drives)
    arrays, before = noisy.arrays(), normal(5, 12, 2) * 30.0
    x = noisy.scaled(torch.cat([before, commands(3, 12)], 1))
    z = normal(4, 12, DRAWS)
    for member in (-1, 0, 2):
        mean = noisy.displacement_of(x, member)
        expected = noisy.disturbed(x, mean, z).numpy()
        per_row = noisy.displacement_of(x, torch.full((12,), member))
        assert torch.allclose(mean, per_row, rtol=1e-12, atol=1e-12)
        for n in range(12):
            size, moved = np.empty(kernels.SIZES), np.empty(3)
            kernels.spread(arrays, x[n].numpy(), mean[n].numpy(), size)
            kernels.shake(mean[n].numpy(), size, z[n].numpy(), moved)
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
    said = r"'noise.kind': 'lasting-cholesky-lognormal' is no noise model.*train the simulator anew"
    with pytest.raises(FileError, match=said):
        read_simulator(tmp_path)


def test_folders_of_version_1_are_read(tmp_path):
    """They had one member, no noise and no dead zone."""
    plain = {"drives": False, "units": 0, "swing": None, "noise": False}
    sim = random_motion_network(members=1, central=False, **plain)
    sim.dead_zone = torch.zeros_like(sim.dead_zone)
    write_motion(sim, tmp_path)
    path = tmp_path / "simulator.json"
    content = json.loads(path.read_text())
    for name in ("members", "central", "noise", "derived", "kernel_units"):
        del content[name]
    path.write_text(json.dumps(content | {"version": 1}))
    weights = tmp_path / "weights.safetensors"
    tensors = load_file(weights)
    del tensors["dead_zone"]
    save_file({k: v[0] if k != "input_scale" else v for k, v in tensors.items()}, weights)
    again = read_simulator(tmp_path)
    x = torch.cat([torch.zeros(5, 2), commands(1, 5)], 1).double()
    assert torch.equal(again.displacement(x), sim.displacement(x))
    assert again.noise is None


def test_the_components_of_a_half_circle():
    moved = torch.tensor([[0.0, 2.0, math.pi]], dtype=torch.float64)
    assert components(moved)[0].tolist() == pytest.approx([math.pi, 2.0, 0.0])
