"""``neurosim evolve``: simulator -> controller."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import click

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.declared import CountOrNone
from neurosim.base.errors import UserError, counted
from neurosim.base.interrupts import exit_code
from neurosim.cli._common import (
    at_line_option,
    emit,
    is_given,
    json_option,
    next_step,
    resume_option,
    seed_option,
    tensorboard_option,
    warn_of,
    warn_unsupported,
)
from neurosim.cli._options import (
    Chosen,
    SettingsCommand,
    choice_options,
    given_options,
    settings_options,
)
from neurosim.cli._realities import (
    ask_person,
    controller_option,
    make_both,
    patience_option,
    reality_option,
    task_option,
)
from neurosim.cli._robots import without_camera
from neurosim.cli._types import PATH, ranged

#: Probability of success below which a plan should be evolved robustly before it is driven.
_LIKELY = 0.5


def _task(chosen: Chosen) -> Any:
    """Return the chosen task, with the settings of its file or its defaults."""
    from neurosim.tasks.files import FILES_AND_TASKS

    task = FILES_AND_TASKS.get(chosen["task"])
    try:
        return task() if isinstance(task, type) else task
    except TypeError:
        return None  # a task without defaults


#: Options of --robust whose names are not those of its settings.
ROBUST = {"generations": "robust-generations"}


def _default_controller(chosen: Chosen) -> str:
    task = _task(chosen)
    return "plan" if task is None else task.usual_controller


def _is_open_loop(chosen: Chosen) -> bool:
    from neurosim.controllers import CONTROLLERS

    return bool(getattr(CONTROLLERS.get(chosen["controller"]), "open_loop", False))


def _defaults(chosen: Chosen) -> Any:
    """Return the default settings of an evolution."""
    from neurosim.controllers import Controller, FixedPlan
    from neurosim.loop.settings import default_settings

    task = _task(chosen)
    controller = FixedPlan(()) if _is_open_loop(chosen) else Controller()
    return None if task is None else default_settings(controller, task)


def _genetic(chosen: Chosen) -> Any:
    settings = _defaults(chosen)
    return None if settings is None else settings.genetic


def _not_settings(chosen: Chosen) -> Sequence[str]:
    """Return the settings of an evolution that have no effect here, or that other options set."""
    task = _task(chosen)
    scattered = task is not None and task.trial_starts == 1
    return (
        *("optimiser", "genetic", "robust", "insertion"),
        *(() if scattered else ("placing",)),
        *(("samples", "selection", "arenas") if _is_open_loop(chosen) else ()),
    )


def changed(
    simulator: Any,
    *,
    noise: Literal["none", "uniform", "samples"] | None = None,
) -> Any:
    """Return a simulator with other noise.

    Args:
        simulator: a simulator with several kinds of noise.
        noise: Noise in place of the simulator's own: none; uniform, 5 % of the range; or as wide as
            the samples' own.
    """
    from neurosim.simulators.base import InPlace

    if noise is None:
        return simulator
    if not isinstance(simulator, InPlace):
        raise UserError(f"a simulator of the kind {simulator.kind} has no --noise")
    return simulator.changed(noise=noise)


@click.command(
    cls=SettingsCommand,
    begun=lambda values: without_camera(Checkpoint(values["out"], "evolution").options()),
)
@click.argument("simulator", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new controller.")
@task_option("nine-rectangles", "The task, or a JSON file with its name and settings.")
@controller_option(
    _default_controller,
    "The kind of controller.  [default: plan, or network where the task needs sensors]",
)
@choice_options(
    "--optimiser",
    "neurosim.evolution.optimisers:OPTIMISERS",
    default="ga",
    help="The optimiser; ga is the genetic algorithm of the controller's paper.",
    of=lambda optimiser: None,  # all of them get the settings below
)
@settings_options(
    "evolution",
    _defaults,
    by_choice=True,
    skip=_not_settings,
    units={"placing": ("mm", "degrees")},
)
@settings_options(
    "genetic",
    _genetic,
    by_choice=True,
    skip=lambda chosen: ("parents",) if _is_open_loop(chosen) else ("tournament",),
)
@click.option(
    "--settings",
    "preset",
    type=click.Choice(["default", "paper"]),
    default="default",
    show_default=True,
    help="Plans: paper has the settings of Table 1 of Pretorius et al. 2009, such as a tournament "
    "of 50. With these, more runs find no plan.",
)
@click.option(
    "--robust",
    is_flag=False,
    flag_value="probability",
    type=click.Choice(["probability", "fitness"]),
    help=(
        "Continue over random samples: maximise the probability of completing the task (--robust "
        "alone, or --robust=probability), or the expected fitness."
    ),
)
@settings_options(
    "robust_settings",
    "neurosim.loop.settings:RobustSettings",
    only=("generations", "draws"),
    names=ROBUST,
)
@settings_options(
    "changes",
    lambda chosen: None if _is_open_loop(chosen) else changed,
    by_choice=True,
    skip=("simulator",),
)
@click.option(
    "--robot-generations",
    "real_generations",
    type=ranged(CountOrNone),
    default=0,
    help="Generations in reality after those in the simulator.",
)
@settings_options("judges", "neurosim.loop.evolve:evolve", only=("workers",))
@reality_option(
    lambda chosen: "virtual-nxt" if _is_open_loop(chosen) else "virtual-khepera",
    "The reality of --robot-generations, by default virtual-nxt for plans, else virtual-khepera.",
)
@patience_option
@at_line_option
@click.option(
    "--all", "keep_all", is_flag=True, help="Keep the best controller of every run: OUT-01, ..."
)
@tensorboard_option
@resume_option
@seed_option
@json_option
def evolve(
    simulator: Path,
    out: Path,
    task: str,
    task_options: dict[str, Any],
    controller: str,
    controller_options: dict[str, Any],
    optimiser: str,
    optimiser_options: dict[str, Any],
    evolution: dict[str, Any],
    genetic: dict[str, Any],
    preset: str,
    robust: str | None,
    robust_settings: dict[str, Any],
    changes: dict[str, Any],
    real_generations: int,
    reality: str,
    reality_options: dict[str, Any],
    camera: str | None,
    calibration: Path | None,
    patience: float,
    at_line: str,
    judges: dict[str, Any],
    keep_all: bool,
    tensorboard: Path | None,
    resume: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Evolve a controller for a task in SIMULATOR.

    By default a plan of motor commands around nine rectangles (section 6.2 of Pretorius et al.
    2009). For --task obstacle-avoidance, in a simulator with sensors, a network (Lund and Miglino
    1996). Any controller, task, simulator and optimiser can be combined.
    """
    from neurosim.evolution.genetic import GeneticSettings
    from neurosim.evolution.optimisers import OPTIMISERS
    from neurosim.loop.evolve import evolve as evolve_
    from neurosim.loop.settings import RobustSettings, default_settings
    from neurosim.simulators import read_simulator
    from neurosim.trials.realities import open_reality

    if not real_generations and (is_given("reality") or reality_options):
        raise UserError("--reality needs --robot-generations: add it, or leave out --reality")
    if robust_settings and not robust:
        given = ", ".join(f"--{ROBUST.get(name, name)}" for name in robust_settings)
        raise UserError(
            f"options have no effect without --robust: {given}; leave them out, or add --robust"
        )
    used = getattr(OPTIMISERS.get(optimiser), "uses", genetic)
    if unused := ", ".join(f"--{name.replace('_', '-')}" for name in genetic if name not in used):
        raise UserError(
            f"options have no effect with --optimiser {optimiser}: {unused}; leave them out"
        )
    prepared = changed(read_simulator(simulator), **changes)
    if at_line == "ignore":
        prepared.perimeter = None
    made, family = make_both(prepared, task, task_options, controller, controller_options)
    warn_of(made.placed(prepared))
    if real_generations:
        evolution = {"runs": 1, **evolution}
    how = default_settings(family, made, optimiser=optimiser, **evolution)
    breeding = GeneticSettings() if preset == "paper" and family.open_loop else how.genetic
    if breeding.parents and "population" in genetic and "parents" not in genetic:
        genetic["parents"] = max(genetic["population"] // 5, 1)
    how = replace(
        how,
        genetic=replace(breeding, **genetic),
        insertion=preset != "paper",
        robust=robust and RobustSettings(robust, **robust_settings),
    )
    opened = nullcontext()
    if real_generations:
        opened = open_reality(
            reality,
            family,
            made,
            prepared,
            camera=camera,
            calibration=calibration,
            **reality_options,
        )
    with opened as real:
        if hours := real_generations * how.genetic.population * getattr(real, "seconds", 0) / 3600:
            click.echo(
                f"{real_generations} generations of {how.genetic.population} trials take up to "
                f"{hours:.1f} h of the robot's time; --resume continues an interrupted evolution.",
                err=True,
            )
        controllers = evolve_(
            prepared,
            made,
            family,
            out=out,
            settings=how,
            source=simulator,
            seed=seed,
            keep_all=keep_all,
            resume=resume,
            options=given_options(),
            reality=real,
            real_generations=real_generations,
            ask=ask_person,
            patience=patience,
            tensorboard=tensorboard,
            **judges,
        )
    if len(controllers) < (asked := evolution.get("runs", 0)):
        runs = counted(len(controllers), "run")
        click.echo(f"neurosim: the optimiser {optimiser} made {runs}, not {asked}", err=True)
    again = ["evolve", simulator, "--task", task, "--robust", "-o", "ROBUST"]
    _say(controllers, out, simulator, made, keep_all, as_json, None if robust else again)


def _robot(controller: Any, simulator: Path) -> list[str]:
    """Return the options of `run` for the robot of a controller's simulator."""
    from neurosim.controllers.base import WHEELS
    from neurosim.simulators import TableSimulator, read_simulator

    if isinstance(read_simulator(simulator), TableSimulator):
        return ["--robot", "virtual-khepera", "--camera", "none"]
    wheels = set(controller.controller.outputs) <= {*WHEELS, "duration"}
    return [*([] if wheels else ["--robot", "ROBOT"]), "--calibration", "calibration.json"]


def _say(
    controllers: list[Any],
    out: Path,
    simulator: Path,
    task: Any,
    keep_all: bool,
    as_json: bool,
    robustly: list[Any] | None,
) -> None:
    """Print what was evolved, and the next step; ``robustly``: that for unlikely plans."""
    from neurosim.loop.evolve import folders_of
    from neurosim.loop.unmet import Unmet

    best = controllers[0]
    runs, asked = len(controllers), best.evolution["settings"]["runs"]
    paths = folders_of(out, asked if keep_all else 1)[:runs]
    complete = sum(one.predicted["completes"] for one in controllers)
    history = best.evolution["history"]
    result = {
        "controllers": [str(path) for path in paths],
        "kind": best.kind,
        "fitness": best.predicted["fitness"],
        "spread": best.predicted.get("spread"),
        "completes": best.predicted["completes"],
        "probability": best.predicted.get("probability"),
        "unsupported": best.predicted["unsupported"],
        "unmet": best.predicted.get("unmet"),
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
        verdict = "completes" if best.predicted["completes"] else "does not complete"
        text = (
            f"{paths[0]}: {counted(len(best.given), 'command')}, fitness {fitness:z.4g}, "
            f"{verdict} the task in the simulator; {complete} of {runs} runs found a plan that "
            "completes it.\n"
        )
    else:
        spread = best.predicted.get("spread")
        around = "" if spread is None else f" (from trial to trial +- {spread:.3g})"
        text = (
            f"{paths[0]}: a {best.kind} of {len(best.genes)} genes, fitness {fitness:.4g}{around}; "
            f"the population's mean went from {history['mean'][0]:.4g} to "
            f"{history['mean'][-1]:.4g}.\n"
        )
    unmet = best.predicted.get("unmet") and Unmet(**best.predicted["unmet"])
    if unmet and not unmet.worse:
        text += f"{unmet}\n"
    if chance is not None:
        text += f"Probability of success: {100 * chance:.1f} %.\n"
    if unsupported := best.predicted["unsupported"]:
        text += f"Unlike what the simulator learned from: {100 * unsupported:.1f} % of the time.\n"
    if task.episode.readings:
        text += next_step("view", simulator, "--controller", paths[0], "-o", "path.png")
    elif robustly and best.given and chance is not None and chance < _LIKELY:
        text += next_step(*robustly)
    else:
        text += next_step("run", paths[0], *_robot(best, simulator), "-o", "TRIAL")
    emit(result, as_json, text)
    warn_unsupported(best.predicted["unsupported"])
    if unmet and unmet.worse:
        click.echo(f"neurosim: {unmet}", err=True)
    if best.evolution["interrupted"]:
        resumable = Checkpoint(out, "evolution").begun
        how = ", continue with --resume" if resumable else ""
        click.echo(f"neurosim: interrupted; the best so far is kept{how}", err=True)
        click.get_current_context().exit(exit_code())
