"""``neurosim evolve --task obstacle-avoidance``: a network rather than a plan."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import emit, next_step


def evolve_network(
    simulator: Path,
    out: Path,
    *,
    arena: Path | None,
    noise: str | None,
    task: dict[str, Any],
    genetic: dict[str, Any],
    seed: int,
    as_json: bool,
) -> None:
    """Evolve a network in a simulator of tables, write it and say how good it is.

    Args:
        simulator: folder.
        out: folder of the controller.
        arena: its file, in place of the simulator's own.
        noise: in place of the simulator's own.
        task: settings of the task that were given.
        genetic: settings of the evolution that were given.
        seed: of all that is drawn.
        as_json: whether to print JSON.
    """
    from neurosim.simulators import TableSimulator, read_simulator
    from neurosim.simulators.arena import Arena
    from neurosim.tasks.base import make_task
    from neurosim.tasks.network_evolution import NetworkSettings, evolve_networks

    found = read_simulator(simulator)
    if not isinstance(found, TableSimulator):
        raise UserError(
            f"{simulator} has no sensors, which obstacle avoidance needs; make a simulator of "
            'samples with "neurosim tables"'
        )
    known = [entry.name for entry in fields(NetworkSettings)]
    for name in genetic:
        if name not in known:
            raise UserError(f"--{name.replace('_', '-')} has no meaning for obstacle avoidance")
    if arena is not None:
        found = found.changed(arena=Arena.read(arena))
    if noise is not None:
        found = found.changed(noise=noise)
    made = evolve_networks(
        found,
        out,
        make_task("obstacle-avoidance", **task),
        NetworkSettings(**genetic),
        source=simulator,
        seed=seed,
    )
    history, steps = made.evolution["history"], made.task["settings"]["steps"]
    result = {
        "controllers": [str(out)],
        "fitness": made.predicted["fitness"],
        "spread": made.predicted["spread"],
        "generations": len(history["best"]),
        "best": history["best"],
        "mean": history["mean"],
    }
    emit(
        result,
        as_json,
        f"{out}: fitness {made.predicted['fitness']:.0f} in {steps} steps of "
        f"{made.task['settings']['duration']:g} s (from trial to trial +- "
        f"{made.predicted['spread']:.0f}); the population's mean rose from "
        f"{history['mean'][0]:.0f} to {history['mean'][-1]:.0f}.\n"
        + next_step("view", arena or simulator, "--controller", out, "-o", "path.png"),
    )
    if made.evolution["interrupted"]:
        click.echo("neurosim: interrupted; the best network so far is kept", err=True)
        click.get_current_context().exit(130)
