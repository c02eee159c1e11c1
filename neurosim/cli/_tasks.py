"""What ``--task`` takes: a name, or a file with name and settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neurosim.base.errors import FileError
from neurosim.base.files import read_json
from neurosim.tasks.base import Task
from neurosim.tasks.registry import TASKS

FORMAT, VERSION = "neurosim-task", 1


def read_task(text: str) -> tuple[type[Task], dict[str, Any]]:
    """Return a task's class and the settings that a file gives it.

    Raises:
        UserError: if there is no such task.
        FileError: if the file is not that of a task.
    """
    if not text.endswith(".json"):
        return TASKS.get(text), {}
    path = Path(text)
    content = read_json(path, FORMAT, VERSION, {"name": str, "settings": dict})
    if content["name"] not in TASKS.names():
        known = ", ".join(TASKS.names())
        raise FileError(path, f"expected one of {known}, found {content['name']!r}", field="name")
    return TASKS.get(content["name"]), content["settings"]
