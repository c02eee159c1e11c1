"""How well networks that follow a line by light sensors transfer from the learned simulator.

No setting was chosen on these robots of the lab. For each, random commands are recorded on a board
with a closed line while its light sensors are read, and a simulator with these sensors is learned.
In it, a network from the two sensors to the two motors is evolved for the task follow-line. The
network drives the lab's robot in closed loop, through the robot's own driver, from random places on
the line, in both directions in turn. The lab's truth judges the drives: laps until the line was
lost or the time was up, and whether 10 laps were made without losing it. They are compared with the
simulator's prediction from the same starts.

    python benchmarks/line_following.py                    five to ten minutes a robot
    python benchmarks/line_following.py --robots 21 --drives 2
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import neurosim as ns
from neurosim.base.errors import UserError
from neurosim.base.trajectory import Trajectory
from neurosim.controllers import SavedController
from neurosim.lab import VirtualRig
from neurosim.loop.evaluate import Evaluator
from neurosim.recording.commands import RandomCommands
from neurosim.recording.record import Rig, record
from neurosim.recording.settings import Guard, RecordSettings
from neurosim.simulators import MotionNetwork
from neurosim.tasks.follow_line import FollowLine
from neurosim.trials.driver import Driver
from tracking.datasets.dataset import build

SIZE = (320, 240)
#: Samples in the simulator from each start.
SAMPLES = 50


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[21, 22, 23])
    parser.add_argument("--commands", type=int, default=1000)
    parser.add_argument("--generations", type=int, default=15)
    parser.add_argument("--drives", type=int, default=6, help="of each robot")
    parser.add_argument("--place", default="rectangle", choices=["rectangle", "ellipse"])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    task = ns.make_task("follow-line", place=options.place)
    rows = []
    for seed in options.robots:
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as name:
            row = one(seed, Path(name), task, options)
        for laps in ("laps", "expected_laps"):
            row[laps] = sorted(row[laps])
        rows.append({"robot": seed, **row, "seconds": round(time.perf_counter() - began)})
        print(f"robot {seed}: {rows[-1]}", file=sys.stderr, flush=True)
    if options.json:
        print(json.dumps({"task": task.describe(), "rows": rows}))
        return
    print("robot   sensors' error   10 laps   laps driven       laps expected   expected 10 laps")
    for row in rows:
        driven, expected = row["laps"], row["expected_laps"]
        print(
            f"{row['robot']:5}   {row['sensor_error']:14.3f}   {row['done']:3} of {len(driven):2}"
            f"   {min(driven):4.1f} to {max(driven):4.1f}   "
            f"{min(expected):4.1f} to {max(expected):4.1f}    {100 * row['probability']:14.1f} %"
        )
    drives = sum(len(row["laps"]) for row in rows)
    print(f"10 laps without losing the line: {sum(row['done'] for row in rows)} of {drives} drives")
    driven, expected = (np.concatenate([r[k] for r in rows]) for k in ("laps", "expected_laps"))
    off = np.abs(driven - expected) / np.maximum(np.abs(driven), 0.1)
    print(f"laps expected differ from those driven by {100 * np.median(off):.1f} % (median)")


def one(seed: int, folder: Path, task: FollowLine, options: argparse.Namespace) -> dict[str, Any]:
    """Return the results of a robot."""
    with VirtualRig(seed, noise_seed=seed, camera_size=SIZE, around=task.place) as rig:
        optics = rig.camera.optics
        model = optics.calibration
        model.write(folder / "calibration.json")
        how = RecordSettings(options.commands, Guard(by="position"), readings=True)
        source = RandomCommands(seed=seed)
        known = folder / "calibration.json"
        record(folder / "recording", Rig.of_lab(rig), source, how, calibration=known)
    build([folder / "recording"], folder / "dataset")
    simulator = ns.train(folder / "dataset", folder / "simulator", seed=seed)
    assert isinstance(simulator, MotionNetwork)
    network = ns.make_controller("network", simulator, task, scale=40.0)
    best = ns.evolve(simulator, task, network, generations=options.generations, seed=seed)[0]
    rng = np.random.default_rng(seed)
    along = rng.uniform(0, task.line.length, options.drives)
    starts = task.line.poses(along, np.arange(options.drives) % 2 == 1)
    judge = Evaluator(simulator, task, best.controller)
    expected = []
    for start in starts:
        draws = judge.rollouts.draw(np.tile(start, (SAMPLES, 1)), seed, (0.003, 0.009))
        judged = task.judge(judge.rollouts.run(best.genes[None], draws))
        expected.append((judged.fitness[0].mean(), judged.success[0].mean()))
    judged = [drive(seed, n, best, start, folder, task) for n, start in enumerate(starts)]
    sensors = simulator.meta["readings"]["sensors"]
    return {
        "sensor_error": float(np.mean([each["rms_error"] for each in sensors])),
        "sensors": sensors,
        "laps": [round(float(each.fitness), 3) for each in judged],
        "done": int(sum(each.success for each in judged)),
        "away": [round(float(each.detail["distance"]), 4) for each in judged],
        "expected_laps": [round(float(laps), 3) for laps, _ in expected],
        "probability": float(np.mean([chance for _, chance in expected])),
    }


def drive(
    seed: int, number: int, best: SavedController, start: Any, folder: Path, task: FollowLine
) -> Any:
    """Drive once, and return the judgement of the true path."""
    source = Driver(best, task.episode, {})
    how = RecordSettings(source.steps, Guard("ignore"))
    at = tuple(map(float, start))
    with VirtualRig(
        seed, noise_seed=1000 + number, start=at, camera=False, around=task.place
    ) as rig:
        try:
            record(folder / f"drive-{number}", Rig(rig.robot), source, how)
        except UserError as error:
            print(f"robot {seed}, drive {number}: {error}", file=sys.stderr)
        truth = rig.lab.truth
    poses, times = truth.poses[::10], truth.times[::10]
    held = np.zeros(len(times), int)
    return task.judge(Trajectory.of_track(times, poses, held, np.zeros((1, 2))))


if __name__ == "__main__":
    main()
