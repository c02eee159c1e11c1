"""``neurosim run``: controller + robot -> trial."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import (
    calibration_option,
    emit,
    json_option,
    markers_option,
    next_step,
    seed_option,
)
from neurosim.cli._options import SettingsCommand, settings_options
from neurosim.cli._robots import camera_options, robot_option
from neurosim.cli._types import PATH


@click.command(cls=SettingsCommand)
@click.argument("controller", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new trial.")
@robot_option
@camera_options
@calibration_option(required=True)
@click.option(
    "--at-line",
    type=click.Choice(["end", "ignore"]),
    default="end",
    show_default=True,
    help="What happens where a light sensor sees a line.",
)
@settings_options(
    "guard",
    "neurosim.recording.settings:Guard",
    only=("contrast",),
    names={"contrast": "line-contrast"},
)
@settings_options(
    "settings",
    "neurosim.recording.settings:RecordSettings",
    only=("battery_limit",),
    helps={"battery_limit": "Voltage below which the trial does not start, V."},
)
@markers_option
@seed_option
@json_option
def run(
    controller: Path,
    out: Path,
    robot: str,
    robot_options: dict[str, Any],
    camera: dict[str, Any],
    calibration: Path,
    at_line: Any,
    guard: dict[str, Any],
    settings: dict[str, Any],
    markers: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Drive the robot with CONTROLLER, and compare what it does with what was predicted.

    Put the robot at the plan's start first: for nine-rectangles the centre of the centre-left
    rectangle, facing rectangle 1, the top-left one.
    """
    from neurosim.controllers import read_controller
    from neurosim.recording.markers import marker_settings
    from neurosim.recording.settings import Guard
    from neurosim.trials.rig import Setup, open_rig
    from neurosim.trials.trial import run_trial
    from tracking.track import track

    if camera.get("camera") == "none":
        raise UserError("a trial is tracked as it ends, so it needs a camera")
    start = read_controller(controller).start
    marked = marker_settings(markers, robot)
    with open_rig(robot, robot_options, Setup(**camera, seed=seed, start=start)) as rig:
        report = run_trial(
            controller,
            out,
            rig.robot,
            rig.camera,
            track=track,
            calibration=calibration,
            # A plan may lead near the edge; it must not lead over it.
            guard=Guard(at_line, margin=0.05, **guard),
            settings={"markers": marked, **settings},
            finish=rig.finish,
            lab=rig.lab,
        )
    seen = [error for error in report["errors"] if error is not None]
    result = {
        "trial": str(out),
        "completes": report["actual"]["completes"],
        "fitness": {
            "predicted": report["predicted"]["fitness"],
            "actual": report["actual"]["fitness"],
        },
        "errors": report["errors"],
    }
    done = "completed" if report["actual"]["completes"] else "did not complete"
    end = seen[-1]
    emit(
        result,
        as_json,
        f"{out}: the robot {done} the course (fitness {report['actual']['fitness']:.1f}, predicted "
        f"{report['predicted']['fitness']:.1f}); after command {end['command']} it was "
        f"{100 * end['position']:.1f} cm and {abs(math.degrees(end['heading'])):.1f} degrees from "
        f"where the simulator said.\n"
        + next_step("report", "DATASET", "SIMULATOR", controller, out, "-o", "report.html"),
    )
