"""``neurosim run``: controller + robot -> trial."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import (
    at_line_option,
    calibration_option,
    emit,
    json_option,
    markers_option,
    next_step,
    seed_option,
    tag_option,
)
from neurosim.cli._options import SettingsCommand, settings_options
from neurosim.cli._robots import camera_options, robot_option
from neurosim.cli._types import PATH

#: Fraction of late commands above which the drive is not the one that was simulated.
_OFTEN = 0.1


@click.command(cls=SettingsCommand)
@click.argument("controller", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new trial.")
@robot_option
@camera_options
@calibration_option()
@at_line_option
@settings_options(
    "guard",
    "neurosim.recording.settings:Guard",
    only=("contrast", "by"),
    names={"contrast": "line-contrast", "by": "guard-by"},
)
@settings_options(
    "settings",
    "neurosim.recording.settings:RecordSettings",
    only=("battery_limit",),
    helps={"battery_limit": "Voltage below which the trial does not start, V."},
)
@click.option(
    "--replan/--no-replan",
    default=None,
    help=(
        "Plans: replan before every command, from the pose that the camera sees.  [default: only "
        "for tasks that need an exact end, such as go-to]"
    ),
)
@click.option(
    "--simulator",
    type=PATH,
    help="The simulator for replanning.  [default: that of the plan]",
)
@settings_options(
    "replanning",
    "neurosim.loop.replan:ReplanSettings",
    only=("generations", "think", "draws"),
    names={"generations": "replan-generations", "draws": "replan-draws"},
)
@markers_option
@tag_option
@seed_option
@json_option
def run(
    controller: Path,
    out: Path,
    robot: str,
    robot_options: dict[str, Any],
    camera: dict[str, Any],
    calibration: Path | None,
    at_line: Any,
    guard: dict[str, Any],
    settings: dict[str, Any],
    replan: bool | None,
    simulator: Path | None,
    replanning: dict[str, Any],
    markers: str | None,
    tag: int | None,
    seed: int,
    as_json: bool,
) -> None:
    """Drive the robot with CONTROLLER, and compare the drive with the prediction.

    Put the robot at the controller's start first: for nine-rectangles the centre of the centre-left
    rectangle, facing rectangle 1, the top-left one. A closed-loop controller gives a command at
    each step of its task. If the robot lacks one of its inputs, the command stops before anything
    moves. With --camera none, the path is that of the wheels' counters.

    With --replan, a plan is replanned before every command, in its simulator, from the robot's
    pose. Meanwhile the command before continues.
    """
    from neurosim.controllers import read_controller
    from neurosim.recording.markers import marker_settings
    from neurosim.recording.settings import Guard
    from neurosim.trials.rig import Setup, open_rig
    from neurosim.trials.trial import run_trial
    from tracking.track import track

    saved = read_controller(controller)
    if calibration is None and camera.get("camera") != "none":
        raise UserError(
            "the robot's position is unknown: give --calibration (camera), or --camera none "
            "(wheel counters)"
        )
    known = _simulator(saved, controller)
    again = _replanning(saved, replan, simulator, known, replanning)
    if again is not None and again[0].perimeter is not None:
        by, perimeter = guard.get("by", "both"), again[0].perimeter
        again[0].perimeter = None if at_line == "ignore" else perimeter.guarded(by)
    marked = marker_settings(markers, robot, tag)
    around = _place(saved, robot, known)
    setup = Setup(**camera, seed=seed, start=saved.start, place=around, markers=marked)
    with open_rig(robot, robot_options, setup) as rig:
        report = run_trial(
            controller,
            out,
            rig,
            track=track,
            calibration=calibration,
            # A plan may lead near the edge, but not over it.
            guard=Guard(at_line, margin=0.05, **guard),
            settings={"markers": marked, **settings},
            replan=again,
            seed=seed,
        )
    result = {
        "trial": str(out),
        "kind": report["kind"],
        "stopped": report["stopped"],
        "guard": report["guard"],
        "completes": report["actual"]["completes"],
        "reason": report["actual"]["reason"],
        "fitness": {
            "predicted": report["predicted"]["fitness"],
            "actual": report["actual"]["fitness"],
        },
        "deadlines": report.get("deadlines"),
        "errors": report["errors"],
    }
    emit(result, as_json, _text(out, controller, report))


def _replanning(
    saved: Any,
    wanted: bool | None,
    simulator: Path | None,
    known: Path | None,
    settings: dict[str, Any],
) -> Any:
    """Return the simulator and the settings of replanning; None: no replanning."""
    from neurosim.loop.replan import ReplanSettings
    from neurosim.simulators import read_simulator
    from neurosim.tasks.registry import make_task

    if wanted is None:
        # If the options have settings of it, or the task needs it.
        asked = simulator is not None or bool(settings)
        wanted = asked or (bool(saved.commands) and make_task(saved.task).replanned)
    if not wanted:
        if simulator is not None or settings:
            raise UserError("--simulator and the settings of replanning need --replan")
        return None
    folder = simulator or known
    if folder is None:
        raise UserError(
            "the simulator of the plan was moved or changed: name one with --simulator, or drive "
            "without replanning (--no-replan)"
        )
    return read_simulator(folder), ReplanSettings(**settings)


def _simulator(saved: Any, controller: Path) -> Path | None:
    """Return the folder of the simulator in which a controller was evolved; None: unknown."""
    from neurosim.base.files import sha256

    # Only the simulator with the controller's checksum: a path from another computer proves
    # nothing. The path is relative to where evolution ran, perhaps a folder above the controller.
    path = Path(str(saved.simulator.get("path", "")))
    for base in (Path(), *controller.resolve().parents):
        file = base / path / "simulator.json"
        if file.is_file() and sha256(file) == saved.simulator.get("sha256"):
            return file.parent
    return None


def _place(saved: Any, robot: str, folder: Path | None) -> Any:
    """Return the place for which a controller was evolved, for a virtual robot; None: unknown."""
    from neurosim.simulators import read_simulator
    from neurosim.tasks.registry import make_task
    from neurosim.trials.rig import place_of

    simulator = None if folder is None else read_simulator(folder)
    return place_of(robot, make_task(saved.task), simulator)


def _text(out: Path, controller: Path, report: dict[str, Any]) -> str:
    """Return the result as text."""
    done = "completed" if report["actual"]["completes"] else "did not complete"
    predicted = report["predicted"].get("fitness")
    expected = "" if predicted is None else f", predicted {predicted:.4g}"
    text = f"{out}: the robot {done} the task (fitness {report['actual']['fitness']:.4g}{expected})"
    if not report["actual"]["completes"] and report["actual"]["reason"]:
        text += f": it {report['actual']['reason']}"
    if report["guard"]["predicted"] != report["guard"]["driven"]:
        which = (
            "without the guard, driven with it"
            if report["guard"]["driven"]
            else ("with the guard, driven without it")
        )
        text += f"; it was predicted {which}"
    seen = [error for error in report["errors"] if error is not None]
    if seen:
        end = seen[-1]
        text += (
            f"; after command {end['command']} it was {100 * end['position']:.1f} cm and "
            f"{abs(math.degrees(end['heading'])):.1f} degrees from the simulator's prediction"
        )
    kept = report.get("deadlines")
    if kept:
        text += f"; {kept['missed']} of {kept['steps']} commands were late"
        if kept["missed"] > _OFTEN * kept["steps"] and not report["replanned"]:
            text += (
                f" (by {kept['worst_late_s']:.2f} s at most), so the drive differs from the "
                "simulated one: evolve with a longer --step"
            )
    return (
        text
        + ".\n"
        + next_step("report", "DATASET", "SIMULATOR", controller, out, "-o", "report.html")
    )
