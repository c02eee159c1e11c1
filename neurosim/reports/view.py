"""A picture of a simulator's place, a task's outline, the robot and its path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Wedge
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from neurosim.base.errors import UserError, counted
from neurosim.base.files import atomic_path, check_new_file
from neurosim.base.place import Place
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.controllers import FixedPlan, SavedController, read_controller
from neurosim.loop.evaluate import Evaluator, with_contacts
from neurosim.loop.stepped import SteppedRollouts
from neurosim.reports.artefacts import task_of
from neurosim.reports.course import Scene, bounds, draw_scene, planned_path, unit_of
from neurosim.reports.svg import INK
from neurosim.simulators import Simulator, read_simulator
from neurosim.simulators.base import InPlace
from neurosim.simulators.tables.simulator import RADIUS
from neurosim.tasks.base import Task

SUFFIXES = (".png", ".svg", ".pdf")
#: Duration of a drive if the task is not registered here, s.
SECONDS = 20.0
#: Longest piece of a command by which a plan's path is computed, s; if this changes the result by
#: more than these (m and rad), poses are joined by arcs.
_PIECE, _SAME = 0.1, 1e-3
#: Size of the arrow for a robot of unknown size, as a fraction of the picture.
_ARROW = 0.02


def draw_view(
    place: str | Path,
    out: str | Path,
    *,
    simulator: str | Path | None = None,
    controller: str | Path | None = None,
    pose: tuple[float, float, float] | None = None,
    seconds: float | None = None,
    noise: bool = False,
    seed: int = 0,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Draw a simulator of any kind, or a place, and a controller's drive in it, into a file.

    Args:
        place: the folder of a simulator, or the JSON file or name of a place.
        out: the picture, .png, .svg or .pdf.
        simulator: folder of another simulator for the drive, in the place of ``place``.
        controller: folder of a controller of any kind.
        pose: x, y (m) and heading (rad) of the start; by default the task's.
        seconds: duration of a closed-loop controller's drive; by default that of its task's trial.
        noise: whether the simulator's noise (and the member of an ensemble) is drawn.
        seed: of the noise and of a random start.
        overwrite: whether an existing picture at ``out`` is replaced.

    Returns:
        ``pose`` (m, m, rad) at the end; ``readings``, if there are sensors; for a controller the
        ``path`` [N, 3], its ``steps``, and ``fitness``, ``completes`` and ``reason`` by its task's
        judgement of this drive; if the simulator has walls, ``contacts``, the number of collisions;
        ``note``, a sentence on parts that could not be done, or None.

    Raises:
        UserError: if a file is wrong, the robot does not fit at its start, a controller does not
            fit the simulator, a controller has no simulator, or a picture must not be replaced.
    """
    out = Path(out)
    if out.suffix.lower() not in SUFFIXES:
        raise UserError(f"{out}: a picture ends in {', '.join(SUFFIXES)}")
    check_new_file(out, "picture", overwrite=overwrite)
    world, around = _place(place, simulator)
    rng = np.random.default_rng(seed)
    saved = task = note = None
    if controller is not None:
        if world is None:
            raise UserError("a path needs a simulator to drive in: give --simulator")
        saved = read_controller(controller)
        task, note = _task(saved, Path(controller) / "controller.json", world)
        if around is not None and not Path(place).is_dir():
            task = task.in_place(around)
        elif task.place is not None:
            world, around = task.placed(world), task.place
    start = _start(world, around, task, pose, rng)
    path, stops, result, touching = start[None], None, {}, None
    if saved is not None and task is not None and world is not None:
        evaluator, episode = Evaluator(world, task, saved.controller), task.episode
        if seconds is not None:
            episode = replace(episode, steps=max(round(seconds / episode.step), 1))
        trajectory = _drive(world, saved, episode, start, rng if noise else None)
        path, stops = _path(world, saved, episode, trajectory, noise)
        if episode.contacts:
            trajectory = with_contacts(world, trajectory)
        result = {"path": path, "steps": trajectory.commands.shape[-2]}
        if note is None:
            judged = evaluator.task.judge(trajectory)
            reason, completes = int(judged.reason[0, 0]), bool(judged.success[0, 0])
            result |= {
                "fitness": float(judged.fitness[0, 0]),
                "completes": completes,
                "reason": None if completes else task.why(reason),
            }
        touching = world.touching(path)
        if touching is not None:
            result["contacts"] = int((touching & ~np.roll(touching, 1))[1:].sum())
    result["pose"], result["note"] = path[-1], note
    place_shapes = [] if around is None else around.shapes()
    if world is not None:
        place_shapes = world.outline()
        if world.reading_names:
            generator = torch.Generator().manual_seed(seed) if noise else None
            standing = world.start(torch.from_numpy(path[-1:]))
            result["readings"] = world.sense(standing, generator)[0].numpy()
    figure = picture(
        Scene.of(task, place_shapes), path, stops, simulator=world, readings=result.get("readings"),
        title=_title(place, simulator, controller, result), touching=touching,
    )  # fmt: skip
    with atomic_path(out) as partial:
        figure.savefig(partial, dpi=160)
    return result


def picture(
    scene: Scene,
    path: NDArray[np.float64],
    stops: NDArray[np.float64] | None = None,
    *,
    simulator: Simulator | None = None,
    readings: NDArray | None = None,
    title: str = "",
    touching: NDArray[np.bool_] | None = None,
) -> Figure:
    """Return the picture; the robot stands at the end of its path [N, 3] (m, m, rad).

    Args:
        scene: place and outline of the task.
        path: the robot's poses.
        stops: [K, 3] poses at the ends of a plan's commands, or None.
        simulator: has the robot's size and the directions of its sensors; None: a place alone.
        readings: [S] of the sensors at the end, or None.
        title: text above the picture.
        touching: [N] whether the robot touches something, or None.
    """
    low, high = bounds(scene, [path[:, :2]])
    scale, unit = unit_of(low, high)
    extent = float(np.max(high - low))
    low, high = low - 0.03 * extent, high + 0.03 * extent
    width = 7.0
    height = float(np.clip(width * (high - low)[1] / (high - low)[0], 2.5, 9.0))
    bars = readings is not None
    figure = Figure((width + 0.6, height + (1.9 if bars else 0.5)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.set_facecolor(INK["paper"])
    grid = figure.add_gridspec(2 if bars else 1, 1, height_ratios=[height, 1.2] if bars else [1])
    axes = figure.add_subplot(grid[0])
    draw_scene(axes, scene, scale)
    (x1, y1), (x2, y2) = scale * low, scale * high
    axes.set(xlim=(x1, x2), ylim=(y1, y2), aspect="equal")
    axes.set_title(title, fontsize=10, color=INK["ink"], loc="left")
    _draw_path(axes, path, stops, scale)
    if touching is not None and touching.any():
        x, y = scale * path[touching, :2].T
        axes.plot(x, y, "x", ms=5, mew=1.4, color=INK["actual"], zorder=4)
    radius = RADIUS if simulator is None else simulator.radius
    bearings = None if simulator is None else simulator.bearings
    if radius is not None and readings is not None and bearings is not None:
        _wedges(axes, path[-1], readings, bearings, radius, scale)
    _robot(axes, path[-1], radius, scale, _ARROW * extent)
    _labels(axes, f"x, {unit}", f"y, {unit}")
    if readings is not None and simulator is not None:
        _bars(figure.add_subplot(grid[1]), readings, simulator.reading_names, bearings)
    return figure


def _title(
    place: str | Path,
    simulator: str | Path | None,
    controller: str | Path | None,
    result: dict[str, Any],
) -> str:
    """Return the text above the picture: controller, place and result."""
    where = Path(place).resolve().name
    if controller is None:
        return where
    words = [f"{Path(controller).resolve().name} in {where}"]
    if simulator is not None:
        words[0] += f" ({Path(simulator).resolve().name})"
    if "fitness" in result:
        words.append(f"fitness {result['fitness']:z.4g}")
    if "contacts" in result:
        words.append(contacts_in_words(result["contacts"]))
    return ", ".join(words)


def contacts_in_words(count: int) -> str:
    """Return a robot's number of contacts, in words."""
    return "no contact" if not count else f"{counted(count, 'contact')} (x)"


def _place(
    place: str | Path, simulator: str | Path | None
) -> tuple[Simulator | None, Place | None]:
    """Return the simulator of the drive, if any, and the place, if known."""
    if not Path(place).is_dir():
        around = Place.of(place)
    elif simulator is None:
        own = read_simulator(place)
        return own, own.place if isinstance(own, InPlace) else None
    else:
        other = read_simulator(place)
        if not isinstance(other, InPlace):
            raise UserError(f"{place} has no place to drive in; name that of --simulator alone")
        around = other.place
    if simulator is None:
        return None, around
    named = read_simulator(simulator)
    return (named.changed(place=around) if isinstance(named, InPlace) else named), around


class _Unknown(Task):
    """A task that is not registered here, with the data of a controller's file."""

    def __init__(self, saved: SavedController, readings: bool):
        self.name = saved.task["name"]  # type: ignore[misc]
        self.start = saved.start
        settings = saved.task.get("settings") or {}
        steps = [settings.get(name) for name in ("step", "duration")]
        known = [s for s in steps if isinstance(s, int | float) and 0.001 <= s <= 10]
        self._step, self._readings = float(known[0]) if known else 0.1, readings

    @property
    def episode(self) -> Episode:
        return Episode(self._step, max(round(SECONDS / self._step), 1), readings=self._readings)


def _task(saved: SavedController, json: Path, simulator: Simulator) -> tuple[Task, str | None]:
    """Return a controller's task, and a sentence if it is not registered here."""
    task = task_of(saved.task, json)
    if task is not None:
        return task, None
    return _Unknown(saved, bool(simulator.reading_names)), (
        f"the task {saved.task['name']} is not registered on this computer: its outline is not "
        "drawn, and the drive is not judged"
    )


def _start(
    simulator: Simulator | None,
    around: Place | None,
    task: Task | None,
    pose: tuple[float, float, float] | None,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the robot's start: the given one, the task's, or a random free pose."""
    radius = RADIUS if simulator is None or simulator.radius is None else simulator.radius
    own = None if around is None else around.start
    if task is not None and simulator is not None:
        poses = task.draw_starts(simulator, 1, rng)
    elif around is not None:
        poses = around.free_poses(1, radius, rng) if around.outline and own is None else None
    else:
        poses = None if simulator is None else simulator.free_poses(1, rng)
    if pose is not None:
        start = np.array(pose)
    elif poses is None:
        usual = (own or (0.0, 0.0, 0.0)) if task is None else task.start
        start = np.asarray(usual, np.float64)
    else:
        start = poses[0] if own is None else np.array(own)
    if around is not None:
        around.check_start(start, radius)
    return start


def _drive(
    simulator: Simulator,
    saved: SavedController,
    episode: Episode,
    start: NDArray[np.float64],
    rng: np.random.Generator | None,
) -> Trajectory:
    """Return the trajectory [1, 1, ...] of one robot, the expected one or with noise of ``rng``."""
    family = saved.controller
    rollouts = simulator.rollouts(family, episode) or SteppedRollouts(simulator, family, episode)
    if rng is not None:
        draws = rollouts.draw(start[None], rng)
    else:
        draws = Draws(start[None], np.array([-1]) if simulator.members > 1 else None)
    return rollouts.run(saved.genes[None], draws)


def _path(
    simulator: Simulator,
    saved: SavedController,
    episode: Episode,
    trajectory: Trajectory,
    noise: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return the poses [N, 3] of the path, and a plan's poses at the ends of commands [K, 3].

    The motion during a command is predicted in pieces, if they lead to the same pose; else the arc
    of constant twist.
    """
    assert trajectory.poses is not None
    poses = trajectory.poses[0, 0]
    if not saved.controller.open_loop:
        return poses, None
    commands, active = saved.controller.commands(saved.genes[None], 0.0)
    given = commands[0][active[0]]
    ends = np.flatnonzero(active[0]) + 1
    if isinstance(saved.controller, FixedPlan) and not noise:
        parts = np.maximum(np.ceil(given[:, -1] / _PIECE - 1e-9), 1).astype(int)
        pieces = [
            (*numbers, duration / count)
            for (*numbers, duration), count in zip(given.tolist(), parts.tolist(), strict=True)
            for _ in range(count)
        ]
        cut = replace(
            saved, controller=replace(saved.controller, slots=tuple(pieces)), genes=np.empty(0)
        )
        fine = _drive(simulator, cut, episode, poses[0], None).poses
        assert fine is not None
        if np.abs(fine[0, 0, np.cumsum(parts)] - poses[ends]).max() < _SAME:
            return fine[0, 0], poses[ends]
    return planned_path(np.concatenate([poses[[0, *ends]], poses[-1:]])), poses[ends]


def _draw_path(axes: Axes, path: NDArray, stops: NDArray | None, scale: float) -> None:
    if len(path) < 2:
        return
    x, y = scale * path[:, :2].T
    axes.plot(x, y, color=INK["predicted"], lw=1.4, solid_joinstyle="round", zorder=2)
    if stops is not None:
        axes.plot(*(scale * stops[:, :2].T), "o", ms=4, mew=0, color=INK["predicted"], zorder=3)
    axes.plot(x[0], y[0], "o", ms=6, mfc=INK["paper"], mec=INK["predicted"], mew=1.4, zorder=3)
    axes.annotate(
        "start", (x[0], y[0]), (6, 6), textcoords="offset points", fontsize=8,
        color=INK["predicted"], path_effects=[withStroke(linewidth=3, foreground=INK["board"])],
        zorder=3,
    )  # fmt: skip


def _wedges(
    axes: Axes, pose: NDArray, readings: NDArray, bearings: NDArray, radius: float, scale: float
) -> None:
    """Draw each sensor's reading, in the sensor's direction."""
    (x, y), heading, size = scale * pose[:2], math.degrees(pose[2]), scale * radius
    for bearing, reading in zip(np.degrees(bearings), readings, strict=True):
        if math.isfinite(bearing):
            middle, reach = heading + bearing, size * (1.08 + 1.3 * float(reading))
            axes.add_patch(
                Wedge(
                    (x, y), reach, middle - 9, middle + 9, width=reach - 1.08 * size,
                    fc=INK["actual"], ec="none", alpha=0.85, zorder=4,
                )
            )  # fmt: skip


def _robot(axes: Axes, pose: NDArray, radius: float | None, scale: float, arrow: float) -> None:
    """Draw the robot: a disc with an arrow, or the arrow alone if its size is unknown."""
    (x, y), theta = scale * pose[:2], pose[2]
    size = scale * (arrow if radius is None else radius)
    if radius is not None:
        axes.add_patch(Circle((x, y), size, fc=INK["paper"], ec=INK["ink"], lw=1.6, zorder=5))
    nose = (0.95, 0.0), (-0.45, 0.55), (-0.2, 0.0), (-0.45, -0.55)
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    corners = np.array([x, y]) + 0.8 * size * np.array(nose) @ turn.T
    axes.add_patch(Polygon(corners, fc=INK["ink"], ec="none", zorder=6))


def _bars(axes: Axes, readings: NDArray, names: Sequence[str], bearings: NDArray | None) -> None:
    places = np.arange(len(readings))
    axes.bar(places, np.ones(len(readings)), 0.62, color=INK["grid"])
    axes.bar(places, readings, 0.62, color=INK["actual"])
    for place, reading in zip(places, readings, strict=True):
        axes.annotate(
            f"{reading:.2f}", (place, reading), (0, 2), textcoords="offset points", ha="center",
            fontsize=7.5, color=INK["ink"],
        )  # fmt: skip
    labels = [name.removeprefix("sensor_") for name in names]
    if bearings is not None:
        looks = [
            f"{degrees:+.0f}°" if degrees == degrees else "" for degrees in np.degrees(bearings)
        ]
        labels = [
            f"{label}\n{look}".replace("-", "\N{MINUS SIGN}")
            for label, look in zip(labels, looks, strict=True)
        ]
    axes.set_xticks(places, labels)
    axes.set_ylim(0, 1.25)
    axes.set_yticks([0, 0.5, 1])
    where = "" if bearings is None else ", and where it looks (to the left)"
    _labels(axes, f"sensor{where}", "reading")


def _labels(axes: Axes, x: str, y: str) -> None:
    axes.set_facecolor("none")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK["muted"])
    axes.tick_params(colors=INK["muted"], labelsize=8)
    axes.set_xlabel(x, fontsize=9, color=INK["ink"])
    axes.set_ylabel(y, fontsize=9, color=INK["ink"])
