"""``neurosim evolve``: simulator -> controller."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import UserError
from neurosim.cli._common import (
    NUMBER,
    PATH,
    SHARE,
    NumberIn,
    Range,
    Resumable,
    emit,
    is_given,
    json_option,
    next_step,
    placing_option,
    seed_option,
)
from neurosim.cli._networks import evolve_network
from neurosim.cli._robots import khepera_or_virtual
from neurosim.cli.tables import arena_option, noise_option


@click.command(cls=Resumable, begun=lambda values: Checkpoint(values["out"], "evolution").options())
@click.argument("simulator", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new controller.")
@click.option("--task", "task_name", default="nine-rectangles", show_default=True)
@click.option("--commands", type=click.IntRange(min=1), default=10, show_default=True)
@click.option("--generations", type=click.IntRange(min=1), help="[1000; obstacle avoidance: 200]")
@click.option(
    "--runs",
    type=click.IntRange(min=1),
    default=10,
    show_default=True,
    help="Independent runs, evolved together; the best plan of all is kept.",
)
@click.option(
    "--settings",
    "preset",
    type=click.Choice(["default", "paper"]),
    default="default",
    show_default=True,
    help="paper is Table 1: a tournament of 50, and null commands come back where they are. It "
    "gets stuck twice as often.",
)
@click.option("--population", type=click.IntRange(min=2), help="[250; obstacle avoidance: 100]")
@click.option("--tournament", type=click.IntRange(min=1), help="[5; paper: 50]")
@click.option("--crossover", type=SHARE, help="Probability.  [0.8]")
@click.option("--mutation", type=SHARE, help="Probability a gene.  [0.05]")
@click.option("--eta", type=NumberIn(min=0), help="Of the crossover.  [15]")
@click.option(
    "--robust",
    is_flag=False,
    flag_value="probability",
    type=click.Choice(["probability", "fitness"]),
    help="Go on over drawn outcomes, for the probability of completing the course "
    "(alone: --robust=probability) or for the expected fitness.",
)
@click.option("--robust-generations", type=click.IntRange(min=1), default=300, show_default=True)
@click.option(
    "--draws", type=click.IntRange(min=1), default=32, show_default=True, help="Outcomes."
)
@placing_option
@click.option("--max-speed", type=NUMBER, default=50.0, show_default=True, help="In percent.")
@click.option("--durations", type=Range(), default="0.5..3", show_default=True, help="In s.")
@click.option(
    "--fitness",
    type=click.Choice(["avoidance", "cells"]),
    help="Obstacle avoidance: equation (1) of Lund and Miglino, or cells visited.  [avoidance]",
)
@click.option(
    "--steps", type=click.IntRange(min=1), help="Obstacle avoidance: of 100 ms in a trial.  [500]"
)
@click.option(
    "--starts",
    type=click.IntRange(min=1),
    help="Obstacle avoidance: random starts that share a trial's steps.  [5]",
)
@arena_option
@noise_option
@click.option(
    "--then-on-robot",
    type=click.IntRange(min=0),
    default=0,
    help="Obstacle avoidance: generations more, on the robot, which is left to itself.",
)
@khepera_or_virtual("Of --then-on-robot.", "Which virtual robot.")
@click.option("--all", "keep_all", is_flag=True, help="Keep every run's plan: OUT-01, OUT-02, ...")
@click.option(
    "--resume",
    is_flag=True,
    help="Obstacle avoidance: go on with an evolution that was interrupted, with its options.",
)
@seed_option
@json_option
def evolve(
    simulator: Path,
    out: Path,
    task_name: str,
    commands: int,
    generations: int | None,
    runs: int,
    preset: str,
    robust: str | None,
    robust_generations: int,
    draws: int,
    placing: tuple[float, float],
    max_speed: float,
    durations: tuple[float, float],
    fitness: str | None,
    steps: int | None,
    starts: int | None,
    arena_path: Path | None,
    noise: str | None,
    then_on_robot: int,
    robot: str,
    serial_port: str | None,
    dialect: str | None,
    baud: int | None,
    lab_seed: int,
    keep_all: bool,
    resume: bool,
    seed: int,
    as_json: bool,
    **genetic: Any,
) -> None:
    """Evolve a controller in SIMULATOR.

    For the nine rectangles a plan of motor commands (section 6.2 of Pretorius et al. 2009); for
    obstacle avoidance, in a simulator of tables, a network (Lund and Miglino 1996).
    """
    given = {name: value for name, value in genetic.items() if value is not None}
    for task, names in _OF_TASKS.items():
        if task != task_name:
            _refuse(names, f"is for --task {task}, not for {task_name}")
    if not then_on_robot:
        _refuse(_OF_ROBOT, "is of the generations on a robot: add --then-on-robot GENERATIONS")
    if task_name == "obstacle-avoidance":
        task = {"fitness": fitness, "steps": steps, "starts": starts}
        evolve_network(
            simulator,
            out,
            arena=arena_path,
            noise=noise,
            task={name: value for name, value in task.items() if value is not None},
            genetic=given if generations is None else {**given, "generations": generations},
            seed=seed,
            as_json=as_json,
            robot={
                "then_on_robot": then_on_robot,
                "robot": robot,
                "serial_port": serial_port,
                "dialect": dialect,
                "baud": baud,
                "lab_seed": lab_seed,
            },
            resume=resume,
        )
        return
    from neurosim.evolution import GeneticSettings
    from neurosim.evolve.plans import DEFAULT_GENETIC, PlanSettings, RobustSettings
    from neurosim.evolve.write_plans import evolve as evolve_

    settings = PlanSettings(
        commands=commands,
        generations=1000 if generations is None else generations,
        runs=runs,
        max_speed=max_speed,
        durations=durations,
        genetic=replace(GeneticSettings() if preset == "paper" else DEFAULT_GENETIC, **given),
        insertion=preset != "paper",
        robust=robust and RobustSettings(robust, robust_generations, draws),
        placing=(placing[0] / 1000.0, math.radians(placing[1])),
    )
    found = evolve_(simulator, out, task_name, settings, seed=seed, keep_all=keep_all)
    written = [folder for folder, _ in found] if keep_all else [out]
    best = found[0][1]
    complete = sum(plan.predicted["completes"] for _, plan in found)
    result = {
        "controllers": [str(path) for path in written],
        "fitness": best.predicted["fitness"],
        "completes": best.predicted["completes"],
        "probability": best.predicted.get("probability"),
        "commands": len(best.given),
        "runs": runs,
        "runs_that_complete": complete,
        "settings": asdict(settings),
    }
    verdict = "completes the course" if best.predicted["completes"] else "does not complete it"
    chance = ""
    if result["probability"] is not None:
        chance = f"Probability that the robot completes it: {100 * result['probability']:.1f} %.\n"
    emit(
        result,
        as_json,
        f"{written[0]}: {len(best.given)} commands, fitness {best.predicted['fitness']:.1f}, "
        f"{verdict} in the simulator; {complete} of {runs} runs found a plan that does.\n{chance}"
        + next_step("run", written[0], "--calibration", "calibration.json", "-o", "TRIAL"),
    )
    if best.evolution["interrupted"]:
        click.echo("neurosim: interrupted; the best plan so far is kept", err=True)
        click.get_current_context().exit(130)


#: Options that mean something to one task alone.
_OF_TASKS = {
    "nine-rectangles": (
        "commands", "runs", "preset", "tournament", "robust", "robust_generations", "draws",
        "placing", "max_speed", "durations", "keep_all",
    ),
    "obstacle-avoidance": (
        "fitness", "steps", "starts", "arena_path", "noise", "then_on_robot", "robot",
        "serial_port", "dialect", "baud", "lab_seed", "resume",
    ),
}  # fmt: skip
_OF_ROBOT = ("robot", "serial_port", "dialect", "baud", "lab_seed")


def _refuse(names: tuple[str, ...], why: str) -> None:
    for parameter in click.get_current_context().command.params:
        if parameter.name in names and is_given(parameter.name):
            raise UserError(f"{parameter.opts[0]} {why}")
