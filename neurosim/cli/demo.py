"""``neurosim demo``: the whole pipeline in the virtual lab."""

from __future__ import annotations

import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from neurosim.base.compiled import compiled_ahead
from neurosim.base.errors import UserError
from neurosim.base.files import is_empty, read_json, write_json
from neurosim.base.formats import Demo
from neurosim.cli._common import is_given, seed_option
from neurosim.cli._types import PATH

#: Demos of version 1 recorded random commands, those of version 2 in rounds of 50.
FORMAT, VERSION = "neurosim-demo", 3


@click.command()
@click.argument("out", type=PATH, default=Path("demo"))
@click.option(
    "--commands",
    type=click.IntRange(50, 100_000),
    default=400,
    show_default=True,
    help="Number of commands to record.",
)
@seed_option
@click.pass_context
def demo(ctx: click.Context, out: Path, commands: int, seed: int) -> None:
    """Run the whole pipeline in the virtual lab, from recording to trial, into the folder OUT.

    Every step is printed as a command. Finished steps are kept: an interrupted demo continues where
    it stopped.
    """
    began = time.monotonic()
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; name a folder")
    commands, seed = _settings(out, commands, seed)
    with _compiling() as compiled:
        for words in _steps(out, commands, seed):
            text = [str(word) for word in words]
            if words[0] == "evolve":
                compiled()
            if words[0] == "report":
                click.echo(f"The pipeline took {time.monotonic() - began:.0f} s.\n")
            click.secho(f"$ neurosim {shlex.join(text)}", bold=True)
            ctx.find_root().command.main(text, standalone_mode=False)
            click.echo()


@contextmanager
def _compiling() -> Iterator[Callable[[], None]]:
    """Compile the functions of evolution in another process, if that was not done yet.

    Give a function that waits for it.
    """
    if compiled_ahead().exists():
        yield lambda: None
        return
    click.echo(
        "On the first run on a computer, the loops of later stages are compiled in another "
        "process; the result is kept.\n",
        err=True,
    )
    # It ends when its input is closed, however this process ends.
    process = subprocess.Popen(
        [sys.executable, "-m", "neurosim.cli._ahead"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )

    done = threading.Event()

    def listen() -> None:
        assert process.stdout is not None
        process.stdout.readline()  # or its end
        done.set()

    def wait() -> None:
        if not done.is_set():
            click.echo("Waiting until the loops of evolution are compiled.", err=True)
            while not done.wait(1.0):  # in parts, so that Ctrl-C is seen on Windows
                pass

    threading.Thread(target=listen, daemon=True).start()
    try:
        yield wait
    finally:
        process.kill()
        process.communicate()


def _steps(out: Path, commands: int, seed: int) -> Iterator[list[Any]]:
    """Give the commands that must still run, each after the ones before it are done."""
    from neurosim.recording.rounds import Rounds, is_whole

    photographs, calibration = out / "photographs", out / "calibration.json"
    recording, dataset, simulator = out / "recording", out / "dataset", out / "simulator"
    controller, page = out / "controller", out / "report.html"
    seeded = ["--seed", seed]
    if not photographs.exists():
        yield ["lab", "photographs", photographs]
    if not calibration.exists():
        points = photographs / "points.csv"
        yield ["calibrate", photographs, "--square", 40, "--points", points, "-o", calibration]
    size = min(100, commands // 3)
    if not is_whole(recording, Rounds(commands, size)):
        resume = ["--resume"] if (recording / "round-01").is_dir() else []
        words = ["record", recording, "--guided", "--commands", commands, "--round", size]
        # Half of the usual rate: most of the time goes into rendering and encoding frames.
        yield [*words, "--fps", 15, "--calibration", calibration, *seeded, *resume]
    if not dataset.exists():
        yield ["dataset", recording, "-o", dataset]
    if not simulator.exists():
        yield ["train", dataset, "-o", simulator, *seeded]
    yield ["evaluate", simulator, dataset]
    if not controller.exists():
        words = ["evolve", simulator, "--task", "nine-rectangles", "--robust", "-o", controller]
        yield [*words, *seeded]
    yield ["plan-check", controller, simulator]
    # Once in open loop, and once replanned after every command from where the robot is seen.
    trials = {out / "trial": [], out / "replanned": ["--replan"]}
    for trial, how in trials.items():
        if not (trial / "trial.json").exists():
            # An interrupted trial does not count; it is renamed and kept.
            if trial.exists():
                trial.rename(_free(out, f"interrupted-{trial.name}"))
            yield ["run", controller, *how, "--calibration", calibration, "-o", trial, *seeded]
    yield ["report", dataset, simulator, controller, *trials, "-o", page]


def _settings(out: Path, commands: int, seed: int) -> tuple[int, int]:
    """Return the options of an interrupted demo; at the beginning, save them."""
    path, now = out / "demo.json", {"commands": commands, "seed": seed}
    if not path.exists():
        if not is_empty(out):
            raise UserError(
                f"{out} is not empty and is not the folder of a demo; name a new folder"
            )
        write_json(path, FORMAT, VERSION, now)
        return commands, seed
    begun = read_json(path, FORMAT, VERSION, Demo, oldest=VERSION)
    for name, value in now.items():
        if is_given(name) and begun[name] != value:
            raise UserError(
                f"the demo in {out} was started with --{name} {begun[name]}, not {value}; use the "
                "same value, or name a new folder"
            )
    return begun["commands"], begun["seed"]


def _free(folder: Path, name: str) -> Path:
    number = 1
    while (path := folder / f"{name}-{number}").exists():
        number += 1
    return path
