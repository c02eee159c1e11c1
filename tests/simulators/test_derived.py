import json
import math

import numpy as np
import pytest
import torch

from neurosim.base.errors import FileError
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.simulators.motion.derived import Derived, can_swing
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.motion.kernels import network_inputs
from neurosim.simulators.motion.noise import CommandFeatures

NAMES = ("prev_left", "prev_right", "left", "right", "duration")
SCALE = [50.0, 50.0, 50.0, 50.0, 3.0]
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
    ((10, 10, 1, 1), 0.0),  # within the dead zone
]


def simulator(derived, dead_zone=0.05):
    network = ProductSummationNetwork(5 + len(derived), 4, 1)
    genes = 0.3 * torch.randn(3, network.genes, generator=torch.Generator().manual_seed(3))
    zone = torch.tensor([dead_zone] * 4 + [0.0])
    inputs = [{"name": name, "unit": ""} for name in NAMES]
    scale, one = torch.tensor(SCALE), torch.ones(3)
    return MotionNetwork(inputs, network, genes, scale, one, dead_zone=zone, derived=derived)


@pytest.mark.parametrize(("speeds", "turns"), CHANGES)
def test_the_change_of_direction_in_half_turns(speeds, turns):
    inputs = torch.tensor([[*speeds, 1.0]], dtype=torch.float64)
    given = simulator(Derived(True, 0.03)).network_inputs(inputs)
    assert given.shape == (1, 7)
    assert given[0, 6].item() == pytest.approx(turns, abs=1e-12)
    mirrored = simulator(Derived(swing=-0.03)).network_inputs(inputs)
    assert mirrored[0, 5].item() == pytest.approx(1.0 if turns == -1.0 else turns, abs=1e-12)


def test_to_creep_within_the_dead_zone_is_not_to_stop():
    given = simulator(Derived(moving=True)).network_inputs(
        torch.tensor([[30.0, 30.0, 1.0, 0.0, 1.0], [30.0, 30.0, 0.0, 0.0, 1.0]])
    )
    assert given[:, 2:4].tolist() == [[0.0, 0.0], [0.0, 0.0]]
    assert given[:, 5].tolist() == [1.0, 0.0]


@pytest.mark.parametrize("derived", [Derived(), Derived(True), Derived(True, -0.03)])
def test_the_compiled_form_agrees(derived):
    sim = simulator(derived)
    arrays = sim.arrays()
    rows = [[*speeds, 0.5] for speeds, _ in CHANGES]
    rows += np.random.default_rng(0).uniform(-50, 50, (50, 5)).tolist()
    inputs = torch.tensor(rows, dtype=torch.float64)
    expected, found = sim.network_inputs(inputs).numpy(), np.empty(5 + len(derived))
    for n, row in enumerate(inputs.numpy()):
        network_inputs(arrays, row, found)
        assert found == pytest.approx(expected[n], abs=1e-12)


def test_written_and_read(tmp_path):
    sim = simulator(Derived(True, 0.03))
    write_motion(sim, tmp_path)
    again = read_simulator(tmp_path)
    assert again.derived == sim.derived
    assert Derived.of(sim.derived.tensor()) == sim.derived
    inputs = torch.tensor([[10.0, 20.0, -30.0, 5.0, 1.0]], dtype=torch.float64)
    assert torch.equal(again.displacement(inputs), sim.displacement(inputs))


@pytest.mark.parametrize("wrong", [{"swing": "left"}, {"moving": 1}, {"swing": 2.0}, {"more": 1}])
def test_a_wrong_description_is_refused(tmp_path, wrong):
    write_motion(simulator(Derived(True, 0.03)), tmp_path)
    path = tmp_path / "simulator.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(content | {"derived": wrong}), encoding="utf-8")
    with pytest.raises(FileError, match="'derived': expected moving"):
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
