"""Settings of a recording, in addition to robot, camera and commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from neurosim.base.declared import (
    Checked,
    Count,
    FullSpeed,
    Metres,
    MetresOrNone,
    Percent,
    Seconds,
    SecondsOrNone,
)
from neurosim.base.place import Place
from neurosim.robots.base import Robot
from tracking.camera.cameras import Camera
from tracking.datasets.recordings import DEFAULT_BOARD, DEFAULT_MARKERS


@dataclass(frozen=True)
class Guard(Checked):
    """The guard that keeps the robot on the board, by light sensors and by its tracked position.

    Attributes:
        at_line: Reaction if a light sensor sees a line or the robot reaches the board's edge:
            return inside and continue, end the session, or ignore it.
        contrast: Difference of a light sensor's reading (0..1) from that of the bare board at
            which it is a line.
        retreat: distance to drive back from the line, m: more than the longest straight command, so
            that the robot then has room ahead of it.
        speed: of the retreat, in percent.
        attempts: number of times that a cut command is sent again.
        lead_in: seconds for which the previous command is driven again before a cut command is
            repeated, so that it begins at the same speeds.
        margin: smallest distance of the middle of the axle from the board's edge, for the guard by
            position, m.
        unseen: time without sight, s, after which a robot without light sensors is stopped until it
            is seen.
        by: Guard of the board: light sensors and the tracked position, or only the position, if the
            board has other lines than the perimeter.
    """

    at_line: Literal["return", "end", "ignore"] = "return"
    contrast: Annotated[float, Meta(ge=0.001, le=1)] = 0.12
    retreat: Metres = 0.9
    speed: Percent = 50.0
    attempts: Count = 4
    lead_in: SecondsOrNone = 0.6
    margin: MetresOrNone = 0.12
    unseen: Seconds = 1.0
    by: Literal["both", "position"] = "both"


@dataclass(frozen=True)
class Rig:
    """A robot and its camera.

    Attributes:
        robot: its driver; its motors are always stopped at the end. It is connected by the
            recorder; a virtual one inside ``with``.
        camera: its camera, or None.
        finish: a function that is always called with (folder, session) after a session's files are
            closed, or None; the virtual lab writes its truth there.
        lab: settings of the virtual lab; None for a real robot.
        place: places a virtual robot at a pose (m, m, rad); None for a real one, which a person
            places.
    """

    robot: Robot
    camera: Camera | None = None
    finish: Callable[[Path, int], None] | None = None
    lab: dict[str, Any] | None = None
    place: Callable[..., None] | None = None

    @classmethod
    def of_lab(cls, rig: Any) -> Rig:
        """Return the rig of a :class:`neurosim.lab.VirtualRig`."""
        return cls(rig.robot, rig.camera, rig.write_truth, rig.describe(), rig.lab.place)


@dataclass(frozen=True)
class RecordSettings(Checked):
    """Settings of a recording, in addition to robot, camera and commands.

    Attributes:
        commands: Number of commands to send.
        guard: how the robot is kept on the board.
        battery_limit: Voltage below which the recording pauses, V.
        full_speed: Wheel speed at 100 %, m/s. Like track, it is used to return inside, and to
            predict where the robot is a moment later.
        track: Track width, the distance between the wheels, m.
        markers, board: as in recording.json.
        place: The place around the robot, or None; its board is then the ``board``.
        readings: Read the sensors continuously and keep the readings, so that a simulator can learn
            them.
    """

    commands: Count = 500
    guard: Guard = field(default_factory=Guard)
    battery_limit: Annotated[float, Meta(ge=0, le=100)] = 6.5
    full_speed: FullSpeed = 0.5
    track: Annotated[float, Meta(ge=0.005, le=5)] = 0.13
    markers: dict[str, Any] = field(default_factory=lambda: DEFAULT_MARKERS)
    board: dict[str, float] = field(default_factory=lambda: DEFAULT_BOARD)
    place: Place | None = None
    readings: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.place is not None and self.place.board is not None:
            object.__setattr__(self, "board", asdict(self.place.board))
