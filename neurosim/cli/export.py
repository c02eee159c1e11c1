"""``neurosim export``: a simulator -> a program that needs no neurosim."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from neurosim.cli._common import emit, json_option
from neurosim.cli._types import PATH


@click.command()
@click.argument("simulator", type=PATH)
@click.option(
    "--to",
    type=click.Choice(["onnx", "torch"]),
    required=True,
    help="The form: onnx, float32, for onnxruntime (extra onnx); or torch, float64, for PyTorch's "
    "torch.export.load.",
)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the program.")
@json_option
def export(simulator: Path, to: Literal["onnx", "torch"], out: Path, as_json: bool) -> None:
    """Write the step of SIMULATOR as a program that runs without neurosim.

    Simulators that were learned from a recording can be exported, look-up tables and walking robots
    cannot. The README.md in the folder describes the program's inputs and outputs.
    """
    from neurosim.simulators.export import export as export_

    about = export_(simulator, out, to)
    emit(
        {"export": str(out), **about},
        as_json,
        f"{out / about['program']}: [rows, {len(about['state'])}] states and "
        f"[rows, {len(about['command'])}] commands in, states out, in {about['precision']}; "
        f"{out / 'README.md'} says how it is used.",
    )
