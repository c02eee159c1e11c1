"""A simulator exported to ONNX computes in onnxruntime the same as here (``make test-extras``)."""

import os

import pytest
import torch
from exported import drive, given, ours, printed_by_page, random_plans
from motion_networks import noise_model, random_motion_network

from neurosim.simulators.export import export

pytestmark = pytest.mark.skipif(
    not os.environ.get("NEUROSIM_EXTRAS"), reason="run by make test-extras, which installs onnx"
)

SIMULATORS = {
    "all": random_motion_network(1, noise=noise_model(1, size=-6.0)),
    "average": random_motion_network(2, central=False, swing=None, units=0, noise=False),
    "whole commands": random_motion_network(3, drives=False, members=1, central=False),
}


@pytest.fixture(scope="module", params=SIMULATORS)
def exported(request, tmp_path_factory):
    simulator = SIMULATORS[request.param]
    folder = tmp_path_factory.mktemp("made") / "program"
    export(simulator, folder, "onnx")
    return simulator, folder


def test_onnxruntime_is_near(exported):
    import onnxruntime

    simulator, folder = exported
    program = onnxruntime.InferenceSession(
        str(folder / "step.onnx"), providers=["CPUExecutionProvider"]
    )
    assert {one.type for one in program.get_inputs()} == {"tensor(float)"}

    def step(state, command, noise):
        rows = {"state": state.numpy(), "command": command.numpy()}
        if noise is not None:
            rows["noise"] = noise.numpy()
        return torch.from_numpy(program.run(None, rows)[0])

    for rows, parts in ((1, 1), (2, 3), (500, 1), (100, 7), (50, 20)):
        commands = random_plans(simulator, rows, steps=10, seed=parts, like=0.6)
        state, noise = given(simulator, commands)
        parts = 1 if simulator.drive is None else parts  # a step is a whole command
        expected = drive(ours(simulator), state, commands, noise, parts)
        driven = drive(step, state.float(), commands, noise, parts)
        assert torch.linalg.norm((driven - expected)[..., :2], dim=-1).max() < 1e-4
        assert (driven - expected)[..., 2].abs().max() < 1e-3


def test_the_page_runs_without_neurosim(exported):
    simulator, folder = exported
    highest = torch.tensor([ends[1] for ends in simulator.domain.values()], dtype=torch.float64)
    commands = torch.stack([0.5 * highest, 0.5 * highest, 0.25 * highest])
    expected = drive(ours(simulator), simulator.start(torch.zeros(1, 3)), commands[None])[0]
    torch.testing.assert_close(printed_by_page(folder), expected, rtol=0, atol=1e-4)


def test_nothing_of_this_machine_is_in_it(exported):
    _, folder = exported
    assert b"/neurosim" not in (folder / "step.onnx").read_bytes()
