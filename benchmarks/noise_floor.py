"""How well any simulator could predict: the variation between drives of the same command.

    python benchmarks/noise_floor.py [-o data/noise_floor.json] [--dataset data/reference]

In the virtual lab, each of many pairs of commands is driven many times. They are taken evenly from
the held-out rows of a dataset, so that the floor is that of the very commands on which errors are
measured; the first of a pair has a random duration, because the dataset has none. Each time the
robot starts at a random place and heading, with a random battery charge. It drives a random command
as its past, then the pair, whose second command's displacement counts. Places from which the robot
would leave the perimeter line are chosen again. A network gets neither place nor battery nor the
past of the pair.

Everything goes through the parts of a recording: the driver, the radio link and the brick, the
roof camera's frames, the tracker and the displacement code. Left out are the video file, frames
that no pose is taken from, and the flash: the camera's clock and optics are taken as known.

The floor is the mean absolute deviation from each pair's median, averaged over pairs. All drives
are kept in a file next to it (``-o``'s name, ending in .csv), to be compared with predictions.
``--pose truth`` uses the lab's true poses instead of the camera: the floor without the tracker's
errors.

Work is done in pieces of one pair, each kept at once in OUT.parts: an interrupted run continues. On
two cores 200 x 30 drives take about 8 minutes, with ``--pose truth`` one.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from neurosim.base import files, se2
from neurosim.base.progress import Progress
from neurosim.lab import VirtualRig
from neurosim.lab.nxt.params import BOARD
from neurosim.lab.nxt.physics import S
from neurosim.recording.commands import Command, RandomCommands
from tracking.datasets.dataset import Dataset
from tracking.datasets.displacements import Settings as TrackSettings
from tracking.datasets.displacements import Track
from tracking.datasets.recordings import DEFAULT_MARKERS
from tracking.follow import Track as Seen
from tracking.markers.colours import parse_colour
from tracking.markers.tracker import Tracker
from tracking.poses import board_poses, marker_geometry

FORMAT, VERSION = "neurosim-noise-floor", 1
UNITS = {"dx": (100.0, "cm"), "dy": (100.0, "cm"), "dtheta": (180.0 / math.pi, "deg")}
INPUTS = ("prev_left", "prev_right", "left", "right", "duration")
#: Open-circuit voltage of a battery between nearly empty and full.
BATTERY = (6.8, 8.2)
#: The camera looks this long before and after the two instants at which the robot's pose counts, s.
_BEFORE, _AFTER = 0.25, 0.11
#: Mean delay of a telegram and of the lamp's filament, s. The flash that matches the clocks of a
#: recording is late by it, so that in a track a command's time is about that of its arrival.
_DELAY = 0.024
_DURATIONS = RandomCommands.durations


@dataclass(frozen=True)
class Settings:
    """Robot, commands and repetitions of a measurement.

    Attributes:
        robot: seed of the robot and its board.
        dataset: whose last fifth gives the pairs of commands.
        commands: how many pairs.
        repetitions: drives of each.
        pose: ``camera`` or ``truth``.
        seed: of everything else.
    """

    robot: int = 0
    dataset: str = "data/reference"
    commands: int = 200
    repetitions: int = 30
    pose: str = "camera"
    seed: int = 1


def pairs_of(settings: Settings) -> pd.DataFrame:
    """Return the held-out rows whose pairs of commands are driven."""
    rows = Dataset.read(settings.dataset).split(0.2)[1].table
    count = settings.commands
    return rows.iloc[[(2 * pair + 1) * len(rows) // (2 * count) for pair in range(count)]]


def displacements(settings: Settings, pair: int) -> np.ndarray:
    """Drive one pair of commands; return its displacements [repetitions, 3] (m, m, rad)."""
    rng = np.random.default_rng([settings.seed, pair])
    row = pairs_of(settings).iloc[pair]
    command = Command((row.left, row.right), row.duration)
    results: list[np.ndarray] = []
    with VirtualRig(
        settings.robot,
        noise_seed=settings.seed * 100_000 + pair,
        camera=settings.pose == "camera",
    ) as rig:
        rig.robot.connect()
        eye = Eye(rig, rng) if settings.pose == "camera" else None
        tries = 0
        while len(results) < settings.repetitions:
            tries += 1
            if tries > 40 * settings.repetitions:
                raise RuntimeError(f"command {pair} fits nowhere on the board")
            first = RandomCommands(seed=int(rng.integers(2**31))).command(0)
            before = Command((first.left, first.right), 1.0)
            previous = Command((row.prev_left, row.prev_right), rng.uniform(*_DURATIONS))
            moved = _drive(rig, [before, previous, command], rng, eye)
            if moved is not None:
                results.append(moved)
        rig.robot.close()
    return np.array(results)


def _drive(
    rig: VirtualRig, commands: list[Command], rng: np.random.Generator, eye: Eye | None
) -> np.ndarray | None:
    """Drive from a random place; return the last command's displacement, None off the board."""
    lab, clock = rig.lab, rig.robot.clock
    half = np.array([BOARD.length, BOARD.width]) / 2 - BOARD.line_inset
    with lab.lock:
        lab.place(*rng.uniform(-half, half), rng.uniform(-math.pi, math.pi))
        lab.body.state[S.BATTERY] = rng.uniform(*BATTERY)
    clock.sleep_until(clock.now() + 0.2)
    times = []
    for number, command in enumerate(commands):
        times.append(clock.now())
        rig.robot.drive(command.numbers)
        last_two = number >= len(commands) - 2
        _wait(rig, times[-1] + command.duration, eye if last_two else None)
        if (np.abs(lab.body.pose[:2]) > half).any():
            rig.robot.stop()
            if eye is not None:
                eye.close()
            return None
    times.append(clock.now())
    rig.robot.stop()
    clock.sleep_until(times[-1] + _AFTER)
    if eye is None:
        return se2.between(*lab.truth.pose_at(np.array(times[-2:]) + _DELAY))
    eye.close()
    turned = np.diff(lab.truth.pose_at(np.array(times[-2:]))[:, 2])[0]
    return eye.displacement(*times[-3:], turned)


def _wait(rig: VirtualRig, until: float, eye: Eye | None) -> None:
    """Wait; look from a little before ``until`` on, and forget earlier frames."""
    clock = rig.robot.clock
    if eye is not None:
        eye_opens = until - _BEFORE - eye.random_phase()
        clock.sleep_until(clock.now() + _AFTER)
        eye.close()
        clock.sleep_until(eye_opens)
        eye.open()
    clock.sleep_until(until)


class Eye:
    """The tracker's poses in the camera's frames about the two instants that count."""

    def __init__(self, rig: VirtualRig, rng: np.random.Generator):
        self._camera, self._rng = rig.camera, rng
        self._model = rig.camera.optics.calibration
        self._geometry = marker_geometry(DEFAULT_MARKERS, self._model)
        self._settings = TrackSettings()
        self._stretches: list[list[tuple]] = []
        self._looking = False

    def random_phase(self) -> float:
        """Return a random fraction of the time between two frames, s."""
        return self._rng.uniform(0.0, 1.0 / self._camera.fps)

    def open(self) -> None:
        """Look from now on."""
        colours = (parse_colour("pink"), parse_colour("blue"))
        self._tracker = Tracker(*colours, self._geometry)
        self._stretches.append([])
        self._looking = True
        self._camera.start(self._frame)

    def close(self) -> None:
        """Look no more."""
        if self._looking:
            self._camera.stop()
        self._looking = False

    def _frame(self, time: float, frame: np.ndarray) -> None:
        seen = self._tracker.update(frame, time)
        row = (time, *seen.front, *seen.rear, seen.quality)
        self._stretches[-1].append(row)

    def displacement(
        self, before: float, start: float, end: float, turned: float
    ) -> np.ndarray | None:
        """Return the displacement from ``start`` to ``end``, None where the robot was lost.

        ``before`` is the command before's time; ``turned`` tells how often the robot went round
        between the two looks, which a camera that looks all the time sees.
        """
        first, last = (self._track(rows) for rows in self._stretches[-2:])
        self._stretches.clear()
        settling = self._settings.settling
        a, b = first.pose_at(start, before + settling), last.pose_at(end, start + settling)
        if a is None or b is None:
            return None
        moved = se2.between(a[0], b[0])
        moved[2] += 2.0 * math.pi * round((turned - moved[2]) / (2.0 * math.pi))
        return moved

    def _track(self, rows: list[tuple]) -> Track:
        table = np.array(rows, float)
        params = self._camera.params
        times = (table[:, 0] - params.clock_offset) / (1.0 + params.clock_drift) - _DELAY
        seen = Seen(
            np.arange(len(table)),
            times,
            table[:, 1:3],
            table[:, 3:5],
            table[:, 5],
            np.zeros(len(table)),
            self._camera.size,
            ({}, {}),
        )
        poses = board_poses(seen, DEFAULT_MARKERS, self._model)
        return Track(times, poses, table[:, 5], self._settings)


def measure(settings: Settings, out: Path, jobs: int) -> dict[str, object]:
    """Drive what has not been driven yet, and return the floor."""
    parts = out.with_name(out.name + ".parts")
    parts.mkdir(parents=True, exist_ok=True)
    _check_same(parts / "settings.json", asdict(settings))
    waiting = [n for n in range(settings.commands) if not (parts / f"{n:04d}.csv").exists()]
    began = time.monotonic()
    with (
        ProcessPoolExecutor(jobs) as pool,
        Progress("noise floor", settings.commands, "commands") as progress,
    ):
        progress.advance(settings.commands - len(waiting))
        work = {pool.submit(displacements, settings, n): n for n in waiting}
        for done in as_completed(work):
            rows = done.result()
            columns = dict(zip(UNITS, rows.T.tolist(), strict=True))
            files.write_csv(parts / f"{work[done]:04d}.csv", columns)
            progress.advance()
    driven = []
    for number in range(settings.commands):
        table = files.read_csv(parts / f"{number:04d}.csv", dict.fromkeys(UNITS, files.number))
        driven.append(np.array([table[name] for name in UNITS]).T)
    _keep(out.with_suffix(".csv"), settings, driven)
    moved = np.array(driven)
    deviations = np.abs(moved - np.median(moved, axis=1, keepdims=True)).mean(1)
    floor, error = deviations.mean(0), deviations.std(0) / math.sqrt(len(deviations))
    return {
        "settings": asdict(settings),
        "floor": {
            name: {
                "mean_absolute_deviation": factor * floor[place],
                "standard_error": factor * error[place],
                "unit": unit,
            }
            for place, (name, (factor, unit)) in enumerate(UNITS.items())
        },
        "wall_clock": {"seconds": round(time.monotonic() - began, 1)},
    }


def _keep(path: Path, settings: Settings, driven: list[np.ndarray]) -> None:
    """Write every drive with its command."""
    rows = pairs_of(settings)
    columns: dict[str, list] = {"pair": np.repeat(np.arange(len(driven)), settings.repetitions)}
    columns |= {name: np.repeat(rows[name].to_numpy(), settings.repetitions) for name in INPUTS}
    columns |= dict(zip(UNITS, np.concatenate(driven).T.round(6), strict=True))
    files.write_csv(path, {name: np.asarray(column).tolist() for name, column in columns.items()})


def _check_same(path: Path, settings: dict[str, object]) -> None:
    if path.exists():
        begun = json.loads(path.read_text(encoding="utf-8"))
        if begun != settings:
            raise SystemExit(f"{path.parent} was begun with {begun}; remove it to start anew")
    path.write_text(json.dumps(settings), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = Settings()
    parser.add_argument("-o", "--out", type=Path, default=Path("data/noise_floor.json"))
    parser.add_argument("--robot", type=int, default=default.robot, help="seed of the lab")
    parser.add_argument("--dataset", default=default.dataset)
    parser.add_argument("--commands", type=int, default=default.commands)
    parser.add_argument("--repetitions", type=int, default=default.repetitions)
    parser.add_argument("--pose", choices=("camera", "truth"), default=default.pose)
    parser.add_argument("--seed", type=int, default=default.seed)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    names = ("robot", "dataset", "commands", "repetitions", "pose", "seed")
    settings = Settings(**{name: getattr(options, name) for name in names})
    result = measure(settings, options.out, options.jobs)
    files.write_json(options.out, FORMAT, VERSION, result)
    shutil.rmtree(options.out.with_name(options.out.name + ".parts"))
    if options.json:
        print(json.dumps(result))
        return
    for name, entry in result["floor"].items():
        print(
            f"{name:7s} {entry['mean_absolute_deviation']:.3f} +- {entry['standard_error']:.3f} "
            f"{entry['unit']}"
        )


if __name__ == "__main__":
    main()
