"""Compiles the functions that a demo needs later, while it records: runs all stages once, in small.

It runs in another process, ``python -m neurosim.cli._ahead``, which prints a line when the
functions of evolution are compiled. It ends with the process that started it, because its standard
input is then closed.
"""

from __future__ import annotations

import io
import os
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from neurosim.base.compiled import compiled_ahead

#: Number of commands that are learned from, a few more than the least.
COMMANDS = 30


def _end_with_parent() -> None:
    # Python cannot end while a thread holds the buffer of standard input.
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(1)


def _run(*words: object) -> None:
    from neurosim.cli.main import cli

    cli.main([str(word) for word in words], standalone_mode=False)


def main(evolved: Callable[[], None]) -> None:
    """Run the stages of a demo on a few commands.

    Args:
        evolved: called when the functions of evolution are compiled.
    """
    from neurosim.controllers import make_controller, read_controller
    from neurosim.lab import VirtualRig
    from neurosim.loop.replan import Replanner, ReplanSettings
    from neurosim.simulators import read_simulator
    from neurosim.tasks.registry import make_task
    from tracking.markers.markers import compile_loops

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset, simulator, controller = (folder / n for n in ("dataset", "simulator", "plan"))
        compile_loops()
        camera = folder / "calibration.json"
        with VirtualRig(0) as rig:
            rig.camera.optics.calibration.write(camera)
        words = ["record", folder / "recording", "--commands", COMMANDS, "--fps", 10]
        _run(*words, "--calibration", camera)
        _run("dataset", folder / "recording", "-o", dataset)
        _run("train", dataset, "-o", simulator)
        evolve = ["evolve", simulator, "--task", "nine-rectangles", "--robust", "-o", controller]
        _run(*evolve, "--generations", 2, "--robust-generations", 2, "--final-draws", 64)
        evolved()
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
    output, sys.stdout = sys.stdout, io.StringIO()  # not what commands print
    main(lambda: print("evolution", file=output, flush=True))
