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
    """How the robot is kept on the board, by light sensors and by its tracked position.

    Attributes:
        at_line: Reaction if a light sensor sees a line or the robot reaches the board's edge:
            return inside and continue, end the session, or ignore it.
        contrast: Difference of a light sensor's reading (0..1) from that of the bare board at
            which it is a line.
        retreat: metres to drive back over, away from the line: more than the longest straight
            command, so that a robot sent back has room ahead of it.
        speed: of the retreat, in percent.
        attempts: how often a command is sent again if it was cut.
        lead_in: seconds to drive the previous command's speeds again before a command that was
            cut is repeated: it then starts from what it would have started from.
        margin: by position, the middle of the axle stays so far inside the board's edge, m.
        unseen: without light sensors, a robot that was not seen for so many seconds is stopped
            until it is.
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
    """A robot, and what films it.

    Attributes:
        robot: its driver; its motors are stopped whatever happens. That of a real robot is
            connected, as is a virtual one inside ``with``.
        camera: what films it, or None.
        finish: what is to be called with (folder, session) when a session's files are closed,
            whatever happened, or None; the virtual lab writes its truth there.
        lab: what makes the same virtual lab again; None for a real robot.
        place: puts a virtual robot at a pose (m, m, rad); None for a real one, which a person puts.
    """

    robot: Robot
    camera: Camera | None = None
    finish: Callable[[Path, int], None] | None = None
    lab: dict[str, Any] | None = None
    place: Callable[..., None] | None = None

    @classmethod
    def of_lab(cls, rig: Any) -> Rig:
        """Return that of a :class:`neurosim.lab.VirtualRig`."""
        return cls(rig.robot, rig.camera, rig.write_truth, rig.describe(), rig.lab.place)


@dataclass(frozen=True)
class RecordSettings(Checked):
    """Settings of a recording, in addition to robot, camera and commands.

    Attributes:
        commands: Number of commands to send.
        guard: how the robot is kept on the board.
        battery_limit: Voltage below which the recording pauses, V.
        full_speed: Wheel speed at 100 %, m/s. Only to find back inside, as the next.
        track: Track width, the distance between the wheels, m.
        markers, board: as in recording.json.
        place: The place around the robot, or None; its board is then the ``board``.
        readings: Read the sensors all the time and keep the readings, so that a simulator can learn
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
