"""``neurosim track``: a recording's video, or any video, -> poses."""

from __future__ import annotations

from pathlib import Path

import click

from neurosim.base.declared import Coordinate
from neurosim.base.errors import UserError
from neurosim.cli._common import (
    COLOUR_NAMES,
    calibration_option,
    emit,
    is_given,
    json_option,
    next_step,
)
from neurosim.cli._types import PATH, PIXEL, Option, ranged


@click.command()
@click.argument("recording", type=PATH)
@click.option(
    "--colours",
    "--markers",
    "markers",
    help="Colours FRONT,REAR of the markers; or a markers.json, as neurosim watch saves it, which "
    f"says where they are, too.  [default: as recorded, or pink,blue]  Colours: {COLOUR_NAMES}.",
)
@calibration_option("The camera's calibration.json.  [default: the one kept with the recording]")
@click.option("--overlay", type=PATH, help="Also write a video with what was found drawn over it.")
@click.option(
    "--video",
    "videos",
    multiple=True,
    type=PATH,
    help="Video of a session that was filmed with something else; once for each.",
)
@click.option("--partial", is_flag=True, help="Use a video that was cut short as far as it goes.")
@click.option(
    "--sync",
    type=click.Choice(["flash", "motion"]),
    help="What aligns the camera's clock with the robot's: the lamp, or the robot's answers to its "
    "commands.  [default: the lamp, if it was switched on]",
)
@click.option(
    "--click",
    "clicks",
    cls=Option,
    type=PIXEL,
    multiple=True,
    help="Of a video file: a pixel of the front marker in its first frame; again for the rear.",
)
@click.option(
    "--doubtful",
    is_flag=True,
    help="Write the poses of a pair that may not be the robot's, too, marked as doubtful.",
)
@click.option("-o", "--out", type=PATH, help="New folder for the poses of a video file.")
@click.option(
    "--height",
    type=ranged(Coordinate),
    help="Of a video file, with a calibration over the board: height of the markers over it, m.  "
    "[default: as markers.json says, or 0]",
)
@json_option
def track(
    recording: Path,
    markers: str | None,
    calibration: Path | None,
    overlay: Path | None,
    videos: tuple[Path, ...],
    partial: bool,
    sync: str | None,
    clicks: tuple[tuple[float, float], ...],
    doubtful: bool,
    out: Path | None,
    height: float | None,
    as_json: bool,
) -> None:
    """Find the two markers in every frame of RECORDING, or of a video file by itself.

    Of a recording, the poses go into its poses.csv, in metres, on the robot's clock. A video file
    needs -o; without a calibration, or with one of the lens alone, its poses are in pixels.
    """
    from tracking.datasets.recordings import read_markers
    from tracking.markers.colours import colour_pair
    from tracking.markers.palette import describe_colours, least_confident, warning
    from tracking.track import describe_doubtful, track_video
    from tracking.track import track as track_

    if not recording.exists():
        raise UserError(f"{recording}: no such recording, and no such video file")
    known = read_markers(markers) if markers and markers.endswith(".json") else None
    pair = colour_pair(markers) if markers and known is None else None
    if recording.is_file():
        for name in ("sync", "videos"):
            if is_given(name):
                raise UserError(
                    f"--{name.removesuffix('s')} is for recordings; a video file by itself has no "
                    "other clock and no other video: leave it out"
                )
        if out is None:
            raise UserError(f"{recording} is a video file; name a folder for its poses with -o")
        if clicks and markers:
            raise UserError("--click takes the colours from the picture; leave out --colours")
        if len(clicks) not in (0, 2):
            raise UserError("--click: give it twice, for the front marker, then for the rear one")
        pixels = [list(pixel) for pixel in clicks]
        if known is not None:
            pair = known["front"]["colour"], known["rear"]["colour"]
        front, rear = pair or ("pink", "blue")
        result = track_video(
            recording, front, rear, out, markers=known,
            calibration=calibration, height=height, overlay=overlay, clicks=pixels or None,
            doubtful=doubtful, partial=partial,
        )  # fmt: skip
        result.pop("poses")
        where, found, then = out, result["markers"], ""
        remedy = "click on each with --click U,V, or name others with --colours"
    else:
        if clicks:
            raise UserError("--click is for video files; set a recording's colours with --colours")
        if out is not None:
            raise UserError("-o is for video files; a recording's poses go into its own folder")
        if height is not None:
            raise UserError(
                "--height is for video files; a recording's markers have theirs in recording.json, "
                "or in a markers.json (--markers)"
            )
        result = track_(
            recording, pair, calibration, overlay, videos, markers=known,
            partial=partial, sync=sync, doubtful=doubtful,
        )  # fmt: skip
        for session in result["sessions"]:
            if session.get("warning"):
                click.echo(f"session {session['session']}: {session['warning']}", err=True)
        where, found = recording, least_confident(result["sessions"])
        then = "\n" + next_step("dataset", recording, "-o", "DATASET")
        remedy = "name others with --colours; neurosim watch shows what a click on each finds"
    if result["undecided"]:
        click.echo(
            f"{recording}: in {result['undecided']} frames after the robot was lost, several pairs "
            "could have been it, and none was taken",
            err=True,
        )
    problem = warning(found)
    doubtful_poses = describe_doubtful(result)
    if doubtful_poses and not problem:
        click.echo(f"{recording}: {doubtful_poses}", err=True)
    if problem:
        click.echo(f"{recording}: {problem}; {remedy}", err=True)
    emit(
        result,
        as_json,
        f"{where}: {result['frames']} frames, the robot found in {100 * result['found']:.1f} %, "
        f"median quality {result['quality']:.2f}.\n{describe_colours(found)}.{then}",
    )
