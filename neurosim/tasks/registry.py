"""The tasks by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from neurosim.base.errors import UserError
from neurosim.base.registry import Registry
from neurosim.tasks.base import Task

#: By name: a class whose settings are keywords.
TASKS = Registry(
    "task",
    "neurosim.tasks",
    {
        "nine-rectangles": "neurosim.tasks.nine_rectangles:NineRectangles",
        "obstacle-avoidance": "neurosim.tasks.obstacle_avoidance:ObstacleAvoidance",
        "go-to": "neurosim.tasks.go_to:GoTo",
        "follow-line": "neurosim.tasks.follow_line:FollowLine",
        "phototaxis": "neurosim.tasks.stay_near:Phototaxis",
        "discrimination": "neurosim.tasks.stay_near:Discrimination",
        "walking": "neurosim.tasks.walking:Walking",
    },
)


def make_task(task: str | Mapping[str, Any] | Task, **settings: Any) -> Task:
    """Return a task.

    Args:
        task: its name; or ``{"name", "settings"}``, as in artefacts; or the task itself.
        settings: of a task that is given by name.

    Raises:
        UserError: if the task or a setting is unknown.

    Example:
        >>> ns.make_task("obstacle-avoidance", steps=100).steps
        100
    """
    if isinstance(task, Task):
        return task
    if isinstance(task, Mapping):
        name, given = str(task.get("name")), task.get("settings", {})
        return make_task(name, **{**given, **settings})
    plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in settings.items()}
    made = TASKS.make(task, plain)
    if not isinstance(made, Task):
        raise UserError(f"the task {task} is not a neurosim.Task: subclass it")
    return made
