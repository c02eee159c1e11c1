"""``neurosim print-page``: markers, or a tag, and a chessboard on a page to print."""

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
    units={"diameter": "mm", "side": "mm", "square": "mm"},
    kinds={"pattern": PATTERN},
    helps={
        "markers": (
            "Colours of the front and the rear marker, FRONT,REAR; or apriltag or aruco, a tag. "
            f"Colours: {COLOUR_NAMES}."
        )
    },
)
@json_option
def print_page(out: Path, settings: dict[str, Any], as_json: bool) -> None:
    """Make a page to print: markers and a chessboard, at true size, as OUT (.pdf or .svg).

    Print it at 100 %. Cut the markers out with their black backing, or the tag with its white edge,
    and lay them flat on the robot;
    glue the chessboard to something flat and photograph it with the robot's camera.
    """
    from tracking.printing import PageSettings, write_page

    page = PageSettings(**settings)
    write_page(out, page)
    pattern, square = "x".join(map(str, page.pattern)), f"{1000 * page.square:g}"
    carried: dict[str, Any] = {"markers": page.markers, "diameter": page.diameter}
    what = f"two markers of {1000 * page.diameter:g} mm ({page.markers})"
    then = f"--markers {page.markers}"
    if (tag := page.printed_tag) is not None:
        carried = {"tag": tag.as_dict(), "side": page.side}
        what, then = f"{tag}, {1000 * page.side:g} mm,", f"{then} --tag {tag.number}"
    emit(
        {"page": str(out), "pattern": list(page.pattern), "square": page.square, **carried},
        as_json,
        f"{out}: {what} and a chessboard with squares of {square} mm, on {page.paper}. Print it at "
        f"100 %.\nNext: neurosim watch {then}, and photographs of the chessboard for\n"
        f"neurosim calibrate PHOTOGRAPHS --pattern {pattern} --square {square}",
    )  # fmt: skip
