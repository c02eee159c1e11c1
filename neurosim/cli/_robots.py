"""The options that say which robot, and the rig (robot and camera) they stand for."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import NumberIn, Size, is_given

_KHEPERA_OPTIONS = [
    click.option(
        "--port",
        "serial_port",
        help="Khepera: its serial port, such as /dev/ttyUSB0 or COM3, or a URL of pyserial.",
    ),
    click.option(
        "--dialect",
        type=click.Choice(["khepera", "khepera3", "epuck"]),
        help="Khepera I or II, Khepera III or e-puck.  [khepera]",
    ),
    click.option(
        "--baud",
        type=click.IntRange(min=300),
        help="Khepera: speed of its line.  [9600; khepera3, epuck: 115200]",
    ),
]
_OPTIONS = [
    click.option(
        "--robot",
        default="virtual",
        show_default=True,
        help="virtual (the lab in software), nxt, khepera, or a driver that a package added.",
    ),
    click.option("--host", help="NXT over Bluetooth: its address, such as 00:16:53:01:02:03."),
    click.option("--device", help="NXT over a device file, such as /dev/rfcomm0."),
    click.option("--server", help="NXT behind nxt-server: HOST:PORT."),
    click.option("--left", "left_port", default="B", show_default=True, help="Left motor's port."),
    click.option(
        "--right", "right_port", default="C", show_default=True, help="Right motor's port."
    ),
    click.option(
        "--lamp",
        default="A",
        show_default=True,
        help="The lamp: a motor port, color:PORT for the colour sensor's own, or none.",
    ),
    click.option(
        "--light-left", default="1", show_default=True, help="Left light sensor's port, or none."
    ),
    click.option(
        "--light-right", default="2", show_default=True, help="Right light sensor's port, or none."
    ),
    click.option("--invert", is_flag=True, help="The motors are mounted the other way round."),
    *_KHEPERA_OPTIONS,
    click.option(
        "--camera",
        default=None,
        help="A camera's number, a file or URL that OpenCV opens, or none.  [default: 0; the "
        "virtual lab has its own]",
    ),
    click.option("--camera-size", type=Size(), help="Frame size.  [virtual default: 640x480]"),
    click.option("--fps", type=NumberIn(1, 240), help="Frame rate.  [virtual default: 30]"),
    click.option(
        "--lab-seed",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Which of the virtual lab's robots and boards.",
    ),
]


def robot_options(command: Callable) -> Callable:
    """Add the options that say which robot and camera."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def khepera_options(command: Callable) -> Callable:
    """Add the options that say where a Khepera is."""
    for option in reversed(_KHEPERA_OPTIONS):
        command = option(command)
    return command


def khepera_or_virtual(robot_help: str, lab_seed_help: str) -> Callable:
    """Return what adds the options of a verb that only a Khepera, virtual or real, can do.

    Args:
        robot_help: help of ``--robot``.
        lab_seed_help: help of ``--lab-seed``.
    """

    def add(command: Callable) -> Callable:
        robot = click.option(
            "--robot",
            type=click.Choice(["virtual", "khepera"]),
            default="virtual",
            show_default=True,
            help=robot_help,
        )
        lab_seed = click.option(
            "--lab-seed",
            type=click.IntRange(min=0),
            default=0,
            show_default=True,
            help=lab_seed_help,
        )
        return robot(khepera_options(lab_seed(command)))

    return add


def khepera(options: dict[str, Any]) -> Any:
    """Make the driver that the options of :func:`khepera_options` stand for, not connected.

    Raises:
        UserError: without a port.
    """
    from neurosim.robots.khepera.driver import Khepera

    port, dialect, baud = (options[name] for name in ("serial_port", "dialect", "baud"))
    if port is None:
        raise UserError(
            "a Khepera is reached by its serial port: give --port, such as /dev/ttyUSB0 or COM3"
        )
    return Khepera(port, dialect=dialect or "khepera", baud=baud)


def virtual_khepera_baud(options: dict[str, Any]) -> int:
    """Return the speed of a virtual Khepera's line, as :func:`khepera_options` say.

    Raises:
        UserError: for an option that only a real one has.
    """
    from neurosim.robots.khepera.dialects import dialect_named

    for name, option in (("serial_port", "--port"), ("dialect", "--dialect")):
        if options[name] is not None:
            raise UserError(f"{option} is for a real robot: add --robot khepera")
    return options["baud"] or dialect_named("khepera").baud


@dataclass
class Rig:
    """A robot, what films it, what to do when a session ends, and in which virtual lab."""

    robot: Any
    camera: Any
    finish: Callable[[Path, int], None] | None
    lab: dict[str, Any] | None


@contextmanager
def open_rig(
    options: dict[str, Any], *, seed: int, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Iterator[Rig]:
    """Make the robot and camera that the options stand for.

    Args:
        options: the values of ``robot_options``; they are taken out of the dict.
        seed: of the virtual lab's chances in this session.
        start: pose at which a person puts the robot; in the lab, where it is put.
    """
    kind = options.pop("robot")
    lab_seed = options.pop("lab_seed")
    size, fps, source = (options.pop(name) for name in ("camera_size", "fps", "camera"))
    if kind == "virtual":
        _refuse_hardware(source)
        from neurosim.lab import VirtualRig

        with VirtualRig(
            lab_seed,
            noise_seed=seed,
            start=start,
            camera=source != "none",
            camera_size=size or (640, 480),
            fps=fps or 30.0,
            lamp=_or_none(options["lamp"]),
        ) as virtual:
            yield Rig(virtual.robot, virtual.camera, virtual.write_truth, virtual.describe())
        return
    robot = _robot(kind, options)
    try:
        # The robot before the camera: what is wrong with it is said first.
        robot.connect()
        yield Rig(robot, open_camera(source, robot.clock.now, size, fps), None, None)
    finally:
        robot.close()


#: Options that mean nothing to the virtual robot, whose wiring is what it is.
_HARDWARE = {
    "host": "--host",
    "device": "--device",
    "server": "--server",
    "left_port": "--left",
    "right_port": "--right",
    "light_left": "--light-left",
    "light_right": "--light-right",
    "invert": "--invert",
    "serial_port": "--port",
    "dialect": "--dialect",
    "baud": "--baud",
}
_OF_KHEPERA = ("serial_port", "dialect", "baud")


def _refuse_hardware(camera: str | None) -> None:
    given = [option for name, option in _HARDWARE.items() if is_given(name)]
    if camera not in (None, "none"):
        given.append("--camera")
    if given:
        raise UserError(
            f"{given[0]} is for a real robot: name it, for example with --robot nxt, or leave "
            f"{given[0]} out to use the virtual lab"
        )


def _robot(kind: str, options: dict[str, Any]) -> Any:
    from neurosim.robots import robot_factory

    factory = robot_factory(kind)
    for name, option in {**_HARDWARE, "lamp": "--lamp"}.items():
        if is_given(name) and kind in ("nxt", "khepera"):
            theirs = "khepera" if name in _OF_KHEPERA else "nxt"
            if theirs != kind:
                raise UserError(f"{option} is for --robot {theirs}, not for --robot {kind}")
    if kind == "khepera":
        return khepera(options)
    wanted = _driver_options(options)
    if kind != "nxt":
        # A driver from elsewhere has options of its own: it gets those that were given.
        wanted = {name: value for name, (value, given) in wanted.items() if given}
    else:
        theirs = ("port", "dialect", "baud")
        wanted = {name: value for name, (value, _) in wanted.items() if name not in theirs}
    try:
        inspect.signature(factory).bind(**wanted)
    except TypeError as error:
        raise UserError(f"the driver {kind!r} does not take these options: {error}") from None
    return factory(**wanted)


def _driver_options(options: dict[str, Any]) -> dict[str, tuple[Any, bool]]:
    """Return the driver's keywords: value, and whether the user gave it."""
    found: dict[str, tuple[Any, bool]] = {}
    server = options["server"]
    if server:
        name, _, port = server.rpartition(":")
        if not port.isdigit():
            raise UserError(f"--server {server!r}: expected HOST:PORT, such as localhost:2727")
        found["server_host"] = (name or "localhost", True)
        found["server_port"] = (int(port), True)
    for keyword, option in (
        ("port", "serial_port"),
        ("dialect", "dialect"),
        ("baud", "baud"),
        ("host", "host"),
        ("filename", "device"),
        ("left", "left_port"),
        ("right", "right_port"),
        ("lamp", "lamp"),
        ("light_left", "light_left"),
        ("light_right", "light_right"),
        ("invert", "invert"),
    ):
        value = options[option]
        if option in ("lamp", "light_left", "light_right"):
            value = _or_none(value)
        found[keyword] = (value, is_given(option))
    return found


def _or_none(text: str | None) -> str | None:
    return None if text in (None, "none") else text


def open_camera(source: str | None, now: Callable[[], float], size: Any, fps: float | None) -> Any:
    """Open the camera that ``--camera`` names; None where it says none."""
    if source == "none":
        return None
    from tracking.camera.cameras import OpenCVCamera

    number_or_name = int(source or 0) if source is None or source.isdigit() else source
    return OpenCVCamera(number_or_name, now, size, fps)
