"""``neurosim demo``: the whole road in the virtual lab."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path

import click

from neurosim.cli._common import PATH, seed_option


@click.command()
@click.argument("out", type=PATH, default=Path("demo"))
@click.option("--commands", type=int, default=400, show_default=True, help="To record.")
@click.option("--trainer", default="exponents", show_default=True)
@seed_option
@click.pass_context
def demo(ctx: click.Context, out: Path, commands: int, trainer: str, seed: int) -> None:
    """Walk the whole road in the virtual lab, from recording to trial, into the folder OUT.

    Every step is printed as the command that does it alone. A folder that is there already is
    kept, so that an interrupted demo goes on where it stopped.
    """
    began = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    photographs, calibration = out / "photographs", out / "calibration.json"
    recording, dataset, simulator = out / "recording", out / "dataset", out / "simulator"
    controller, trial, page = out / "controller", out / "trial", out / "report.html"
    points = photographs / "points.csv"
    record = ["record", recording, "--commands", commands, "--calibration", calibration]
    steps = [
        (photographs, ["lab", "photographs", photographs]),
        (
            calibration,
            ["calibrate", photographs, "--square", 40, "--points", points, "-o", calibration],
        ),
        (recording / "commands.csv", record),
        (recording / "poses.csv", ["track", recording]),
        (dataset, ["dataset", recording, "-o", dataset]),
        (simulator, ["train", dataset, "--trainer", trainer, "-o", simulator]),
        (None, ["evaluate", simulator, dataset]),
        (controller, ["evolve", simulator, "--task", "nine-rectangles", "-o", controller]),
        (trial / "trial.json", ["run", controller, "--calibration", calibration, "-o", trial]),
        (None, ["report", dataset, simulator, controller, trial, "-o", page]),
    ]
    for makes, words in steps:
        if makes is not None and makes.exists():
            continue
        words = [str(word) for word in words]
        if words[0] in ("record", "train", "evolve", "run"):
            words += ["--seed", str(seed)]
        click.secho(f"$ neurosim {shlex.join(words)}", bold=True)
        ctx.find_root().command.main(words, standalone_mode=False)
        click.echo()
    sys.stdout.flush()
    click.echo(f"The whole road took {time.monotonic() - began:.0f} s.")
