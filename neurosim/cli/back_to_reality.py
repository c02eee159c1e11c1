"""``neurosim back-to-reality``: a simulator and a reality -> a controller that works in both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from neurosim.base.checkpoint import Checkpoint
from neurosim.cli._common import (
    emit,
    json_option,
    next_step,
    resume_option,
    seed_option,
    tensorboard_option,
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
from neurosim.cli._types import PATH


class _Named:
    """Named settings, for ``--settings``."""

    def names(self) -> list[str]:
        """Return the names."""
        return ["paper", "better"]

    def get(self, name: str) -> Any:
        """Return the settings of this name; raise UserError if there are none."""
        from neurosim.back_to_reality import settings_named

        return settings_named(name)


NAMED = _Named()


def _settings(chosen: Chosen) -> Any:
    """Return the named settings; their values are the options' defaults."""
    return NAMED.get(chosen["settings"])


@click.command(
    "back-to-reality",
    cls=SettingsCommand,
    begun=lambda values: without_camera(Checkpoint(values["out"], "run").options()),
)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the result.")
@click.option(
    "--simulator",
    type=PATH,
    help=(
        "A simulator with adjustable parameters.  [default: the walking robot's; with the "
        "paper's settings, that of the paper]"
    ),
)
@task_option("walking", "The task.")
@controller_option("gait", "The kind of controller.")
@reality_option("virtual-walker", "Where controllers are tried for real.")
@click.option(
    "--start",
    type=PATH,
    help=(
        "First controller: its folder, or a JSON file of its parameters.  [default: the "
        "hand-tuned one]"
    ),
)
@choice_options(
    "--settings",
    "neurosim.cli.back_to_reality:NAMED",
    default="better",
    help="The settings: the paper's, or our own choices.",
    of=lambda settings: None,  # options are made of these below
)
@settings_options("how", _settings, by_choice=True)
@settings_options(
    "genetic",
    lambda chosen: _settings(chosen).genetic,
    by_choice=True,
    prefix="search-",
)
@settings_options(
    "adapt_genetic",
    lambda chosen: _settings(chosen).adapt_genetic,
    by_choice=True,
    prefix="adapt-",
)
@settings_options("policy", lambda chosen: _settings(chosen).policy, by_choice=True)
@patience_option
@tensorboard_option
@resume_option
@seed_option
@json_option
def back_to_reality(
    out: Path,
    simulator: Path | None,
    task: str,
    task_options: dict[str, Any],
    controller: str,
    controller_options: dict[str, Any],
    reality: str,
    reality_options: dict[str, Any],
    camera: str | None,
    calibration: Path | None,
    start: Path | None,
    settings: str,
    settings_options: dict[str, Any],
    how: dict[str, Any],
    genetic: dict[str, Any],
    adapt_genetic: dict[str, Any],
    policy: dict[str, Any],
    patience: float,
    tensorboard: Path | None,
    resume: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Adapt a controller and a simulator to each other by trials in reality.

    Controllers are evolved in the simulator (L1) and tried in reality. The simulator's parameters
    are changed until it agrees with reality (L3). The best controller may be improved further in
    reality (L2). Then evolution continues in the adapted simulator (Zagal, Ruiz-del-Solar and
    Vallejos 2004). By default L3 needs a reality that tracks the robot, and there is no L2. Every
    trial is on the disk before it is used; --resume continues an interrupted run.
    """
    from neurosim.back_to_reality.run import back_to_reality as run
    from neurosim.back_to_reality.run import start_genes
    from neurosim.back_to_reality.settings import settings_named
    from neurosim.simulators import read_simulator
    from neurosim.simulators.legged.build import Build, ServoBuild
    from neurosim.simulators.legged.simulator import LeggedSimulator
    from neurosim.trials.realities import open_reality

    if simulator is None:
        model = LeggedSimulator(Build() if settings == "paper" else ServoBuild())
    else:
        model = read_simulator(simulator)
    made, family = make_both(model, task, task_options, controller, controller_options)
    chosen = settings_named(settings)
    chosen = replace(
        chosen,
        genetic=replace(chosen.genetic, **genetic),
        adapt_genetic=replace(chosen.adapt_genetic, **adapt_genetic),
        policy=replace(chosen.policy, **policy),
        **how,
    )
    with open_reality(
        reality, family, made, model, camera=camera, calibration=calibration, **reality_options
    ) as real:
        content = run(
            model if simulator is None else simulator,
            made,
            family,
            real,
            out=out,
            start=start_genes(family, start),
            settings=chosen,
            seed=seed,
            resume=resume,
            options=given_options(),
            ask=ask_person,
            patience=patience,
            tensorboard=tensorboard,
        )
    emit({"out": str(out), **content}, as_json, _text(content, out))


def _text(content: dict[str, Any], out: Path) -> str:
    from neurosim.base.errors import counted

    start, best = content["start"]["fitness"], content["best"]
    times = "" if best["times_start"] is None else f", {best['times_start']:.2f} times that"
    text = (
        f"{out}: fitness {start:.3g} in reality to start with, {best['fitness']:.3g} in the end"
        f"{times}, after {counted(content['trials'], 'trial')}.\n"
    )
    for number, cycle in enumerate(content["cycles"], 1):
        if "L3" in cycle:
            compared = cycle["L3"]["compared"]
            tracked = "poses" in compared["before"]
            by, unit, what = ("poses", " m", "paths") if tracked else ("norm", "", "norm")
            text += (
                f"Cycle {number}: the simulator and reality differed by "
                f"{compared['before'][by]:.3g}{unit} over {compared['individuals']} controllers "
                f"({what}), by {compared['after'][by]:.3g}{unit} after its parameters were "
                "adapted.\n"
            )
    how, adapted = content["settings"], any("L3" in cycle for cycle in content["cycles"])
    if (
        how["adapt"] != "none"
        and how["compare"] == "tracked"
        and not adapted
        and len(content["cycles"]) > 1
    ):
        text += (
            "The simulator's parameters were not adapted: reality returned a fitness, and no poses "
            "(--compare recent adapts them to fitness).\n"
        )
    if not (out / "controller").is_dir():
        text += "The best plan gives no command: there is no controller to send.\n"
        return text + next_step("report", out, "-o", "report.html")
    return text + next_step("report", out, out / "controller", "-o", "report.html")
