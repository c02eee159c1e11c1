"""``neurosim track``: a recording's video, or any video, -> poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from neurosim.base.declared import Coordinate
from neurosim.base.errors import UserError
from neurosim.base.files import check_free
from neurosim.cli._common import (
    COLOUR_NAMES,
    calibration_option,
    emit,
    is_given,
    json_option,
    next_step,
    tag_option,
)
from neurosim.cli._types import NEW, PATH, PIXEL, Option, ranged


@click.command()
@click.argument("recording", type=PATH)
@click.option(
    "--colours",
    "--markers",
    "markers",
    help="Colours FRONT,REAR of the markers; or apriltag or aruco, a printed tag; or a "
    "markers.json, as neurosim watch saves it, which says where they are, too.  "
    f"[default: as recorded, or pink,blue]  Colours: {COLOUR_NAMES}.",
)
@tag_option
@click.option(
    "--all-tags",
    is_flag=True,
    help="Video files: track every tag of the dictionary in view, each into a folder of its own.",
)
@calibration_option("The camera's calibration.json.  [default: the one kept with the recording]")
@click.option(
    "--overlay", type=NEW, help="Also write a video with the tracked markers drawn over it."
)
@click.option(
    "--video",
    "videos",
    multiple=True,
    type=PATH,
    help="Video of a session that was filmed by another program; give it once for each session.",
)
@click.option(
    "--partial", is_flag=True, help="Use the existing part of a video that was cut short."
)
@click.option(
    "--sync",
    type=click.Choice(["flash", "motion"]),
    help=(
        "How the camera's clock is aligned with the robot's: by the lamp, or by the robot's "
        "answers to its commands.  [default: the lamp, if it was switched on]"
    ),
)
@click.option(
    "--click",
    "clicks",
    cls=Option,
    type=PIXEL,
    multiple=True,
    help=(
        "Video files: a pixel of the front marker in the first frame; give it again for the rear "
        "marker."
    ),
)
@click.option(
    "--doubtful",
    is_flag=True,
    help="Also write the poses of a pair that may not be the robot, marked as doubtful.",
)
@click.option("-o", "--out", type=PATH, help="New folder for the poses of a video file.")
@click.option(
    "--height",
    type=ranged(Coordinate),
    help=(
        "Video files, with a calibration over the board: height of the markers over it, m.  "
        "[default: as markers.json says, or 0]"
    ),
)
@json_option
def track(
    recording: Path,
    markers: str | None,
    tag: int | None,
    all_tags: bool,
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
    """Find the markers, or the tag, in every frame of RECORDING, or of a video file by itself.

    The poses of a recording go into its poses.csv, in metres, on the robot's clock. A video file
    needs -o. Without a calibration, or with one of the lens alone, its poses are in pixels.
    """
    from neurosim.recording.markers import marker_settings
    from tracking.datasets.recordings import Recording
    from tracking.markers.palette import describe_markers, least_confident, warning
    from tracking.markers.sought import sought
    from tracking.track import describe_doubtful, track_video
    from tracking.track import track as track_

    if not recording.exists():
        raise UserError(f"{recording}: no recording or video file has this name")
    if recording.is_file():
        for name in ("sync", "videos"):
            if is_given(name):
                raise UserError(
                    f"--{name.removesuffix('s')} is for recordings, not for a video file: leave "
                    "it out"
                )
        if out is None:
            raise UserError(f"{recording} is a video file; name a folder for its poses with -o")
        if clicks and (markers or tag is not None):
            raise UserError("--click takes the colours from the picture; leave out --markers")
        if len(clicks) not in (0, 2):
            raise UserError("--click: give it twice, for the front marker, then for the rear one")
        pixels = [list(pixel) for pixel in clicks]
        known = marker_settings(markers, tag=0 if all_tags and markers is None else tag)
        if all_tags:
            if tag is not None or "tag" not in known:
                raise UserError(
                    "--all-tags tracks all tags of a dictionary: give --markers apriltag or aruco "
                    "with it, and no --tag"
                )
            _track_all(
                recording, known, out, as_json, markers=known if _is_file(markers) else None,
                calibration=calibration, height=height, overlay=overlay, partial=partial,
            )  # fmt: skip
            return
        what = None if clicks else sought(known)
        placed = known if _is_file(markers) else None
        result = track_video(
            recording, what, out, markers=placed,
            calibration=calibration, height=height, overlay=overlay, clicks=pixels or None,
            doubtful=doubtful, partial=partial,
        )  # fmt: skip
        result.pop("poses")
        where, colours, then = out, result["markers"], ""
        remedy = "click on each with --click U,V, or name others with --markers"
    else:
        if clicks:
            raise UserError("--click is for video files; set a recording's colours with --markers")
        if out is not None:
            raise UserError("-o is for video files; a recording's poses go into its own folder")
        if height is not None:
            raise UserError(
                "--height is for video files; a recording's markers have theirs in recording.json, "
                "or in a markers.json (--markers)"
            )
        if all_tags:
            raise UserError("--all-tags is for video files; choose a recording's tag with --tag")
        check_free(recording, "recorded into")
        known = marker_settings(markers, tag=tag, recorded=Recording(recording).meta["markers"])
        result = track_(
            recording, None, calibration, overlay, videos, markers=known,
            partial=partial, sync=sync, doubtful=doubtful,
        )  # fmt: skip
        for session in result["sessions"]:
            if session.get("warning"):
                click.echo(f"session {session['session']}: {session['warning']}", err=True)
        where, colours = recording, least_confident(result["sessions"])
        then = "\n" + next_step("dataset", recording, "-o", "DATASET")
        remedy = "name others with --markers; neurosim watch shows what a click on each finds"
    if result["undecided"]:
        click.echo(
            f"{recording}: in {result['undecided']} frames after the robot was lost, several "
            "pairs, or tags, fitted the robot, and none was accepted",
            err=True,
        )
    problem = warning(colours)
    doubtful_poses = describe_doubtful(result)
    if doubtful_poses and not problem:
        click.echo(f"{recording}: {doubtful_poses}", err=True)
    if problem:
        click.echo(f"{recording}: {problem}; {remedy}", err=True)
    emit(
        result,
        as_json,
        f"{where}: {result['frames']} frames, the robot found in {100 * result['in_view']:.1f} %, "
        f"median quality {result['quality']:.2f}.\n{describe_markers(colours)}.{then}",
    )


def _is_file(markers: str | None) -> bool:
    return markers is not None and markers.endswith(".json")


def _track_all(
    video: Path, known: dict[str, Any], out: Path, as_json: bool, **options: Any
) -> None:
    """Track every tag of a dictionary in a video, and print a summary of each."""
    from tracking.track import track_tags

    tracked = track_tags(video, known["tag"]["dictionary"], out, **options)
    lines = []
    for number, result in tracked.items():
        result.pop("poses")
        lines.append(
            f"{out / f'tag-{number}'}: {result['frames']} frames, tag {number} found in "
            f"{100 * result['in_view']:.1f} %, median quality {result['quality']:.2f}."
        )
    emit({"tags": list(tracked.values())}, as_json, "\n".join(lines))
