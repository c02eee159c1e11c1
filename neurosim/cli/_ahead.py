"""Compiles the functions that a demo needs later, while it records: runs all stages once, in small.

It runs in another process, ``python -m neurosim.cli._ahead DEMO``. It ends with the process that
started it, because its standard input is then closed.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from neurosim.base.compiled import compiled_ahead
from tracking.datasets.recordings import Recording


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


def _run(*words: object) -> None:
    from neurosim.cli.main import cli

    cli.main([str(word) for word in words], standalone_mode=False)


def _is_whole(folder: Path) -> bool:
    """Return whether a recording is complete and tracked; its poses are written last."""
    return (folder / "poses.csv").exists() and bool(Recording(folder).meta["complete"])


def main(out: Path) -> None:
    """Run the stages of a demo on the first round of its recording, as soon as it exists."""
    from neurosim.controllers import make_controller, read_controller
    from neurosim.loop.replan import Replanner, ReplanSettings
    from neurosim.simulators import read_simulator
    from neurosim.tasks.registry import make_task
    from tracking.markers.markers import compile_loops

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset, simulator, controller = (folder / n for n in ("dataset", "simulator", "plan"))
        compile_loops()
        _run("record", folder / "recording", "--commands", 1)
        round_1 = out / "recording" / "round-01"
        while not _is_whole(round_1):
            time.sleep(0.5)
        _run("dataset", round_1, "-o", dataset)
        _run("train", dataset, "-o", simulator)
        evolve = ["evolve", simulator, "--task", "nine-rectangles", "--robust", "-o", controller]
        _run(*evolve, "--generations", 2, "--robust-generations", 2, "--final-draws", 64)
        _run("plan-check", controller, simulator, "--draws", 64)
        saved, model = read_controller(controller), read_simulator(simulator)
        task = make_task(saved.task)
        plan = make_controller("plan", model, task, slots=len(saved.commands))
        settings = ReplanSettings(generations=1)
        Replanner(model, task, plan, saved.commands, settings).next(np.array(saved.start))
    compiled_ahead().touch()


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if hasattr(os, "nice"):  # first the functions that the demo needs next
        os.nice(5)
    main(Path(sys.argv[1]))
