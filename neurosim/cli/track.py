"""``neurosim track``: a recording's video, or any video, -> poses."""

from __future__ import annotations

import math
from pathlib import Path

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import NUMBER, PATH, emit, json_option, next_step


@click.command()
@click.argument("recording", type=PATH)
@click.option("--colours", help="Of the markers: FRONT,REAR.  [default: as recorded; pink,blue]")
@click.option("--calibration", type=PATH, help="[default: the one kept with the recording]")
@click.option("--overlay", type=PATH, help="Also write a video with what was found drawn over it.")
@click.option(
    "--video",
    "videos",
    multiple=True,
    type=PATH,
    help="Of a session that was filmed with something else; once for each.",
)
@click.option("--partial", is_flag=True, help="Use a video that was cut short as far as it goes.")
@click.option(
    "--sync",
    type=click.Choice(["flash", "motion"]),
    default="flash",
    show_default=True,
    help="What ties the camera's clock to the robot's: the lamp, or the robot's answers to its "
    "commands.",
)
@click.option(
    "--click",
    "clicks",
    multiple=True,
    metavar="U,V",
    help="Of a video file: a pixel of the front marker in its first frame; again for the rear.",
)
@click.option("-o", "--out", type=PATH, help="A video file's poses go to this new folder.")
@click.option(
    "--height",
    type=NUMBER,
    default=0.0,
    show_default=True,
    help="Of a video file's markers over the board, m.",
)
@json_option
def track(
    recording: Path,
    colours: str | None,
    calibration: Path | None,
    overlay: Path | None,
    videos: tuple[Path, ...],
    partial: bool,
    sync: str,
    clicks: tuple[str, ...],
    out: Path | None,
    height: float,
    as_json: bool,
) -> None:
    """Find the two markers in every frame of RECORDING, or of a video file by itself.

    Of a recording, the poses go into its poses.csv, in metres, on the robot's clock. A video file
    needs -o; without a calibration its poses are in pixels.
    """
    from tracking.markers.palette import in_words, least_sure, warning
    from tracking.track import track as track_
    from tracking.track import track_video

    if not recording.exists():
        raise UserError(f"{recording}: no such recording, and no such video file")
    pair = _pair(colours) if colours else None
    if recording.is_file():
        if out is None:
            raise UserError(f"{recording} is a video file; name a folder for its poses with -o")
        if clicks and colours:
            raise UserError("--click takes the colours from the picture; leave out --colours")
        places = _places(clicks) if clicks else None
        front, rear = pair or ("pink", "blue")
        result = track_video(
            recording, front, rear, out,
            calibration=calibration, height=height, overlay=overlay, clicks=places,
        )  # fmt: skip
        result.pop("poses")
        where, markers, then = out, result["markers"], ""
        remedy = "click on each with --click U,V, or name others with --colours"
    else:
        if clicks:
            raise UserError("--click is for video files; set a recording's colours with --colours")
        if out is not None:
            raise UserError("-o is for video files; a recording's poses go into its own folder")
        result = track_(recording, pair, calibration, overlay, videos, partial=partial, sync=sync)
        for session in result["sessions"]:
            if session.get("warning"):
                click.echo(f"session {session['session']}: {session['warning']}", err=True)
        where, markers = recording, least_sure(result["sessions"])
        then = "\n" + next_step("dataset", recording, "-o", "DATASET")
        remedy = "name others with --colours; neurosim watch shows what a click on each finds"
    doubt = warning(markers)
    if doubt:
        click.echo(f"{recording}: {doubt}; {remedy}", err=True)
    emit(
        result,
        as_json,
        f"{where}: {result['frames']} frames, the robot found in {100 * result['found']:.1f} %, "
        f"median quality {result['quality']:.2f}.\n{in_words(markers)}.{then}",
    )


def _pair(colours: str) -> tuple[str, str]:
    names = [name.strip() for name in colours.split(",")]
    if len(names) != 2 or not all(names):
        raise UserError(f"--colours {colours!r}: expected two colours, such as pink,blue")
    return names[0], names[1]


def _places(clicks: tuple[str, ...]) -> list[list[float]]:
    try:
        places = [[float(part) for part in text.split(",")] for text in clicks]
    except ValueError:
        places = []
    finite = all(math.isfinite(part) for place in places for part in place)
    if len(places) != 2 or any(len(place) != 2 for place in places) or not finite:
        raise UserError("--click: expected two of them, U,V in pixels, front first, then rear")
    return places
