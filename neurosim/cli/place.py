"""``neurosim place``: files of places."""

from __future__ import annotations

from pathlib import Path

import click

from neurosim.cli._common import emit, json_option, next_step
from neurosim.cli._types import PATH


@click.group()
def place() -> None:
    """Files of places: walls, obstacles, lines, lights, the board and the start."""


@place.command("import")
@click.argument("drawing", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="The place's new file, .json.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@json_option
def import_(drawing: Path, out: Path, overwrite: bool, as_json: bool) -> None:
    """Make the file of a place from DRAWING, an SVG.

    Name elements or layers outline, walls, obstacles, lines, lights, board, perimeter and start.
    Name a line of known length scale-50cm; without one, the page's size counts.
    """
    from neurosim.base.drawing import read_drawing
    from neurosim.base.errors import UserError, counted
    from neurosim.base.files import check_new_file

    if out.suffix != ".json":
        raise UserError(f"{out}: the file of a place ends in .json")
    check_new_file(out, "file", overwrite=overwrite)
    drawn, notes = read_drawing(drawing)
    drawn.write(out)
    for note in notes:
        click.echo(f"warning: {drawing}: {note}", err=True)
    counts = {
        "corners": len(drawn.outline),
        "walls": len(drawn.walls),
        "obstacles": len(drawn.obstacles),
        "lines": len(drawn.lines),
        "lights": len(drawn.lights),
    }
    there = [name for name in ("board", "start") if getattr(drawn, name) is not None]
    what = [*(counted(count, name[:-1]) for name, count in counts.items() if count), *there]
    result = {"place": str(out), **counts, **{name: name in there for name in ("board", "start")}}
    picture = out.with_suffix(".png")
    emit(result, as_json, f"{out}: {', '.join(what)}.\n" + next_step("view", out, "-o", picture))
