"""The board seen from above: rectangles, predicted and actual path (Figures 6 and 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.reports.svg import INK, drawing, to_svg
from neurosim.tasks.nine_rectangles import COURSE, LAST, LENGTH, WIDTH, NineRectangles
from tracking.datasets.recordings import DEFAULT_BOARD

_LONGEST_ARC = NineRectangles().longest_arc


def layout(task: Mapping[str, Any]) -> dict[int, tuple[float, float]]:
    """Return the centre (x, y), m, of every rectangle of a task's course by its number.

    The start counts as 8, the forbidden centre as -1; a task without rectangles has none.
    """
    if task.get("name") != NineRectangles.name:
        return {}
    return {
        LAST if number == 0 else int(number): ((column - 1) * LENGTH, (1 - row) * WIDTH)
        for (row, column), number in np.ndenumerate(COURSE)
    }


def planned_path(poses: ArrayLike, spacing: float = 0.02, longest: float = _LONGEST_ARC) -> NDArray:
    """Return the poses (N, 3) of the constant-twist arcs from each pose to the next.

    Args:
        poses: (K + 1, 3) poses at the commands' boundaries, m and rad.
        spacing: largest distance between two points, m.
        longest: an arc longer than this, m, is no robot's path, but the twist of nearly whole
            turns; a straight line stands in for it, as it does in the task's own judgement.
    """
    poses = np.asarray(poses, float)
    pieces = [poses[:1]]
    for start, displacement in zip(poses, se2.between(poses[:-1], poses[1:]), strict=False):
        length = float(se2.arc_length(displacement))
        straight = not length < longest
        if straight:
            length = float(np.hypot(*displacement[:2]))
        fractions = np.linspace(0, 1, int(np.ceil(length / spacing)) + 1)[1:]
        if not fractions.size:  # it stands, or turns on the spot
            fractions = np.ones(1)
        along = displacement * fractions[:, None] if straight else se2.arc(displacement, fractions)
        pieces.append(se2.compose(start, along))
    return np.concatenate(pieces)


def course(
    task: Mapping[str, Any],
    predicted: Sequence[Sequence[float]],
    actual: Sequence[Sequence[float] | None],
    path: Sequence[Sequence[float]],
    label: str,
    prefix: str,
    *,
    rest: Sequence[float] | None = None,
    board: Mapping[str, float] = DEFAULT_BOARD,
    small: bool = False,
) -> str:
    """Draw the course with both paths.

    Args:
        task: its ``name`` and ``settings``.
        predicted: poses before the first and after each given command.
        actual: the same as they were tracked; None where the robot was not seen.
        path: [t, x, y, theta] of the whole drive.
        label: what the picture shows, in words.
        prefix: makes the picture's ids unique.
        rest: predicted pose once the motors have run down after the last command.
        board: ``length`` along x and ``width`` along y, m.
        small: one of many, without axes.
    """
    with drawing(*((3.3, 2.45) if small else (5.4, 3.9))) as (figure, axes):
        draw_course(axes, task, predicted, actual, path, rest=rest, board=board)
        if small:
            axes.set_axis_off()
        return to_svg(figure, label, prefix)


def draw_course(
    axes: Axes,
    task: Mapping[str, Any],
    predicted: Sequence[Sequence[float]],
    actual: Sequence[Sequence[float] | None],
    path: Sequence[Sequence[float]],
    *,
    rest: Sequence[float] | None = None,
    board: Mapping[str, float] = DEFAULT_BOARD,
) -> None:
    """Draw the course with both paths into ``axes``; the arguments are those of :func:`course`."""
    _ground(axes, task, board)
    longest = task.get("settings", {}).get("longest_arc", _LONGEST_ARC)
    ends = np.asarray(predicted, float)
    stops = ends if rest is None else np.vstack([ends, rest])
    ideal = planned_path(stops, longest=longest)
    axes.plot(ideal[:, 0], ideal[:, 1], color=INK["predicted"], lw=1.8, label="predicted")
    if len(path):
        x, y = _thin(np.asarray(path, float)[:, 1:3]).T
        axes.plot(x, y, color=INK["actual"], lw=1.8, ls=(0, (4, 1.6)), label="actual")
    axes.plot(ends[1:, 0], ends[1:, 1], "o", ms=4.5, mew=0, color=INK["predicted"])
    seen = np.array([pose for pose in actual[1:] if pose is not None], float).reshape(-1, 3)
    axes.plot(seen[:, 0], seen[:, 1], "s", ms=4.5, mew=1.2, mec=INK["actual"], mfc=INK["paper"])
    _numbers(axes, ends)
    _arrow(axes, ends[0])
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.margins(0.015)
    axes.grid(visible=False)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0.2)


def _ground(axes: Axes, task: Mapping[str, Any], board: Mapping[str, float]) -> None:
    _box(axes, (0, 0), (board["length"], board["width"]), fc=INK["board"], ec=INK["muted"])
    for number, (x, y) in layout(task).items():
        if number > 0:
            _box(axes, (x, y), (LENGTH, WIDTH), fc="none", ec=INK["muted"], lw=0.8)
            axes.text(
                x, y, str(number), ha="center", va="center", size=24, weight="bold",
                color=INK["muted"], alpha=0.3, zorder=0.6,
            )  # fmt: skip
        else:
            style = {"fc": INK["shade"], "ec": INK["muted"], "lw": 0.8, "hatch": "////"}
            _box(axes, (x, y), (LENGTH, WIDTH), **style)
            axes.text(
                x, y, "forbidden", ha="center", va="center",
                bbox={"fc": INK["board"], "ec": "none", "pad": 2},
            )  # fmt: skip


def _box(axes: Axes, centre: Sequence[float], size: Sequence[float], **style: Any) -> None:
    corner = (centre[0] - size[0] / 2, centre[1] - size[1] / 2)
    style = {"lw": 1.0, "zorder": 0.5, **style}
    axes.add_patch(Rectangle(corner, size[0], size[1], **style))
    axes.update_datalim([corner, (corner[0] + size[0], corner[1] + size[1])])
    axes.autoscale_view()


def _numbers(axes: Axes, ends: NDArray) -> None:
    # Beside the path, on the side away from where it goes next.
    for number in range(1, len(ends)):
        heading = ends[number, 2] + np.pi / 2
        axes.annotate(
            str(number), ends[number, :2], xytext=(9 * np.cos(heading), 9 * np.sin(heading)),
            textcoords="offset points", ha="center", va="center", size=8.5,
            color=INK["predicted"], bbox={"fc": INK["board"], "ec": "none", "pad": 0.6}, zorder=1.5,
        )  # fmt: skip


def _arrow(axes: Axes, start: NDArray, length: float = 0.17) -> None:
    x, y, heading = start
    axes.annotate(
        "", (x + length * np.cos(heading), y + length * np.sin(heading)), (x, y),
        arrowprops={"arrowstyle": "-|>", "color": INK["ink"], "lw": 1.6},
    )  # fmt: skip
    axes.plot(x, y, "o", ms=6, color=INK["ink"])


def _thin(points: NDArray, spacing: float = 0.004) -> NDArray:
    """Leave out points nearer than ``spacing`` to the last one kept."""
    kept = [0]
    for place in range(1, len(points)):
        if np.hypot(*(points[place] - points[kept[-1]])) >= spacing:
            kept.append(place)
    return points[[*kept, len(points) - 1]]
