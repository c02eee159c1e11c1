"""Where a guard ends a drive: at the line around a board, and at the board's edge.

A recording has the board and the robot's light sensors; the dataset and the simulator get them from
it. The guard of a session, the virtual lab, tasks and pictures use this module, so that a drive
ends in a simulator where it ends on the robot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from neurosim.base.compiled import njit
from neurosim.base.declared import Checked, Coordinate, Metres, MetresOrNone
from neurosim.base.se2 import compiled as se2

#: Reason of a drive's end, by code from 1 (0: not ended); the words follow "the robot".
ENDS = (
    "was stopped at the perimeter line",
    "was stopped at the board's edge",
    "was stopped because it was not seen",
)
LINE, EDGE, UNSEEN = 1, 2, 3

#: Time from the guard's decision until the robot stands, s.
STOPPING = 0.25
#: Error of a distance that was only commanded, as a fraction of it.
DISTANCE_ERROR = 0.15
#: Sensors are checked at the beginning of a path and at least this often along it, m.
SPACING = 0.01
#: The interval is at most the line's width, but never less than this, m.
CLOSEST = 0.001
#: A robot drives no longer arc than this in one interval, m; see :meth:`Perimeter.ends`.
LONGEST_ARC = 1.5


@dataclass(frozen=True)
class Board(Checked):
    """A board; its frame is at its centre, x along its length.

    Attributes:
        length: Length of the board, along x, m.
        width: Width of the board, m.
        line_inset: The middle of the perimeter line is so far inside the edge, m.
        line_width: Width of the perimeter line, m; 0 for a board without one.
    """

    length: Metres = 2.76
    width: Metres = 1.84
    line_inset: MetresOrNone = 0.12
    line_width: MetresOrNone = 0.02


@dataclass(frozen=True)
class Perimeter(Checked):
    """A board, and the parts of a robot that the guard checks.

    Attributes:
        board: the board.
        sensors: x (forward) and y (left) of each light sensor in the robot's frame, m.
        margin: smallest distance of the middle of the axle from the edge, m; None: the robot's
            position is not guarded.
    """

    board: Board = Board()
    sensors: tuple[tuple[Coordinate, Coordinate], ...] = ()
    margin: Annotated[float, Meta(ge=0, le=1000)] | None = 0.05

    @classmethod
    def of_recording(cls, meta: Mapping[str, Any]) -> Perimeter:
        """Return the perimeter that the guard of a recording uses.

        Args:
            meta: content of recording.json: ``board``; ``robot`` with the positions of its
                ``light_sensors``; ``settings`` with those of the guard.
        """
        names = [one.name for one in fields(Board)]
        known = {name: meta["board"][name] for name in names if name in meta["board"]}
        known.setdefault("line_width", 0.0)  # a line that is not written down is unknown
        sensors = (meta["robot"].get("light_sensors") or {}).values()
        perimeter = cls(Board(**known), tuple((float(x), float(y)) for x, y in sensors))
        guard = (meta.get("settings") or {}).get("guard") or {}
        return perimeter.guarded(guard.get("by", "both"))

    @classmethod
    def from_json(cls, content: Mapping[str, Any] | None) -> Perimeter | None:
        """Return the perimeter from the JSON of :meth:`describe`; None for None."""
        if content is None:
            return None
        sensors = tuple((x, y) for x, y in content["sensors"])
        return cls(Board(**content["board"]), sensors, content.get("margin"))

    def describe(self) -> dict[str, Any]:
        """Return the perimeter for JSON."""
        content = asdict(self)
        return {**content, "sensors": [list(place) for place in self.sensors]}

    def near_line(self, pose: ArrayLike, distance: float) -> bool:
        """Return whether a light sensor may be on the line, or beyond it, after a short drive.

        Args:
            pose: the robot's, [3] (m, m, rad, board frame); its heading does not matter.
            distance: of the drive, m.
        """
        x, y = np.asarray(pose, np.float64)[:2]
        board = self.board
        inside = min(board.length / 2 - abs(x), board.width / 2 - abs(y))
        reach = max((math.hypot(*place) for place in self.sensors), default=0.0)
        return bool(inside - reach - distance <= board.line_inset + board.line_width / 2)

    def guarded(self, by: str) -> Perimeter:
        """Return the perimeter that a guard uses: ``both``, or ``position`` alone."""
        return self if by == "both" else replace(self, sensors=())

    def ends(
        self,
        guard: NDArray[np.float64],
        after: NDArray[np.float64],
        duration: NDArray[np.float64] | float,
        running: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float64]:
        """Return the poses at which the guard ends intervals of K drives.

        A robot moves on the arc of constant twist between two poses, or straight where that arc is
        longer than :data:`LONGEST_ARC`. It is stopped where a light sensor is on the line or beyond
        the board's edge, or where the middle of its axle, :data:`STOPPING` later, would be less
        than ``margin`` inside the edge and farther out than it is now.

        Args:
            guard: [K, 4] the last known poses (m, m, rad, board frame), and codes of :data:`ENDS`
                or 0; changed in place for drives that are running.
            after: [K, 3] poses at the end; an interval with an unknown pose is not ended.
            duration: [K] or one for all, s.
            running: [K] whether each drive is still running; by default all.

        Returns:
            Poses [K, 3] at the end of each interval, or where the robot was stopped.
        """
        poses = np.array(after, np.float64)
        seconds = np.full(len(after), duration, np.float64)
        board = self.board
        sensors = np.array(self.sensors, np.float64).reshape(-1, 2)
        margin = math.nan if self.margin is None else self.margin
        line = board.line_inset, board.line_width
        half = board.length / 2, board.width / 2
        if running is None:
            running = np.ones(len(after), np.bool_)
        _ends(guard, poses, seconds, running, half, line, sensors, margin)
        return poses


@njit(nogil=True)
def _inside(x: float, y: float, half: tuple[float, float]) -> float:
    """Return a point's distance from the board's edge, m; below 0 outside."""
    return min(half[0] - abs(x), half[1] - abs(y))


@njit(nogil=True, error_model="numpy")
def _ends(
    guard: NDArray,
    poses: NDArray,
    seconds: NDArray,
    running: NDArray,
    half: tuple[float, float],
    line: tuple[float, float],
    sensors: NDArray,
    margin: float,
) -> None:
    """Write ``guard`` [K, 4], and the stopped robots' ``poses`` [K, 3]; see Perimeter.ends."""
    reach = 0.0
    for i in range(len(sensors)):
        reach = max(reach, math.hypot(sensors[i, 0], sensors[i, 1]))
    inner, outer = line[0] + 0.5 * line[1], line[0] - 0.5 * line[1]
    marked = line[1] > 0.0
    spacing = min(SPACING, max(line[1], CLOSEST)) if marked else SPACING
    for k in range(len(poses)):
        x, y, heading = guard[k, 0], guard[k, 1], guard[k, 2]
        dx, dy, turn = poses[k, 0] - x, poses[k, 1] - y, poses[k, 2] - heading
        if not running[k] or (seconds[k] == 0.0 and dx == dy == turn == 0.0):
            continue
        if math.isfinite(poses[k, 0] + poses[k, 1] + poses[k, 2]):
            for i in range(3):
                guard[k, i] = poses[k, i]
        if not (abs(x) + abs(y) + abs(dx) + abs(dy) < 1e3 and abs(heading) + abs(turn) < 1e6):
            continue
        length = se2.arc_length(dx, dy, turn)
        if not length < LONGEST_ARC:
            length, turn = math.hypot(dx, dy), 0.0
        # The guard looks ahead along the same arc.
        ahead = STOPPING / seconds[k] if seconds[k] > 1e-6 else 0.0
        length_ahead = length * ahead
        # Farther inside, no drive ends; the middle moves no faster than along the arc.
        near = reach + inner
        if margin == margin:
            near = max(near, margin + (1.0 + DISTANCE_ERROR) * length_ahead)
        count = max(math.ceil((length + reach * abs(turn)) / spacing), 1)
        n, room = 0, 0.0
        while n <= count:
            fraction = n / count
            off_x, off_y = se2.arc(dx, dy, turn, fraction)
            to_x, to_y, theta = x + off_x, y + off_y, heading + fraction * turn
            here = _inside(to_x, to_y, half)
            room = here - near
            if room > 0.0:
                n += max(int(room / length * count), 1) if room < length else count + 1
                continue
            cos, sin = math.cos(theta), math.sin(theta)
            code = 0
            for i in range(len(sensors)):
                sx = to_x + cos * sensors[i, 0] - sin * sensors[i, 1]
                sy = to_y + sin * sensors[i, 0] + cos * sensors[i, 1]
                depth = _inside(sx, sy, half)
                if depth < 0.0 or (marked and outer <= depth <= inner):
                    code = LINE
            if code == 0 and n > 0 and margin == margin:
                off_x, off_y = se2.arc(dx, dy, turn, fraction + ahead)
                there = _inside(x + off_x, y + off_y, half)
                if there - DISTANCE_ERROR * length_ahead < margin and there < here - 1e-4:
                    code = EDGE
            if code > 0:
                poses[k, 0], poses[k, 1], poses[k, 2] = to_x, to_y, theta
                for i in range(3):
                    guard[k, i] = poses[k, i]
                guard[k, 3] = code
                break
            n += 1
