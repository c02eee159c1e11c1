"""The compiled rollouts against the slow, obvious way: the simulator's own steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from neurosim.loop.rollouts import RUN_DOWN, CompiledRollouts, SteppedRollouts, rollouts, stepped

from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.network import COORDINATES
from neurosim.simulators.motion.noise import NoiseModel

START = (-0.8, 0.0, 1.5)
NAMES = ("prev_left", "prev_right", "left", "right", "duration")


def normal(seed, *shape):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def simulator(
    members, coordinates, *, noisy=True, names=NAMES, shared=False, central=False, derived=None
):
    inputs = 5 + len(derived or ())
    network = ProductSummationNetwork(inputs=inputs, products=7, summations=2, ceilings=True)
    genes = 2.5 / inputs * normal(1, members + central, COORDINATES[coordinates], network.genes)
    if shared:  # networks with the same exponents, as read-outs of one search have
        genes[:, :, : 7 * inputs] = genes[:1, :1, : 7 * inputs]
        genes[:, :, -7:] = genes[:1, :1, -7:]
        genes[:, :, 7 * inputs] = 0.0
    noise = None
    if noisy:
        shapes = NoiseModel.SHAPES
        drawn = {name: 0.1 * normal(2, *shape) for name, shape in shapes.items()}
        drawn["log_scale"][:, 0] -= 3.0
        drawn["unit"] = torch.tensor([1.0, 0.2, 0.1])
        drawn["motion"] = drawn["motion"].abs()
        noise = NoiseModel(**drawn)
    scale = [3.0 if name == "duration" else 50.0 for name in names]
    return MotionNetwork(
        [{"name": name, "unit": ""} for name in names],
        network,
        genes,
        torch.tensor(scale),
        torch.full((COORDINATES[coordinates],), 0.1),
        coordinates,
        noise=noise,
        dead_zone=torch.tensor([0.06 if name != "duration" else 0.0 for name in names]),
        central=central,
        derived=derived,
    )


def plans(batch, count):
    rng = np.random.default_rng(0)
    commands = rng.uniform((-50, -50, 0.5), (50, 50, 3), (batch, count, 3))
    # Zeros, speeds within the dead zone, equal speeds, and the same speeds backwards.
    commands[0, 0, :2] = 0.0
    commands[1, :, 0] = 2.0
    commands[2, :, 1] = commands[2, :, 0]
    commands[-1, 1:, :2] = -commands[-1, :-1, :2]
    commands[-1, 1::2, :2] *= 0.5
    given = rng.random((batch, count)) < 0.75
    given[3] = False
    return commands, given


@pytest.mark.parametrize("derived", [None, Derived(moving=True), Derived(True, 0.03)])
@pytest.mark.parametrize("names", [NAMES, (*NAMES[2:], *NAMES[:2])])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(
    ("members", "coordinates", "central"),
    [(1, "displacement", False), (3, "twist-offset", False), (3, "twist-offset", True)],
)
def test_expected_paths_are_those_of_single_steps(
    members, coordinates, central, shared, names, derived
):
    how = {"names": names, "shared": shared, "noisy": False, "derived": derived}
    sim = simulator(members, coordinates, central=central, **how)
    commands, given = plans(8, 6)
    fast, slow = rollouts(sim, START), SteppedRollouts(sim, START)
    assert isinstance(fast, CompiledRollouts)
    expected = slow.expected(commands, given)
    assert np.abs(expected - np.array(START)).max() > 0.1
    assert fast.expected(commands, given) == pytest.approx(expected, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize(
    ("members", "coordinates", "noisy", "central"),
    [
        (1, "displacement", True, False),
        (4, "twist-offset", False, False),
        (4, "twist-offset", True, False),
        (4, "twist-offset", True, True),
    ],
)
def test_drawn_paths_are_those_of_single_steps_with_the_same_draws(
    members, coordinates, noisy, central
):
    sim = simulator(members, coordinates, noisy=noisy, central=central)
    commands, given = plans(6, 5)
    fast = rollouts(sim, START)
    draws = fast.draw(9, 5, 3, (0.01, 0.05))
    paths = fast.drawn(commands, given, draws)
    assert paths.shape == (6, 9, 7, 3)
    for b in range(6):
        for r in range(9):
            assert paths[b, r] == pytest.approx(
                obvious(sim, commands[b], given[b], draws, r), rel=1e-8, abs=1e-8
            )


def obvious(sim, commands, given, draws, r):
    """One plan, one outcome, straight from the simulator's displacement and noise."""
    pose, before, poses, sent = draws.starts[r], (0.0, 0.0), [draws.starts[r]], 0
    for command, is_given in [*zip(commands, given, strict=True), ((0.0, 0.0, RUN_DOWN), True)]:
        if is_given:
            inputs = torch.tensor([[*before, *command]], dtype=torch.float64)
            moved = sim.displacement(inputs, int(draws.member[r]))
            moved = sim.disturbed(inputs, moved, torch.from_numpy(draws.kept[r, sent])[None])
            dx, dy, turn = moved[0].tolist()
            cos, sin = np.cos(pose[2]), np.sin(pose[2])
            pose = pose + np.array([cos * dx - sin * dy, sin * dx + cos * dy, turn])
            before, sent = command[:2], sent + 1
        poses.append(pose)
    return np.array(poses)


def test_outcomes_spread_as_the_steps_of_the_protocol_do():
    sim = simulator(3, "displacement")
    commands, given = plans(8, 3)
    commands, given = commands[4:5], np.ones((1, 3), bool)
    fast = rollouts(sim, START)
    fast = fast.drawn(commands, given, fast.draw(24_000, 3, 1, (0.003, 0.01)))[0]
    slow = SteppedRollouts(sim, START)
    slow = slow.drawn(commands, given, slow.draw(24_000, 3, 2, (0.003, 0.01)))[0]
    for quantile in (0.1, 0.5, 0.9):
        a, b = (np.quantile(paths[:, 1:], quantile, axis=0) for paths in (fast, slow))
        assert np.abs(a - b).max() < 0.1 * slow[:, 1:].std(axis=0).max() + 1e-3


def test_draws_are_the_same_for_the_same_seed_and_use_all_members_alike():
    fast = rollouts(simulator(4, "displacement"), START)
    a, b, c = (fast.draw(40, 3, seed, (0.003, 0.01)) for seed in (1, 1, 2))
    assert np.array_equal(a.kept, b.kept)
    assert not np.array_equal(a.kept, c.kept)
    assert np.bincount(a.member).tolist() == [10] * 4
    still = fast.draw(5, 3, 1, (0.0, 0.0))
    assert np.array_equal(still.starts, np.tile(START, (5, 1)))


def test_other_activations_go_through_the_protocol():
    sim = simulator(1, "displacement", noisy=False)
    curved = replace(sim.network, hidden_activation="tanh")
    sim = MotionNetwork(
        sim.inputs, curved, sim.genes, sim.input_scale, sim.output_scale, sim.coordinates
    )
    drives = rollouts(sim, START)
    assert isinstance(drives, SteppedRollouts)
    commands, given = plans(4, 3)
    starts = torch.tensor([START] * 4, dtype=torch.float64)
    expected = stepped(sim, starts, torch.from_numpy(commands), torch.from_numpy(given))
    assert drives.expected(commands, given) == pytest.approx(expected.numpy())
