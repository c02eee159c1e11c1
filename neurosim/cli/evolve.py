"""``neurosim evolve``: simulator -> controller."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import click

from neurosim.cli._common import PATH, Range, emit, json_option, seed_option


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
@click.option("--population", type=click.IntRange(min=2), default=250, show_default=True)
@click.option("--tournament", type=click.IntRange(min=1), default=50, show_default=True)
@click.option("--crossover", type=click.FloatRange(0, 1), default=0.8, show_default=True)
@click.option("--mutation", type=click.FloatRange(0, 1), default=0.05, show_default=True)
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
    population: int,
    tournament: int,
    crossover: float,
    mutation: float,
    max_speed: float,
    durations: tuple[float, float],
    keep_all: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Evolve a plan of motor commands in SIMULATOR (section 6.2 of Pretorius et al. 2009)."""
    from neurosim.tasks.evolve import evolve as evolve_
    from neurosim.tasks.planning import PlanSettings

    settings = PlanSettings(
        commands=commands,
        generations=generations,
        runs=runs,
        max_speed=max_speed,
        durations=durations,
    )
    settings = replace(
        settings,
        genetic=replace(
            settings.genetic,
            population=population,
            tournament=tournament,
            crossover=crossover,
            mutation=mutation,
        ),
    )
    found = evolve_(simulator, out, task_name, settings, seed=seed, keep_all=keep_all)
    written = [folder for folder, _ in found] if keep_all else [out]
    best = found[0][1]
    complete = sum(plan.predicted["completes"] for _, plan in found)
    result = {
        "controllers": [str(path) for path in written],
        "fitness": best.predicted["fitness"],
        "completes": best.predicted["completes"],
        "commands": len(best.given),
        "runs": runs,
        "runs_that_complete": complete,
        "settings": asdict(settings),
    }
    verdict = "completes the course" if best.predicted["completes"] else "does not complete it"
    emit(
        result,
        as_json,
        f"{written[0]}: {len(best.given)} commands, fitness {best.predicted['fitness']:.1f}, "
        f"{verdict} in the simulator; so do {complete} of {runs} runs.\n"
        f"Next: neurosim run {written[0]} -o TRIAL",
    )
