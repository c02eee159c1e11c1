"""``neurosim new``: a folder with a robot, task, simulator or controller to be changed."""

from __future__ import annotations

from pathlib import Path

import click

from neurosim.cli._common import emit, json_option
from neurosim.cli._types import PATH

#: For each kind, a command that works at once; see the templates.
_NEXT = {
    "robot": "neurosim --plugin {folder}/driver.py check-robot --robot {name}",
    "task": "neurosim --plugin {folder}/task.py evolve SIMULATOR --task {name} -o controller",
    "simulator": "neurosim --plugin {folder}/simulator.py evolve {folder} --task go-to "
    "-o controller",
    "controller": "neurosim --plugin {folder}/controller.py evolve SIMULATOR --task go-to "
    "--controller {name} -o controller",
}


@click.command()
@click.argument("kind", type=click.Choice(list(_NEXT)), metavar="KIND")
@click.argument("name")
@click.option("--folder", type=PATH, help="The new folder.  [default: NAME]")
@json_option
def new(kind: str, name: str, folder: Path | None, as_json: bool) -> None:
    """Make a folder with a robot, task, simulator or controller of your own, that works at once.

    KIND is robot, task, simulator or controller. NAME is how commands call it: --robot NAME. The
    folder has the code to change, its test, and a README. A robot comes with a fake of it.
    """
    from neurosim.templates import make_from_template

    folder = Path(name) if folder is None else folder
    files = make_from_template(kind, name, folder)
    try_it = _NEXT[kind].format(folder=folder, name=name)
    emit(
        {"folder": str(folder), "files": [str(path) for path in files]},
        as_json,
        f"{folder}: {', '.join(path.name for path in files)}.\n"
        f"Try it as it is: {try_it}\nIts test: pytest {folder}",
    )
