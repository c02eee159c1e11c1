"""``neurosim record``: robot + camera -> recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from neurosim.cli._common import (
    calibration_option,
    emit,
    json_option,
    markers_option,
    next_step,
    resume_option,
    seed_option,
    tag_option,
)
from neurosim.cli._options import SettingsCommand, given_options, settings_options
from neurosim.cli._robots import camera_options, robot_option, without_camera
from neurosim.cli._types import PATH

if TYPE_CHECKING:
    from tracking.datasets.recordings import Recording


def _begun(values: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a recording, or of a guided one's first round."""
    from neurosim.base.files import read_json

    for path in (values["out"] / "recording.json", values["out"] / "round-01" / "recording.json"):
        if path.exists():
            options = without_camera(read_json(path, "neurosim-recording", 1).get("options"))
            options.pop("calibration", None)
            if (kept := path.with_name("calibration.json")).exists():
                options["calibration"] = str(kept)  # whatever became of the one that was given
            return options
    return {}


@click.command(cls=SettingsCommand, begun=_begun)
@click.argument("out", type=PATH)
@settings_options(
    "settings",
    "neurosim.recording.settings:RecordSettings",
    only=("commands", "readings", "battery_limit", "full_speed", "track"),
    names={"track": "wheel-track"},
)
@settings_options("source", "neurosim.recording.commands:RandomCommands", skip=("seed",))
@settings_options(
    "guard",
    "neurosim.recording.settings:Guard",
    only=("at_line", "contrast", "by"),
    names={"contrast": "line-contrast", "by": "guard-by"},
)
@robot_option
@camera_options
@calibration_option(
    "The camera's calibration.json. It is kept with the recording, and the robot is tracked "
    "while it is recorded."
)
@markers_option
@tag_option
@click.option(
    "--live/--no-live", default=True, show_default=True, help="Track while recording, or later."
)
@click.option(
    "--watch",
    "page",
    is_flag=True,
    help="Serve a page with the camera's picture and the tracked robot.",
)
@click.option(
    "--guided",
    is_flag=True,
    help="Choose the commands in rounds, where the simulator learned so far is most uncertain.",
)
@settings_options(
    "rounds", "neurosim.recording.rounds:Rounds", only=("size",), names={"size": "round"}
)
@resume_option
@seed_option
@json_option
def record(
    out: Path,
    settings: dict[str, Any],
    source: dict[str, Any],
    guard: dict[str, Any],
    robot: str,
    robot_options: dict[str, Any],
    camera: dict[str, Any],
    calibration: Path | None,
    markers: str | None,
    tag: int | None,
    live: bool,
    page: bool,
    guided: bool,
    rounds: dict[str, Any],
    resume: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Drive a robot with random commands and film it, into the folder OUT.

    Put the robot in the middle of the board first. Lamp flashes at the beginning and at the end
    align the video's clock with the robot's.

    With --guided, OUT has one recording for each round. An ensemble is learned from all rounds so
    far, and the next commands are those about which its members disagree most. This needs a camera
    and its --calibration.
    """
    from neurosim.base.errors import UserError
    from neurosim.recording.commands import RandomCommands
    from neurosim.recording.markers import marker_settings
    from neurosim.recording.record import record as record_
    from neurosim.recording.settings import Guard, RecordSettings
    from neurosim.trials.rig import Setup, open_rig

    commands = RandomCommands(**source, seed=seed)
    how = RecordSettings(
        **settings, guard=Guard(**guard), markers=marker_settings(markers, robot, tag)
    )

    def given(seed: int, start: tuple[float, float, float] | None) -> Setup:
        return Setup(**camera, seed=seed, start=start, markers=how.markers)

    @contextmanager
    def opened(seed: int, start: tuple[float, float, float] | None) -> Iterator[Any]:
        with (
            open_rig(robot, robot_options, given(seed, start)) as rig,
            _page(page, rig.camera, how, calibration if live else None) as on_seen,
        ):
            yield rig, on_seen

    if guided:
        from neurosim.recording.rounds import Rounds, record_rounds
        from neurosim.training.guided import choose_round

        if camera.get("camera") == "none" or calibration is None:
            raise UserError(
                "--guided tracks every round: it needs a camera and its --calibration "
                "calibration.json (from neurosim calibrate)"
            )
        made = record_rounds(
            out,
            opened,
            commands,
            how,
            Rounds(how.commands, **rounds),
            choose_round,
            calibration,
            live=live,
            resume=resume,
            options=given_options(),
        )
        result = {"rounds": [str(part.path) for part in made], **_summary(out, how.commands, made)}
        emit(
            result,
            as_json,
            _words(result) + next_step("dataset", out, "-o", "DATASET"),
        )
        return
    # Each session of a resumed recording meets other noise, as it would on a real robot.
    session = _sessions(out) if resume else 0
    with opened(seed + 1000 * session, None) as (rig, on_seen):
        recording = record_(
            out,
            rig,
            commands,
            how,
            calibration=calibration,
            live=live,
            on_seen=on_seen,
            resume=resume,
            options=given_options(),
        )
    result = _summary(out, how.commands, [recording])
    emit(
        result,
        as_json,
        _words(result) + _next(out, recording.is_tracked, calibration),
    )
    if (out / "sightings.csv").exists() and not recording.is_tracked:
        # It was tracked, and has no poses: why was said on stderr.
        click.get_current_context().exit(1)


def _summary(out: Path, commands: int, made: list[Recording]) -> dict[str, Any]:
    from tracking.markers.palette import least_confident

    lines = [part.commands() for part in made]
    kinds = [kind for part in lines for kind in part["kind"]]
    return {
        "recording": str(out),
        "commands": commands,
        "sent": kinds.count("command"),
        "cut": kinds.count("cut"),
        "sessions": sum(part.sessions for part in made),
        "tracked": all(part.is_tracked for part in made),
        "markers": least_confident([told for part in made for told in part.tracked_sessions()]),
        "robot_seconds": sum(float(part.groupby("session")["time"].last().sum()) for part in lines),
    }


def _words(result: dict[str, Any]) -> str:
    from tracking.markers.palette import describe_markers

    markers = describe_markers(result["markers"])
    return (
        f"{result['recording']}: {result['commands']} commands ({result['sent']} sent, "
        f"{result['cut']} cut at the line), "
        f"{result['robot_seconds'] / 60:.1f} minutes of the robot's time.\n"
        + (f"{markers}.\n" if markers else "")
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
    from tracking.markers.sought import sought

    model = None if calibration is None else CameraModel.read(calibration)
    if camera is None or model is None or not model.has_board:
        raise UserError(
            "--watch needs live tracking: give a camera and a --calibration with points on the "
            "board"
        )
    viewer = Viewer(
        camera.size,
        settings.markers,
        sought(settings.markers),
        camera=model,
        board=settings.board,
        label="recording",
    )
    with PageServer(viewer) as server:
        click.echo(f"Watch at {server.url}", err=True)
        yield viewer.show
        viewer.end("the recording has ended")


def _sessions(out: Path) -> int:
    from tracking.datasets.recordings import Recording

    return Recording(out).sessions
