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
    is_given,
    json_option,
    markers_option,
    next_step,
    place_option,
    resume_option,
    seed_option,
    tag_option,
)
from neurosim.cli._options import SettingsCommand, given_options, settings_options
from neurosim.cli._robots import camera_options, robot_option, without_camera
from neurosim.cli._types import PATH

if TYPE_CHECKING:
    from neurosim.recording.by_hand import Hand
    from tracking.datasets.recordings import Recording


def _begun(values: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a recording, or of a guided one's first round."""
    from neurosim.base.files import read_json

    for path in (values["out"] / "recording.json", values["out"] / "round-01" / "recording.json"):
        if path.exists():
            options = without_camera(read_json(path, "neurosim-recording", 1).get("options"))
            options.pop("calibration", None)
            if (kept := path.with_name("calibration.json")).exists():
                options["calibration"] = str(kept)  # the original file may be gone
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
@place_option
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
@click.option(
    "--by-hand",
    is_flag=True,
    help="Drive by keyboard or game pad, on a page with the camera's picture.",
)
@click.option(
    "--by-network",
    "controller",
    type=PATH,
    help="Drive with this closed-loop controller (a folder from evolve), for the steps of its task "
    "or --commands of them. Put the robot at its start.",
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
    place: Path | None,
    markers: str | None,
    tag: int | None,
    live: bool,
    page: bool,
    guided: bool,
    by_hand: bool,
    controller: Path | None,
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

    With --by-hand, a person drives on a page in the browser; its address is printed. Commands are
    recorded as they are given. --max-speed limits them. The robot stops if the page is closed or
    hidden, and at the board's edge.
    """
    from neurosim.base.errors import UserError
    from neurosim.base.place import Place
    from neurosim.controllers import read_controller
    from neurosim.recording.by_hand import Hand
    from neurosim.recording.commands import RandomCommands
    from neurosim.recording.markers import marker_settings
    from neurosim.recording.record import record as record_
    from neurosim.recording.settings import Guard, RecordSettings
    from neurosim.trials.driver import driver_of
    from neurosim.trials.rig import Setup, open_rig

    _check_who_drives(guided=guided, by_hand=by_hand, by_network=controller is not None)
    commands = RandomCommands(**source, seed=seed)
    hand = Hand(commands.max_speed) if by_hand else None
    around = None if place is None else Place.of(place)
    marked = marker_settings(markers, robot, tag)
    how = RecordSettings(**settings, guard=Guard(**guard), markers=marked, place=around)

    def given(seed: int, start: tuple[float, float, float] | None) -> Setup:
        set_up = {**camera, "place": around, "markers": marked, "real_time": by_hand}
        return Setup(**set_up, seed=seed, start=start)

    @contextmanager
    def opened(seed: int, start: tuple[float, float, float] | None) -> Iterator[Any]:
        with (
            open_rig(robot, robot_options, given(seed, start)) as rig,
            _page(page, rig.camera, how, calibration if live else None, hand) as on_seen,
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
    saved = None if controller is None else read_controller(controller)
    # Each session of a resumed recording has new noise, as on a real robot.
    session = _sessions(out) if resume else 0
    with opened(seed + 1000 * session, saved and saved.start) as (rig, on_seen):
        drives: Any = hand or commands
        if saved is not None:
            drives = driver_of(
                controller, rig, calibration if live else None, settings.get("commands")
            )
        recording = record_(
            out,
            rig,
            drives,
            how,
            calibration=calibration,
            live=live,
            on_seen=on_seen,
            resume=resume,
            options=given_options(),
        )
    count = how.commands if drives is commands else None
    result = _summary(out, count, [recording])
    emit(
        result,
        as_json,
        _words(result) + _next(out, recording, calibration),
    )
    if (out / "sightings.csv").exists() and not recording.is_tracked:
        # It was tracked, and has no poses: stderr has the reason.
        click.get_current_context().exit(1)


def _check_who_drives(**drivers: bool) -> None:
    """Raise an error for options that do not fit the choice of the driver."""
    from neurosim.base.errors import UserError

    chosen = [name for name, is_chosen in drivers.items() if is_chosen]
    if len(chosen) > 1:
        both = " and ".join(f"--{name.replace('_', '-')}" for name in chosen)
        raise UserError(f"{both} do not go together: choose who drives")
    meant_for_others = {
        "by_hand": ("commands", "durations", "straight", "stopped", "round"),
        "by_network": ("durations", "straight", "stopped", "max_speed", "round", "resume"),
    }
    for driver in chosen:
        for name in meant_for_others.get(driver, ()):
            if is_given(name):
                option = f"--{name.replace('_', '-')}"
                raise UserError(f"{option} is not for --{driver.replace('_', '-')}: leave it out")


def _summary(out: Path, commands: int | None, made: list[Recording]) -> dict[str, Any]:
    """Return a summary of a recording; without a number of commands, the sent ones count."""
    from tracking.markers.palette import least_confident

    lines = [part.commands() for part in made]
    kinds = [kind for part in lines for kind in part["kind"]]
    return {
        "recording": str(out),
        "commands": kinds.count("command") if commands is None else commands,
        "sent": kinds.count("command"),
        "cut": kinds.count("cut"),
        "sessions": sum(part.sessions for part in made),
        "tracked": all(part.is_tracked for part in made),
        "markers": least_confident(
            [session for part in made for session in part.tracked_sessions()]
        ),
        "robot_seconds": sum(float(part.groupby("session")["time"].last().sum()) for part in lines),
    }


def _words(result: dict[str, Any]) -> str:
    from neurosim.base.errors import counted
    from tracking.markers.palette import describe_markers

    markers = describe_markers(result["markers"])
    return (
        f"{result['recording']}: {counted(result['commands'], 'command')} ({result['sent']} sent, "
        f"{result['cut']} cut at the line), "
        f"{result['robot_seconds'] / 60:.1f} minutes of the robot's time.\n"
        + (f"{markers}.\n" if markers else "")
    )


def _next(out: Path, recording: Any, calibration: Path | None) -> str:
    if recording.is_tracked:
        return next_step("dataset", out, "-o", "DATASET")
    filmed = () if recording.video(1) else ("--video", "VIDEO")
    calibrated = () if calibration else ("--calibration", "calibration.json")
    return next_step("track", out, *filmed, *calibrated)


@contextmanager
def _page(
    wanted: bool, camera: Any, settings: Any, calibration: Path | None, hand: Hand | None = None
) -> Iterator[Callable[[Any], None] | None]:
    """Serve a page with the camera's picture during a recording; give its viewer.

    With a hand, the robot is driven there.
    """
    if not wanted and hand is None:
        yield None
        return
    from neurosim.base.errors import UserError
    from neurosim.watch import PageServer, Viewer
    from tracking.camera.camera_model import CameraModel
    from tracking.markers.sought import sought

    model = None if calibration is None else CameraModel.read(calibration)
    tracked = camera is not None and model is not None and model.has_board
    if not tracked and hand is None:
        raise UserError(
            "--watch needs live tracking: give a camera and a --calibration with points on the "
            "board"
        )
    viewer = Viewer(
        (640, 480) if camera is None else camera.size,
        settings.markers,
        sought(settings.markers),
        camera=model,
        board=settings.board,
        place=settings.place,
        label="recording",
        seen_by="tracker" if tracked else "nobody" if camera is None else "camera",
        hand=hand,
    )
    with PageServer(viewer) as server:
        click.echo(f"{'Watch' if hand is None else 'Drive'} at {server.url}", err=True)
        yield viewer.show
        viewer.end("the recording has ended")


def _sessions(out: Path) -> int:
    from tracking.datasets.recordings import Recording

    return Recording(out).sessions
