"""From a simulator to controllers on disk."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from neurosim.base.errors import UserError
from neurosim.base.files import check_new_folder
from neurosim.controllers import Plan
from neurosim.evolve.plans import PlanResult, PlanSettings, evolve_plan
from neurosim.simulators.registry import read_simulator
from neurosim.simulators.sources import named
from neurosim.tasks.base import Task, make_task


def evolve(
    simulator: str | Path,
    out: str | Path,
    task: str | Task = "nine-rectangles",
    settings: PlanSettings | None = None,
    *,
    seed: int = 0,
    keep_all: bool = False,
    progress: bool = True,
) -> list[tuple[Path, Plan]]:
    """Evolve plans for a task in a simulator and write the best.

    Args:
        simulator: its folder.
        out: folder of the controller; with ``keep_all`` there is one for each run, OUT-01 and on.
        task: the task, or its name.
        settings: how to evolve.
        seed: of all that is drawn.
        keep_all: write the best plan of every run, not only the best of all.
        progress: whether to show progress on stderr.

    Returns:
        The best plan of every run, the best first, each with the folder it was written to (or
        would have been, without ``keep_all``).

    Raises:
        UserError: if the simulator or the task is not what it should be, or something stands at
            ``out``.
    """
    out, settings = Path(out), settings or PlanSettings()
    folders = [out.with_name(f"{out.name}-{run + 1:02d}") for run in range(settings.runs)]
    for folder in folders if keep_all else [out]:
        check_new_folder(folder)
    task = make_task(task) if isinstance(task, str) else task
    if not isinstance(task, Task):
        raise UserError(f"the task {task.name} takes a network, not a plan of commands")
    results = evolve_plan(read_simulator(simulator), task, settings, seed=seed, progress=progress)
    source = named(simulator)
    plans = [_plan(result, task, settings, seed, source) for result in results]
    if not plans[0].given:
        raise UserError("no plan that gives any command came of this; use more generations")
    if keep_all:
        for folder, plan in zip(folders, plans, strict=True):
            plan.write(folder)
    else:
        plans[0].write(out)
        folders = [out] * len(plans)
    return list(zip(folders, plans, strict=True))


def _plan(
    result: PlanResult, task: Task, settings: PlanSettings, seed: int, source: dict[str, Any]
) -> Plan:
    drawn = {}
    if result.probability is not None:
        drawn = {
            "probability": result.probability,
            "expected_fitness": result.expected_fitness,
            "draws": result.draws,
        }
    return Plan(
        commands=tuple(result.commands),
        task=task.describe(),
        start=task.start,
        predicted={
            "poses": result.poses.tolist(),
            "rest": result.rest.tolist(),
            "fitness": result.fitness,
            "completes": result.completes,
            **drawn,
        },
        simulator=source,
        evolution={
            "settings": asdict(settings),
            "seed": seed,
            "run": result.run,
            "interrupted": result.interrupted,
            "history": result.history,
        },
    )
