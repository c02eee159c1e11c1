"""``neurosim view``: a picture of an arena with a robot in it."""

from __future__ import annotations

from pathlib import Path

import click

from neurosim.cli._common import emit, json_option, seed_option
from neurosim.cli._types import NUMBER, PATH, NumberIn


@click.command()
@click.argument("arena", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="The picture: .png, .svg or .pdf.")
@click.option("--simulator", type=PATH, help="Folder of tables: shows what the sensors read.")
@click.option("--controller", type=PATH, help="Folder of a network or plan: shows its path.")
@click.option(
    "--pose",
    type=(NUMBER, NUMBER, NUMBER),
    help="Where the robot starts: x and y in cm, heading in degrees.  [the arena's, or drawn]",
)
@click.option("--seconds", type=NumberIn(0.1, 3600), default=20.0, show_default=True)
@click.option("--noise/--no-noise", default=False, show_default=True)
@seed_option
@json_option
def view(
    arena: Path,
    out: Path,
    simulator: Path | None,
    controller: Path | None,
    pose: tuple[float, float, float] | None,
    seconds: float,
    noise: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Draw ARENA: a JSON file, or the folder of a simulator of tables, whose arena it is.

    With a simulator and a controller the robot drives; it is drawn where it ends, with what its
    sensors read there.
    """
    from neurosim.reports.arena import draw_arena

    result = draw_arena(
        arena,
        out,
        simulator=simulator,
        controller=controller,
        pose=pose,
        seconds=seconds,
        noise=noise,
        seed=seed,
    )
    emit({"picture": str(out), **result}, as_json, str(out))
