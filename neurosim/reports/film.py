"""A trial as a moving picture: the robot, the prediction, samples of the noise, the sensors."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.base.files import atomic_path, check_name, check_new_file, sha256
from neurosim.base.perimeter import LONGEST_ARC
from neurosim.base.trajectory import RUN_DOWN
from neurosim.loop.stepped import SteppedRollouts
from neurosim.reports.artefacts import Artefact, Artefacts, Trial, gather
from neurosim.reports.course import Scene, bounds, draw_scene
from neurosim.reports.svg import INK, drawing
from tracking.datasets.recordings import Recording

#: Sampled drives in a picture; largest number of frames of a film, and per second.
SAMPLES, FRAMES, FPS = 20, 600, 10
#: Size of the robot's arrow, as a fraction of the picture, and its corners relative to it.
ARROW = 0.03
NOSE = ((1.0, 0.0), (-0.6, 0.6), (-0.25, 0.0), (-0.6, -0.6))


@dataclass(frozen=True, eq=False)
class Film:
    """The moving parts, frame by frame; unknown poses are NaN.

    Attributes:
        times: [N] since the first command, s.
        robot: [N, 3] tracked poses (m, m, rad).
        predicted: [N, 3].
        samples: [S, N, 3] drives with the simulator's noise; S may be 0.
        names: of the sensors.
        readings: [N, R] of them, 0 to 1.
    """

    times: NDArray[np.float64]
    robot: NDArray[np.float64]
    predicted: NDArray[np.float64]
    samples: NDArray[np.float64]
    names: Sequence[str] = ()
    readings: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))

    def as_json(self, x: float, y: float, scale: float) -> str:
        """Return the film for a page's script, in the units of a drawing.

        Args:
            x, y: the origin in the drawing, whose y points down.
            scale: units of the drawing per metre.
        """
        place = np.array([x, y])

        def points(poses: NDArray) -> NDArray:
            return place + scale * poses[..., :2] * [1, -1]

        def track(poses: NDArray) -> list[list[float] | None]:
            turned = -np.degrees(poses[:, 2:])
            rows = np.round(np.concatenate([points(poses), turned], axis=1), 1)
            return [None if np.isnan(row).any() else row.tolist() for row in rows]

        samples = np.round(points(self.samples), 1).transpose(1, 0, 2)
        content = {
            "times": np.round(self.times, 2).tolist(),
            "robot": track(self.robot),
            "predicted": track(self.predicted),
            "samples": samples.reshape(len(self.times), -1).tolist() if len(self.samples) else [],
            "names": list(self.names),
            "readings": np.round(self.readings, 2).tolist(),
        }
        return json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")


def film(artefacts: Artefacts, trial: Trial, seed: int = 0) -> Film | None:
    """Return a trial as a film; None if the robot was never seen.

    Samples are drives of the trial's controller in its simulator, if both are among the artefacts.
    A replanned drive has none, because its commands differ.
    """
    track = np.asarray(trial.meta["actual"].get("path") or [], float).reshape(-1, 4)
    if len(track) < 2:
        return None
    begun = track[0, 0]
    planned, ends = _boundaries(trial)
    last = max(track[-1, 0] - begun, ends[-1] if len(ends) else 0.0)
    times = np.linspace(0, last, int(np.clip(last * FPS, 2, FRAMES)))
    names, readings = _readings(trial, begun + times)
    longest = LONGEST_ARC if trial.task is None else trial.task.longest_arc
    samples = [along(one, ends_of, times, longest) for one, ends_of in
               _samples(artefacts, trial, seed)]  # fmt: skip
    return Film(
        times,
        _seen(track[:, 0] - begun, track[:, 1:], times),
        along(planned, ends, times, longest),
        np.array(samples).reshape(-1, len(times), 3),
        names,
        readings,
    )


def along(
    poses: ArrayLike, ends: ArrayLike, times: NDArray, longest: float = LONGEST_ARC
) -> NDArray[np.float64]:
    """Return poses [N, 3] on the arcs between known poses.

    Args:
        poses: [K, 3] (m, m, rad); none: all is NaN.
        ends: [K] their times, s; afterwards the last one stays.
        times: [N], s.
        longest: see :func:`neurosim.reports.course.planned_path`.
    """
    poses, ends = np.asarray(poses, float).reshape(-1, 3), np.asarray(ends, float)
    if len(poses) < 2:
        return np.full((len(times), 3), np.nan)
    place = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(poses) - 2)
    length = np.maximum(ends[place + 1] - ends[place], 1e-9)
    fraction = np.clip((times - ends[place]) / length, 0, 1)
    moved = se2.between(poses[place], poses[place + 1])
    straight = ~(se2.arc_length(moved) < longest)
    part = np.where(straight[:, None], moved * fraction[:, None], se2.arc(moved, fraction))
    return se2.compose(poses[place], part)


def _seen(times: NDArray, poses: NDArray, at: NDArray) -> NDArray[np.float64]:
    """Return a track [N, 3] at other times; NaN where it has a gap of more than 0.5 s."""
    interpolated = np.column_stack([np.interp(at, times, column) for column in poses.T])
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    interpolated[(times[after] - times[after - 1] > 0.5) | (at > times[-1] + 0.5)] = np.nan
    return interpolated


def _boundaries(trial: Trial) -> tuple[NDArray, NDArray]:
    """Return the predicted poses [K, 3], and their times [K], s."""
    poses, durations = trial.predicted, np.array([row[-1] for row in trial.meta["commands"]])
    if trial.by_command:
        ends = np.concatenate([[0.0], np.cumsum(durations)])
        rest = trial.meta["predicted"].get("rest")
        if rest is not None:
            poses, ends = np.vstack([poses, rest]), np.append(ends, ends[-1] + RUN_DOWN)
        return poses, ends
    step = trial.task.episode.step if trial.task is not None else float(np.median(durations))
    return poses, step * np.arange(len(poses))


def _readings(trial: Trial, at: NDArray) -> tuple[Sequence[str], NDArray]:
    """Return the sensors' names and readings [N, R], each until the next reading."""
    looks = None
    if (trial.path / "recording.json").exists():
        looks = Recording(trial.path).observations()
    if looks is None or not looks.names:
        return (), np.empty((len(at), 0))
    looks = looks.of_session(1)
    if not len(looks.time):
        return (), np.empty((len(at), 0))
    place = np.clip(np.searchsorted(looks.time, at, side="right") - 1, 0, None)
    return looks.names, pd.DataFrame(looks.readings).ffill().bfill().to_numpy()[place]


def _samples(
    artefacts: Artefacts, trial: Trial, seed: int
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return sampled drives: poses [K, 3] and their times [K], s, of each."""
    simulator = _named(artefacts.simulators, trial.meta.get("simulator"))
    controller = _named(artefacts.controllers, trial.meta["controller"])
    task = trial.task
    if simulator is None or controller is None or task is None or trial.meta.get("replanned"):
        return []
    model, saved = simulator.content, controller.content
    rollouts = SteppedRollouts(model, saved.controller, task.episode)
    starts = np.repeat(np.array(saved.start, float)[None], SAMPLES, axis=0)
    draws = rollouts.draw(starts, np.random.default_rng(seed))
    trajectory = rollouts.run(saved.genes[None], draws)
    assert trajectory.poses is not None
    poses = trajectory.poses[0]
    if np.ptp(poses, axis=0).max() < 1e-6:
        return []  # this simulator has no noise
    if saved.controller.open_loop:
        commands, active = saved.controller.commands(saved.genes[None], 0.0)
        ends = np.concatenate([[0.0], np.cumsum(commands[0][active[0], -1])])
        places = [0, *(np.flatnonzero(active[0]) + 1)]
        if poses.shape[1] > active.shape[1] + 1:
            places, ends = [*places, -1], np.append(ends, ends[-1] + RUN_DOWN)
        return [(one[places], ends) for one in poses]
    ends = task.episode.step * np.arange(poses.shape[1])
    return [(one, ends) for one in poses]


def _named(artefacts: Sequence[Artefact], source: Any) -> Artefact | None:
    """Return the artefact that a trial names by its SHA-256."""
    digest = (source or {}).get("sha256")
    return next((one for one in artefacts if sha256(one.json) == digest), None)


def write_film(
    folder: str | Path,
    out: str | Path,
    *,
    simulator: str | Path | None = None,
    controller: str | Path | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write the video of a trial, seen from above.

    Args:
        folder: of the trial.
        out: the video, .mp4.
        simulator, controller: folders of the trial's own, for samples of the noise.
        seed: of the samples.
        overwrite: whether a file at ``out`` is replaced.

    Returns:
        ``frames`` and ``seconds`` of it, and the number of ``samples``.

    Raises:
        UserError: if the folder is not a trial's, the robot was never seen, or the video cannot be
            written.
    """
    out = Path(out)
    if out.suffix.lower() != ".mp4":
        raise UserError(f"{out}: the name of a video ends in .mp4")
    check_new_file(out, "video", overwrite=overwrite)
    others = [one for one in (simulator, controller) if one is not None]
    only = "--video shows the drive of a trial"
    _, scene, shown = filmed_trial([folder, *others], seed, only)
    moving = frames(scene, shown)
    first = next(moving)
    fps = (len(shown.times) - 1) / shown.times[-1]
    size = (first.shape[1], first.shape[0])
    with atomic_path(out) as partial:
        writer = cv2.VideoWriter(check_name(partial), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
        if not writer.isOpened():
            raise UserError(f"{out}: OpenCV cannot write this video here")
        for frame in chain([first], moving):
            writer.write(frame)
        writer.release()
    return {
        "frames": len(shown.times),
        "seconds": float(shown.times[-1]),
        "samples": len(shown.samples),
    }


def filmed_trial(folders: Sequence[str | Path], seed: int, only: str) -> tuple[Trial, Scene, Film]:
    """Return a trial, its scene and its film.

    Args:
        folders: folder of the trial, and those of its simulator and controller for samples of the
            noise.
        seed: of the samples.
        only: the end of the message if the first folder is not a trial's.

    Raises:
        UserError: if it is not, or the robot was never seen.
    """
    artefacts = gather(folders)
    if not artefacts.trials:
        raise UserError(f"{folders[0]} is not a trial; {only}")
    trial = artefacts.trials[0]
    shown = film(artefacts, trial, seed)
    if shown is None:
        raise UserError(f"{folders[0]}: nothing saw the robot, so there is no drive to show")
    return trial, Scene.of(trial.task, artefacts.place_of(trial), trial.board), shown


def frames(scene: Scene, film: Film) -> Iterator[NDArray[np.uint8]]:
    """Give the frames (H, W, 3) of a trial's film, BGR."""
    ground, place, scale = _ground(scene, film)
    for number in range(len(film.times)):
        yield _frame(ground, film, number, place, scale)


def _ground(scene: Scene, film: Film) -> tuple[NDArray[np.uint8], NDArray, float]:
    """Return the still picture (H, W, 3), BGR, its origin and pixels per metre."""
    poses = np.concatenate([film.robot, film.predicted])
    low, high = bounds(scene, [poses[np.isfinite(poses).all(axis=1), :2]])
    aspect = float(np.clip((high - low)[1] / (high - low)[0], 0.35, 1.3))
    with drawing(6.4, 6.4 * aspect) as (figure, axes):
        canvas = FigureCanvasAgg(figure)
        figure.set_facecolor(INK["paper"])
        draw_scene(axes, scene)
        room = 0.04 * float(np.max(high - low))
        axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room))
        axes.set_aspect("equal")
        axes.set_axis_off()
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., 2::-1]
        origin, one = axes.transData.transform([[0.0, 0.0], [1.0, 0.0]])
    height, width = (side - side % 2 for side in picture.shape[:2])  # even, for encoders
    place = np.array([origin[0], picture.shape[0] - origin[1]])
    return np.ascontiguousarray(picture[:height, :width]), place, float(one[0] - origin[0])


def _frame(
    ground: NDArray[np.uint8], film: Film, number: int, place: NDArray, scale: float
) -> NDArray[np.uint8]:
    """Return one frame (H, W, 3), BGR."""
    frame = ground.copy()
    size = ARROW * ground.shape[1]

    def pixels(poses: NDArray) -> NDArray:
        return place + scale * poses[..., :2] * [1, -1]

    for x, y in pixels(film.samples[:, number]) if len(film.samples) else ():
        cv2.circle(frame, (round(x), round(y)), 3, _bgr("muted"), -1, cv2.LINE_AA)
    for poses, ink in ((film.predicted, "predicted"), (film.robot, "actual")):
        known = poses[: number + 1]
        known = known[np.isfinite(known).all(axis=1)]
        if len(known) > 1:
            line = np.round(16 * pixels(known)).astype(np.int32)
            cv2.polylines(frame, [line], False, _bgr(ink), 2, cv2.LINE_AA, 4)
        if np.isfinite(poses[number]).all():
            theta = poses[number, 2]
            turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
            corners = pixels(poses[number]) + size * np.array(NOSE) @ turn.T
            shape = [np.round(16 * corners).astype(np.int32)]
            cv2.fillPoly(frame, shape, _bgr(ink), cv2.LINE_AA, 4)
    words = [
        (f"{film.times[number]:.1f} s", "ink"),
        ("robot", "actual"),
        ("predicted", "predicted"),
    ]
    words += [("samples", "muted")] * bool(len(film.samples))
    at = 8
    for text, ink in words:
        cv2.putText(frame, text, (at, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _bgr(ink), 1, cv2.LINE_AA)
        at += 24 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0]
    for row, name in enumerate(film.names):
        top, reading = 32 + 16 * row, float(np.clip(film.readings[number, row], 0, 1))
        cv2.rectangle(frame, (8, top), (68, top + 9), _bgr("grid"), -1)
        cv2.rectangle(frame, (8, top), (8 + round(60 * reading), top + 9), _bgr("actual"), -1)
        spot = (74, top + 9)
        cv2.putText(frame, name, spot, cv2.FONT_HERSHEY_SIMPLEX, 0.4, _bgr("ink"), 1, cv2.LINE_AA)
    return frame


def _bgr(ink: str) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in to_rgb(INK[ink]))
    return blue, green, red
