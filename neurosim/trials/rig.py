"""A robot and its camera, ready for use: real ones, or those of the virtual lab."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import Meta

from neurosim.base.declared import Baud, Checked, Fps, Metres, Pose, SecondsOrNone, Seed, checks
from neurosim.base.errors import UserError
from neurosim.base.interrupts import not_suspended, stopped_at_end
from neurosim.base.place import Place
from neurosim.lab import (
    CameraParams,
    Pacer,
    Push,
    VirtualKheperaRig,
    VirtualLinesRig,
    VirtualRig,
    VirtualRosRig,
    VirtualThymioRig,
)
from neurosim.lab.khepera.rig import START
from neurosim.recording.settings import Rig
from neurosim.robots.khepera.dialects import dialect_named
from neurosim.robots.registry import ROBOTS
from neurosim.robots.ros.driver import NONE, SectorCount
from tracking.camera.cameras import open_camera

if TYPE_CHECKING:  # PyTorch, which they import, takes seconds
    from neurosim.simulators.base import Simulator
    from neurosim.tasks.base import Task

#: Virtual robots that sample themselves.
_SAMPLERS = ("virtual-khepera", "virtual-thymio")
#: Width or height of a frame, pixels.
Side = Annotated[int, Meta(ge=120, le=8192)]


@dataclass(frozen=True)
class Setup(Checked):
    """Settings of a rig, in addition to the robot's own options.

    Attributes:
        camera: A camera's number, a file or URL that OpenCV opens, lab for the virtual lab's, or
            none. By default, if one is needed: 0, in the virtual lab its own.
        size: Width and height of a frame in pixels; of the virtual lab's camera by default 640x480.
        fps: Frames per second; of the virtual lab's camera by default 30.
        seed: Random seed of the virtual lab's noise in this session.
        start: Pose at which a person, or the virtual lab, places the robot (m, m, rad); None: the
            lab's default.
        place: The place around a virtual robot; by default that of its lab: a board, or the arena
            of the Khepera's paper.
        markers: The markers of a virtual robot, as in recording.json; by default its two colours.
        real_time: The virtual lab's time is the wall clock's, as for driving by hand.
    """

    camera: str | None = None
    size: tuple[Side, Side] | None = None
    fps: Fps | None = None
    seed: Seed = 0
    start: Pose | None = None
    place: Place | None = None
    markers: dict[str, Any] | None = None
    real_time: bool = False


def place_of(robot: str, task: Task, simulator: Simulator | None) -> Place | None:
    """Return the place for a virtual robot: its task's, or, if it samples, its simulator's."""
    from neurosim.simulators.base import InPlace

    if task.place is None and robot in _SAMPLERS and isinstance(simulator, InPlace):
        return simulator.place
    return task.place


@contextmanager
def open_rig(
    robot: str, options: Mapping[str, Any] | None = None, setup: Setup | None = None
) -> Iterator[Rig]:
    """Open a robot and its camera, and close both.

    Args:
        robot: a name in :data:`RIGS`.
        options: of the robot: keywords of its driver, or of :func:`virtual`,
            :func:`virtual_khepera`.
        setup: further settings.

    Raises:
        UserError: if the robot is unknown, or does not take these options.
        RobotError: if it cannot be reached.
    """
    setup = setup or Setup()
    if robot in _VIRTUAL:
        try:
            opened = _VIRTUAL[robot](setup, **(options or {}))
        except TypeError as error:
            raise UserError(f"the robot {robot} does not take these options: {error}") from None
        with opened as rig:
            if setup.markers is not None and rig.camera is not None:
                rig.camera.carry(setup.markers)
            yield rig
        return
    if setup.camera == "lab":
        raise UserError("--camera lab is for virtual robots; name a real camera")
    driver = ROBOTS.make(robot, options or {})
    with not_suspended(), stopped_at_end(lambda: driver.stop()):
        try:
            # The robot before the camera, so that its errors come first.
            driver.connect()
            camera = None
            if setup.camera != "none":
                camera = open_camera(setup.camera or "0", driver.clock.now, setup.size, setup.fps)
            yield Rig(driver, camera)
        finally:
            driver.close()


@contextmanager
@checks
def virtual(
    setup: Setup,
    *,
    lab_seed: Seed = 0,
    lamp: str | None = "A",
    push: Annotated[float, Meta(ge=0, le=1)] = 0.0,
    push_after: SecondsOrNone = 5.0,
    real_time: bool = False,
) -> Iterator[Rig]:
    """Open the virtual lab's NXT under its roof camera.

    Args:
        setup: further settings.
        lab_seed: Number of the virtual lab's robot and board.
        lamp: The lamp: A (on motor port A), color:3 (of the colour sensor on port 3), or none.
        push: A hand pushes the robot aside by this distance while it drives, m; the random seed
            chooses the direction.
        push_after: Time of the push after the start of the drive, s.
        real_time: Run the lab in real time, not as fast as the computer can.

    Raises:
        UserError: if the push is impossible.
    """
    hand = None
    if push:
        direction = np.random.default_rng([setup.seed, 0x9054]).uniform(-math.pi, math.pi)
        hand = Push(push, push_after, float(direction))
    common = _common(replace(setup, real_time=real_time or setup.real_time))
    with (
        VirtualRig(
            lab_seed,
            lamp=None if lamp == "none" else lamp,
            push=hand,
            **common,
        ) as rig,
        _paced(rig.lab, common["real_time"]),
    ):
        yield Rig.of_lab(rig)


@contextmanager
@checks
def virtual_khepera(setup: Setup, *, lab_seed: Seed = 0, baud: Baud | None = None) -> Iterator[Rig]:
    """Open the virtual lab's Khepera, with a camera above its start.

    Args:
        setup: further settings.
        lab_seed: Number of the virtual lab's robot.
        baud: Speed of its serial line; by default the robot's own, 9600.
    """
    camera = None
    if _has_camera(setup):
        camera = CameraParams(size=setup.size or (640, 480), fps=setup.fps or 30.0)
    with (
        VirtualKheperaRig(
            lab_seed,
            noise_seed=setup.seed,
            place=setup.place,
            start=_start(setup, START),
            baud=baud or dialect_named("khepera").baud,
            camera=camera,
            real_time=setup.real_time,
        ) as rig,
        _paced(rig.lab, setup.real_time),
    ):
        yield Rig(rig.robot, rig.camera, None, rig.describe(), rig.lab.place)


@checks
def virtual_car(setup: Setup, *, lab_seed: Seed = 0) -> AbstractContextManager[Rig]:
    """Open the virtual lab's model car (a speed and a steering angle) under its roof camera.

    It describes itself in lines of text, and has no lamp.

    Args:
        setup: further settings.
        lab_seed: Number of the virtual lab's car.
    """
    return _on_board(VirtualLinesRig, lab_seed, setup, kind="car")


@checks
def virtual_omni(setup: Setup, *, lab_seed: Seed = 0) -> AbstractContextManager[Rig]:
    """Open the virtual lab's omnidirectional base (vx, vy, omega) under its roof camera.

    It describes itself in lines of text.

    Args:
        setup: further settings.
        lab_seed: Number of the virtual lab's base.
    """
    return _on_board(VirtualLinesRig, lab_seed, setup, kind="omni")


@checks
def virtual_thymio(setup: Setup, *, lab_seed: Seed = 0) -> AbstractContextManager[Rig]:
    """Open the virtual lab's Thymio II under its roof camera.

    Args:
        setup: further settings.
        lab_seed: Number of the virtual lab's Thymio.
    """
    return _on_board(VirtualThymioRig, lab_seed, setup)


@checks
def virtual_ros(
    setup: Setup,
    *,
    lab_seed: Seed = 0,
    laser: str = NONE,
    laser_sectors: SectorCount = 8,
    laser_reach: Metres = 1.0,
) -> AbstractContextManager[Rig]:
    """Open the virtual lab's base behind a rosbridge (v, omega) under its roof camera.

    Args:
        setup: further settings.
        lab_seed: Number of the virtual lab's base.
        laser: Topic of the laser's scans, /scan; none: they are not read.
        laser_sectors: Number of sensors into which a scan is divided.
        laser_reach: Distance from which on a sensor reads 0, m.
    """
    scans = {"laser": laser, "laser_sectors": laser_sectors, "laser_reach": laser_reach}
    return _on_board(VirtualRosRig, lab_seed, setup, **scans)


def _common(setup: Setup) -> dict[str, Any]:
    """Return the common settings of rigs on the board."""
    return {
        "noise_seed": setup.seed,
        "start": _start(setup, (0.0, 0.0, 0.0)),
        "camera": _has_camera(setup),
        "camera_size": setup.size or (640, 480),
        "fps": setup.fps or 30.0,
        "real_time": setup.real_time,
        "around": setup.place or Place(),
    }


def _start(setup: Setup, usual: Pose) -> Pose:
    """Return the start of a virtual robot: the given one, its place's, or the default."""
    own = None if setup.place is None else setup.place.start
    return setup.start or own or usual


def _paced(lab: Any, real_time: bool) -> AbstractContextManager[Any]:
    """Return the pacer that keeps a lab in step with the wall clock, if wanted."""
    return Pacer(lab) if real_time else nullcontext()


@contextmanager
def _on_board(
    made: type[VirtualLinesRig | VirtualThymioRig | VirtualRosRig],
    lab_seed: int,
    setup: Setup,
    **own: Any,
) -> Iterator[Rig]:
    """Open a rig on the board, connected, so that its commands and abilities are known."""
    with made(lab_seed, **own, **_common(setup)) as rig, _paced(rig.lab, setup.real_time):
        rig.robot.connect()
        yield Rig.of_lab(rig)


def _has_camera(setup: Setup) -> bool:
    """Return whether the virtual lab's own camera is wanted."""
    if setup.camera not in (None, "lab", "none"):
        raise UserError(
            f"--camera {setup.camera} does not see the virtual robot: leave it out, or name a real "
            "robot with --robot"
        )
    return setup.camera != "none"


_VIRTUAL: dict[str, Callable[..., AbstractContextManager[Rig]]] = {
    "virtual": virtual,
    "virtual-khepera": virtual_khepera,
    "virtual-car": virtual_car,
    "virtual-omni": virtual_omni,
    "virtual-thymio": virtual_thymio,
    "virtual-ros": virtual_ros,
}


class Rigs:
    """All robots by the names that ``--robot`` takes: the virtual lab's, and all drivers."""

    def names(self) -> list[str]:
        """Return all names."""
        return [*_VIRTUAL, *ROBOTS.names()]

    def is_virtual(self, name: str) -> bool:
        """Return whether the robot of this name is one of the virtual lab."""
        return name in _VIRTUAL

    def get(self, name: str) -> Callable[..., Any]:
        """Return the callable whose keywords are the robot's options.

        Raises:
            UserError: if the name is unknown.
        """
        return _VIRTUAL[name] if name in _VIRTUAL else ROBOTS.get(name, list(_VIRTUAL))


RIGS = Rigs()
