"""``neurosim evolve``: simulator -> controller."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import UserError
from neurosim.cli._common import (
    PATH,
    Resumable,
    emit,
    given_options,
    json_option,
    next_step,
    placing_option,
    seed_option,
)
from neurosim.cli._settings import DynamicCommand, given_of, options_of

_SKIP = ("optimiser", "genetic", "robust", "placing", "insertion")


def _settings_options(values: Mapping[str, str]) -> Sequence[click.Parameter]:
    """Return the options of the task, the controller and the algorithm that are asked for."""
    from neurosim.cli._tasks import read_task
    from neurosim.controllers import CONTROLLERS, Controller, FixedPlan
    from neurosim.loop.settings import default_settings

    try:
        cls, settings = read_task(values["task"])
        task = cls(**settings)
        kind = values["controller"] or ("network" if task.episode.readings else "plan")
        controller = CONTROLLERS.get(kind)
    except (UserError, TypeError):
        return []  # the command itself says what is wrong
    blind = bool(getattr(controller, "blind", False))
    how = default_settings(FixedPlan(()) if blind else Controller(), task)
    hidden = ("parents",) if blind else ("tournament",)
    found = [
        *options_of(how, skip=(*_SKIP, *(("outcomes", "selection") if blind else ("runs",)))),
        *options_of(how.genetic, skip=hidden),
        *options_of(controller, names={"slots": "commands"}),
        *options_of(task),
    ]
    if task.trial_starts == 1:
        found.append(_placing_option())
    if not blind:
        found += _table_options()
    words = values["words"]
    if any(f"--{name}" in words for name in ("robot-generations", "then-on-robot")):
        found += _robot_options()
    return found


def _placing_option() -> click.Option:
    """Return the option of how exactly the robot is put down."""
    return _options(placing_option)[0]


def _table_options() -> list[click.Option]:
    from neurosim.cli.tables import arena_option, noise_option

    return _options(arena_option, noise_option)


def _robot_options() -> list[click.Option]:
    from neurosim.cli._robots import khepera_or_virtual

    return _options(khepera_or_virtual("Of --robot-generations.", "Which virtual robot."))


def _options(*decorators: Any) -> list[click.Option]:
    """Return the options that decorators of click would add."""

    def nothing() -> None:
        pass

    for decorator in decorators:
        decorator(nothing)
    return list(reversed(nothing.__click_params__))  # type: ignore[attr-defined]


class EvolveCommand(Resumable, DynamicCommand):
    """Takes the options of what is asked for, and goes on with --resume."""


@click.command(
    cls=EvolveCommand,
    begun=lambda values: Checkpoint(values["out"], "evolution").options(),
    first={"task": "nine-rectangles", "controller": ""},
    dynamic=_settings_options,
)
@click.argument("simulator", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new controller.")
@click.option(
    "--task",
    default="nine-rectangles",
    show_default=True,
    help="A task's name, or a JSON file with its name and settings. Its options are listed with "
    "--task NAME --help.",
)
@click.option(
    "--controller",
    "kind",
    help="plan, network, recurrent or a registered kind.  [plan; network where the task needs "
    "sensors]",
)
@click.option(
    "--optimiser", default="ga", show_default=True, help="ga, cma or a registered optimiser."
)
@click.option(
    "--settings",
    "preset",
    type=click.Choice(["default", "paper"]),
    default="default",
    show_default=True,
    help="Plans: paper is Table 1: a tournament of 50, and null commands come back where they "
    "are. It gets stuck twice as often.",
)
@click.option(
    "--robust",
    is_flag=False,
    flag_value="probability",
    type=click.Choice(["probability", "fitness"]),
    help="Go on over drawn outcomes, for the probability of completing the task "
    "(alone: --robust=probability) or for the expected fitness.",
)
@click.option("--robust-generations", type=click.IntRange(min=1), default=300, show_default=True)
@click.option(
    "--draws", type=click.IntRange(min=1), default=32, show_default=True, help="Outcomes."
)
@click.option(
    "--robot-generations",
    "--then-on-robot",
    "real_generations",
    type=click.IntRange(min=0),
    default=0,
    help="Generations on a robot after those in the simulator; it is left to itself.",
)
@click.option("--all", "keep_all", is_flag=True, help="Keep the best of every run: OUT-01, ...")
@click.option("--resume", is_flag=True, help="Continue an interrupted evolution, same options.")
@seed_option
@json_option
def evolve(
    simulator: Path,
    out: Path,
    task: str,
    kind: str | None,
    optimiser: str,
    preset: str,
    robust: str | None,
    robust_generations: int,
    draws: int,
    real_generations: int,
    keep_all: bool,
    resume: bool,
    seed: int,
    as_json: bool,
    **given: Any,
) -> None:
    """Evolve a controller for a task in SIMULATOR.

    By default a plan of motor commands around nine rectangles (section 6.2 of Pretorius et al.
    2009). For --task obstacle-avoidance, in a simulator with sensors, a network (Lund and Miglino
    1996). Any controller, task, simulator and optimiser can be combined.
    """
    from neurosim.cli._tasks import read_task
    from neurosim.controllers import CONTROLLERS, make_controller
    from neurosim.evolution.genetic import GeneticSettings
    from neurosim.loop.evolve import evolve as evolve_
    from neurosim.loop.settings import EvolveSettings, RobustSettings, default_settings
    from neurosim.simulators import read_simulator
    from neurosim.tasks.registry import make_task

    cls, settings = read_task(task)
    made = make_task(cls.name, **{**settings, **given_of(cls, given)})
    kind = kind or ("network" if made.episode.readings else "plan")
    found = _changed(read_simulator(simulator), given)
    family = make_controller(kind, found, made, **given_of(CONTROLLERS.get(kind), given))
    how = default_settings(family, made, optimiser=optimiser, **given_of(EvolveSettings, given))
    genetic = GeneticSettings() if preset == "paper" and family.blind else how.genetic
    changes = given_of(GeneticSettings, given)
    if genetic.parents and "population" in changes and "parents" not in changes:
        changes["parents"] = max(changes["population"] // 5, 1)
    how = replace(
        how,
        genetic=replace(genetic, **changes),
        insertion=preset != "paper",
        robust=robust and RobustSettings(robust, robust_generations, draws),
    )
    if given.get("placing") is not None:
        millimetres, degrees = given["placing"]
        how = replace(how, placing=(millimetres / 1000.0, math.radians(degrees)))
    with _on_robot(found, made, family, how, real_generations, given, seed) as reality:
        controllers = evolve_(
            found,
            made,
            family,
            out=out,
            settings=how,
            source=simulator,
            seed=seed,
            keep_all=keep_all,
            resume=resume,
            options=given_options(),
            reality=reality,
            real_generations=real_generations,
        )
    _say(controllers, out, simulator, made, keep_all, as_json)


def _changed(simulator: Any, given: Mapping[str, Any]) -> Any:
    """Return the simulator with another arena or noise, where they were given."""
    changes: dict[str, Any] = {}
    if given.get("arena_path") is not None:
        from neurosim.simulators.tables.arena import Arena

        changes["arena"] = Arena.read(given["arena_path"])
    if given.get("noise") is not None:
        changes["noise"] = given["noise"]
    if not changes:
        return simulator
    if not hasattr(simulator, "changed"):
        raise UserError(f"a simulator of the kind {simulator.kind} has neither --arena nor --noise")
    return simulator.changed(**changes)


def _say(
    controllers: list[Any], out: Path, simulator: Path, task: Any, keep_all: bool, as_json: bool
) -> None:
    best = controllers[0]
    runs = len(controllers)
    paths = [out]
    if keep_all and runs > 1:
        paths = [out.with_name(f"{out.name}-{run + 1:02d}") for run in range(runs)]
    complete = sum(one.predicted["completes"] for one in controllers)
    history = best.evolution["history"]
    result = {
        "controllers": [str(path) for path in paths],
        "kind": best.kind,
        "fitness": best.predicted["fitness"],
        "spread": best.predicted.get("spread"),
        "completes": best.predicted["completes"],
        "probability": best.predicted.get("probability"),
        "commands": len(best.given) or None,
        "runs": runs,
        "runs_that_complete": complete,
        "generations": len(history["best"]),
        "transfer": history.get("transfer"),
        "best": history["best"],
        "mean": history["mean"],
        "settings": best.evolution["settings"],
    }
    fitness, chance = best.predicted["fitness"], best.predicted.get("probability")
    if best.given:
        verdict = "completes the task" if best.predicted["completes"] else "does not complete it"
        text = (
            f"{paths[0]}: {len(best.given)} commands, fitness {fitness:.1f}, {verdict} in the "
            f"simulator; {complete} of {runs} runs found a plan that does.\n"
        )
    else:
        spread = best.predicted.get("spread")
        around = "" if spread is None else f" (from trial to trial +- {spread:.3g})"
        text = (
            f"{paths[0]}: a {best.kind} of {len(best.genes)} genes, fitness {fitness:.4g}{around}; "
            f"the population's mean went from {history['mean'][0]:.4g} to "
            f"{history['mean'][-1]:.4g}.\n"
        )
    if chance is not None:
        text += f"Probability of success: {100 * chance:.1f} %.\n"
    if task.episode.readings:
        text += next_step("view", simulator, "--controller", paths[0], "-o", "path.png")
    else:
        text += next_step("run", paths[0], "--calibration", "calibration.json", "-o", "TRIAL")
    emit(result, as_json, text)
    if best.evolution["interrupted"]:
        resumable = Checkpoint(out, "evolution").begun
        how = ", continue with --resume" if resumable else ""
        click.echo(f"neurosim: interrupted; the best so far is kept{how}", err=True)
        click.get_current_context().exit(130)


@contextmanager
def _on_robot(
    simulator: Any,
    task: Any,
    controller: Any,
    settings: Any,
    generations: int,
    options: Mapping[str, Any],
    seed: int,
) -> Iterator[Any]:
    """Give the robot on which evolution goes on; None where it does not."""
    if not generations:
        yield None
        return
    from neurosim.cli._robots import khepera, virtual_khepera_baud
    from neurosim.loop.evaluate import Evaluator
    from neurosim.trials.reality import in_lab, on_khepera

    evaluator = Evaluator(simulator, task, controller, placing=settings.placing)
    if options["robot"] != "khepera":
        baud = virtual_khepera_baud(dict(options))
        with in_lab(evaluator, seed=seed, lab_seed=options["lab_seed"], baud=baud) as reality:
            yield reality
        return
    with on_khepera(khepera(dict(options)), evaluator, _ask) as reality:
        hours = generations * settings.genetic.population * reality.seconds / 3600
        click.echo(
            f"{generations} generations of {settings.genetic.population} trials of "
            f"{reality.seconds:.0f} s on the robot take {hours:.1f} h; an interrupted evolution "
            "continues with --resume.",
            err=True,
        )
        yield reality


def _ask(start: Any) -> None:
    x, y, theta = 100 * start[0], 100 * start[1], math.degrees(start[2])
    where = f"x {x:.1f} cm, y {y:.1f} cm, heading {theta:.0f} degrees"
    click.prompt(
        f"Put the robot at {where}, and press Enter", default="", show_default=False, err=True
    )
