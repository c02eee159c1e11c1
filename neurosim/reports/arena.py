"""A picture of an arena, the robot in it, what its sensors read and the path it took."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Wedge
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import atomic_path
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.controllers import read_controller
from neurosim.loop.stepped import SteppedRollouts
from neurosim.reports.svg import INK
from neurosim.simulators import TableSimulator, read_simulator
from neurosim.simulators.tables.arena import Arena
from neurosim.simulators.tables.simulator import RADIUS
from neurosim.tasks.obstacle_avoidance import FITNESS

#: Where a Khepera's sensors look, degrees to the left.
SENSOR_BEARINGS = (90.0, 45.0, 10.0, -10.0, -45.0, -90.0, -170.0, 170.0)
SUFFIXES = (".png", ".svg", ".pdf")


def draw_arena(
    arena: str | Path,
    out: str | Path,
    *,
    simulator: str | Path | None = None,
    controller: str | Path | None = None,
    pose: tuple[float, float, float] | None = None,
    seconds: float = 20.0,
    noise: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Draw an arena into a file.

    Args:
        arena: its JSON file, or the folder of a table simulator.
        out: the picture, .png, .svg or .pdf.
        simulator: folder of a table simulator, for readings and path; where ``arena`` is one, it
            is that.
        controller: folder of what drives.
        pose: x and y in cm, heading in degrees.
        seconds: how long a network drives.
        noise: whether the simulator's noise is drawn.
        seed: of the noise and, where no pose is given and the arena has none, of the start.

    Returns:
        ``pose`` (m, m, rad) at the end, and where there is a simulator ``readings``, where
        something drives ``path`` and, of a network, ``steps`` and its task's ``fitness``, where
        that is known here.

    Raises:
        UserError: if a file is not what it should be, the robot does not fit where it is to
            start, or there is a controller and no simulator.
    """
    out = Path(out)
    if out.suffix.lower() not in SUFFIXES:
        raise UserError(f"{out}: a picture ends in {', '.join(SUFFIXES)}")
    if Path(arena).is_dir() and simulator is None:
        simulator = arena
    found = None if simulator is None else _tables(simulator)
    shown = _tables(arena).arena if Path(arena).is_dir() else Arena.read(arena)
    if found is not None:
        found = found.changed(arena=shown)
    elif controller is not None:
        raise UserError("a path needs a simulator to drive in: give --simulator")
    radius = RADIUS if found is None else found.radius
    rng = np.random.default_rng(seed)
    start = _start(shown, pose, radius, rng)
    path, result = np.array([start]), {}
    if controller is not None:
        trajectory, named = _drive(found, controller, start, seconds, rng if noise else None)
        path = trajectory.poses
        result["path"] = path
        if trajectory.readings is not None:
            result["steps"] = len(trajectory.readings)
            if named in FITNESS:
                result["fitness"] = float(FITNESS[named](trajectory, trajectory.durations))
    result["pose"] = path[-1]
    if found is not None:
        generator = torch.Generator().manual_seed(seed) if noise else None
        result["readings"] = found.sense(torch.from_numpy(path[-1:]), generator)[0].numpy()
    figure = picture(shown, path, result.get("readings"), radius)
    with atomic_path(out) as partial:
        figure.savefig(partial, dpi=160)
    return result


def picture(
    arena: Arena,
    path: ArrayLike,
    readings: ArrayLike | None = None,
    radius: float = RADIUS,
) -> Figure:
    """Return the picture: the robot stands at the end of its path [N, 3] (m, m, rad)."""
    path = np.asarray(path, float)
    x1, y1, x2, y2 = 100 * np.array(arena.bounds)
    bars = readings is not None
    width = 7.0
    height = min(max(width * (y2 - y1) / (x2 - x1), 2.5), 9.0)
    figure = Figure((width + 0.6, height + (1.9 if bars else 0.5)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.set_facecolor(INK["paper"])
    grid = figure.add_gridspec(2 if bars else 1, 1, height_ratios=[height, 1.2] if bars else [1])
    axes = figure.add_subplot(grid[0])
    margin = 0.03 * max(x2 - x1, y2 - y1)
    axes.set(xlim=(x1 - margin, x2 + margin), ylim=(y1 - margin, y2 + margin), aspect="equal")
    draw_objects(axes, arena)
    _path(axes, path)
    _robot(axes, path[-1], None if readings is None else np.asarray(readings, float), radius)
    _labels(axes, "x, cm", "y, cm")
    if bars:
        _bars(figure.add_subplot(grid[1]), np.asarray(readings, float))
    return figure


def draw_objects(axes: Axes, arena: Arena) -> None:
    """Draw walls and obstacles, in cm."""
    corners = [(100 * wall[0], 100 * wall[1]) for wall in arena.outline]
    axes.add_patch(Polygon(corners, fc=INK["board"], ec=INK["ink"], lw=2.2, joinstyle="miter"))
    walls = 100 * np.array(arena.inner).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(walls, colors=INK["ink"], lw=2.2))
    for x, y, size in arena.obstacles:
        axes.add_patch(
            Circle((100 * x, 100 * y), 100 * size, fc=INK["shade"], ec=INK["ink"], lw=1.2)
        )


def _path(axes: Axes, path: NDArray[np.float64]) -> None:
    if len(path) < 2:
        return
    x, y = 100 * path[:, 0], 100 * path[:, 1]
    axes.plot(x, y, color=INK["predicted"], lw=1.4, solid_joinstyle="round", zorder=2)
    axes.plot(x[0], y[0], "o", ms=6, mfc=INK["paper"], mec=INK["predicted"], mew=1.4, zorder=3)
    axes.annotate(
        "start", (x[0], y[0]), (6, 6), textcoords="offset points", fontsize=8,
        color=INK["predicted"], path_effects=[withStroke(linewidth=3, foreground=INK["board"])],
        zorder=3,
    )  # fmt: skip


def _robot(axes: Axes, pose: NDArray, readings: NDArray | None, radius: float) -> None:
    x, y, theta = 100 * pose[0], 100 * pose[1], pose[2]
    size, heading = 100 * radius, math.degrees(theta)
    if readings is not None:
        for bearing, reading in zip(SENSOR_BEARINGS, readings, strict=True):
            middle, reach = heading + bearing, size * (1.08 + 1.3 * reading)
            axes.add_patch(
                Wedge(
                    (x, y), reach, middle - 9, middle + 9, width=reach - 1.08 * size,
                    fc=INK["actual"], ec="none", alpha=0.85, zorder=4,
                )
            )  # fmt: skip
    axes.add_patch(Circle((x, y), size, fc=INK["paper"], ec=INK["ink"], lw=1.6, zorder=5))
    nose = (0.95, 0.0), (-0.45, 0.55), (-0.2, 0.0), (-0.45, -0.55)
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    arrow = np.array([x, y]) + 0.8 * size * np.array(nose) @ turn.T
    axes.add_patch(Polygon(arrow, fc=INK["ink"], ec="none", zorder=6))


def _bars(axes: Axes, readings: NDArray) -> None:
    places = np.arange(len(readings))
    axes.bar(places, np.ones(len(readings)), 0.62, color=INK["grid"])
    axes.bar(places, readings, 0.62, color=INK["actual"])
    for place, reading in zip(places, readings, strict=True):
        axes.annotate(
            f"{reading:.2f}", (place, reading), (0, 2), textcoords="offset points", ha="center",
            fontsize=7.5, color=INK["ink"],
        )  # fmt: skip
    names = [
        f"{index}\n{bearing:+.0f}°".replace("-", "\N{MINUS SIGN}")
        for index, bearing in enumerate(SENSOR_BEARINGS)
    ]
    axes.set_xticks(places, names)
    axes.set_ylim(0, 1.25)
    axes.set_yticks([0, 0.5, 1])
    _labels(axes, "sensor, and where it looks (to the left)", "reading")


def _labels(axes: Axes, x: str, y: str) -> None:
    axes.set_facecolor("none")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK["muted"])
    axes.tick_params(colors=INK["muted"], labelsize=8)
    axes.set_xlabel(x, fontsize=9, color=INK["ink"])
    axes.set_ylabel(y, fontsize=9, color=INK["ink"])


def _tables(folder: str | Path) -> TableSimulator:
    found = read_simulator(folder)
    if not isinstance(found, TableSimulator):
        raise UserError(f"{folder} is no simulator of tables; it has neither arena nor sensors")
    return found


def _start(
    arena: Arena,
    pose: tuple[float, float, float] | None,
    radius: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    if pose is not None:
        start = np.array([pose[0] / 100, pose[1] / 100, math.radians(pose[2])])
    elif arena.start is not None:
        start = np.array(arena.start)
    else:
        return arena.free_poses(1, radius, rng)[0]
    arena.check_start(start, radius)
    return start


def _drive(
    simulator: TableSimulator,
    folder: str | Path,
    start: NDArray[np.float64],
    seconds: float,
    rng: np.random.Generator | None,
) -> tuple[Trajectory, str]:
    """Return what one robot did, [T, ...], and the name of its task's fitness.

    Of a plan the poses alone, ten a second.
    """
    saved = read_controller(folder)
    if saved.commands:
        path = _plan_path(simulator, saved.given, start)
        steps = len(path) - 1
        return Trajectory(path, np.zeros((steps, 2)), 0.1), ""
    settings = saved.task.get("settings", {})
    step = settings.get("duration", settings.get("step", 0.1))
    episode = Episode(step, max(round(seconds / step), 1), readings=True)
    drives = simulator.rollouts(saved.controller, episode)
    drives = drives or SteppedRollouts(simulator, saved.controller, episode)
    draws = Draws(start[None]) if rng is None else drives.draw(start[None], rng)
    found = drives.run(saved.genes[None], draws)
    driven = Trajectory(found.poses[0, 0], found.commands[0, 0], step, found.readings[0, 0])
    return driven, settings.get("fitness", "avoidance")


def _plan_path(simulator: TableSimulator, given: list, start: NDArray) -> NDArray[np.float64]:
    state, poses = simulator.start(torch.from_numpy(start[None])), [start]
    for left, right, duration in given:
        parts = max(math.ceil(duration / 0.1), 1)
        command = torch.tensor([[left, right, duration / parts]], dtype=torch.float64)
        for _ in range(parts):
            state = simulator.step(state, command)
            poses.append(state[0, :3].numpy())
    return np.array(poses)
