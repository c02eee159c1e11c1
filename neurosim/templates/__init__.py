"""Folders to copy: a robot, a task, a simulator or a controller of one's own, with its test.

A template's files have three words that are replaced: ``my-thing`` by the name, ``my_thing`` by the
name as Python writes it, ``MyThing`` by the beginning of the
names of classes. They are replaced in the names of files, too.
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

#: What there are templates of, and where such things are registered.
TEMPLATES: dict[str, Registry] = {
    "robot": ROBOTS,
    "task": TASKS,
    "simulator": SIMULATORS,
    "controller": CONTROLLERS,
}
_NAME = re.compile(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*")
#: Template files end in this, so that no tool takes them for modules.
_SUFFIX = ".txt"


def make_from_template(kind: str, name: str, folder: str | Path) -> list[Path]:
    """Make a folder with a part of one's own that works at once.

    Args:
        kind: a key of :data:`TEMPLATES`.
        name: of the part, such as ``my-robot``.
        folder: a new one.

    Returns:
        Its files.

    Raises:
        UserError: if the name cannot be one or is taken, or if something stands in the folder.
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
