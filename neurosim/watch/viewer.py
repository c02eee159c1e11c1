"""The page's picture and its settings: two colours, four corners and a place."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.perimeter import Board
from neurosim.base.place import Place, strip
from neurosim.recording.by_hand import Hand
from neurosim.watch.sketch import Sketch
from tracking.camera.board import camera_over_board, corner_points
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import write_markers
from tracking.live import Seen
from tracking.markers.palette import SeenColour
from tracking.markers.pointing import Pointed, colour_at, distinguishable
from tracking.markers.sought import Sought, drawing_colours
from tracking.markers.tags import Tag
from tracking.poses import marker_poses

#: Positions of the corners, in halves of the board's length and width, in the order of clicks, for
#: a picture in which x points to the right.
CORNERS = {
    "top left": (-1, 1),
    "top right": (1, 1),
    "bottom right": (1, -1),
    "bottom left": (-1, -1),
}
#: Distance of the grid's lines over the board, m.
GRID = 0.5
#: Largest distance of drawn parts from the board, m.
MARGIN = 0.05
#: Time without sight after which the robot counts as lost, s; also without a picture, the camera.
LOST_AFTER, STALE_AFTER = 0.5, 2.0
JPEG_QUALITY = 85

LookFor = Callable[[Sought, CameraModel | None], None]


class Viewer:
    """Keeps the newest picture and the robot in it, for any number of readers.

    Args:
        size: of the camera's pictures.
        markers: as in recording.json.
        what: the tracked markers: the colours of front and rear, or a tag.
        camera: the calibration, or None; with a place over the board, or of the lens alone.
        board: ``length`` and ``width`` in metres.
        look_for: called with new markers and a calibration, when they are set on the page; None for
            a page without settings.
        calibration_file: file for the calibration.
        markers_file: file for the markers.
        place_file: file for the place.
        place: the place over the picture, which can be drawn; by default the board alone.
        label: the camera's name, for the page's heading.
        seen_by: source of the picture: the ``tracker``, only the ``camera``, or ``nobody``.
        hand: the input of a person who drives on the page, or None.
    """

    def __init__(
        self,
        size: tuple[int, int],
        markers: Mapping[str, Any],
        what: Sought,
        *,
        camera: CameraModel | None = None,
        board: Mapping[str, float],
        look_for: LookFor | None = None,
        calibration_file: Path = Path("calibration.json"),
        markers_file: Path = Path("markers.json"),
        place_file: Path = Path("place.json"),
        place: Place | None = None,
        label: str = "camera",
        seen_by: Literal["tracker", "camera", "nobody"] = "tracker",
        hand: Hand | None = None,
    ):
        self.size = size
        self._markers = dict(markers)
        self._what = what
        self._lens = camera
        self._camera = camera if camera is not None and camera.has_board else None
        if place is None:
            place = Place(board=Board(board["length"], board["width"], line_width=0.0))
        on = board if place.board is None else asdict(place.board)
        self._board = {"length": float(on["length"]), "width": float(on["width"])}
        self._sketch, self._drawing_number = Sketch(place), 1
        self._height: float | None = None
        self._corners: dict[str, tuple[float, float]] = {}
        self._pointed: dict[str, Pointed] = {}
        self._look_for = look_for
        files = {"calibration": calibration_file, "markers": markers_file, "place": place_file}
        self._files = {what: Path(path) for what, path in files.items()}
        self._saved: set[str] = set()
        self._label, self._seen_by = label, seen_by
        self.hand = hand
        self._ended = ""
        self._change = threading.Condition()
        self._seen: Seen | None = None
        self._number = 0
        self._jpeg: tuple[int, bytes] = (0, b"")
        self._shown_at = time.monotonic()
        self._seen_at: float | None = None
        self._times: deque[float] = deque(maxlen=30)

    @property
    def settable(self) -> bool:
        """Whether the page has settings."""
        return self._look_for is not None

    @property
    def corners(self) -> dict[str, list[float]]:
        """The pixels of the clicked corners, by name."""
        with self._change:
            return {name: list(pixel) for name, pixel in self._corners.items()}

    # From the camera

    def show(self, seen: Seen) -> None:
        """Show a frame from now on."""
        with self._change:
            self._seen = seen
            self._number += 1
            self._shown_at = time.monotonic()
            self._times.append(self._shown_at)
            if seen.sighting.in_view:
                self._seen_at = self._shown_at
            self._change.notify_all()

    def end(self, why: str) -> None:
        """Show on the page why no more pictures will come."""
        with self._change:
            self._ended = why
            self._change.notify_all()

    # To the page

    def picture(self, after: int, timeout: float) -> tuple[bytes, dict[str, Any]]:
        """Return the newest picture as JPEG, and its state.

        Waits up to ``timeout`` seconds for a picture newer than number ``after``; the picture is
        empty if there is none.
        """
        with self._change:
            self._change.wait_for(lambda: self._number > after or self._ended, timeout)
            seen, number, state = self._seen, self._number, self._state()
        if seen is None or number <= after:
            return b"", state
        if self._jpeg[0] != number:
            good, data = cv2.imencode(".jpg", seen.frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            self._jpeg = (number, data.tobytes() if good else b"")
        return self._jpeg[1], state

    def _state(self) -> dict[str, Any]:
        now = time.monotonic()
        lost = None if self._seen_at is None else now - self._seen_at
        span = self._times[-1] - self._times[0] if len(self._times) > 1 else 0.0
        seen = self._seen
        in_view = seen is not None and seen.sighting.in_view
        return {
            "number": self._number,
            "label": self._label,
            "seen_by": self._seen_by,
            "hand": None if self.hand is None else self.hand.state(),
            "size": list(self.size),
            "settable": self.settable,
            "ended": self._ended,
            "stale": now - self._shown_at > STALE_AFTER,
            "fps": round((len(self._times) - 1) / span, 1) if span > 0 else 0.0,
            "time": round(seen.time, 3) if seen is not None else 0.0,
            "in_view": in_view,
            "quality": round(seen.sighting.quality, 3) if in_view else 0.0,
            "ever_seen": self._seen_at is not None,
            "lost": lost is not None and lost > LOST_AFTER,
            "lost_for": round(lost, 1) if lost is not None else 0.0,
            "front": _pixel(seen.sighting.front) if in_view else None,
            "rear": _pixel(seen.sighting.rear) if in_view else None,
            "pose": self._pose(seen) if in_view else None,
            "colours": {
                which: self._describe(which, place) for place, which in enumerate(("front", "rear"))
            },
            "tag": str(self._what) if isinstance(self._what, Tag) else None,
            "others": sorted(seen.others) if seen is not None else [],
            "apart": isinstance(self._what, Tag) or distinguishable(*self._what),
            "corners": self.corners,
            "board": {**self._board, "height": self._height},
            "calibrated": self._camera is not None,
            "lens": self._lens is not None,
            "grid": self._grid(),
            "drawing": self._drawing_number,
            "files": {what: str(path) for what, path in self._files.items()},
            "saved": sorted(self._saved),
        }

    def _describe(self, which: str, place: int) -> dict[str, Any]:
        """Describe a marker's colour, and its look in this camera."""
        pointed, learned = self._pointed.get(which), self._seen_colour(which)
        named = _hex(drawing_colours(self._what)[place])
        if isinstance(self._what, Tag):
            return {
                "name": "",
                "swatch": named,
                "seen_as": None,
                "confidence": None,
                "reason": None,
            }
        colour = self._what[place]
        named = colour.name if colour.name.startswith("#") else named
        best = learned or pointed
        return {
            "name": colour.name,
            "swatch": named if learned is None else learned.rgb,
            "seen_as": None if learned is None else learned.rgb,
            "confidence": None if best is None else round(best.confidence, 2),
            "reason": None if learned is None else learned.as_dict()["reason"],
        }

    def _seen_colour(self, which: str) -> SeenColour | None:
        """Return a marker's colour as tracked, if the robot is in view."""
        if self._seen is None or self._seen.colours is None or not self._seen.sighting.in_view:
            return None
        return self._seen.colours[("front", "rear").index(which)]

    def _pose(self, seen: Seen) -> dict[str, float] | None:
        if self._camera is None:
            return None
        front, rear = (np.atleast_2d(p) for p in (seen.sighting.front, seen.sighting.rear))
        x, y, theta = marker_poses(front, rear, self._markers, self._camera)[0]
        return {"x": round(x, 4), "y": round(y, 4), "degrees": round(math.degrees(theta), 1)}

    def _grid(self) -> list[list[list[float]]]:
        """Return lines over the board as pixels: its edges and lines every half metre."""
        x, y = self._board["length"] / 2, self._board["width"] / 2
        lines = [
            *(((-x, b), (x, b)) for b in (-y, y, *_between(y))),
            *(((a, -y), (a, y)) for a in (-x, x, *_between(x))),
        ]
        return self._pixels(lines)

    def drawing(self) -> dict[str, Any]:
        """Return the place for the page's drawing.

        Returns:
            ``number``: ``drawing`` of the state at the same moment; ``free``, ``solid``: lines,
            each a list of pairs of pixels; ``clicks``: pairs, those on the unfinished part.
        """
        with self._change:
            place, clicks = self._sketch.place, self._sketch.points
            free, solid = (
                [_outline_of(one) for one in place.shapes() if ("forbidden" in one) == is_solid]
                for is_solid in (False, True)
            )
            if place.start is not None:
                free.append(_arrow(*place.start))
            return {
                "number": self._drawing_number,
                "free": self._pixels(free),
                "solid": self._pixels(solid),
                "clicks": [pixel for [pixel] in self._pixels([[click] for click in clicks])],
            }

    def _pixels(self, lines: Sequence[ArrayLike]) -> list[list[list[float]]]:
        """Return lines through points [N, 2] on the floor (m) as pixels, bent by the lens."""
        if self._camera is None or not lines:
            return []
        fine = [_finer(np.asarray(line, float)) for line in lines]
        flat = np.concatenate(fine)
        pixels = self._camera.to_pixels(np.column_stack([flat, np.zeros(len(flat))]))
        ends = np.cumsum([len(line) for line in fine])[:-1]
        return [np.round(line, 1).tolist() for line in np.split(pixels, ends)]

    # From the page

    def set_colour(self, which: str, u: float, v: float) -> str:
        """Take a marker's colour from a pixel of the newest picture; return a message.

        Raises:
            UserError: if there is no colour there.
        """
        if isinstance(self._what, Tag):
            raise UserError(f"the robot is found by {self._what}, not by colours")
        pointed = colour_at(self._newest(), (u, v))
        with self._change:
            front, rear = self._what
            self._what = (pointed.colour, rear) if which == "front" else (front, pointed.colour)
            apart = distinguishable(*self._what)
            self._pointed[which] = pointed
            self._saved.discard("markers")
        self._start_afresh()
        message = (
            f"{which} marker: {pointed.colour.name}, {100 * pointed.confidence:.0f} % confidence"
        )
        if not apart:
            return f"{message}; too much like the other marker's: set that as well"
        others = pointed.places - 1
        if others > 0:
            message += f"; {others} more patch{'es' if others > 1 else ''} of this colour in view"
        return message

    def set_corner(self, name: str, u: float, v: float) -> str:
        """Set a corner of the board; the fourth one gives the camera's pose."""
        with self._change:
            self._corners[name] = (round(u, 2), round(v, 2))
        return self._find_camera()

    def clear_corners(self) -> str:
        """Drop the corners, and the camera's pose from them."""
        with self._change:
            self._corners = {}
            given = self._lens
            self._camera = given if given is not None and given.has_board else None
        self._start_afresh()
        return "click on the four corners of the board"

    def set_board(self, length: float, width: float, height: float | None) -> str:
        """Set the board's measures and, if it was measured, the camera's height above it, m."""
        if not (0.05 <= width <= 100 and 0.05 <= length <= 100):
            raise UserError("a board is 0.05 to 100 m long and wide")
        if height is not None and not 0.1 <= height <= 100:
            raise UserError("a camera hangs 0.1 to 100 m above the board")
        with self._change:
            self._board = {"length": length, "width": width}
            self._height = height
            self._sketch.set_board(length, width)
            self._drawing_number += 1
        return self._find_camera()

    def draw(self, part: str, u: float, v: float, width: float) -> str:
        """Take a click on a pixel for a part of the place; see :meth:`Sketch.click`.

        Raises:
            UserError: if no calibration gives its position, or it is outside of the board.
        """
        with self._change:
            return self._sketched(self._sketch.click(part, self._on_floor(u, v), width))

    def finish(self, width: float) -> str:
        """End a part with any number of clicks; see :meth:`Sketch.finish`."""
        with self._change:
            return self._sketched(self._sketch.finish(width))

    def undo(self) -> str:
        """Undo the last click on the place, or the last part; see :meth:`Sketch.undo`."""
        with self._change:
            return self._sketched(self._sketch.undo())

    def _sketched(self, message: str) -> str:
        self._drawing_number += 1
        self._saved.discard("place")
        return message

    def _on_floor(self, u: float, v: float) -> tuple[float, float]:
        """Return a pixel's position on the floor, m."""
        if self._camera is None:
            raise UserError(
                "no calibration says where on the floor that is: click on the four corners of the "
                "board first, or start with --calibration"
            )
        x, y = (round(float(one), 4) for one in self._camera.to_board([[u, v]])[0])
        off = max(abs(x) - self._board["length"] / 2, abs(y) - self._board["width"] / 2)
        if not off <= MARGIN:
            raise UserError(
                f"that is {100 * off:.0f} cm outside the board; click on the floor of the board"
            )
        return x, y

    def save(self, what: str, *, replace: bool = False) -> str:
        """Write calibration.json, markers.json or place.json; return a message.

        Raises:
            UserError: if there is nothing to save, or the file exists.
        """
        path = self._files[what]
        if what == "calibration" and self._camera is None:
            raise UserError("click on the four corners of the board first")
        if what == "place" and self._sketch.points:
            raise UserError(f"finish the {self._sketch.part} first, or undo its clicks")
        if path.exists() and what not in self._saved and not replace:
            raise UserError(f"{path} exists already; replace it?")
        if what == "calibration":
            self._camera.write(path)
        elif what == "markers":
            write_markers(path, {**self._markers, **self._named()})
        else:
            self._sketch.place.write(path)
        with self._change:
            self._saved.add(what)
        return f"{path} is written; record with --{what} {path}"

    def _named(self) -> dict[str, Any]:
        """Return front and rear with their colours for markers.json; empty for a tag."""
        if isinstance(self._what, Tag):
            return {}
        if not distinguishable(*self._what):
            raise UserError("the two markers' colours are too much alike; set them first")
        return {
            which: {**self._markers[which], "colour": colour.name, **self._seen_as(which)}
            for which, colour in zip(("front", "rear"), self._what, strict=True)
        }

    def _seen_as(self, which: str) -> dict[str, Any]:
        seen = self._seen_colour(which)
        return {} if seen is None else {"rgb": seen.rgb, "confidence": round(seen.confidence, 3)}

    def _find_camera(self) -> str:
        missing = [name for name in CORNERS if name not in self._corners]
        if missing:
            return f"next: the {missing[0]} corner"
        length, width = self._board["length"], self._board["width"]
        clicked = [self._corners[name] for name in CORNERS]
        points = corner_points(self.size, clicked, (length, width))
        camera = camera_over_board(self.size, points, self._lens, self._height)
        with self._change:
            self._camera = camera
            self._saved.discard("calibration")
        self._start_afresh()
        message = (
            f"the camera hangs {camera.position[2]:.2f} m above the board; the corners fit to "
            f"{1000 * (camera.board_rms_m or 0.0):.1f} mm"
        )
        if self._lens is None:
            error = 1000 * camera.uncertainty["board_m"]
            message += f", but the lens is not known: positions may be off by {error:.0f} mm"
        return f"{message}. Does the grid lie on the board?"

    def _start_afresh(self) -> None:
        with self._change:
            self._seen_at = None
            self._drawing_number += 1
            what, camera = self._what, self._camera
        if self._look_for is not None:
            self._look_for(what, camera)

    def _newest(self) -> NDArray:
        with self._change:
            if self._seen is None:
                raise UserError("there is no picture yet")
            return self._seen.frame


def _pixel(point: NDArray) -> list[float]:
    return [round(float(value), 2) for value in point]


def _finer(line: NDArray) -> NDArray:
    """Return a line [N, 2] with more points between its corners, unless it has many."""
    if len(line) > 12:
        return line
    fraction = np.linspace(0, 1, 13)[1:, None]
    return np.concatenate([line[:1], *(a + fraction * (b - a) for a, b in pairwise(line))])


def _outline_of(shape: Mapping[str, Any]) -> NDArray:
    """Return the closed line [N, 2] around a shape of a place, m."""
    if "circle" in shape:
        x, y, radius = shape["circle"]
        angles = np.linspace(0, 2 * np.pi, 37)
        return np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
    corners = np.array(shape["polygon"], float)
    if "width" in shape:
        corners = strip(corners.ravel(), shape["width"])[:, :2]
    return np.concatenate([corners, corners[:1]])


def _arrow(x: float, y: float, heading: float, length: float = 0.1) -> NDArray:
    """Return an arrow [5, 2] from a pose (m, rad) ahead."""
    ahead = length * np.array([math.cos(heading), math.sin(heading)])
    side = np.array([-ahead[1], ahead[0]])
    foot = np.array([x, y])
    tip = foot + ahead
    barbs = foot + 0.7 * ahead + 0.2 * np.array([side, -side])
    return np.array([foot, tip, barbs[0], tip, barbs[1]])


def _between(half: float) -> list[float]:
    most = math.ceil(half / GRID) - 1
    return [GRID * place for place in range(-most, most + 1)]


def _hex(bgr: tuple[int, int, int]) -> str:
    blue, green, red = bgr
    return f"#{red:02x}{green:02x}{blue:02x}"
