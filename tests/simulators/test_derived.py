import json
import math
import re

import numpy as np
import pytest
import torch
from motion_networks import NAMES, random_motion_network
from numba import njit

from neurosim.base.errors import FileError
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.simulators.motion import kernels
from neurosim.simulators.motion.derived import Derived, can_swing
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.motion.noise import DRAWS, CommandFeatures

#: Inputs, and by how many half turns the direction changes where a reversal may be short of 0.03.
CHANGES = [
    ((10, 10, 40, 40), 0.0),
    ((10, 10, -5, 5), 0.5),  # from straight ahead to a turn to the left on the spot
    ((10, 10, 5, -5), -0.5),
    ((10, 0, 10, 10), 0.25),
    ((10, 10, -20, -20), -1.0),  # a reversal counts to the right
    ((-20, -20, 10, 10), -1.0),
    ((0, 10, 0, -10), -1.0),
    ((0, 0, 10, 10), 0.0),
    ((10, 10, 0, 0), 0.0),
    ((10, 10, 1, 1), 0.0),  # within the dead band
]


@njit
def inputs_of(model, state, command, memory, began, x):
    """Write the inputs of the compiled networks; return whether the previous command continues."""
    same = kernels._inputs(model, state, command, memory, began, x)
    kernels.swung(model, x)
    return same


def given(sim, inputs):
    """Return the scaled inputs of the networks."""
    return sim.derived.append(sim.columns, sim.scaled(inputs))


@pytest.mark.parametrize(("speeds", "turns"), CHANGES)
def test_the_change_of_direction_in_half_turns(speeds, turns):
    inputs = torch.tensor([[*speeds, 1.0]], dtype=torch.float64)
    driven = given(random_motion_network(swing=0.03, drives=False), inputs)
    assert driven.shape == (1, 6)
    assert driven[0, 5].item() == pytest.approx(turns, abs=1e-12)
    mirrored = given(random_motion_network(swing=-0.03, drives=False), inputs)
    assert mirrored[0, 5].item() == pytest.approx(1.0 if turns == -1.0 else turns, abs=1e-12)


@pytest.mark.parametrize("swing", [None, 0.03, -0.03])
@pytest.mark.slow
def test_the_compiled_form_agrees(swing):
    sim = random_motion_network(swing=swing, drives=False)
    model = sim.compiled()
    rows = [[*speeds, 0.5] for speeds, _ in CHANGES]
    rows += np.random.default_rng(0).uniform(-50, 50, (50, 5)).tolist()
    expected = given(sim, torch.tensor(rows, dtype=torch.float64)).numpy()
    for row, wanted in zip(np.array(rows), expected, strict=True):
        state, out = np.array([0.0, 0.0, 0.0, *row[:2]]), np.empty(len(wanted))
        assert not inputs_of(model, state, row[2:], np.empty(7), np.empty(0), out)
        assert out == pytest.approx(wanted, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("swing", [None, 0.03])
def test_the_compiled_form_agrees_beside_a_drive_model(swing):
    """The speeds before are those with which the command began."""
    sim = random_motion_network(swing=swing)
    model, start = sim.compiled(), 3 + 3 * 2 + 1 + 3 + DRAWS
    inputs = np.random.default_rng(0).uniform((-50, -50, 0.05), (50, 50, 0.4), (40, 3))
    inputs[::5, :2] = 0.0
    state = sim.start(torch.zeros(1, 3))
    for command in inputs:
        before = state[0].numpy().copy()
        state = sim.step(state, torch.from_numpy(command[None]))
        speeds, driven = state[0, start : start + 2], torch.from_numpy(command[None, :2])
        x = torch.cat([speeds, sim._speeds(driven)[0], state[0, 9:10] / sim.longest])
        out = np.empty(5 + len(sim.derived))
        began = np.empty((2 + model.slots) * 2 + model.slots)
        assert not inputs_of(model, before, command, np.empty(7), began, out)
        wanted = sim.derived.append(sim.columns, x[None])[0]
        assert out == pytest.approx(wanted.numpy(), abs=1e-12)


def test_written_and_read(tmp_path):
    sim = random_motion_network(swing=0.03)
    write_motion(sim, tmp_path)
    again = read_simulator(tmp_path)
    assert again.derived == sim.derived == Derived(0.03)
    inputs = torch.tensor([[10.0, 20.0, -30.0, 5.0, 1.0]], dtype=torch.float64)
    assert torch.equal(again.displacement(inputs), sim.displacement(inputs))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (
            {"swing": "left"},
            "'derived.swing': expected a number above -1, up to 0.999999999999, found 'left'",
        ),
        (
            {"moving": False, "swing": 0.03},
            "'derived.moving': is not a field here",
        ),
        (
            {"swing": 2.0},
            "'derived.swing': expected a number above -1, up to 0.999999999999, found 2.0",
        ),
        ({"more": 1}, "'derived.more': is not a field here"),
        (0.03, "'derived': expected an object, found 0.03"),
    ],
)
def test_a_wrong_description_is_refused(tmp_path, wrong, says):
    write_motion(random_motion_network(), tmp_path)
    path = tmp_path / "simulator.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(content | {"derived": wrong}), encoding="utf-8")
    with pytest.raises(FileError, match=re.escape(says)):
        read_simulator(tmp_path)


def test_there_is_no_swing_where_directions_are_not_remembered():
    assert can_swing(CommandFeatures.of(NAMES))
    assert not can_swing(CommandFeatures.of(("left", "right", "duration")))
    network = ProductSummationNetwork(4, 1, 1)
    inputs = [{"name": name, "unit": ""} for name in NAMES[2:]]
    genes = torch.zeros(3, network.genes)
    with pytest.raises(ValueError, match="swing"):
        MotionNetwork(
            inputs, network, genes, torch.ones(3), torch.ones(3), derived=Derived(swing=math.pi / 9)
        )
