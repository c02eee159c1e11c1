"""``neurosim lab``: the virtual lab by itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from neurosim.base.declared import Baud, Seconds
from neurosim.base.errors import UserError
from neurosim.base.interrupts import ended_as_usual
from neurosim.cli._common import emit, is_given, json_option, next_step, seed_option
from neurosim.cli._types import PATH, POSE, SIZE, Option, ranged

_port_option = click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    help="Port of the socket; 0: any that is free.",
)
_seconds_option = click.option(
    "--seconds", type=ranged(Seconds), help="Stop after this time, s.  [default: with Ctrl-C]"
)


def _line_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add --socket and --port; the command takes ``line``, the settings of a rig's line."""

    @click.option("--socket", "by_socket", is_flag=True, help="Serve a socket, not a device.")
    @_port_option
    @wraps(command)
    def with_line(by_socket: bool, port: int, **others: Any) -> None:
        if is_given("port") and not by_socket:
            raise UserError("--port is the port of a socket: add --socket")
        line = {"device": "socket" if by_socket else None, "port": port, "real_time": True}
        command(line=line, **others)

    return with_line


def _place_options(default: str | None, start: str) -> Callable[[Any], Any]:
    """Return a decorator that adds --place and --start.

    Args:
        default: the usual place; None: the board.
        start: words for the robot's default start.
    """
    place = click.option(
        "--place",
        type=PATH,
        default=default,
        show_default=default or "the board",
        help="The place, a JSON file or a name; arena: 60 x 35 cm with three obstacles.",
    )
    pose = click.option(
        "--start",
        cls=Option,
        type=POSE,
        help="Where the robot stands at first: x and y in cm, heading in degrees.  "
        f"[the place's own; {start}]",
    )
    return lambda command: place(pose(command))


def _board_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add --place, --start and --seed; the command takes ``board``, these settings of a rig."""

    @_place_options(None, "by default the middle")
    @seed_option
    @wraps(command)
    def with_board(
        place: Path | None, start: tuple[float, float, float] | None, seed: int, **others: Any
    ) -> None:
        from neurosim.base.place import Place

        around = Place() if place is None else Place.of(place)
        pose = start or around.start or (0.0, 0.0, 0.0)
        board = {"robot_seed": seed, "around": around, "start": pose, "camera": False}
        command(board=board, **others)

    return with_board


@click.group()
def lab() -> None:
    """The virtual lab by itself: robots for other programs, photographs for calibration."""


@lab.command()
@_board_options
@_line_options
@_seconds_option
@json_option
def nxt(board: dict[str, Any], line: dict[str, Any], seconds: float | None, as_json: bool) -> None:
    """Keep a virtual NXT running in real time, for any program that uses LEGO's protocol."""
    from neurosim.lab import VirtualRig

    with VirtualRig(**line, **board) as rig:
        where, how = _commands_for(rig.address)
        about = f"A virtual NXT runs in real time. Reach it with:\n{how}"
        _keep(rig, seconds, where, as_json, about)


@lab.command()
@_place_options("arena", "in the default arena -22 0 0")
@_line_options
@click.option(
    "--baud",
    type=ranged(Baud),
    default=9600,
    show_default=True,
    help="Speed of the serial line.",
)
@_seconds_option
@seed_option
@json_option
def khepera(
    place: Path,
    start: tuple[float, float, float] | None,
    line: dict[str, Any],
    baud: int,
    seconds: float | None,
    seed: int,
    as_json: bool,
) -> None:
    """Keep a virtual Khepera running in real time, for any program that speaks its protocol."""

    from neurosim.base.place import Place, paper_arena
    from neurosim.lab import VirtualKheperaRig
    from neurosim.lab.khepera.params import RADIUS
    from neurosim.lab.khepera.rig import START

    around = Place.of(place)
    pose = start or around.start or (START if around == paper_arena() else (0.0, 0.0, 0.0))
    around.check_start(pose, RADIUS)
    with VirtualKheperaRig(
        seed,
        place=around,
        start=pose,
        baud=baud,
        **line,
    ) as rig:
        about = (
            f"A virtual Khepera runs in real time, at {baud} baud. Reach it with:\n"
            f"  python -m serial.tools.miniterm {rig.address} {baud} --eol CR\n"
            f"  neurosim record OUT --robot khepera --port {rig.address} --camera none"
        )
        _keep(rig, seconds, {"port": rig.address, "baud": baud}, as_json, about)


@lab.command()
@click.option(
    "--kind",
    type=click.Choice(["wheels", "car", "omni"]),
    default="wheels",
    show_default=True,
    help="Two wheels, a model car, or a base that drives in any direction.",
)
@_board_options
@_line_options
@_seconds_option
@json_option
def lines(
    kind: str, board: dict[str, Any], line: dict[str, Any], seconds: float | None, as_json: bool
) -> None:
    """Keep a virtual robot running in real time that speaks lines of text (docs/lines.md)."""
    from neurosim.lab import VirtualLinesRig

    with VirtualLinesRig(kind=kind, **line, **board) as rig:
        about = (
            "A virtual robot that speaks lines of text runs in real time. Reach it with:\n"
            f"  python -m serial.tools.miniterm {rig.address} --eol LF   (and type hello)\n"
            f"  neurosim record OUT --robot lines --port {rig.address} --camera none"
        )
        _keep(rig, seconds, {"port": rig.address}, as_json, about)


@lab.command()
@_board_options
@_line_options
@_seconds_option
@json_option
def thymio(
    board: dict[str, Any], line: dict[str, Any], seconds: float | None, as_json: bool
) -> None:
    """Keep a virtual Thymio II running in real time, for any program that speaks Aseba."""
    from neurosim.lab import VirtualThymioRig

    with VirtualThymioRig(**line, **board) as rig:
        about = (
            "A virtual Thymio II runs in real time. Reach it with:\n"
            f"  neurosim check-robot --robot thymio --port {rig.address}\n"
            f"  neurosim record OUT --robot thymio --port {rig.address} --camera none"
        )
        _keep(rig, seconds, {"port": rig.address}, as_json, about)


@lab.command()
@_board_options
@_port_option
@_seconds_option
@json_option
def ros(board: dict[str, Any], port: int, seconds: float | None, as_json: bool) -> None:
    """Keep a virtual base running in real time behind a rosbridge, for any of its clients."""
    from neurosim.lab import VirtualRosRig

    with VirtualRosRig(port=port, real_time=True, **board) as rig:
        about = (
            "A virtual base runs in real time behind a rosbridge. Reach it with:\n"
            f"  neurosim check-robot --robot ros --url {rig.address} --stops-after 0.5\n"
            f"  neurosim record OUT --robot ros --url {rig.address} --stops-after 0.5 "
            "--camera none"
        )
        _keep(rig, seconds, {"url": rig.address}, as_json, about)


def _keep(
    rig: Any, seconds: float | None, where: dict[str, Any], as_json: bool, about: str
) -> None:
    """Keep a robot running in real time, and say how to reach it."""
    from neurosim.lab.nxt.world import Pacer

    with Pacer(rig.lab):
        emit(where, as_json, f"{about}\nCtrl-C ends it.")
        _stay(rig, seconds)


def _stay(rig: Any, seconds: float | None) -> None:
    """Return at the end of the time, when the line is lost, or at Ctrl-C."""
    end = time.monotonic() + seconds if seconds is not None else float("inf")
    try:
        while time.monotonic() < end and rig.alive:
            time.sleep(0.1)
    except KeyboardInterrupt:
        ended_as_usual()


def _commands_for(address: dict[str, str | int]) -> tuple[dict, str]:
    if "filename" in address:
        name = address["filename"]
        return address, (
            f"  nxt-test --backend devfile --filename {name}\n"
            f"  neurosim record OUT --robot nxt --filename {name} --camera none"
        )
    host, port = address["server_host"], address["server_port"]
    return address, (
        f"  nxt-test --backend socket --server-host {host} --server-port {port}\n"
        f"  neurosim record OUT --robot nxt --server-host {host} --server-port {port} --camera none"
    )


@lab.command()
@click.argument("out", type=PATH)
@click.option(
    "--count",
    type=click.IntRange(3, 1000),
    default=20,
    show_default=True,
    help="Number of photographs of the chessboard.",
)
@click.option(
    "--camera-size",
    cls=Option,
    type=SIZE,
    default="640x480",
    show_default=True,
    help="Width and height of a photograph in pixels.",
)
@click.option(
    "--over",
    type=click.Choice(["nxt", "khepera"]),
    default="nxt",
    show_default=True,
    help="The camera: under the roof, or the small one above a Khepera (sample --camera lab).",
)
@seed_option
@json_option
def photographs(
    out: Path, count: int, camera_size: tuple[int, int], over: str, seed: int, as_json: bool
) -> None:
    """Take photographs of a chessboard and of the board with the lab's camera, into OUT."""
    from neurosim.lab.camera.photographs import SQUARE, render_photographs
    from neurosim.lab.khepera.camera import SCALE
    from neurosim.lab.nxt.params import CameraParams

    scale = SCALE if over == "khepera" else 1.0
    render_photographs(out, CameraParams(size=camera_size), seed, count, scale=scale)
    square = f"{1000 * scale * SQUARE:g}"
    emit(
        {"folder": str(out), "photographs": count},
        as_json,
        f"{out}: {count} photographs of a chessboard, a picture of the board, and points.csv "
        f"with the points that a person marked in it.\n"
        + next_step("calibrate", out, "--square", square, "--points", out / "points.csv"),
    )
