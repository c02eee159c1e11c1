"""Folders to copy: a user's own robot, task, simulator or controller, with its test.

A template's files have three words that are replaced: ``my-thing`` by the name, ``my_thing`` by the
name in Python's form, ``MyThing`` by the beginning of class names. They are replaced in names of
files, too.
"""

from __future__ import annotations

import keyword
import re
from importlib.resources import files as package_files
from pathlib import Path

from neurosim.base.errors import UserError
from neurosim.base.files import new_folder, write_text
from neurosim.base.registry import Registry
from neurosim.controllers.registry import CONTROLLERS
from neurosim.robots.registry import ROBOTS
from neurosim.simulators.registry import SIMULATORS
from neurosim.tasks.registry import TASKS

#: The kinds of templates, and the registry of each.
TEMPLATES: dict[str, Registry] = {
    "robot": ROBOTS,
    "task": TASKS,
    "simulator": SIMULATORS,
    "controller": CONTROLLERS,
}
_NAME = re.compile(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*")
#: Ending of template files, so that no tool mistakes them for modules.
_SUFFIX = ".txt"


def make_from_template(kind: str, name: str, folder: str | Path) -> list[Path]:
    """Make a folder with a user's own part that works at once.

    Args:
        kind: a key of :data:`TEMPLATES`.
        name: name of the part, such as ``my-robot``.
        folder: the new folder.

    Returns:
        Its files.

    Raises:
        UserError: if the name is invalid or taken, or the folder is not empty.
    """
    module = name.replace("-", "_")
    if not _NAME.fullmatch(name) or keyword.iskeyword(module) or len(name) > 40:
        raise UserError(
            f"{name[:60]!r} cannot be the name of a {kind}: give lower-case letters and digits, "
            f"with - between words, such as my-{kind}"
        )
    registry = TEMPLATES[kind]
    if registry.is_own(name):
        raise UserError(f"the name {name!r} is taken by neurosim's own {registry.what}")
    words = {"my-thing": name, "my_thing": module, "MyThing": _class_name(name)}
    folder = Path(folder)
    with new_folder(folder) as partial:
        written = []
        for source in package_files(__package__).joinpath(kind).iterdir():
            place = _replaced(source.name.removesuffix(_SUFFIX), words)
            write_text(partial / place, _replaced(source.read_text("utf-8"), words))
            written.append(folder / place)
    return sorted(written)


def _class_name(name: str) -> str:
    return "".join(word.capitalize() for word in re.split("[-_]", name))


def _replaced(text: str, words: dict[str, str]) -> str:
    for word, other in words.items():
        text = text.replace(word, other)
    return text
