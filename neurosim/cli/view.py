"""``neurosim view``: a picture of a simulator and a drive in it, or the video of a trial."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click
from msgspec import Meta

from neurosim.base.errors import UserError, counted
from neurosim.cli._common import emit, is_given, json_option, seed_option
from neurosim.cli._types import NEW, PATH, POSE, Option, ranged


@click.command()
@click.argument("place", type=PATH)
@click.option("-o", "--out", type=PATH, help="The picture: .png, .svg or .pdf.")
@click.option("--video", type=NEW, help="A video instead of a picture, of a trial: .mp4.")
@click.option(
    "--simulator",
    type=PATH,
    help="Simulator to drive in, if PLACE is a place; if it is a trial, to sample from.",
)
@click.option("--controller", type=PATH, help="Controller of any kind; its path is drawn.")
@click.option(
    "--pose",
    cls=Option,
    type=POSE,
    help=(
        "Where the robot starts: x and y in cm, heading in degrees.  [the start of its task or "
        "of the place, or random]"
    ),
)
@click.option(
    "--seconds",
    type=ranged(Annotated[float, Meta(ge=0.1, le=3600)]),
    help="Time that a closed-loop controller drives, s.  [as long as its trial]",
)
@click.option(
    "--noise/--no-noise",
    default=False,
    show_default=True,
    help="Drive with the simulator's noise, one random sample.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing picture or video.")
@seed_option
@json_option
def view(
    place: Path,
    out: Path | None,
    video: Path | None,
    simulator: Path | None,
    controller: Path | None,
    pose: tuple[float, float, float] | None,
    seconds: float | None,
    noise: bool,
    overwrite: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Draw PLACE: the folder of a simulator of any kind, or the JSON file or name of a place.

    With a controller, the robot drives its task in the simulator. It is drawn at the end of its
    path, with its sensors' readings.

    With --video, PLACE is the folder of a trial. The video shows the robot, its prediction and its
    sensors. With the trial's --simulator and --controller it shows random samples, too.
    """
    if video is not None:
        from neurosim.reports.film import write_film

        for name in ("out", "pose", "seconds", "noise"):
            if is_given(name):
                raise UserError(f"--video shows a trial as it was: leave out --{name}")
        made = write_film(
            place, video, simulator=simulator, controller=controller, seed=seed, overwrite=overwrite
        )
        text = f"{video}: {made['seconds']:.1f} s, {counted(made['samples'], 'sample')}"
        emit({"video": str(video), **made}, as_json, text)
        return
    if out is None:
        raise UserError("name the picture with -o, or the video of a trial with --video")
    from neurosim.reports.view import contacts_in_words, draw_view

    result = draw_view(
        place,
        out,
        simulator=simulator,
        controller=controller,
        pose=pose,
        seconds=seconds,
        noise=noise,
        seed=seed,
        overwrite=overwrite,
    )
    text = str(out)
    if "fitness" in result:
        why = "completes the task" if result["completes"] else f"the robot {result['reason']}"
        text += f": one drive, fitness {result['fitness']:z.4g}, {why}"
        if "contacts" in result:
            text += f", {contacts_in_words(result['contacts'])}"
    emit({"picture": str(out), **result}, as_json, text)
    if result["note"]:
        click.echo(f"neurosim: {result['note']}", err=True)
