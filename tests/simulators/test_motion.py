import json
import math

import numpy as np
import pytest
import torch
from motion_networks import random_motion_network

from neurosim.base import se2
from neurosim.base.errors import FileError
from neurosim.networks import ProductSummationNetwork, Weights
from neurosim.simulators import MotionNetwork, Simulator, read_simulator
from neurosim.simulators.motion.files import write_motion

MOTORS = [
    {"name": name, "unit": unit}
    for name, unit in {
        "prev_left": "%",
        "prev_right": "%",
        "left": "%",
        "right": "%",
        "duration": "s",
    }.items()
]
SMALL = ProductSummationNetwork(5, 2, 1)


def random_network(seed=0, **more):
    g = torch.Generator().manual_seed(seed)
    genes = 0.3 * torch.randn(3, SMALL.genes, generator=g, dtype=torch.float64)
    scale = torch.tensor([50.0, 50.0, 50.0, 50.0, 3.0])
    return MotionNetwork(MOTORS, SMALL, genes, scale, torch.tensor([0.2, 0.1, 1.0]), **more)


def straight_ahead():
    """dx = 0.001 * left * duration, worked by hand; dy = 0, dtheta = 0.01 * right."""
    network = ProductSummationNetwork(5, 1, 1)
    weights = Weights(
        exponents=torch.tensor([[[0.0, 0.0, 1.0, 0.0, 1.0]]] * 3),
        product_weights=torch.tensor([[1.0], [0.0], [0.0]]),
        summation=torch.tensor([[[0.0] * 5]] * 2 + [[[0.0, 0.0, 0.0, 1.0, 0.0]]]),
        summation_bias=torch.zeros(3, 1),
        summation_weights=torch.ones(3, 1),
        bias=torch.zeros(3),
    )
    return MotionNetwork(
        MOTORS,
        network,
        network.join(weights),
        torch.tensor([50.0, 50.0, 50.0, 50.0, 2.0]),
        torch.tensor([0.1, 1.0, 0.5]),
    )


def test_it_is_a_simulator_whose_state_remembers_the_last_command():
    simulator = random_network()
    assert isinstance(simulator, Simulator)
    assert simulator.state_names == ("x", "y", "theta", "prev_left", "prev_right")
    assert simulator.command_names == ("left", "right", "duration")
    state = simulator.start(torch.tensor([[1.0, 2.0, 3.0]]))
    assert state.tolist() == [[1.0, 2.0, 3.0, 0.0, 0.0]]
    state = simulator.step(state, torch.tensor([[30.0, -20.0, 1.5]], dtype=torch.float64))
    assert state[0, 3:].tolist() == [30.0, -20.0]


def test_a_step_worked_by_hand():
    # Facing +y at (1, 1): 25 % for 1 s is dx = 0.1 * 0.5 * 0.5; 10 % turns by 0.5 * 0.2.
    simulator = straight_ahead()
    state = simulator.start(torch.tensor([[1.0, 1.0, math.pi / 2]], dtype=torch.float64))
    state = simulator.step(state, torch.tensor([[25.0, 10.0, 1.0]], dtype=torch.float64))
    expected = [1.0, 1.025, math.pi / 2 + 0.1, 25.0, 10.0]
    assert state[0].tolist() == pytest.approx(expected)


def test_a_batch_is_its_rows_and_nothing_is_remembered_outside_the_state():
    simulator = random_network()
    g = torch.Generator().manual_seed(1)
    state = torch.randn(20, 5, generator=g, dtype=torch.float64)
    command = torch.randn(20, 3, generator=g, dtype=torch.float64)
    together = simulator.step(state, command)
    for n in reversed(range(20)):
        alone = simulator.step(state[n : n + 1], command[n : n + 1])
        torch.testing.assert_close(alone, together[n : n + 1])


def test_inputs_may_stand_in_any_order():
    simulator = random_network()
    order = [4, 2, 0, 3, 1]
    w = SMALL.split(simulator.genes[0])
    shuffled = MotionNetwork(
        [MOTORS[i] for i in order],
        SMALL,
        SMALL.join(
            w._replace(exponents=w.exponents[..., order], summation=w.summation[..., order])
        ),
        simulator.input_scale[order],
        simulator.output_scale,
    )
    assert shuffled.command_names == ("duration", "left", "right")
    assert shuffled.state_names[3:] == ("prev_left", "prev_right")
    state = torch.tensor([[0.0, 0.0, 1.0, 10.0, -20.0]], dtype=torch.float64)
    a = simulator.step(state, torch.tensor([[30.0, 5.0, 1.5]], dtype=torch.float64))
    b = shuffled.step(state, torch.tensor([[1.5, 30.0, 5.0]], dtype=torch.float64))
    torch.testing.assert_close(a, b)


def test_what_departs_from_the_drive_model_is_added_to_the_twist_of_its_last_piece():
    simulator = random_motion_network(noise=False)
    inputs = torch.tensor([[10.0, -20.0, 30.0, 40.0, 2.0]], dtype=torch.float64)
    x = simulator.scaled(inputs)
    outputs = simulator.outputs(inputs)[0, 1].numpy()
    time = torch.tensor([2.0], dtype=torch.float64)
    drive = simulator.drive
    changing, steady = drive.phases(drive.begun(x[:, :2]), x[:, 2:4], time)
    rest = se2.exp(steady[0].numpy() + outputs * 2.0 / 3.0)
    expected = se2.compose(changing[0].numpy(), rest)
    np.testing.assert_allclose(simulator.displacement(inputs, 1)[0], expected, atol=1e-12)


@pytest.fixture
def folder(tmp_path):
    write_motion(random_network(meta={"training": {"seed": 7}}), tmp_path)
    return tmp_path


def test_what_was_written_is_read(folder):
    written, read = random_network(), read_simulator(folder)
    assert isinstance(read, MotionNetwork)
    inputs = torch.tensor([[10.0, -20.0, 30.0, 40.0, 2.0]], dtype=torch.float64)
    assert torch.equal(written.displacement(inputs), read.displacement(inputs))
    assert read.inputs == MOTORS
    assert read.meta == {"training": {"seed": 7}}


def edit(folder, **changes):
    path = folder / "simulator.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"version": 99}, "version"),
        ({"kind": "crystal-ball"}, "crystal-ball"),
        ({"format": "neurosim-dataset"}, "neurosim-simulator"),
        ({"inputs": ["left"]}, "inputs"),
        ({"inputs": [*MOTORS, {"name": "gear"}]}, "expected shape"),
        ({"inputs": [{"name": "prev_gear"}, *MOTORS[1:]]}, "prev_gear"),
        ({"coordinates": "polar"}, "coordinates"),
        # Files of simulators from before drive models existed.
        (
            {"coordinates": "twist-offset"},
            "'coordinates': expected .*'twist-offset'",
        ),
        ({"network": {"neurons": 3}}, "network"),
        ({"network": {"products": 2, "summations": 3}}, "expected shape"),
    ],
)
def test_a_wrong_description_is_refused_by_name(folder, changes, says):
    edit(folder, **changes)
    with pytest.raises(FileError, match=says):
        read_simulator(folder)


def test_a_missing_folder_or_file_is_refused(folder, tmp_path):
    with pytest.raises(FileError, match="no such simulator"):
        read_simulator(tmp_path / "nowhere")
    (folder / "weights.safetensors").unlink()
    with pytest.raises(FileError, match=r"weights\.safetensors: no such file"):
        read_simulator(folder)


@pytest.mark.parametrize("name", ["weights.safetensors", "simulator.json"])
def test_a_file_cut_in_half_is_refused(folder, name):
    path = folder / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(FileError, match="cut short"):
        read_simulator(folder)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("genes", math.nan, "not finite"),
        ("output_scale", math.inf, "not finite"),
        ("input_scale", 0.0, "above 0"),
    ],
)
def test_weights_that_cannot_be_are_refused(folder, name, value, says):
    simulator = random_network()
    getattr(simulator, name).view(-1)[0] = value
    write_motion(simulator, folder)
    with pytest.raises(FileError, match=says):
        read_simulator(folder)
