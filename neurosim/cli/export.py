"""``neurosim export``: a simulator, a recording or a trial in the format of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import click

from neurosim.base.declared import Fps
from neurosim.base.errors import UserError, counted
from neurosim.cli._common import emit, is_given, json_option
from neurosim.cli._types import PATH, ranged


@click.command()
@click.argument("source", nargs=-1, required=True, type=PATH)
@click.option(
    "--to",
    type=click.Choice(["onnx", "torch", "lerobot", "rerun"]),
    required=True,
    help="The format. Of a simulator: onnx, float32, for onnxruntime (extra onnx); or torch, "
    "float64, for PyTorch's torch.export.load. Of recordings: lerobot (extra lerobot). Of a trial: "
    "rerun (extra rerun).",
)
@click.option("-o", "--out", type=PATH, required=True, help="New folder; of rerun a file, .rrd.")
@click.option(
    "--fps",
    type=ranged(Fps),
    help="lerobot: frames a second, a whole number.  [default: as the camera filmed]",
)
@json_option
def export(
    source: tuple[Path, ...],
    to: Literal["onnx", "torch", "lerobot", "rerun"],
    out: Path,
    fps: float | None,
    as_json: bool,
) -> None:
    """Write SOURCE in a format that other programs read.

    onnx and torch: the step of one simulator as a program that runs without neurosim. Simulators
    that were learned from a recording can be exported, look-up tables and walking robots cannot.
    The README.md in the folder describes the program's inputs and outputs.

    lerobot: recordings, also guided ones, as a dataset of LeRobot v3.0, in Parquet and MP4.

    rerun: one trial for the viewer of rerun. With the trial's simulator and controller after it,
    random samples are shown, too.
    """
    if is_given("fps") and to != "lerobot":
        raise UserError("--fps is for --to lerobot: leave it out")
    if to == "lerobot":
        result, text = _lerobot(source, out, fps)
    elif to == "rerun":
        from neurosim.reports.rerun import export_rerun

        result = export_rerun(source[0], out, source[1:])
        text = (
            f"{out}: {counted(result['frames'], 'frame')}, {counted(result['samples'], 'sample')}"
        )
    else:
        if len(source) > 1:
            raise UserError(f"--to {to} takes one simulator")
        from neurosim.simulators.export import export as export_

        result = export_(source[0], out, to)
        text = (
            f"{out / result['program']}: [rows, {len(result['state'])}] states and "
            f"[rows, {len(result['command'])}] commands in, states out, in {result['precision']}; "
            f"{out / 'README.md'} says how it is used."
        )
    emit({"export": str(out), **result}, as_json, text)


def _lerobot(source: tuple[Path, ...], out: Path, fps: float | None) -> tuple[dict[str, Any], str]:
    from neurosim.recording.rounds import parts_of
    from tracking.datasets.lerobot import export_lerobot

    if fps is not None and not fps.is_integer():
        raise UserError(f"--fps is a whole number, not {fps:g}")
    folders = [part for folder in source for part in parts_of(folder)]
    result = export_lerobot(folders, out, None if fps is None else int(fps))
    return result, (
        f"{out}: {counted(result['episodes'], 'episode')}, "
        f"{result['frames']} frames at {result['fps']} a second"
    )
