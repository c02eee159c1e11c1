"""``neurosim check-robot``: try a robot before its first recording."""

from __future__ import annotations

from typing import Any

import click

from neurosim.cli._common import emit, json_option
from neurosim.cli._options import SettingsCommand
from neurosim.cli._robots import robot_option

_MARKS = {"good": "good ", "wrong": "WRONG", "unknown": "?    "}


@click.command("check-robot", cls=SettingsCommand)
@robot_option
@click.option(
    "--ask",
    is_flag=True,
    help="Ask a person about the robot's motion if it has no wheel counters.",
)
@json_option
def check_robot(robot: str, robot_options: dict[str, Any], ask: bool, as_json: bool) -> None:
    """Try a robot: how fast it answers, whether it stops by itself, which way it drives.

    The robot drives for a short time at 30 % of its limits: give it free space. Each result is one
    sentence; an error includes what to do. The exit code is 1 if something is wrong.
    """
    from neurosim.robots.check import check
    from neurosim.trials.rig import Setup, open_rig

    asked = (lambda question: click.confirm(question, err=True)) if ask else None
    with open_rig(robot, robot_options, Setup(camera="none")) as rig, rig.robot as tried:
        findings = check(tried, asked)
        about = tried.describe()
    wrong = sum(one.verdict == "wrong" for one in findings)
    result = {"robot": about, "wrong": wrong, "findings": [one.describe() for one in findings]}
    lines = [f"{_MARKS[one.verdict]}  {one.what}: {one.sentence}." for one in findings]
    emit(result, as_json, "\n".join(lines))
    if wrong:
        raise click.exceptions.Exit(1)
