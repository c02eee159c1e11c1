"""Compiles the functions that a demo needs later, before it does: runs its stages, in small.

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

#: Number of rows that are learned from, a few more than the least.
ROWS = 30


def _end_with_parent() -> None:
    # Python cannot end while a thread holds the buffer of standard input.
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(1)


def _run(*words: object) -> None:
    from neurosim.cli.main import cli

    cli.main([str(word) for word in words], standalone_mode=False)


def _make_rows(out: Path) -> None:
    """Write a dataset of random commands that a robot on ideal wheels followed on a board."""
    from neurosim.base import se2
    from neurosim.base.commands import TWO_WHEELS
    from neurosim.base.perimeter import Perimeter
    from neurosim.robots.base import LIGHT_AHEAD, LIGHT_ASIDE
    from tracking.datasets.dataset import OUTPUTS, make
    from tracking.datasets.logs import inputs_of

    rng, wheels = np.random.default_rng(0), TWO_WHEELS.measured(full=0.5, track=0.13)
    given = rng.uniform((-50.0, -50.0, 0.5), (50.0, 50.0, 3.0), (ROWS, 3))
    inputs, duration, twist = inputs_of(wheels.units), given[:, 2], wheels.twist(given[:, :2])
    halfway, moved = (
        se2.exp(twist * time[:, None]) + rng.normal(0.0, 0.002, (ROWS, 3))
        for time in (duration / 2.0, duration)
    )
    rows = [
        {
            "recording": "made up",
            "command": number,
            "quality": 1.0,
            "start": rng.uniform(-0.5, 0.5, 3),
            "within": [{"time": duration[number] / 2.0, **dict(zip(OUTPUTS, half, strict=True))}],
            **dict(zip(inputs, (*given[number - 1, :2], *given[number]), strict=True)),
            **dict(zip(OUTPUTS, end, strict=True)),
        }
        for number, (half, end) in enumerate(zip(halfway, moved, strict=True))
    ]
    lights = tuple((LIGHT_AHEAD, side) for side in (LIGHT_ASIDE, -LIGHT_ASIDE))
    perimeter = Perimeter(sensors=lights).describe()
    about = {"sources": [], "left_out": {}, "settings": {}, "perimeter": perimeter}
    make(rows, inputs, **about).write(out)


def main(evolved: Callable[[], None]) -> None:
    """Film the virtual robot once, and run the stages of a demo after its recording on a few rows.

    Args:
        evolved: called when the functions of evolution are compiled.
    """
    from neurosim.controllers import make_controller, read_controller
    from neurosim.lab import CameraParams
    from neurosim.lab.camera.camera import RoofCamera
    from neurosim.loop.replan import Replanner, ReplanSettings
    from neurosim.simulators import read_simulator
    from neurosim.tasks.registry import make_task
    from tracking.markers.markers import compile_loops

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset, simulator, controller = (folder / n for n in ("dataset", "simulator", "plan"))
        compile_loops()
        RoofCamera(CameraParams(size=(320, 240)), 0).render(np.zeros(3))
        _make_rows(dataset)
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
