"""A simulator's step as a program that runs without neurosim, in the form of ONNX or PyTorch.

The program is only the simulator's :meth:`step`: state and command in, state out, for a batch of
any size. The ensemble's member is in the state, and noise is computed from given numbers. ONNX is
in float32, because its runtimes lack some functions in float64. PyTorch's is in float64, like the
simulator, and gradients flow through it.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from neurosim.base import files
from neurosim.base.errors import UserError
from neurosim.simulators.base import Simulator
from neurosim.simulators.registry import read_simulator
from neurosim.simulators.sources import named

FORMAT, VERSION = "neurosim-export", 1

#: File and precision of each form.
FORMS = {"onnx": ("step.onnx", "float32"), "torch": ("step.pt2", "float64")}

#: Rows of the batch with which a program is traced; no other size may have this number.
_ROWS = 5


class _Step(torch.nn.Module):
    def __init__(self, simulator: Simulator):
        super().__init__()
        self.simulator = simulator

    def forward(self, state: Tensor, command: Tensor, noise: Tensor | None = None) -> Tensor:
        given: dict[str, Any] = {} if noise is None else {"z": noise}
        return self.simulator.step(state, command, **given)


def export(
    simulator: str | Path | Simulator, out: str | Path, to: Literal["onnx", "torch"]
) -> dict[str, Any]:
    """Write a simulator's step as a program that needs no neurosim.

    The folder has the program (``step.onnx`` or ``step.pt2``), ``export.json``, which describes its
    inputs and outputs, and a ``README.md`` about its use.

    Args:
        simulator: a simulator, or its folder.
        out: the new folder.
        to: the form: onnx (float32, extra ``onnx``) or torch (``torch.export``, float64).

    Returns:
        The content of export.json.

    Raises:
        UserError: if this kind of simulator cannot be exported, a package is missing, or ``out``
            exists.
    """
    source: dict[str, Any] = {}
    if isinstance(simulator, str | Path):
        folder, simulator = simulator, read_simulator(simulator)
        source = named(folder)
    if to == "onnx":
        _check_installed()
    files.check_new_folder(out)
    name, precision = FORMS[to]
    program = trace(simulator.for_export(getattr(torch, precision)))
    about = describe(simulator, to, source)
    with files.new_folder(out) as partial:
        if to == "onnx":
            (partial / name).write_bytes(_onnx(program))
        else:
            with _quiet():
                torch.export.save(program, partial / name)
        files.write_json(partial / "export.json", FORMAT, VERSION, about)
        files.write_text(partial / "README.md", _page(about))
    return about


def trace(simulator: Simulator) -> torch.export.ExportedProgram:
    """Return the step of a simulator as a program of PyTorch, for batches of any size.

    Args:
        simulator: of :meth:`Simulator.for_export`.

    Raises:
        UserError: if ``torch.export`` cannot trace its step.
    """
    state = simulator.start(torch.zeros(_ROWS, 3))
    command = torch.ones(_ROWS, len(simulator.command_names)).to(state)
    given = [state, command]
    if simulator.noise_width:
        given.append(state.new_zeros(_ROWS, simulator.noise_width))
    rows = torch.export.Dim("rows", min=1)
    shapes = tuple({0: rows} for _ in given)
    try:
        with _quiet():
            program = torch.export.export(_Step(simulator), tuple(given), dynamic_shapes=shapes)
    except Exception as error:
        why = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(
            f"the step of this simulator ({simulator.kind}) cannot be exported: torch.export says: "
            f"{why}"
        ) from error
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)  # paths of this computer
    program._example_inputs = None  # it would be the only pickle in the file
    return program


def describe(
    simulator: Simulator, to: Literal["onnx", "torch"], source: dict[str, Any]
) -> dict[str, Any]:
    """Return the content of export.json: columns, units and limits of inputs and outputs.

    Args:
        simulator: the exported simulator.
        to: the form.
        source: name of its folder; may be empty.
    """
    name, precision = FORMS[to]
    domain = simulator.domain
    return {
        "program": name,
        "form": to,
        "precision": precision,
        "made_with": {"torch": str(torch.__version__)},
        "kind": simulator.kind,
        "state": list(simulator.state_names),
        "start": simulator.start(torch.zeros(1, 3))[0].tolist(),
        "command": [
            {
                "name": column,
                "lowest": _finite(domain.get(column, (-np.inf, np.inf))[0]),
                "highest": _finite(domain.get(column, (-np.inf, np.inf))[1]),
            }
            for column in simulator.command_names
        ],
        "noise": simulator.noise_width,
        "members": simulator.members,
        **({"simulator": source} if source else {}),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress PyTorch's warnings about its own internals."""
    log = logging.getLogger("torch")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _check_installed() -> None:
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError:
        raise UserError(
            "exporting to ONNX needs the packages onnx and onnxscript: pip install 'neurosim[onnx]'"
        ) from None


def _onnx(program: torch.export.ExportedProgram) -> bytes:
    """Return an ONNX model of a program, one file without notes on its making."""
    names = ["state", "command", "noise"]
    inputs = [spec for spec in program.graph_signature.user_inputs if spec is not None]
    with _quiet():
        made = torch.onnx.export(
            program,
            input_names=names[: len(inputs)],
            output_names=["next_state"],
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    assert made is not None
    model = made.model_proto
    for part in (model.graph.node, model.graph.input, model.graph.output, model.graph.value_info):
        for each in part:
            each.ClearField("metadata_props")
            each.ClearField("doc_string")
    return bytes(model.SerializeToString())


_LOADS = {
    "onnx": """import json

import numpy as np
import onnxruntime

about = json.load(open("export.json"))
program = onnxruntime.InferenceSession("step.onnx", providers=["CPUExecutionProvider"])


def step(state, command, noise=None):
    given = {"state": state, "command": command}
    if about["noise"]:
        zeros = np.zeros((len(state), about["noise"]), np.float32)
        given["noise"] = zeros if noise is None else noise
    return program.run(None, given)[0]


state = np.array([about["start"]], np.float32)  # a row a robot; x (m), y (m), heading (rad) first
for command in COMMANDS:
    state = step(state, np.array([command], np.float32))
    print(state[0, :3])
""",
    "torch": """import json

import torch

about = json.load(open("export.json"))
program = torch.export.load("step.pt2").module()


def step(state, command, noise=None):
    if about["noise"] and noise is None:
        noise = state.new_zeros(len(state), about["noise"])
    return program(state, command, *([noise] if about["noise"] else []))


# A row a robot; x (m), y (m), heading (rad) first.
state = torch.tensor([about["start"]], dtype=torch.float64)
for command in COMMANDS:
    state = step(state, torch.tensor([command], dtype=torch.float64))
    print(state[0, :3].tolist())
""",
}


def _page(about: dict[str, Any]) -> str:
    """Return the page for a program's folder."""
    columns = "\n".join(
        f"| `{one['name']}` | {_shown(one['lowest'])} | {_shown(one['highest'])} |"
        for one in about["command"]
    )
    # Half of the highest command, twice, and a quarter.
    full = [1.0 if one["highest"] is None else one["highest"] for one in about["command"]]
    commands = [[round(part * each, 6) for each in full] for part in (0.5, 0.5, 0.25)]
    packages = {"onnx": "numpy onnxruntime", "torch": f"'torch>={torch.__version__.split('+')[0]}'"}
    lines = [
        "# The step of a robot's simulator",
        "",
        f"`{about['program']}` predicts the state that a command leads to, in "
        f"{about['precision']}, for a batch of B robots. "
        f"It needs `pip install {packages[about['form']]}`, not neurosim.",
        "",
        "| input or output | shape | what |",
        "|---|---|---|",
        f"| `state` | [B, {len(about['state'])}] | {', '.join(about['state'])} |",
        f"| `command` | [B, {len(about['command'])}] | the columns below |",
    ]
    if about["noise"]:
        lines.append(
            f"| `noise` | [B, {about['noise']}] | standard normal numbers, new ones for each "
            "step; zeros: the expected motion |"
        )
    lines += [
        f"| returned | [B, {len(about['state'])}] | the state afterwards |",
        "",
        "x and y are in metres, theta is the heading in radians, counter-clockwise, not wrapped. "
        "A robot that stands still has the state `start` of `export.json`; its pose may be any. "
        "Give the other columns back as they were returned.",
    ]
    if about["members"] > 1:
        lines += [
            "",
            f"The simulator is an ensemble: `member` is 0 to {about['members'] - 1}, or -1 for "
            "the expected motion. It stays the same from start to end.",
        ]
    if "elapsed" in about["state"]:
        lines += [
            "",
            "A step may be any part of a command: the same command, given again, continues it.",
        ]
    else:
        lines += ["", "A step is a whole command."]
    lines += [
        "",
        "| command | lowest | highest that the robot was recorded with |",
        "|---|---|---|",
        columns,
        "",
        "A duration is in seconds. Commands outside of these limits are not refused: the answer is "
        "then a guess.",
        "",
        "```python",
        _LOADS[about["form"]].replace("COMMANDS", str(commands)).rstrip(),
        "```",
        "",
    ]
    return "\n".join(lines)


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:g}"
