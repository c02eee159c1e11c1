"""Tasks from ``--task``: a name, or a file with name and settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neurosim.base.errors import FileError
from neurosim.base.files import made, read_json
from neurosim.base.formats import Task as TaskFile
from neurosim.tasks.base import Task
from neurosim.tasks.registry import TASKS

FORMAT, VERSION = "neurosim-task", 1


class FilesAndTasks:
    """A task from ``--task``."""

    def names(self) -> list[str]:
        return TASKS.names()

    def get(self, text: str) -> type[Task] | Task:
        """Return a task's class, or the task of a file.

        Raises:
            UserError: if the task is unknown.
            FileError: if the file is not a task.
        """
        name, settings = read_task(text)
        return TASKS.make(name, settings) if settings else TASKS.get(name)


FILES_AND_TASKS = FilesAndTasks()


def read_task(text: str) -> tuple[str, dict[str, Any]]:
    """Return a task's name and settings from a file.

    Raises:
        UserError: if the task is unknown.
        FileError: if the file is not a task.
    """
    if not text.endswith(".json"):
        return text, {}
    path = Path(text)
    content = read_json(path, FORMAT, VERSION, TaskFile)
    name, settings = content["name"], content["settings"]
    if name not in TASKS.names():
        known = ", ".join(TASKS.names())
        raise FileError(path, f"expected one of {known}, found {name!r}", field="name")
    made(path, "settings", lambda **given: TASKS.make(name, given), settings)
    return name, settings
