"""The kinds of controllers by name."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

from neurosim.base.errors import UserError
from neurosim.base.registry import Registry
from neurosim.controllers.base import Controller
from neurosim.controllers.plan import COMMAND_NAMES, Plan
from neurosim.networks.control import GOAL_INPUTS

#: Functions by name that take settings as keywords and return a :class:`Controller`.
CONTROLLERS = Registry(
    "kind of controller",
    "neurosim.controllers",
    {
        "plan": "neurosim.controllers.plan:Plan",
        "network": "neurosim.controllers.network:Network",
        "recurrent": "neurosim.controllers.network:Recurrent",
        "gait": "neurosim.controllers.gait:Gait",
        "sine-gait": "neurosim.controllers.sine_gait:SineGait",
    },
)


def make_controller(
    kind: str,
    simulator: Any = None,
    task: Any = None,
    **settings: Any,
) -> Controller:
    """Return a family of controllers.

    Args:
        kind: its name.
        simulator: the simulator of its drives: unless set otherwise, a network observes all its
            sensors, and its outputs are the simulator's commands.
        task: a network observes its next goal, if it has goals.
        settings: of the kind.

    Raises:
        UserError: if the kind or a setting is unknown, or a network has nothing to observe.

    Example:
        >>> ns.make_controller("plan", slots=10).slots
        10
        >>> tables, task = ns.load("tables"), ns.make_task("obstacle-avoidance")
        >>> ns.make_controller("network", tables, task).inputs[:2]
        ('sensor_0', 'sensor_1')
    """
    for what, given, made in (("simulator", simulator, "load"), ("task", task, "make_task")):
        if isinstance(given, str | Path):
            raise UserError(
                f"make_controller needs the {what} itself, not its name {str(given)!r}: give "
                f"neurosim.{made}({str(given)!r})"
            )
    maker = CONTROLLERS.get(kind)
    fields = [one.name for one in dataclasses.fields(maker)] if _is_settings(maker) else []
    if simulator is not None and "inputs" in fields and "inputs" not in settings:
        settings["inputs"] = usual_inputs(simulator, task)
        if not settings["inputs"]:
            raise UserError(
                f"a {kind} needs something to observe: the simulator has no sensors and the task "
                "no goals; use a simulator with sensors, such as tables (neurosim build-tables), "
                "or give inputs, such as x, y, cos_heading, sin_heading"
            )
    if simulator is not None and "outputs" in fields and "outputs" not in settings:
        names = tuple(name for name in simulator.command_names if name != "duration")
        settings["outputs"] = names
        limits = [simulator.domain.get(name, (-100.0, 100.0)) for name in names]
        settings.setdefault("scale", tuple(max(map(abs, pair)) for pair in limits))
    if simulator is not None and kind == "plan":
        settings = {**_within(simulator), **settings}
    return CONTROLLERS.make(kind, settings)


def usual_inputs(simulator: Any, task: Any) -> tuple[str, ...]:
    """Return the default observations: the sensors, and the position of the next goal."""
    if task is None:
        return tuple(simulator.reading_names)
    goals = () if task.episode.goals is None else GOAL_INPUTS
    return (*task.placed(simulator).reading_names, *goals)


def units_of(simulator: Any) -> dict[str, str]:
    """Return the units of a simulator's inputs by name; empty if it does not know them."""
    return {one["name"]: one["unit"] for one in getattr(simulator, "inputs", ())}


def _within(simulator: Any) -> dict[str, Any]:
    """Return settings of plans, with defaults limited to a simulator's data."""
    settings: dict[str, Any] = {}
    *names, last = simulator.command_names
    if last != "duration":
        return settings
    known = units_of(simulator)
    percent = all(known.get(name, "%") == "%" for name in names)
    if (*names, last) == COMMAND_NAMES and percent:
        speeds = [simulator.domain[name] for name in names if name in simulator.domain]
        fastest = max((abs(end) for pair in speeds for end in pair), default=math.inf)
        if fastest * (1.0 + simulator.slack) < Plan.max_speed:
            settings["max_speed"] = max(fastest, 1.0)
    elif set(names) <= set(simulator.domain):
        settings["names"] = tuple(names)
        settings["units"] = tuple(known.get(name) or "1" for name in names)
        settings["limits"] = tuple(tuple(map(float, simulator.domain[name])) for name in names)
    low, high = simulator.domain.get("duration", (0.0, math.inf))
    slack = simulator.slack * (high - low) if math.isfinite(high) else 0.0
    shortest, longest = Plan.durations
    if shortest < low - slack or longest > high + slack:
        shortest = min(max(shortest, low), high)
        settings["durations"] = shortest, max(min(longest, high), shortest)
    return settings


def _is_settings(maker: Any) -> bool:
    return isinstance(maker, type) and dataclasses.is_dataclass(maker)
