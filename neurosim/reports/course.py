"""A task seen from above: its place and outline, predicted and actual path (Figures 6 and 7)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.base.perimeter import LONGEST_ARC
from neurosim.reports.svg import INK, drawing, to_svg

#: Size below which a picture is in centimetres, m.
_SMALL = 1.5

Shape = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Scene:
    """The parts of a picture around the robot, in m.

    Attributes:
        task: shapes of the task's outline, see :meth:`neurosim.tasks.base.Task.outline`.
        place: shapes of the simulator's place, drawn below the outline.
        board: ``length`` along x and ``width`` along y of the board, where it is known, and
            ``line_inset`` and ``line_width`` of its perimeter line.
        longest_arc: see :func:`planned_path`.
    """

    task: Sequence[Shape] = ()
    place: Sequence[Shape] = ()
    board: Mapping[str, float] | None = None
    longest_arc: float = LONGEST_ARC

    @classmethod
    def of(
        cls, task: Any, place: Sequence[Shape] = (), board: Mapping[str, float] | None = None
    ) -> Scene:
        """Return the scene of a task, or of an unknown one (None).

        The default place is the task's.
        """
        if task is None:
            return cls((), place, board)
        if not place and task.place is not None:
            place = task.place.shapes()
        own = [shape for shape in task.outline() if shape not in place]
        return cls(own, place, board, task.longest_arc)

    def corners(self) -> NDArray[np.float64]:
        """Return points [N, 2] between which all of it lies."""
        points = [shape_corners(shape) for shape in (*self.place, *self.task)]
        if self.board is not None:
            points.append(_box(self.board))
        return np.concatenate([np.empty((0, 2)), *points])


@dataclass(frozen=True, eq=False)
class Paths:
    """A robot in a picture.

    Attributes:
        predicted: [K + 1, 3] poses (m, m, rad): before the first and after each command where
            ``by_command``, else at every step.
        by_command: whether the robot moves on an arc from each predicted pose to the next.
        rest: predicted pose at rest after the last command, or None.
        actual: tracked poses after each command, None if the robot was not seen.
        driven: [M, 4] time (s) and pose, of the whole drive.
        stopped: pose at which the guard stopped the robot, or None.
    """

    predicted: ArrayLike = field(default_factory=lambda: np.empty((0, 3)))
    by_command: bool = False
    rest: Sequence[float] | None = None
    actual: Sequence[Sequence[float] | None] = ()
    driven: ArrayLike = field(default_factory=lambda: np.empty((0, 4)))
    stopped: Sequence[float] | None = None

    @classmethod
    def of_trial(cls, trial: Mapping[str, Any]) -> Paths:
        """Return the predicted and the driven path of a trial.

        Args:
            trial: the content of its trial.json, which :func:`neurosim.trials.trial.run_trial`
                returns.
        """
        predicted, actual, stopped = trial["predicted"], trial["actual"], trial.get("stopped")
        return cls(
            np.array(predicted.get("poses") or [], float).reshape(-1, 3),
            bool(trial["errors"]),
            predicted.get("rest"),
            actual.get("poses") or [],
            actual.get("path") or [],
            # The tracked pose, else the guard's.
            None if stopped is None else actual.get("cut") or stopped.get("pose"),
        )

    def ideal(self, longest: float = LONGEST_ARC) -> NDArray[np.float64]:
        """Return the poses [N, 3] of the predicted path."""
        ends = np.asarray(self.predicted, float).reshape(-1, 3)
        if not self.by_command or not len(ends):
            return ends
        stops = ends if self.rest is None else np.vstack([ends, self.rest])
        return planned_path(stops, longest=longest)


def planned_path(poses: ArrayLike, spacing: float = 0.02, longest: float = LONGEST_ARC) -> NDArray:
    """Return the poses (N, 3) of the constant-twist arcs from each pose to the next.

    Args:
        poses: (K + 1, 3) poses at the commands' boundaries, m and rad.
        spacing: largest distance between two points, m.
        longest: longest arc, m. A longer one comes from the twist of nearly whole turns, and a
            straight line replaces it, as in the task's own judgement.
    """
    poses = np.asarray(poses, float)
    pieces = [poses[:1]]
    for start, displacement in zip(poses, se2.between(poses[:-1], poses[1:]), strict=False):
        length = float(se2.arc_length(displacement))
        straight = not length < longest
        if straight:
            length = float(np.hypot(*displacement[:2]))
        fractions = np.linspace(0, 1, int(np.ceil(length / spacing)) + 1)[1:]
        if not fractions.size:  # a stop, or a turn on the spot
            fractions = np.ones(1)
        along = displacement * fractions[:, None] if straight else se2.arc(displacement, fractions)
        pieces.append(se2.compose(start, along))
    return np.concatenate(pieces)


@dataclass(frozen=True)
class Drawn:
    """The drawing of a course.

    Attributes:
        svg: the drawing.
        origin: position of x = y = 0 in it; its y points down.
        scale: units of the drawing per metre.
    """

    svg: str
    origin: tuple[float, float]
    scale: float


def course(scene: Scene, paths: Paths, label: str, prefix: str, *, small: bool = False) -> Drawn:
    """Draw both paths over a scene.

    Args:
        scene, paths: content of the drawing.
        label: description of the picture, in words.
        prefix: makes the picture's ids unique.
        small: whether it is one of many, without axes.
    """
    low, high = _bounds(scene, paths)
    aspect = float(np.clip((high - low)[1] / (high - low)[0], 0.35, 1.3))
    width = 3.3 if small else 5.4
    height = width * aspect + 0.25 if small else (width - 0.6) * aspect + 0.7
    with drawing(width, height) as (figure, axes):
        draw_course(axes, scene, paths)
        if small:
            axes.set_axis_off()
        svg = to_svg(figure, label, prefix)
        metre = unit_of(low, high)[0]
        (x, y), (one, _) = axes.transData.transform([[0, 0], [metre, 0]]) * 72 / figure.dpi
        return Drawn(svg, (float(x), 72 * float(figure.get_size_inches()[1]) - float(y)), one - x)


def draw_course(axes: Axes, scene: Scene, paths: Paths) -> None:
    """Draw both paths over a scene into ``axes``, in cm if it is small, else in m."""
    low, high = _bounds(scene, paths)
    scale, unit = unit_of(low, high)
    draw_scene(axes, scene, scale)
    ideal, ends = paths.ideal(scene.longest_arc), np.asarray(paths.predicted, float).reshape(-1, 3)
    driven = np.asarray(paths.driven, float).reshape(-1, 4)
    if len(ideal):
        x, y = scale * ideal[:, :2].T
        axes.plot(x, y, color=INK["predicted"], lw=1.8, label="predicted")
    if len(driven):
        x, y = scale * _thin(driven[:, 1:3]).T
        axes.plot(x, y, color=INK["actual"], lw=1.8, ls=(0, (4, 1.6)), label="actual")
    if paths.by_command:
        axes.plot(
            *(scale * ends[1:, :2].T), "o", ms=4.5, mew=0, color=INK["predicted"]
        )  # fmt: skip
        seen = [pose for pose in paths.actual[1:] if pose is not None]
        axes.plot(
            *(scale * np.array(seen, float).reshape(-1, 3)[:, :2].T), "s", ms=4.5, mew=1.2,
            mec=INK["actual"], mfc=INK["paper"],
        )  # fmt: skip
        _numbers(axes, ends, scale)
    if paths.stopped is not None:
        x, y = scale * np.asarray(paths.stopped, float)[:2]
        axes.plot(x, y, "X", ms=11, mew=0.8, mec=INK["paper"], color=INK["actual"], label="stopped")
    start = ends if len(ends) else driven[:, 1:]
    if len(start):
        _arrow(axes, start[0], scale, 0.06 * float(np.max(high - low)))
    axes.set(aspect="equal", xlabel=f"x ({unit})", ylabel=f"y ({unit})")
    axes.margins(0.015)
    axes.grid(visible=not len(scene.corners()))
    if len(ideal) or len(driven):
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.2)


def unit_of(low: NDArray, high: NDArray) -> tuple[float, str]:
    """Return the units per metre in a picture between two corners [2] (m), and the unit's name."""
    return (100.0, "cm") if np.max(high - low) < _SMALL else (1.0, "m")


def draw_scene(axes: Axes, scene: Scene, scale: float = 1.0) -> None:
    """Draw board, place and outline of the task, with ``unit`` units per metre.

    Raises:
        UserError: if a shape cannot be drawn.
    """
    if scene.board is not None:
        _polygon(axes, scale * _box(scene.board), fc=INK["board"], ec=INK["muted"], lw=1.0)
        if scene.board.get("line_width"):
            inset = {k: scene.board[k] - 2 * scene.board["line_inset"] for k in ("length", "width")}
            _polygon(axes, scale * _box(inset), fc="none", ec=INK["muted"], lw=2.2, alpha=0.6)
    walls: dict[str, Any] = {"ec": INK["ink"], "lw": 2.2, "joinstyle": "miter"}
    for shape in scene.place:
        _draw(axes, shape, scale, walls)
    for shape in scene.task:
        _draw(axes, shape, scale, {"ec": INK["muted"], "lw": 0.8})


def _draw(axes: Axes, shape: Shape, scale: float, edge: Mapping[str, Any]) -> None:
    """Draw one shape; free polygons have the given edge."""
    forbidden = bool(shape.get("forbidden"))
    points = scale * shape_corners(shape)
    if "text" in shape:
        _text(axes, points[0], str(shape["text"]), forbidden)
    elif "circle" in shape:
        style = {"fc": INK["shade"], "ec": INK["ink"], "lw": 1.2}
        free = {"fc": "none", "ec": INK["muted"], "lw": 1.0}
        radius = (points[1, 0] - points[0, 0]) / 2
        patch = Circle(points.mean(axis=0), radius, zorder=0.5, **(style if forbidden else free))
        axes.add_patch(patch)
        axes.update_datalim(points)
    elif len(points) == 2 and "width" in shape:
        _stroke(axes, points, scale * float(shape["width"]) / 2)
    elif len(points) == 2:
        ink, width = (INK["ink"], 2.2) if forbidden else (INK["muted"], 0.8)
        axes.plot(*points.T, color=ink, lw=width, zorder=0.6)
    elif forbidden:
        style = {"fc": INK["shade"], "ec": INK["muted"], "lw": 0.8, "hatch": "////"}
        _polygon(axes, points, **style)
    else:
        _polygon(axes, points, **{"fc": INK["board"], **edge})
    axes.autoscale_view()


def _stroke(axes: Axes, ends: NDArray, half: float) -> None:
    """Draw a piece of a printed line with its true width and round ends."""
    along = ends[1] - ends[0]
    aside = half * np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-12)
    style = {"fc": INK["muted"], "ec": "none", "lw": 0.0}
    _polygon(axes, np.array([*(ends + aside), *(ends - aside)[::-1]]), **style)
    for end in ends:
        axes.add_patch(Circle(end, half, zorder=0.5, **style))


def _text(axes: Axes, at: NDArray, text: str, forbidden: bool) -> None:
    style: dict[str, Any] = {"bbox": {"fc": INK["board"], "ec": "none", "pad": 2}}
    if not forbidden:
        style = {
            "size": 24, "weight": "bold", "color": INK["muted"], "alpha": 0.3, "zorder": 0.6
        }  # fmt: skip
    axes.text(*at, text, ha="center", va="center", clip_on=True, **style)


def _polygon(axes: Axes, corners: NDArray, **style: Any) -> None:
    axes.add_patch(Polygon(corners, zorder=0.5, **style))
    axes.update_datalim(corners)
    axes.autoscale_view()


def shape_corners(shape: Shape) -> NDArray[np.float64]:
    """Return points [N, 2] of a shape; for a circle the corners of the square around it."""
    try:
        if "polygon" in shape:
            points = np.array(shape["polygon"], float).reshape(-1, 2)
        elif "circle" in shape:
            x, y, radius = map(float, shape["circle"])
            points = np.array([[x - radius, y - radius], [x + radius, y + radius]])
        else:
            _ = shape["text"]
            points = np.array(shape["at"], float).reshape(1, 2)
    except (KeyError, TypeError, ValueError):
        points = np.empty((0, 2))
    if len(points) < 1 + ("polygon" in shape) or not np.isfinite(points).all():
        raise UserError(
            f"an outline has polygons [[x, y], ...], circles [x, y, radius] and texts at [x, y], "
            f"not {shape!r:.80}"
        )
    return points


def _box(board: Mapping[str, float]) -> NDArray[np.float64]:
    half = np.array([board["length"], board["width"]]) / 2
    return half * [[-1, -1], [1, -1], [1, 1], [-1, 1]]


def _bounds(scene: Scene, paths: Paths) -> tuple[NDArray, NDArray]:
    """Return the corners [2] between which everything lies, at least a centimetre apart."""
    driven = np.asarray(paths.driven, float).reshape(-1, 4)[:, 1:3]
    return bounds(scene, [paths.ideal(scene.longest_arc)[:, :2], driven])


def bounds(scene: Scene, paths: Iterable[NDArray]) -> tuple[NDArray, NDArray]:
    """Return the corners [2] (m) between which a scene and paths [N, 2] lie.

    A side is at least a tenth of the other, and a centimetre.
    """
    points = np.concatenate([scene.corners(), *paths])
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    least = max(0.1 * float(np.max(high - low)), 0.01)
    room = np.maximum(least - (high - low), 0.0) / 2
    return low - room, high + room


def _numbers(axes: Axes, ends: NDArray, scale: float) -> None:
    # Next to the path, on the side away from its next part.
    for number in range(1, len(ends)):
        heading = ends[number, 2] + np.pi / 2
        axes.annotate(
            str(number), scale * ends[number, :2],
            xytext=(9 * np.cos(heading), 9 * np.sin(heading)),
            textcoords="offset points", ha="center", va="center", size=8.5,
            color=INK["predicted"], bbox={"fc": INK["board"], "ec": "none", "pad": 0.6}, zorder=1.5,
        )  # fmt: skip


def _arrow(axes: Axes, start: NDArray, scale: float, length: float) -> None:
    (x, y), heading = scale * start[:2], start[2]
    tip = (x + scale * length * np.cos(heading), y + scale * length * np.sin(heading))
    axes.annotate("", tip, (x, y), arrowprops={"arrowstyle": "-|>", "color": INK["ink"], "lw": 1.6})
    axes.plot(x, y, "o", ms=6, color=INK["ink"])


def _thin(points: NDArray, spacing: float = 0.004) -> NDArray:
    """Leave out points nearer than ``spacing`` to the last one kept."""
    kept = [0]
    for place in range(1, len(points)):
        if np.hypot(*(points[place] - points[kept[-1]])) >= spacing:
            kept.append(place)
    return points[[*kept, len(points) - 1]]
