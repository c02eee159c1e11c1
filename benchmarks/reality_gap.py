"""How far drives of evolved plans end from their prediction, in (virtual) reality.

For each seed a simulator is learned from the reference dataset and plans are evolved in it; every
plan is driven in the virtual lab, through brick, camera and tracker, and compared with the
prediction. Prints how often plans complete the course, and the distance between predicted and
actual position after each command.

    python benchmarks/reality_gap.py            the default trainer; plans evolved in the mean
                                                prediction (plain), and over random samples (robust)
    python benchmarks/reality_gap.py --paper    the paper's, Table 1 (some minutes a seed)

One robot, one reference recording: seeds vary training, evolution and what happens in the lab.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from neurosim.controllers import Plan
from neurosim.evolution import GeneticSettings
from neurosim.lab import VirtualRig
from neurosim.lab.camera.photographs import SQUARE, render_photographs
from neurosim.lab.nxt.params import CameraParams
from neurosim.loop.evolve import evolve
from neurosim.loop.settings import EvolveSettings, RobustSettings
from neurosim.recording.settings import Rig
from neurosim.training.train import train
from neurosim.trials.trial import run_trial
from tracking.camera.calibrate import calibrate
from tracking.track import track

REFERENCE = Path(__file__).resolve().parents[1] / "data" / "reference"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--dataset", type=Path, default=REFERENCE)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0, help="to share seeds out")
    parser.add_argument("--lengths", default="10,13", help="commands in a plan")
    parser.add_argument("--runs", type=int, default=1, help="plans of each kind a seed")
    parser.add_argument("--paper", action="store_true", help="train and evolve as the paper did")
    parser.add_argument("--lab-seed", type=int, default=0, help="the robot that was recorded")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    drives = []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        calibration = make_calibration(folder)
        try:
            for seed in range(options.seeds):
                drives += one_seed(folder, calibration, options.first_seed + seed, options)
        except KeyboardInterrupt:
            print(f"interrupted: {seed} of {options.seeds} seeds are whole", file=sys.stderr)
            options.seeds = seed
    table = [
        summary(drives, int(length), kind)
        for length in options.lengths.split(",")
        for kind in kinds(options)
    ]
    if options.json:
        print(
            json.dumps({"settings": vars(options), "table": table, "drives": drives}, default=str)
        )
    else:
        print_table(table, options)


def make_calibration(folder: Path) -> Path:
    photographs = render_photographs(folder / "photographs", CameraParams(), seed=0)
    path = folder / "calibration.json"
    calibrate(list(photographs.chessboards), square=SQUARE, points=photographs.points).write(path)
    return path


def one_seed(folder: Path, calibration: Path, seed: int, options: argparse.Namespace) -> list[dict]:
    simulator = folder / f"simulator-{seed}"
    trainer = {"trainer": "ga"} if options.paper else {}
    train(options.dataset, simulator, seed=seed, **trainer)
    drives = []
    for length, kind in product(map(int, options.lengths.split(",")), kinds(options)):
        settings = EvolveSettings(runs=options.runs)
        if options.paper:
            settings = replace(settings, genetic=GeneticSettings(), insertion=False)
        if kind == "robust":
            settings = replace(settings, robust=RobustSettings())
        out = folder / f"plan-{seed}-{length}-{kind}"
        how = {"settings": settings, "seed": seed, "keep_all": True}
        evolved = evolve(simulator, "nine-rectangles", Plan(slots=length), out=out, **how)
        for number, plan in enumerate(evolved):
            many = f"{out.name}-{number + 1:02d}" if len(evolved) > 1 else out.name
            controller = out.with_name(many)
            trial = folder / f"trial-{seed}-{length}-{kind}-{number}"
            noise = 1000 * seed + 20 * length + 2 * number + (kind == "robust")
            with VirtualRig(options.lab_seed, noise_seed=noise, start=plan.start) as rig:
                report = run_trial(
                    controller,
                    trial,
                    Rig.of_lab(rig),
                    track=track,
                    calibration=calibration,
                )
            (trial / "video-001.avi").unlink()
            drives.append(
                {
                    "seed": seed,
                    "length": length,
                    "kind": kind,
                    "probability": plan.predicted.get("probability"),
                    "predicted": report["predicted"]["completes"],
                    "completed": report["actual"]["completes"],
                    "fitness": report["actual"]["fitness"],
                    "errors_m": [e["position"] if e else None for e in report["errors"]],
                    "heading_rad": [abs(e["heading"]) if e else None for e in report["errors"]],
                }
            )
    return drives


def kinds(options: argparse.Namespace) -> tuple[str, ...]:
    return ("plain",) if options.paper else ("plain", "robust")


def summary(drives: list[dict], length: int, kind: str) -> dict:
    chosen = [drive for drive in drives if (drive["length"], drive["kind"]) == (length, kind)]
    complete = [drive for drive in chosen if drive["predicted"]]
    after = []
    for number in range(1, length + 1):
        seen = [
            drive["errors_m"][number]
            for drive in chosen
            if number < len(drive["errors_m"]) and drive["errors_m"][number] is not None
        ]
        after.append(float(np.median(seen)) if seen else None)
    return {
        "length": length,
        "kind": kind,
        "plans": len(chosen),
        "complete_in_simulator": len(complete),
        "complete_in_reality": sum(drive["completed"] for drive in chosen),
        "complete_in_both": sum(drive["completed"] for drive in complete),
        "median_error_m_after_command": after,
    }


def print_table(table: list[dict], options: argparse.Namespace) -> None:
    print(f"{options.seeds} seeds; {'the paper' if options.paper else 'default'} settings\n")
    print("commands  kind    plans  complete in simulator  of these in reality")
    for row in table:
        print(
            f"{row['length']:8}  {row['kind']:6}  {row['plans']:5}"
            f"  {row['complete_in_simulator']:21}  {row['complete_in_both']:19}"
        )
    print("\nmedian distance between predicted and actual position after command, cm")
    longest = max(row["length"] for row in table)
    print("commands  kind  " + "".join(f"{number:7}" for number in range(1, longest + 1)))
    for row in table:
        cells = [
            f"{100 * error:7.1f}" if error is not None else "      -"
            for error in row["median_error_m_after_command"]
        ]
        print(f"{row['length']:8}  {row['kind']:6}" + "".join(cells))


if __name__ == "__main__":
    main()
