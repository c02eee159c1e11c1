"""A simulator's step as a program of PyTorch, and in float32, against ours."""

import json

import pytest
import torch
from click.testing import CliRunner
from exported import drive, given, ours, printed_by_page, random_plans
from motion_networks import drive_model, noise_model, random_motion_network
from simulators_of_tests import tables

from neurosim.base.errors import UserError
from neurosim.cli.main import cli
from neurosim.simulators.base import Simulator
from neurosim.simulators.export import export


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Export an ensemble with everything, and load its program, once."""
    simulator = random_motion_network(4, central=True, floor=True)
    folder = tmp_path_factory.mktemp("made") / "program"
    export(simulator, folder, "torch")
    return simulator, folder, torch.export.load(folder / "step.pt2").module()


@pytest.mark.parametrize("rows", [1, 2, 5, 64])
@pytest.mark.slow
def test_the_program_is_the_step(exported, rows):
    simulator, _, program = exported
    commands = random_plans(simulator, rows)
    state, noise = given(simulator, commands)
    for parts in (1, 3):
        expected = drive(ours(simulator), state, commands, noise, parts)
        driven = drive(program, state, commands, noise, parts)
        torch.testing.assert_close(driven, expected, rtol=0, atol=1e-12)


def test_a_step_multiplies_two_tensors_at_a_time(monkeypatch):
    """For three, opt_einsum (where it is installed, as by JAX) fixes the exported batch's size."""
    plain, factors = torch.einsum, []
    monkeypatch.setattr(
        torch, "einsum", lambda text, *of: factors.append(len(of)) or plain(text, *of)
    )
    simulator = random_motion_network(4, central=True, floor=True)
    commands = random_plans(simulator, 4)
    state, noise = given(simulator, commands)
    drive(ours(simulator), state, commands, noise)
    assert set(factors) == {2}


@pytest.mark.slow
def test_gradients_flow_through_the_program(exported):
    simulator, _, program = exported
    commands = random_plans(simulator, 4)
    state, noise = given(simulator, commands)
    slopes = []
    for step in (ours(simulator), program):
        free = commands.clone().requires_grad_()
        drive(step, state, free, noise)[:, -1].square().sum().backward()
        slopes.append(free.grad)
    assert slopes[0].abs().max() > 1e-4
    torch.testing.assert_close(*slopes)


@pytest.mark.slow
def test_the_page_runs_without_neurosim(tmp_path):
    # PyTorch reads the program of a robot without a delay in a third of the time.
    prompt = drive_model(5, delay=torch.zeros(1, dtype=torch.float64))
    simulator, folder = random_motion_network(5, drives=prompt), tmp_path / "program"
    export(simulator, folder, "torch")
    about = json.loads((folder / "export.json").read_text())
    assert about["state"] == list(simulator.state_names)
    assert [one["name"] for one in about["command"]] == list(simulator.command_names)
    highest = torch.tensor([one["highest"] for one in about["command"]], dtype=torch.float64)
    commands = torch.stack([0.5 * highest, 0.5 * highest, 0.25 * highest])
    start = simulator.start(torch.zeros(1, 3))
    result = printed_by_page(folder)
    expected = drive(ours(simulator), start, commands[None])[0]
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_one_network_of_whole_commands(tmp_path):
    plain = {"units": 0, "swing": None, "noise": False}
    simulator = random_motion_network(4, drives=False, members=1, central=False, **plain)
    export(simulator, tmp_path / "program", "torch")
    program = torch.export.load(tmp_path / "program" / "step.pt2").module()
    commands = random_plans(simulator, 7)
    state, _ = given(simulator, commands)
    driven = drive(lambda state, command, _: program(state, command), state, commands)
    expected = drive(ours(simulator), state, commands)
    torch.testing.assert_close(driven, expected, rtol=0, atol=1e-12)
    page = (tmp_path / "program" / "README.md").read_text()
    assert "noise" not in page.split("```")[0]
    assert "`pip install 'torch>=" in page  # a shell would read > as a file


@pytest.mark.slow
@pytest.mark.parametrize(
    "simulator",
    [
        random_motion_network(1, noise=noise_model(1, size=-6.0)),
        random_motion_network(2, central=False, swing=None, noise=noise_model(2, size=-6.0)),
        random_motion_network(3, drives=False, members=1, central=False, noise=False),
        random_motion_network(5, products=10, units=40, noise=False),
    ],
    ids=["all", "average", "whole commands", "large"],
)
@torch.no_grad()
def test_float32_is_near(simulator):
    commands = random_plans(simulator, 100, steps=10, like=0.6)
    state, noise = given(simulator, commands)
    single = simulator.for_export(torch.float32)
    for parts in (1,) if simulator.drive is None else (1, 2, 7):  # or a step is a whole command
        expected = drive(ours(simulator), state, commands, noise, parts)
        driven = drive(ours(single), state.float(), commands, noise, parts)
        assert torch.linalg.norm((driven - expected)[..., :2], dim=-1).max() < 1e-4
        assert (driven - expected)[..., 2].abs().max() < 1e-3
    assert simulator.genes.dtype == torch.float64  # the original is unchanged


@pytest.mark.slow
def test_a_step_of_ones_own(tmp_path):
    class Ideal(Simulator):
        kind, state_names, command_names = "ideal", ("x", "y", "theta"), ("v", "w")

        def start(self, pose, generator=None):
            return pose.to(torch.float64)

        def step(self, state, command, generator=None):
            x, y, theta = state.unbind(1)
            v, w = command.unbind(1)
            return torch.stack([x + v * theta.cos(), y + v * theta.sin(), theta + w], 1)

    with pytest.raises(UserError, match="kind ideal cannot be exported"):
        export(Ideal(), tmp_path / "no", "torch")

    class Traced(Ideal):
        def for_export(self, dtype):
            return self

    about = export(Traced(), tmp_path / "program", "torch")
    assert about["command"][0] == {"name": "v", "lowest": None, "highest": None}
    result = printed_by_page(tmp_path / "program")
    assert result[0].tolist() == [0.5, 0.0, 0.5]


def test_refusals_are_one_sentence(tmp_path):
    folder = tmp_path / "tables"
    folder.mkdir()
    tables().write(folder)
    out = tmp_path / "out"
    done = CliRunner().invoke(cli, ["export", str(folder), "--to", "torch", "-o", str(out)])
    assert isinstance(done.exception, UserError)
    assert "tables cannot be exported" in str(done.exception)
    assert not out.exists()
    with pytest.raises(UserError, match="no such simulator"):
        export(tmp_path / "nothing", out, "torch")
    (out / "something").mkdir(parents=True)
    with pytest.raises(UserError, match=r"out"):
        export(random_motion_network(1), out, "torch")
