"""``neurosim print-page``: two markers and a chessboard on a page to print."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from neurosim.cli._common import COLOUR_NAMES, emit, json_option
from neurosim.cli._options import SettingsCommand, settings_options
from neurosim.cli._types import PATH, PATTERN


@click.command("print-page", cls=SettingsCommand)
@click.argument("out", type=PATH)
@settings_options(
    "settings",
    "tracking.printing:PageSettings",
    units={"diameter": "mm", "square": "mm"},
    kinds={"pattern": PATTERN},
    helps={
        "colours": (
            f"Colours of the front and the rear marker, FRONT,REAR. Colours: {COLOUR_NAMES}."
        )
    },
)
@json_option
def print_page(out: Path, settings: dict[str, Any], as_json: bool) -> None:
    """Make a page to print: two markers and a chessboard, at true size, as OUT (.pdf or .svg).

    Print it at 100 %, cut the markers out with their black backing and lay them flat on the robot;
    glue the chessboard to something flat and photograph it with the robot's camera.
    """
    from tracking.printing import PageSettings, write_page

    page = PageSettings(**settings)
    write_page(out, page)
    pattern, square = "x".join(map(str, page.pattern)), f"{1000 * page.square:g}"
    emit(
        {"page": str(out), "pattern": list(page.pattern), "square": page.square,
         "diameter": page.diameter, "colours": page.colours},
        as_json,
        f"{out}: two markers of {1000 * page.diameter:g} mm ({page.colours}) and a chessboard with "
        f"squares of {square} mm, on {page.paper}. Print it at 100 %.\n"
        f"Next: neurosim watch --markers {page.colours}, and photographs of the chessboard for\n"
        f"neurosim calibrate PHOTOGRAPHS --pattern {pattern} --square {square}",
    )  # fmt: skip
