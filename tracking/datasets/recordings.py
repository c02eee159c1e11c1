"""Recordings: the commands sent to a robot, its video, and the poses tracked in it.

A recording is a folder. ``recording.json`` describes robot, camera and settings; ``commands.csv``
has one line for each command, written when it is sent; ``frames.csv`` has the camera time of every
frame of the video parts; ``sightings.csv`` has the pixels of the markers, if they were tracked
live; ``observations.csv`` has the observations of a closed-loop controller; ``poses.csv`` and
``tracking.json`` come from tracking. The files can be read after any interruption.

A recording consists of sessions: the first start, and one more for every time it was resumed.
Each session has its own video part and its own clocks, with any zero.
"""

from __future__ import annotations

import datetime
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neurosim.base import formats
from neurosim.base.commands import Commands
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import (
    LineLog,
    flag,
    inside,
    integer,
    new_folder,
    number,
    optional_number,
    read_csv,
    read_header,
    read_json,
    refuse_lines,
    write_csv,
    write_json,
)
from neurosim.base.perimeter import Board
from tracking.camera.video import Video

FORMAT, VERSION = "neurosim-recording", 1
#: Kind of source for driving by hand, where each command lasts until the next line.
BY_HAND = "by-hand"
#: Longest command, s.
LONGEST = 3600.0
MARKERS_FORMAT = "neurosim-markers"
TRACKING_FORMAT, TRACKING_VERSION = "neurosim-tracking", 3

#: Kinds of lines in commands.csv.
KINDS = (
    "command",  # a numbered command, with its planned duration (none where a person drives)
    "cut",  # the motors stopped early, at a line; carries the number of the command it cut
    "manoeuvre",  # driving that is not data: the return inside
    "stop",
    "lamp-on",
    "lamp-off",
    "pause",  # the battery is low
    "end",  # the session ended normally
)
#: Kinds that change the motors' speeds.
MOTOR_KINDS = frozenset({"command", "cut", "manoeuvre", "stop"})

_FRAME_COLUMNS = ("session", "frame", "time")
SIGHTING_COLUMNS = (
    "session", "frame", "front_u", "front_v", "rear_u", "rear_v", "quality", "lamp",
)  # fmt: skip
_OBSERVATION_COLUMNS = ("session", "command", "time", "x", "y", "theta")
_POSE_COLUMNS = ("session", "frame", "time", "x", "y", "theta", "quality", "doubtful")

#: The paper's markers on this project's robot: pink in front, blue behind, in metres in the
#: robot's frame (x forward, y left, origin on the board under the middle of the axle).
DEFAULT_MARKERS: dict[str, Any] = {
    "front": {"colour": "pink", "x": 0.07, "y": 0.0},
    "rear": {"colour": "blue", "x": -0.09, "y": 0.0},
    "height": 0.10,
    "diameter": 0.06,
    "lamp": {"x": -0.01, "y": 0.0},
}
#: Markers of a Khepera unless others are given: two discs of 12 mm on its lid, 20 mm above the
#: floor, 32 mm apart along its middle (m, in the robot's frame).
KHEPERA_MARKERS: dict[str, Any] = {
    "front": {"colour": "pink", "x": 0.014, "y": 0.0},
    "rear": {"colour": "blue", "x": -0.018, "y": 0.0},
    "height": 0.020,
    "diameter": 0.012,
}
#: A printed tag of 80 mm on the same robot, behind its lamp, and a smaller one on a Khepera.
DEFAULT_TAG: dict[str, Any] = {
    "front": {"x": -0.032, "y": 0.0},
    "rear": {"x": -0.112, "y": 0.0},
    "height": 0.10,
    "lamp": {"x": -0.01, "y": 0.0},
}
KHEPERA_TAG: dict[str, Any] = {
    "front": {"x": -0.0064, "y": 0.0},
    "rear": {"x": -0.0224, "y": 0.0},
    "height": 0.020,
}
#: The paper's board (section 6.1), in metres.
DEFAULT_BOARD = asdict(Board())


#: A row of :meth:`Recording.commands`, as ``itertuples`` gives it.
CommandLine = Any


@dataclass(frozen=True)
class Poses:
    """Tracked poses, one row a frame: seconds on the session's robot clock, metres, radians.

    ``pose`` is NaN and ``quality`` 0 if the robot was lost; ``doubtful`` marks a pair that may not
    be the robot, by default none.
    """

    session: NDArray  # [N] int
    frame: NDArray  # [N] int
    time: NDArray  # [N]
    pose: NDArray  # [N, 3]
    quality: NDArray  # [N]
    doubtful: NDArray = field(default_factory=lambda: np.zeros(0, bool))  # [N] bool

    def __post_init__(self) -> None:
        if not len(self.doubtful):
            object.__setattr__(self, "doubtful", np.zeros(len(self.time), bool))

    def of_session(self, session: int) -> Poses:
        """Return the rows of one session."""
        rows = self.session == session
        return Poses(*(getattr(self, one.name)[rows] for one in fields(self)))

    def certain(self) -> Poses:
        """Return the same rows, with doubtful poses marked as not found."""
        doubtful = self.doubtful
        return replace(
            self,
            pose=np.where(doubtful[:, None], np.nan, self.pose),
            quality=np.where(doubtful, 0.0, self.quality),
            doubtful=np.zeros_like(doubtful),
        )


@dataclass(frozen=True)
class Observations:
    """A controller's observations, one row for each; seconds on the session's robot clock, metres,
    radians.

    Attributes:
        session: [N] int.
        command: [N] int, the command that followed; -1 if there was none.
        time: [N] time of the pose.
        pose: [N, 3], NaN if it was unknown.
        names: of the sensors.
        readings: [N, S] of the sensors, 0..1; NaN where one was not read.
    """

    session: NDArray
    command: NDArray
    time: NDArray
    pose: NDArray
    names: tuple[str, ...]
    readings: NDArray

    def of_session(self, session: int) -> Observations:
        """Return the rows of one session."""
        rows = self.session == session
        parts = ("session", "command", "time", "pose", "readings")
        return replace(self, **{name: getattr(self, name)[rows] for name in parts})


class Recording:
    """A recording on disk.

    Attributes:
        path: its folder.
        meta: content of recording.json.
    """

    def __init__(self, path: str | Path):
        """Open a recording.

        Raises:
            FileError: if the folder has no recording.json that this version reads.
        """
        self.path = Path(path)
        if self.path.suffix.lower() == ".csv":
            raise FileError(self.path, "is a CSV file; neurosim dataset --from csv reads it")
        if not self.path.is_dir():
            raise FileError(self.path, "no such recording; expected a folder made by record")
        self.meta = read_json(self.path / "recording.json", FORMAT, VERSION, formats.Recording)
        self.meta.setdefault("complete", False)  # it would have been said
        _check_markers(self.path / "recording.json", self.meta["markers"])
        for name in self.meta["videos"]:
            if name is not None:
                inside(self.path, name, file=self.path / "recording.json", field="videos")

    @classmethod
    def create(
        cls, path: str | Path, meta: Mapping[str, Any], calibration: str | Path | None = None
    ) -> Recording:
        """Make the folder of a new recording, whole or not at all.

        Args:
            path: a folder that does not exist yet, or is empty.
            meta: content for recording.json; ``markers`` and ``board`` have defaults.
            calibration: calibration.json of the camera, which is copied into it.

        Raises:
            UserError: if ``path`` exists.
        """
        path, takes = Path(path), Commands.of(meta.get("commands"))
        content = {
            "created": _wall_clock(),
            "complete": False,
            "robot": {},
            "camera": {},
            "settings": {},
            "markers": DEFAULT_MARKERS,
            "board": DEFAULT_BOARD,
            "units": {"time": "s", **takes.units, "duration": "s", "board": "m"},
            "sessions": [],
            "videos": [],
            **meta,
        }
        with new_folder(path) as folder:
            write_json(folder / "recording.json", FORMAT, VERSION, content)
            LineLog(folder / "commands.csv", _command_columns(takes)).close()
            if calibration is not None:
                shutil.copyfile(calibration, folder / "calibration.json")
        return cls(path)

    @property
    def takes(self) -> Commands:
        """The numbers of the robot's command.

        Raises:
            FileError: if recording.json has no valid commands.
        """
        try:
            return Commands.of(self.meta.get("commands"))
        except (KeyError, TypeError, ValueError) as error:
            raise FileError(
                self.path / "recording.json", f"describes no commands: {error}", field="commands"
            ) from None

    @property
    def by_hand(self) -> bool:
        """Whether a person drove: commands have no duration, and last until the next line."""
        source = (self.meta.get("settings") or {}).get("source") or {}
        return source.get("kind") == BY_HAND

    def save_meta(self) -> None:
        """Write ``meta`` back to recording.json."""
        content = {k: v for k, v in self.meta.items() if k not in ("format", "version")}
        write_json(self.path / "recording.json", FORMAT, VERSION, content)

    # Sessions and videos

    @property
    def sessions(self) -> int:
        """The number of sessions; they are numbered from 1."""
        return len(self.meta["sessions"])

    def begin_session(self, *, video: str | None) -> int:
        """Open the next session in recording.json and return its number."""
        self.meta["sessions"].append({"started": _wall_clock()})
        self.meta["videos"].append(video)
        self.save_meta()
        return self.sessions

    def video(self, session: int) -> Path | None:
        """Return the video part of a session, or None if it has none (yet)."""
        videos = self.meta["videos"]
        name = videos[session - 1] if session <= len(videos) else None
        return None if name is None else self.path / name

    def command_log(self) -> LineLog:
        """Open commands.csv for appending; a torn last line is removed."""
        return LineLog(self.path / "commands.csv", _command_columns(self.takes))

    def frame_log(self) -> LineLog:
        """Open frames.csv for appending; a torn last line is removed."""
        return LineLog(self.path / "frames.csv", _FRAME_COLUMNS)

    def sighting_log(self) -> LineLog:
        """Open sightings.csv for appending; a torn last line is removed."""
        return LineLog(self.path / "sightings.csv", SIGHTING_COLUMNS)

    def observation_log(self, names: Sequence[str]) -> LineLog:
        """Open observations.csv for appending, with a column for each sensor."""
        return LineLog(self.path / "observations.csv", (*_OBSERVATION_COLUMNS, *names))

    # Reading

    def commands(self) -> pd.DataFrame:
        """Read commands.csv.

        Returns:
            A row for each line, indexed by the number of the line in the file: session, command
            (its number, -1 where there is none), kind (one of :data:`KINDS`), time (s on the
            session's robot clock), the numbers of the command by name and together (a tuple),
            duration (s), is_motor, whether it changes what the motors do, and ``forward`` and
            ``turn``, the speeds that are commanded (percent of the greatest; 0 where nobody says
            how the robot moves).

        Raises:
            FileError: naming line and field: a column that is missing, a word where a number
                belongs, an unknown kind, a clock that goes backwards.
        """
        path = self.path / "commands.csv"
        parsers = {"session": integer, "command": _optional_integer, "kind": _kind, "time": number}
        names = self.takes.names
        parsers |= dict.fromkeys((*names, "duration"), optional_number)
        table = read_csv(path, parsers, drop_torn_line=True)
        table = table.astype({"command": int}).assign(is_motor=table["kind"].isin(MOTOR_KINDS))
        refuse = partial(refuse_lines, path, table)
        numbers = table[[*names]].to_numpy(float)
        whole = np.isfinite(numbers).all(axis=1)
        missing = "both speeds" if len(names) == 2 else "all its numbers"
        refuse(table["is_motor"] & ~whole, f"a motor command needs {missing}")
        known = self.takes.moves_as_known
        percent = self.takes.percent(numbers) if known else np.zeros((len(table), 2))
        table = table.assign(
            numbers=list(map(tuple, numbers.tolist())), forward=percent[:, 0], turn=percent[:, 1]
        )
        lasts = table["duration"].between(0, LONGEST, inclusive="right")
        if self.by_hand:
            lasts |= table["duration"].isna()
        refuse(
            (table["kind"] == "command") & ((table["command"] == -1) | ~lasts),
            f"a command needs a number and a duration above 0 and up to {LONGEST:g} s",
        )
        refuse(table["session"].diff() < 0, "sessions are out of order", "session")
        backwards = (table["session"].diff() == 0) & (table["time"].diff() < 0)
        refuse(backwards, "the clock goes backwards", "time")
        return table

    def observations(self) -> Observations | None:
        """Read observations.csv; None without observations.

        Raises:
            FileError: naming the wrong line and field.
        """
        path = self.path / "observations.csv"
        if not path.exists():
            return None
        names = read_header(path)
        if names[: len(_OBSERVATION_COLUMNS)] != _OBSERVATION_COLUMNS:
            expected = ", ".join(_OBSERVATION_COLUMNS)
            raise FileError(path, f"expected the columns {expected} and sensors", line=1)
        sensors = names[len(_OBSERVATION_COLUMNS) :]
        parsers = {"session": integer, "command": _optional_integer, "time": number}
        poses, readings = ("x", "y", "theta"), dict.fromkeys(sensors, optional_number)
        parsers |= dict.fromkeys(poses, optional_number) | readings
        table = read_csv(path, parsers, drop_torn_line=True)
        return Observations(
            table["session"].to_numpy(),
            table["command"].to_numpy(int),
            table["time"].to_numpy(),
            table[[*poses]].to_numpy(),
            sensors,
            table[[*sensors]].to_numpy(float),
        )

    def frame_times(self, session: int) -> NDArray | None:
        """Return camera times [N] in seconds of a session's frames; None without frames.csv."""
        path = self.path / "frames.csv"
        if not path.exists():
            return None
        table = read_csv(
            path, {"session": integer, "frame": integer, "time": number}, drop_torn_line=True
        )
        table = table[table["session"] == session]
        backwards = table["time"].diff() <= 0
        refuse_lines(path, table, backwards, "the camera's clock goes backwards", "time")
        return None if table.empty else table["time"].to_numpy()

    def lost_film(self, session: int) -> float:
        """Return the seconds of a session's last frames that are missing.

        They are in frames.csv, but not in the video, after a killed program, and were not tracked
        live.
        """
        path, times = self.video(session), self.frame_times(session)
        if path is None or times is None:
            return 0.0
        sightings = self.path / "sightings.csv"
        if sightings.exists():
            table = read_csv(sightings, {"session": integer}, drop_torn_line=True)
            if (table["session"] == session).any():
                return 0.0
        try:
            with Video(path) as video:
                there = sum(1 for _ in video)
        except FileError:
            there = 0
        return float(times[-1] - times[min(max(there, 1), len(times)) - 1])

    @property
    def is_tracked(self) -> bool:
        """Whether poses.csv exists."""
        return (self.path / "poses.csv").exists()

    def tracked_sessions(self) -> list[dict[str, Any]]:
        """Return the tracked sessions from tracking.json; none without it.

        Raises:
            FileError: if it is wrong.
        """
        path = self.path / "tracking.json"
        if not path.exists():
            return []
        about = read_json(path, TRACKING_FORMAT, TRACKING_VERSION, formats.Tracking, oldest=2)
        sessions = about["sessions"]
        return [session for session in sessions if session.get("clock") is not None]

    def poses(self) -> Poses:
        """Read poses.csv.

        Raises:
            FileError: if the recording has not been tracked, or the file is wrong somewhere.
        """
        path = self.path / "poses.csv"
        if not path.exists():
            raise FileError(self.path, "has no poses.csv; run neurosim track on it first")
        parsers = dict.fromkeys(_POSE_COLUMNS[:-1], number)
        parsers |= {"session": integer, "frame": integer}
        parsers |= dict.fromkeys(("x", "y", "theta"), optional_number) | {"doubtful": flag}
        table = read_csv(path, parsers)
        backwards = (table["time"].diff() <= 0) & (table["session"].diff() == 0)
        refuse_lines(path, table, backwards, "the clock goes backwards", "time")
        return Poses(
            table["session"].to_numpy(),
            table["frame"].to_numpy(),
            table["time"].to_numpy(),
            table[["x", "y", "theta"]].to_numpy(),
            table["quality"].to_numpy(),
            table["doubtful"].to_numpy(bool),
        )

    def write_poses(self, poses: Poses) -> None:
        """Write poses.csv, whole or not at all: to a thousandth of a millimetre, microradians."""
        x, y, theta = (np.round(poses.pose[:, i], 6) for i in range(3))
        columns = (
            *(poses.session, poses.frame, np.round(poses.time, 6), x, y, theta),
            *(np.round(poses.quality, 3), poses.doubtful.astype(int)),
        )
        write_csv(self.path / "poses.csv", dict(zip(_POSE_COLUMNS, columns, strict=True)))


def read_markers(path: str | Path) -> dict[str, Any]:
    """Read a markers file: the content of recording.json under ``markers``, alone.

    Raises:
        FileError: if it is missing or wrong.
    """
    document = read_json(path, MARKERS_FORMAT, VERSION, formats.Markers)
    _check_markers(Path(path), document)
    return {name: value for name, value in document.items() if name in {*DEFAULT_MARKERS, "tag"}}


def write_markers(path: str | Path, markers: Mapping[str, Any]) -> None:
    """Write a markers file, whole or not at all."""
    write_json(path, MARKERS_FORMAT, VERSION, dict(markers))


def ended_sessions(lines: Iterable[CommandLine]) -> set[int]:
    """Return the sessions that ended normally, of rows of :meth:`Recording.commands`."""
    return {line.session for line in lines if line.kind == "end"}


def _command_columns(takes: Commands) -> tuple[str, ...]:
    return ("session", "command", "kind", "time", *takes.names, "duration")


def _wall_clock() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def _optional_integer(text: str) -> int:
    return -1 if text == "" else integer(text)


def _kind(text: str) -> str:
    if text not in KINDS:
        raise ValueError
    return text


def _check_markers(path: Path, markers: Mapping[str, Any]) -> None:
    if markers.get("tag") is not None:
        return
    front, rear = (markers[which].get("colour") for which in ("front", "rear"))
    if front is None or rear is None:
        which = "front" if front is None else "rear"
        raise FileError(path, "is missing: name a colour, or a tag", field=f"{which}.colour")
    if front == rear:
        raise UserError(f"{path}: the two markers need different colours")
