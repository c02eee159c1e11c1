"""The options that say where controllers are tried for real."""

from __future__ import annotations

from collections.abc import Callable

import click

from neurosim.base.declared import Seconds
from neurosim.cli._common import calibration_option
from neurosim.cli._options import Chosen, choice_options
from neurosim.cli._types import ranged


def _may_be_real(name: str) -> bool:
    from neurosim.trials.realities import REALITIES

    return not REALITIES.is_own(name)


def reality_option(
    default: str | Callable[[Chosen], str], help: str
) -> Callable[[Callable], Callable]:
    """Return what adds ``--reality``, the options of what it names, and the camera's.

    Args:
        default: a name in :data:`neurosim.trials.realities.REALITIES`, or a driver's, or what says
            it by what was chosen before.
        help: of the option; the names are added.
    """

    def add(function: Callable) -> Callable:
        for option in (
            calibration_option("The calibration.json of --camera."),
            click.option("--camera", help="Films a real robot: a number, or what OpenCV opens."),
            choice_options(
                "--reality",
                "neurosim.trials.realities:NAMED",
                default=default,
                help=f"{help} One of the lab, by-hand (a person types what came out), or a robot "
                "by the name of its driver.",
                skip=("controller", "task", "simulator"),  # which it is given
                outside=_may_be_real,
            ),
        ):
            function = option(function)
        return function

    return add


patience_option = click.option(
    "--patience",
    type=ranged(Seconds),
    default=600.0,
    show_default=True,
    help="A trial in reality that takes longer is given up, s.",
)


def ask_person(message: str) -> None:
    """Ask a person to do something, and return when it is done."""
    click.prompt(message, default="", show_default=False, prompt_suffix=". ", err=True)
