"""``neurosim record``: robot + camera -> recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from neurosim.cli._common import (
    NUMBER,
    PATH,
    POSITIVE,
    SHARE,
    NumberIn,
    Range,
    Resumable,
    emit,
    given_options,
    json_option,
    next_step,
    seed_option,
)
from neurosim.cli._robots import open_rig, robot_options

if TYPE_CHECKING:
    from tracking.datasets.recordings import Recording


def _begun(values: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a recording, or of a guided one's first round."""
    from neurosim.base.files import read_json

    for path in (values["out"] / "recording.json", values["out"] / "round-01" / "recording.json"):
        if path.exists():
            options = read_json(path, "neurosim-recording", 1).get("options")
            options = dict(options) if isinstance(options, dict) else {}
            if (kept := path.with_name("calibration.json")).exists():
                options["calibration"] = str(kept)  # whatever became of the one that was given
            return options
    return {}


@click.command(cls=Resumable, begun=_begun)
@click.argument("out", type=PATH)
@click.option("--commands", type=int, default=500, show_default=True, help="How many to send.")
@robot_options
@click.option(
    "--max-speed", type=NUMBER, default=50.0, show_default=True, help="Largest speed, in percent."
)
@click.option(
    "--durations",
    type=Range(),
    default="0.5..3",
    show_default=True,
    help="Shortest and longest, in s.",
)
@click.option(
    "--straight", type=SHARE, default=0.3, show_default=True, help="Share of equal speeds."
)
@click.option("--stopped", type=SHARE, default=0.2, show_default=True, help="Share of stops.")
@click.option(
    "--at-line",
    type=click.Choice(["return", "end", "ignore"]),
    default="return",
    show_default=True,
    help="What to do where a light sensor sees a line.",
)
@click.option(
    "--line-contrast", type=SHARE, default=0.12, show_default=True, help="Of a line, in 0..1."
)
@click.option(
    "--full-speed", type=POSITIVE, default=0.5, show_default=True, help="Wheels at 100 %, m/s, and"
)
@click.option(
    "--wheel-track",
    type=POSITIVE,
    default=0.13,
    show_default=True,
    help="between the wheels, m: to find back.",
)
@click.option(
    "--battery-limit",
    type=NumberIn(min=0),
    default=6.5,
    show_default=True,
    help="Pause below it, in V.",
)
@click.option(
    "--calibration",
    type=PATH,
    help="The camera's calibration.json, kept with the recording: with it the robot is tracked "
    "while it is recorded.",
)
@click.option(
    "--live/--no-live", default=True, show_default=True, help="Track while recording, or later."
)
@click.option("--watch", "page", is_flag=True, help="Serve a page with what is seen meanwhile.")
@click.option(
    "--markers",
    default="pink,blue",
    show_default=True,
    help="Colours FRONT,REAR, or a markers.json that watch has written.",
)
@click.option(
    "--guided",
    is_flag=True,
    help="Choose the commands in rounds, where what was learned so far is least sure.",
)
@click.option(
    "--round", "size", default=50, show_default=True, help="Commands of a round of --guided."
)
@click.option(
    "--resume", is_flag=True, help="Go on with a recording that was interrupted, with its options."
)
@seed_option
@json_option
def record(
    out: Path,
    commands: int,
    max_speed: float,
    durations: tuple[float, float],
    straight: float,
    stopped: float,
    at_line: Any,
    line_contrast: float,
    full_speed: float,
    wheel_track: float,
    battery_limit: float,
    calibration: Path | None,
    live: bool,
    page: bool,
    markers: str,
    guided: bool,
    size: int,
    resume: bool,
    seed: int,
    as_json: bool,
    **robot: Any,
) -> None:
    """Drive a robot with random commands and film it, into the folder OUT.

    Put the robot in the middle of the board first. Lamp flashes at the beginning and at the end
    join the video's clock and the robot's.

    With --guided OUT holds a recording for each round. Every round is tracked, and the next one's
    commands are those that an ensemble, learned from all rounds so far, disagrees about most. That
    needs a camera and its --calibration.
    """
    from neurosim.base.errors import UserError
    from neurosim.recording.commands import RandomCommands
    from neurosim.recording.record import Guard, RecordSettings
    from neurosim.recording.record import record as record_

    source = RandomCommands(max_speed, durations, straight, stopped, seed)
    settings = RecordSettings(
        commands,
        Guard(at_line, line_contrast),
        battery_limit,
        full_speed,
        wheel_track,
        markers=marker_settings(markers, robot["robot"]),
    )

    @contextmanager
    def opened(seed: int, start: tuple[float, float, float]) -> Iterator[Any]:
        with (
            open_rig(dict(robot), seed=seed, start=start) as rig,
            _page(page, rig.camera, settings, calibration if live else None) as on_seen,
        ):
            yield rig, on_seen

    if guided:
        from neurosim.cli._guided import record_rounds

        if robot["camera"] == "none" or calibration is None:
            raise UserError(
                "--guided looks at what every round did: it needs a camera, and its --calibration "
                "calibration.json (neurosim calibrate makes one)"
            )
        made = record_rounds(
            out,
            opened,
            source,
            settings,
            size,
            calibration,
            live=live,
            resume=resume,
            options=given_options(),
        )
        result = {"rounds": [str(part.path) for part in made], **_summary(out, commands, made)}
        emit(
            result,
            as_json,
            _words(result) + next_step("dataset", out, "-o", "DATASET"),
        )
        return
    # Each session of a resumed recording meets other chances, as it would on a real robot.
    session = _sessions(out) if resume else 0
    with opened(seed + 1000 * session, (0.0, 0.0, 0.0)) as (rig, on_seen):
        made = record_(
            out,
            rig.robot,
            rig.camera,
            source,
            settings,
            calibration=calibration,
            live=live,
            on_seen=on_seen,
            resume=resume,
            finish=rig.finish,
            lab=rig.lab,
            options=given_options(),
        )
    result = _summary(out, commands, [made])
    emit(
        result,
        as_json,
        _words(result) + _next(out, made.is_tracked, calibration),
    )


def _summary(out: Path, commands: int, made: list[Recording]) -> dict[str, Any]:
    from tracking.markers.palette import least_sure

    lines = [part.commands() for part in made]
    ends = [{line.session: line.time for line in part} for part in lines]  # of each session
    return {
        "recording": str(out),
        "commands": commands,
        "sent": sum(line.kind == "command" for part in lines for line in part),
        "cut": sum(line.kind == "cut" for part in lines for line in part),
        "sessions": sum(part.sessions for part in made),
        "tracked": all(part.is_tracked for part in made),
        "markers": least_sure([told for part in made for told in part.tracked_sessions()]),
        "robot_seconds": sum(sum(part.values()) for part in ends),
    }


def _words(result: dict[str, Any]) -> str:
    from tracking.markers.palette import in_words

    colours = in_words(result["markers"])
    return (
        f"{result['recording']}: {result['commands']} commands ({result['sent']} sent, "
        f"{result['cut']} cut at the line), "
        f"{result['robot_seconds'] / 60:.1f} minutes of the robot's time.\n"
        + (f"{colours}.\n" if colours else "")
    )


def _next(out: Path, tracked: bool, calibration: Path | None) -> str:
    if tracked:
        return next_step("dataset", out, "-o", "DATASET")
    return next_step("track", out, *(() if calibration else ("--calibration", "calibration.json")))


@contextmanager
def _page(
    wanted: bool, camera: Any, settings: Any, calibration: Path | None
) -> Iterator[Callable[[Any], None] | None]:
    """Serve a page with what is seen while a recording is made; give what to show it with."""
    if not wanted:
        yield None
        return
    from neurosim.base.errors import UserError
    from neurosim.watch import PageServer, Viewer
    from tracking.camera.camera_model import CameraModel
    from tracking.markers.colours import parse_colour

    model = None if calibration is None else CameraModel.read(calibration)
    if camera is None or model is None or not model.has_board:
        raise UserError(
            "--watch shows what is tracked live: it needs a camera, and a --calibration with "
            "points on the board"
        )
    viewer = Viewer(
        camera.size,
        settings.markers,
        tuple(parse_colour(settings.markers[which]["colour"]) for which in ("front", "rear")),
        camera=model,
        board=settings.board,
        label="recording",
    )
    with PageServer(viewer) as server:
        click.echo(f"Watch at {server.url}", err=True)
        yield viewer.show
        viewer.end("the recording has ended")


def marker_settings(colours: str, robot: str) -> dict[str, Any]:
    """Return the markers of a robot: a file's, or the default with these colours.

    Args:
        colours: FRONT,REAR or a markers.json.
        robot: as ``--robot`` names it; ``virtual khepera`` for that.
    """
    from neurosim.base.errors import UserError
    from tracking.datasets.recordings import DEFAULT_MARKERS, KHEPERA_MARKERS, read_markers
    from tracking.markers.colours import parse_colour

    if colours.endswith(".json"):
        markers = read_markers(colours)
        for which in ("front", "rear"):
            parse_colour(str(markers[which]["colour"]))
        return markers
    names = [name.strip() for name in colours.split(",")]
    if len(names) != 2 or not all(names) or names[0] == names[1]:
        raise UserError(f"--markers {colours!r}: expected two different colours, such as pink,blue")
    for name in names:
        parse_colour(name)  # says what colours there are
    if robot.startswith("virtual") and names != ["pink", "blue"]:
        raise UserError("the virtual robot's markers are pink and blue; leave --markers out")
    known = KHEPERA_MARKERS if robot.endswith("khepera") else DEFAULT_MARKERS
    front, rear = (
        {**known[which], "colour": name}
        for which, name in zip(("front", "rear"), names, strict=True)
    )
    return {**known, "front": front, "rear": rear}


def _sessions(out: Path) -> int:
    from tracking.datasets.recordings import Recording

    return Recording(out).sessions
