"""Whether phototaxis and discrimination, evolved in tables, succeed in the virtual lab.

The robots have sampled light and a small cylinder too. For each robot and task, a network is
evolved in the robot's tables. It drives the robot of the lab in closed loop through its serial
line, from random starts, as ``neurosim run`` does. The lab's truth judges these drives, which are
compared with drives in the tables from the same starts. For discrimination, other drives have the
cylinder at random places, as in the environment ErDiscrim of evorobotpy2; nothing was evolved
there.

    neurosim sample S7 --light --cylinders 27.5,12.5 --grid 5 --baud 38400 --lab-seed 7
    python benchmarks/kinds.py S7                        two minutes a robot, without the sampling
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import neurosim as ns
from neurosim.base.place import Place
from neurosim.base.trajectory import Trajectory
from neurosim.controllers import SavedController
from neurosim.lab import VirtualKheperaRig
from neurosim.loop.evaluate import Evaluator
from neurosim.recording.record import Rig, record
from neurosim.recording.settings import Guard, RecordSettings
from neurosim.sampling import build_tables
from neurosim.tasks.base import Judgement
from neurosim.tasks.stay_near import StayNear
from neurosim.trials.driver import Driver

TASKS = ("phototaxis", "discrimination")
#: Number of drives in the tables for each drive in the lab.
EACH = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("samples", nargs="+", type=Path, help="folders of neurosim sample")
    parser.add_argument("--generations", type=int, default=100)
    parser.add_argument("--drives", type=int, default=20, help="in the lab, of each row")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = []
    for folder in options.samples:
        for name in TASKS:
            for row in one(folder, name, options):
                rows.append(row)
                print(row, file=sys.stderr, flush=True)
    if options.json:
        predicted = [row["tables_success"] for row in rows]
        summary = {
            "succeeded": sum(row["lab_success"] for row in rows),
            "drives": sum(row["drives"] for row in rows),
            "predicted": [min(predicted), max(predicted)],
        }
        print(json.dumps({"rows": rows, **summary}))
        return
    print("task             place       success: tables     lab      fitness: tables    lab")
    for row in rows:
        print(
            f"{row['task']:16} {row['place']:10} {100 * row['tables_success']:14.1f} %"
            f" {row['lab_success']:4} of {row['drives']} {row['tables_fitness']:15.3f}"
            f" {row['lab_fitness']:8.3f}"
        )


def one(folder: Path, name: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the results of a robot in a task."""
    sampling = json.loads((folder / "sampling.json").read_text())
    robot = int(sampling["virtual_lab"]["robot_seed"])
    began = time.perf_counter()
    simulator = build_tables(sorted(folder.glob("*.sample")), folder / "motors.csv")
    task = ns.make_task(name)
    network = ns.make_controller("network", simulator, task)
    how: dict[str, Any] = {"generations": options.generations, "seed": robot}
    best = ns.evolve(simulator, task, network, **how)[0]
    evolved = time.perf_counter() - began
    rng, rows = np.random.default_rng([robot, 0x4B]), []
    for place in ("evolved in", "elsewhere") if name == "discrimination" else ("evolved in",):
        drives: list[tuple[Judgement, Judgement]] = []
        for number in range(options.drives):
            here = task if place == "evolved in" else task.in_place(_elsewhere(rng))
            evaluator = Evaluator(simulator, here, best.controller)
            start = here.draw_starts(evaluator.simulator, 1, rng)
            draws = evaluator.rollouts.draw(np.tile(start, (EACH, 1)), number)
            expected, _ = evaluator.judge(best.genes[None], draws)
            drives.append((expected, drive(robot, number, best, start[0], here, sampling)))
        expected, driven = zip(*drives, strict=True)
        rows.append(
            {
                "robot": robot,
                "task": name,
                "place": place,
                "tables_success": float(np.mean([one.success for one in expected])),
                "tables_fitness": float(np.mean([one.fitness for one in expected])),
                "lab_success": int(sum(one.success for one in driven)),
                "lab_fitness": float(np.mean([one.fitness for one in driven])),
                "drives": options.drives,
                "evolved_in_s": round(evolved),
            }
        )
    return rows


def _elsewhere(rng: np.random.Generator) -> Place:
    """Return the room of ErDiscrim with its cylinder anywhere in one half, 10 cm from walls."""
    x, y = rng.uniform((-0.1, -0.1), (0.1, 0.0))
    return replace(Place.of("cylinder-arena"), obstacles=((x, y, 0.0125),))


def drive(
    robot: int,
    number: int,
    best: SavedController,
    start: np.ndarray,
    task: StayNear,
    sampling: dict[str, Any],
) -> Judgement:
    """Drive once, and return the judgement of the true path."""
    source, at = Driver(best, task.episode, {}), tuple(map(float, start))
    baud, path = sampling["robot"]["baud"], []
    with (
        tempfile.TemporaryDirectory() as folder,
        VirtualKheperaRig(
            robot, noise_seed=1000 + number, place=task.place, start=at, baud=baud
        ) as rig,
    ):
        own = rig.robot.drive

        def noted(command: Any) -> None:
            own(command)
            path.append((rig.lab.time, *rig.lab.pose))

        rig.robot.drive = noted  # type: ignore[method-assign]
        how = RecordSettings(source.steps, Guard("ignore"))
        record(Path(folder) / "drive", Rig(rig.robot), source, how)
    times, poses = np.array(path)[:, 0], np.array(path)[:, 1:]
    held = np.zeros(len(times), int)
    return task.judge(Trajectory.of_track(times, poses, held, np.zeros((1, 2))))


if __name__ == "__main__":
    main()
