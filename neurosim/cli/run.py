"""``neurosim run``: controller + robot -> trial."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import PATH, SHARE, NumberIn, emit, json_option, next_step, seed_option
from neurosim.cli._robots import open_rig, robot_options
from neurosim.cli.record import marker_settings


@click.command()
@click.argument("controller", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new trial.")
@robot_options
@click.option("--calibration", type=PATH, required=True, help="The camera's calibration.json.")
@click.option(
    "--at-line",
    type=click.Choice(["end", "ignore"]),
    default="end",
    show_default=True,
    help="What to do where a light sensor sees a line.",
)
@click.option(
    "--line-contrast", type=SHARE, default=0.12, show_default=True, help="Of a line, in 0..1."
)
@click.option(
    "--battery-limit",
    type=NumberIn(min=0),
    default=6.5,
    show_default=True,
    help="Do not start below it, V.",
)
@click.option(
    "--markers",
    default="pink,blue",
    show_default=True,
    help="Colours FRONT,REAR, or a markers.json that watch has written.",
)
@seed_option
@json_option
def run(
    controller: Path,
    out: Path,
    calibration: Path,
    at_line: Any,
    line_contrast: float,
    battery_limit: float,
    markers: str,
    seed: int,
    as_json: bool,
    **robot: Any,
) -> None:
    """Drive the robot with CONTROLLER, and compare what it does with what was predicted.

    Put the robot at the plan's start first: for nine-rectangles the centre of the centre-left
    rectangle, facing rectangle 1, the top-left one.
    """
    from neurosim.controllers import read_controller
    from neurosim.recording.record import Guard
    from neurosim.trials.trial import run_trial
    from tracking.track import track

    if robot["camera"] == "none":
        raise UserError("a trial is tracked as it ends, so it needs a camera")
    start = read_controller(controller).start
    marked = marker_settings(markers, robot["robot"])
    with open_rig(robot, seed=seed, start=start) as rig:
        report = run_trial(
            controller,
            out,
            rig.robot,
            rig.camera,
            track=track,
            calibration=calibration,
            # A plan may lead near the edge; it must not lead over it.
            guard=Guard(at_line, line_contrast, margin=0.05),
            settings={
                "markers": marked,
                "battery_limit": battery_limit,
            },
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
