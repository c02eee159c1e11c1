"""Options and output that several commands share."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from typing import Any

import click
from click.core import ParameterSource

from neurosim.base.declared import MetresOrNone, Seconds, Seed, TagId, Turn
from neurosim.base.files import plain
from neurosim.cli._types import NEW, PATH, Option, Real, ranged

#: A fraction of the time that is not worth a warning.
MOST_UNSUPPORTED = 0.05

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as JSON, for machines."
)
seed_option = click.option(
    "--seed", type=ranged(Seed), default=0, show_default=True, help="Random seed."
)
resume_option = click.option(
    "--resume", is_flag=True, help="Continue an interrupted run, with its options."
)
tensorboard_option = click.option(
    "--tensorboard",
    type=NEW,
    metavar="DIR",
    help="Folder for curves that TensorBoard shows (extra tensorboard).",
)
#: Names of colours; a test compares them with the tracker's.
COLOUR_NAMES = (
    "red, orange, yellow, green, cyan, blue, purple, violet, magenta, pink, #rrggbb or hsv:h,s,v"
)
markers_option = click.option(
    "--markers",
    help="Colours FRONT,REAR of the robot's markers; or apriltag or aruco, a printed tag; or a "
    "markers.json, which says where they are, too.  [default: pink,blue]  "
    f"Colours: {COLOUR_NAMES}.",
)
tag_option = click.option(
    "--tag", type=ranged(TagId), help="Number of the robot's tag; other tags are ignored.  [0]"
)


def calibration_option(
    help: str = "The camera's calibration.json.", **others: Any
) -> Callable[[Callable], Callable]:
    """Return the option of a camera's calibration."""
    return click.option("--calibration", type=PATH, help=help, **others)


place_option = click.option(
    "--place",
    type=PATH,
    help="The place, a JSON file or a name: arena, board, rectangle or ellipse. The guard goes by "
    "its board; a virtual robot drives in it.",
)
placing_option = click.option(
    "--placing",
    cls=Option,
    type=(Real(MetresOrNone, "mm"), Real(Turn, "degrees")),
    default=("3", "0.5"),
    show_default=True,
    help="Error in placing the robot: standard deviations of position and heading, mm and degrees.",
)


at_line_option = click.option(
    "--at-line",
    type=click.Choice(["end", "ignore"]),
    default="end",
    show_default=True,
    help=(
        "Reaction to a line or the board's edge, on the robot and in the simulator: end the drive, "
        "or ignore them."
    ),
)


def page_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a command that shows a page in the browser."""
    options = (
        click.option(
            "--port",
            type=click.IntRange(0, 65535),
            default=0,
            help="Port of the page; 0: any that is free.",
        ),
        click.option("--open", "open_browser", is_flag=True, help="Open the page in the browser."),
        click.option(
            "--seconds",
            type=ranged(Seconds),
            help="Stop after this time, s.  [default: with Ctrl-C]",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def is_given(name: str) -> bool:
    """Return whether an option was given to the command that runs."""
    context = click.get_current_context(silent=True)
    unset = (None, ParameterSource.DEFAULT)
    return context is not None and context.get_parameter_source(name) not in unset


def warn_of(simulator: Any) -> None:
    """Print a simulator's notes on stderr."""
    for note in simulator.notes:
        click.echo(f"neurosim: {note}", err=True)


def emit(result: dict[str, Any], as_json: bool, text: str | Callable[[], str]) -> None:
    """Print a command's result: JSON for machines, or text for people.

    The result is also added to the dict with which the command line was started (``obj``), if any.
    """
    context = click.get_current_context(silent=True)
    kept = None if context is None else context.find_object(dict)
    if kept is not None:
        kept.update(result)
    if as_json:
        click.echo(json.dumps(result, indent=2, default=plain))
    else:
        click.echo(text() if callable(text) else text)


def warn_unsupported(fraction: float) -> None:
    """Warn on stderr if too many commands are unlike those in the simulator's data.

    Args:
        fraction: fraction of the time in such commands.
    """
    if fraction > MOST_UNSUPPORTED:
        click.echo(
            f"neurosim: {100 * fraction:.0f} % of the commands (by time) are unlike any in the "
            "simulator's data; record such commands: neurosim record --guided",
            err=True,
        )


def next_step(*words: Any) -> str:
    """Return the line that names the next command, quoted so that it can be pasted."""
    return f"Next: neurosim {shlex.join(str(word) for word in words)}"
