"""``neurosim watch``: the camera's picture on a page; colours, board and place set by clicking."""

from __future__ import annotations

import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from neurosim.base.declared import Fps
from neurosim.base.errors import UserError, counted
from neurosim.base.interrupts import ended_as_usual
from neurosim.cli._common import (
    calibration_option,
    emit,
    json_option,
    markers_option,
    next_step,
    page_options,
    tag_option,
)
from neurosim.cli._types import PATH, SIZE, Option, ranged


@click.command()
@click.option(
    "--camera",
    default="0",
    show_default=True,
    help="A camera's number, a video file, a URL that OpenCV opens, or lab for the virtual lab's.",
)
@click.option("--camera-size", cls=Option, type=SIZE, help="Frame size.  [lab: 640x480]")
@click.option("--fps", type=ranged(Fps), help="Frame rate.  [lab: 30]")
@markers_option
@tag_option
@calibration_option("A calibration.json of the camera, or of its lens alone.")
@click.option(
    "-o",
    "--out",
    type=PATH,
    default=Path("calibration.json"),
    show_default=True,
    help="Where the page saves the calibration; markers.json is written next to it.",
)
@click.option(
    "--place",
    type=PATH,
    help="A place's .json file, shown over the picture if it exists. The page draws on it and "
    "saves it there.  [default: place.json next to the calibration]",
)
@click.option(
    "--film",
    type=PATH,
    help="Also write the camera's pictures to a new .avi file, for neurosim track.",
)
@page_options
@json_option
def watch(
    camera: str,
    camera_size: tuple[int, int] | None,
    fps: float | None,
    markers: str | None,
    tag: int | None,
    calibration: Path | None,
    out: Path,
    place: Path | None,
    film: Path | None,
    port: int,
    open_browser: bool,
    seconds: float | None,
    as_json: bool,
) -> None:
    """Show the camera's picture and the tracked robot on a page in the browser.

    On the page, one click sets a marker's colour, four clicks set the board's corners, and clicks
    draw a place: walls, obstacles, lines, lights and the start. The page works on this computer
    only.
    """
    from neurosim.base.place import Place
    from neurosim.recording.markers import marker_settings
    from neurosim.watch import PageServer, Viewer
    from tracking.camera.camera_model import CameraModel
    from tracking.camera.cameras import Film
    from tracking.datasets.recordings import DEFAULT_BOARD
    from tracking.live import LiveTracker
    from tracking.markers.pair import Geometry
    from tracking.markers.sought import sought
    from tracking.poses import marker_geometry

    known = marker_settings(markers, tag=tag)
    what = sought(known)
    model = None if calibration is None else CameraModel.read(calibration)
    if place is not None and place.suffix != ".json":
        raise UserError(f"{place}: the file of a place ends in .json")

    def geometry(model: CameraModel | None) -> Geometry:
        if model is None or not model.has_board:
            return Geometry()
        return marker_geometry(known, model)

    with _open_camera(camera, camera_size, fps, known) as source:
        if model is not None and tuple(model.image_size) != tuple(source.size):
            raise UserError(
                f"{calibration} is for pictures of {model.image_size[0]}x{model.image_size[1]}, "
                f"but the camera gives {source.size[0]}x{source.size[1]}; set its size with "
                "--camera-size"
            )
        viewer = Viewer(
            source.size,
            known,
            what,
            camera=model,
            board=DEFAULT_BOARD,
            look_for=lambda what, model: tracker.look_for(what, geometry(model)),
            calibration_file=out,
            markers_file=out.with_name("markers.json"),
            place_file=place or out.with_name("place.json"),
            place=None if place is None or not place.exists() else Place.read(place),
            label="virtual lab" if camera == "lab" else f"camera {camera}",
        )
        tracker = LiveTracker(
            what,
            geometry(model),
            time.monotonic,
            viewer.show,
        )
        if film is not None and Path(camera).is_file():
            raise UserError(f"{camera} is a video file: --film is for cameras; leave it out")
        filmed = None if film is None else Film(film, source.size)

        def take(at: float, frame: Any) -> None:
            if filmed is not None:
                filmed.take(at, frame)
            tracker.take(at, frame)

        with PageServer(viewer, port) as server:
            source.start(take)
            try:
                emit(
                    {"url": server.url},
                    as_json,
                    f"Open {server.url}\nThe address is good on this computer until Ctrl-C.",
                )
                if open_browser:
                    webbrowser.open(server.url)
                _wait(source, tracker, seconds)
            except KeyboardInterrupt:
                ended_as_usual()
            except UserError as error:
                viewer.end(str(error))
                time.sleep(1.0)  # for the page to fetch it
                raise
            finally:
                source.stop()
                tracker.close()
                if filmed is not None:
                    _say_filmed(filmed.path, filmed.close())


def _say_filmed(film: Path, frames: int) -> None:
    click.echo(
        f"{film}: {counted(frames, 'frame')}. {next_step('track', film, '-o', 'POSES')}"
        if frames
        else f"{film}: the camera delivered nothing to film",
        err=True,
    )


def _wait(source: Any, tracker: Any, seconds: float | None) -> None:
    end = time.monotonic() + seconds if seconds is not None else float("inf")
    while time.monotonic() < end:
        if source.failed:
            raise UserError("the camera stopped delivering pictures; is it still plugged in?")
        if tracker.failed:
            return
        time.sleep(0.1)


@contextmanager
def _open_camera(name: str, size: Any, fps: float | None, markers: dict[str, Any]) -> Iterator[Any]:
    if name == "lab":
        with _lab_camera(size or (640, 480), fps or 30.0) as camera:
            camera.carry(markers)
            yield camera
        return
    from tracking.camera.cameras import VideoCamera, open_camera

    if Path(name).is_file():
        yield VideoCamera(name)
    else:
        yield open_camera(name, time.monotonic, size, fps)


@contextmanager
def _lab_camera(size: tuple[int, int], fps: float) -> Iterator[Any]:
    """The lab's camera in real time, over a robot that drives in a circle."""
    from neurosim.lab import Pacer, VirtualRig

    with (
        VirtualRig(0, start=(0.0, -0.4, 0.0), camera_size=size, fps=fps, real_time=True) as rig,
        rig.robot,
        Pacer(rig.lab),
    ):
        rig.robot.drive((22, 31))
        yield rig.camera
