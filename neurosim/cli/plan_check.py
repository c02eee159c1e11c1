"""``neurosim plan-check``: a prediction for a plan before the robot moves."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from neurosim.base.declared import Count
from neurosim.cli._common import (
    at_line_option,
    emit,
    json_option,
    placing_option,
    seed_option,
    warn_unsupported,
)
from neurosim.cli._types import PATH, ranged

if TYPE_CHECKING:
    from neurosim.loop.check import Check


@click.command("plan-check")
@click.argument("controller", type=PATH)
@click.argument("simulator", type=PATH)
@click.option(
    "--draws",
    type=ranged(Count),
    default=4096,
    show_default=True,
    help="Random samples for estimating the probability.",
)
@placing_option
@at_line_option
@click.option(
    "--extrapolate",
    is_flag=True,
    help="Commands may leave the range of the simulator's data; this is only reported.",
)
@seed_option
@json_option
def plan_check(
    controller: Path,
    simulator: Path,
    draws: int,
    placing: tuple[float, float],
    at_line: str,
    extrapolate: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Predict in SIMULATOR how likely the plan CONTROLLER is to succeed, and where it fails.

    SIMULATOR may be another one than that of the plan's evolution.
    """
    from neurosim.loop.check import check
    from neurosim.simulators import read_simulator

    how: dict[str, Any] = {"placing": placing, "extrapolate": extrapolate}
    model = read_simulator(simulator)
    if at_line == "ignore":
        model.perimeter = None
    checked = check(controller, model, draws=draws, seed=seed, **how)
    emit(checked.as_dict(), as_json, lambda: _in_words(checked))
    warn_unsupported(checked.unsupported)


def _in_words(check: Check) -> str:
    low, high = check.interval
    lines = [
        f"Completes the course with a probability of {_percent(check.probability)} ({check.draws} "
        f"random samples: {_percent(low)} to {_percent(high)})."
    ]
    if check.members is not None:
        low, high = check.members
        lines.append(
            f"The members of the simulator's ensemble say {_percent(low)} to {_percent(high)}."
        )
    lines.append(
        f"Unlike any command that the simulator learned from: {_percent(check.unsupported)} of "
        "the time."
    )
    last = len(check.spread) - 1
    if check.failures:
        lines += ["", "Where it fails most often:"]
        for failure in check.failures[:5]:
            when = f"command {failure.command}" if failure.command <= last else "running down"
            lines.append(f"  {_percent(failure.fraction):>7}  {when}: {failure.reason}")
    lines += ["", "after command   95 % within   heading (standard deviation)"]
    rows = zip(check.after, check.spread, check.turn, strict=True)
    for index, (number, radius, turn) in enumerate(rows):
        name = str(number) if index < last else "at the end"
        lines.append(f"{name:>13}{100 * radius:11.1f} cm{math.degrees(turn):13.1f} deg")
    return "\n".join(lines)


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.1f} %"
