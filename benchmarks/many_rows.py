"""How long `neurosim train` takes on many rows, how much memory it needs, and its errors.

    python benchmarks/many_rows.py                              10,000 and 100,000 rows
    python benchmarks/many_rows.py --rows 1000,3000 --windows   rows that follow one another
    python benchmarks/many_rows.py --robots car,late,omni --cores 2 --json

Datasets are of robots of :mod:`zoo_robots`, made in pieces of 10,000 rows. Training is the command
with its defaults, ensemble and noise model included, in a process of its own on a given number of
cores. Seconds are of wall-clock time; memory is the largest of that process, libraries included.
Errors are mean absolute errors of single commands, from the motion without noise (cm, cm, deg).
``--windows``: commands last 0.1 to 0.3 s, and the dataset says that its rows follow one another.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from zoo import poses_within
from zoo_robots import ZOO, Drives, Robot, clean, random_commands

from neurosim.simulators import read_simulator
from tracking.datasets.dataset import make

#: Rows of a piece: a recording of its own; rows that a simulator is judged by.
PIECE, JUDGED = 10_000, 2000
#: Limits for the learner: seconds on two cores by rows, and GB.
WANTED, MEMORY = {10_000: 60.0, 100_000: 600.0}, 4.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", default="10000,100000", help="a,b,...")
    parser.add_argument("--robots", default="small", help="a,b,... of the zoo, or all")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--windows", action="store_true", help="rows that follow one another")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    names = list(ZOO) if options.robots == "all" else options.robots.split(",")
    results = []
    for name in names:
        for count in map(int, options.rows.split(",")):
            entry = {"robot": name, "rows": count, **measured(ZOO[name], count, options)}
            results.append(entry)
            if not options.json:
                wanted = WANTED.get(count)
                limit = "" if wanted is None else f" (wanted: {wanted:.0f} s, {MEMORY:g} GB)"
                errors = ", ".join(f"{error:.2f}" for error in entry["errors"])
                print(
                    f"{name}, {count} rows: {entry['seconds']:.1f} s, {entry['memory_gb']:.2f} GB"
                    f"{limit}; errors {errors}",
                    flush=True,
                )
    if options.json:
        print(json.dumps(results, indent=2))


def measured(robot: Robot, count: int, options: argparse.Namespace) -> dict[str, object]:
    """Return seconds, memory and errors of a training on this many rows of a robot."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write(robot, count, options.seed, options.windows, folder / "dataset")
        began = time.perf_counter()
        child = subprocess.Popen(
            [sys.executable, "-m", "neurosim", "train", folder / "dataset", "-o", folder / "s",
             "--seed", str(options.seed), "--json"],
            stdout=subprocess.DEVNULL,
            preexec_fn=lambda: on_cores(options.cores),
        )  # fmt: skip
        _, status, used = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - began
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            sys.exit(f"training on {count} rows ended with {child.returncode}")
        unit = 1.0 if sys.platform == "darwin" else 1024.0
        judged = clean(robot, JUDGED)
        simulator = read_simulator(folder / "s")
        commanded = simulator.chained(torch.tensor(judged.x))
        errors = np.abs(simulator.displacement_of(commanded).numpy() - judged.y)
    return {
        "seconds": seconds,
        "memory_gb": used.ru_maxrss * unit / 1e9,
        "errors": (errors.mean(axis=0) * [100, 100, 180 / np.pi]).tolist(),
    }


def on_cores(count: int) -> None:
    """Limit this process to this many of its cores, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:count]))


def write(robot: Robot, count: int, seed: int, windows: bool, out: Path) -> None:
    """Write a dataset of this many rows; a piece is a recording of its own."""
    columns = [one["name"] for one in robot.inputs]
    rows = []
    for piece, first in enumerate(range(0, count, PIECE)):
        drives = driven(robot, min(PIECE, count - first), seed + 1000 * piece, windows)
        within = poses_within(drives)
        inside: dict[int, list[dict[str, float]]] = {}
        if within is not None and not windows:
            for row, moment, moved in zip(*(part.tolist() for part in within), strict=True):
                pose = dict(zip(("time", "dx", "dy", "dtheta"), (moment, *moved), strict=True))
                others = inside.setdefault(row, [])
                if moment > (others[-1]["time"] if others else 0.0) + 1e-6:
                    others.append(pose)
        for place, (x, y) in enumerate(zip(drives.x.tolist(), drives.y.tolist(), strict=True)):
            rows.append(
                {
                    "recording": f"piece-{piece}",
                    "command": place + 1,
                    **dict(zip(columns, x, strict=True)),
                    **dict(zip(("dx", "dy", "dtheta"), y, strict=True)),
                    "quality": 1.0,
                    "within": inside.get(place, ()),
                }
            )
    units = {one["name"]: one["unit"] for one in robot.inputs}
    make(rows, units, sources=[], left_out={}, settings={}, windows=windows).write(out)


def driven(robot: Robot, count: int, seed: int, windows: bool) -> Drives:
    """Return this many rows of random commands; for windows, of short ones."""
    rng = np.random.default_rng([seed, 1])
    commands = random_commands(robot, count, rng)
    if windows:
        commands = np.array(commands)
        commands[:, -1] = rng.uniform(0.1, 0.3, count)
    return robot.drive(commands, seed)


if __name__ == "__main__":
    main()
