"""The options of task, controller and reality."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from neurosim.base.declared import Seconds
from neurosim.cli._common import calibration_option
from neurosim.cli._options import Chosen, choice_options
from neurosim.cli._types import ranged

Default = str | Callable[[Chosen], str]


def task_option(default: Default, help: str) -> Callable[[Callable], Callable]:
    """Return a decorator that adds ``--task`` and the options of the chosen task."""
    return choice_options(
        "--task", "neurosim.tasks.files:FILES_AND_TASKS", default=default, help=help
    )


def controller_option(default: Default, help: str) -> Callable[[Callable], Callable]:
    """Return a decorator that adds ``--controller`` and the options of the chosen kind."""
    return choice_options(
        "--controller",
        "neurosim.controllers:CONTROLLERS",
        default=default,
        help=help,
        names={"slots": "commands"},
        optional=("inputs",),
    )


def make_both(
    simulator: Any,
    task: str,
    task_options: dict[str, Any],
    controller: str,
    controller_options: dict[str, Any],
) -> tuple[Any, Any]:
    """Return the task and the kind of controller that were chosen, for a simulator."""
    from neurosim.controllers import make_controller
    from neurosim.tasks.files import read_task
    from neurosim.tasks.registry import make_task

    name, settings = read_task(task)
    made = make_task(name, **{**settings, **task_options})
    return made, make_controller(controller, simulator, made, **controller_options)


def _may_be_real(name: str) -> bool:
    from neurosim.trials.realities import REALITIES

    return not REALITIES.is_own(name)


def reality_option(default: Default, help: str) -> Callable[[Callable], Callable]:
    """Return a decorator that adds ``--reality``, its options, and the camera's.

    Args:
        default: a name in :data:`neurosim.trials.realities.REALITIES`, or a driver's, or a function
            that returns it from the earlier choices.
        help: of the option; the names are added.
    """

    def add(function: Callable) -> Callable:
        for option in (
            calibration_option(
                "The calibration.json of the camera; by-hand: of the one that films."
            ),
            click.option(
                "--camera",
                help=(
                    "Camera above a real robot: a number, a file, or a URL that OpenCV opens; lab "
                    "for the virtual walker's."
                ),
            ),
            choice_options(
                "--reality",
                "neurosim.trials.realities:NAMED",
                default=default,
                help=(
                    f"{help} virtual-*: of the lab. by-hand: a person types the fitness. Others: a "
                    "real robot by its driver."
                ),
                skip=(
                    "controller",
                    "task",
                    "simulator",
                    "camera",
                    "calibration",
                ),  # the command gives it
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
    help="Longest time of a trial in reality, s.",
)


def ask_person(message: str) -> None:
    """Ask a person to do something, and wait until it is done."""
    click.prompt(message, default="", show_default=False, prompt_suffix=". ", err=True)
