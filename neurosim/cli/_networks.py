"""``neurosim evolve --task obstacle-avoidance``: a network rather than a plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import UserError
from neurosim.cli._common import emit, given_options, next_step
from neurosim.cli._robots import khepera, virtual_khepera_baud


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
    robot: dict[str, Any],
    resume: bool,
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
        robot: options of the generations on a robot.
        resume: go on with an evolution that was interrupted.
    """
    from neurosim.evolve.evolve_networks import begun_with, evolve_networks
    from neurosim.evolve.network_evolution import NetworkSettings
    from neurosim.simulators import TableSimulator, read_simulator
    from neurosim.simulators.tables.arena import Arena
    from neurosim.tasks.base import make_task

    found = read_simulator(simulator)
    if not isinstance(found, TableSimulator):
        raise UserError(
            f"{simulator} has no sensors, which obstacle avoidance needs; make a simulator of "
            'samples with "neurosim tables"'
        )
    if arena is not None:
        found = found.changed(arena=Arena.read(arena))
    if noise is not None:
        found = found.changed(noise=noise)
    wanted, settings = make_task("obstacle-avoidance", **task), NetworkSettings(**genetic)
    if resume:
        # Said before a robot is looked for.
        begun = begun_with(
            found, wanted, settings, simulator, seed, robot["then_on_robot"], _describe(robot)
        )
        Checkpoint(out, "evolution").resume(begun)
    with _on_robot(robot, found, wanted, settings.population, seed) as then:
        made = evolve_networks(
            found,
            out,
            wanted,
            settings,
            source=simulator,
            seed=seed,
            resume=resume,
            options=given_options(),
            **then,
        )
    history, steps = made.evolution["history"], made.task["settings"]["steps"]
    result = {
        "controllers": [str(out)],
        "fitness": made.predicted["fitness"],
        "spread": made.predicted["spread"],
        "generations": len(history["best"]),
        "transfer": history.get("transfer"),
        "best": history["best"],
        "mean": history["mean"],
    }
    emit(
        result,
        as_json,
        f"{out}: fitness {made.predicted['fitness']:.0f} in {steps} steps of "
        f"{made.task['settings']['duration']:g} s (from trial to trial +- "
        f"{made.predicted['spread']:.0f}); the population's mean went from "
        f"{history['mean'][0]:.0f} to {history['mean'][-1]:.0f}.\n"
        + next_step("view", arena or simulator, "--controller", out, "-o", "path.png"),
    )
    if made.evolution["interrupted"]:
        click.echo(
            "neurosim: interrupted; the best network so far is kept, go on with --resume", err=True
        )
        click.get_current_context().exit(130)


#: Figure 4 compares this many seconds, from so many starts.
_SECONDS, _STARTS = 10.0, 2


def _describe(options: dict[str, Any]) -> dict[str, Any] | None:
    """Return what can be said of the robot before it is reached; None where none is to be."""
    if not options["then_on_robot"]:
        return None
    if options["robot"] == "khepera":
        return khepera(options).describe()
    baud, lab = virtual_khepera_baud(options), {"robot_seed": options["lab_seed"]}
    return {"kind": "khepera", "dialect": "khepera", "baud": baud, "virtual_lab": lab}


@contextmanager
def _on_robot(
    options: dict[str, Any], simulator: Any, task: Any, population: int, seed: int
) -> Iterator[dict]:
    """Give what evolve_networks needs to go on on a robot; nothing where it is not to."""
    options = dict(options)
    generations, kind = options.pop("then_on_robot"), options.pop("robot")
    lab_seed = options.pop("lab_seed")
    if not generations:
        yield {}
        return
    from neurosim.robots.odometry import Odometry
    from neurosim.trials.networks import RobotTrials

    arena = simulator.arena

    def settings(robot: Any, place: Callable, pose: Callable, **lab: Any) -> dict[str, Any]:
        trials = RobotTrials(robot, task, simulator.reaction.hold)
        if kind == "khepera":
            hours = generations * population * trials.seconds / 3600
            click.echo(
                f"{generations} generations of {population} trials of {trials.seconds:.0f} s on "
                f"the robot take {hours:.1f} h; what is interrupted goes on with --resume.",
                err=True,
            )

        def compare(genes: Any, simulated: Any) -> list[dict[str, list]]:
            steps = round(_SECONDS / task.duration)
            rng = np.random.default_rng([seed, 2])
            starts = arena.free_poses(_STARTS, simulated.simulator.radius, rng)
            paths = simulated.drive(genes[None], starts, steps=steps).poses[0]
            drives = []
            for start, path in zip(starts, paths, strict=True):
                trials.rest()
                place(start)
                real = trials.drive(genes, steps, pose(start))
                drives.append({"simulated": path.tolist(), "robot": real.poses.tolist()})
            robot.stop()
            return drives

        return {
            "on_robot": trials,
            "robot_generations": generations,
            "robot": {**robot.describe(), **lab},
            "compare": compare,
        }

    if kind == "khepera":
        robot = khepera(options)
        _same_line(simulator, robot.describe()["baud"])
        with robot:
            yield settings(robot, _ask, lambda start: Odometry(robot, start).read)
        return
    from neurosim.lab import LabArena, VirtualKheperaRig

    baud = virtual_khepera_baud(options)
    _same_line(simulator, baud)
    start = tuple(arena.free_poses(1, 0.03, np.random.default_rng(seed))[0])
    with (
        VirtualKheperaRig(
            lab_seed, noise_seed=seed, arena=LabArena.of(arena), start=start, baud=baud
        ) as rig,
        rig.robot as robot,
    ):
        yield settings(
            robot,
            lambda pose: rig.lab.place(*pose),
            lambda _: lambda: rig.lab.pose,
            virtual_lab=rig.describe(),
        )


def _same_line(simulator: Any, baud: int) -> None:
    """Refuse a robot on a line of another speed than the reaction time was measured on."""
    sampled = simulator.meta.get("baud")
    if sampled not in (None, baud):
        raise UserError(
            f"the simulator's reaction time was measured at {sampled} baud, and the robot's line "
            f"is at {baud}: give --baud {sampled}, or sample again at {baud}"
        )


def _ask(start: Any) -> None:
    x, y, theta = 100 * start[0], 100 * start[1], math.degrees(start[2])
    where = f"x {x:.1f} cm, y {y:.1f} cm, heading {theta:.0f} degrees"
    click.prompt(
        f"Put the robot at {where}, and press Enter",
        default="", show_default=False, err=True,
    )  # fmt: skip
