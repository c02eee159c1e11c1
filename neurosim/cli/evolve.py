"""``neurosim evolve``: simulator -> controller."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from neurosim.cli._common import (
    PATH,
    Range,
    emit,
    json_option,
    next_step,
    placing_option,
    seed_option,
)


@click.command()
@click.argument("simulator", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new controller.")
@click.option("--task", "task_name", default="nine-rectangles", show_default=True)
@click.option("--commands", type=click.IntRange(min=1), default=10, show_default=True)
@click.option("--generations", type=click.IntRange(min=1), default=1000, show_default=True)
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
    help="Both are Table 1; with paper null commands come back where they are: stuck more often.",
)
@click.option("--population", type=click.IntRange(min=2), help="[250]")
@click.option("--tournament", type=click.IntRange(min=1), help="[50]")
@click.option("--crossover", type=click.FloatRange(0, 1), help="Probability.  [0.8]")
@click.option("--mutation", type=click.FloatRange(0, 1), help="Probability a gene.  [0.05]")
@click.option("--eta", type=click.FloatRange(min=0), help="Of the crossover.  [15]")
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
@click.option("--max-speed", default=50.0, show_default=True, help="In percent.")
@click.option("--durations", type=Range(), default="0.5..3", show_default=True, help="In s.")
@click.option("--all", "keep_all", is_flag=True, help="Keep every run's plan: OUT-01, OUT-02, ...")
@seed_option
@json_option
def evolve(
    simulator: Path,
    out: Path,
    task_name: str,
    commands: int,
    generations: int,
    runs: int,
    preset: str,
    robust: str | None,
    robust_generations: int,
    draws: int,
    placing: tuple[float, float],
    max_speed: float,
    durations: tuple[float, float],
    keep_all: bool,
    seed: int,
    as_json: bool,
    **genetic: Any,
) -> None:
    """Evolve a plan of motor commands in SIMULATOR (section 6.2 of Pretorius et al. 2009)."""
    from neurosim.tasks.evolve import evolve as evolve_
    from neurosim.tasks.planning import DEFAULT_GENETIC, PlanSettings, RobustSettings

    settings = PlanSettings(
        commands=commands,
        generations=generations,
        runs=runs,
        max_speed=max_speed,
        durations=durations,
        genetic=replace(
            DEFAULT_GENETIC,
            **{name: value for name, value in genetic.items() if value is not None},
        ),
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
