"""How well a learned simulator follows commands that change faster than the robot answers.

A simulator is learned from whole commands of 0.5 to 3 s, or with the poses within them. Then
robot and simulator are given the same commands, new ones every 0.05, 0.1 and 0.25 s: as a person
or a controller drives (each actuator drifts about, first-order), and constant except for one
percent that comes and goes. The error is their distance from each other at the end, over the
distance driven: the median of several drives.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent))

from zoo import poses_within
from zoo_robots import LOOKS, ZOO, Robot, rows

from neurosim.base import se2
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData
from neurosim.training.train import learn

#: Robots of the zoo, and robots of the lab that answer late.
ROBOTS: dict[str, Robot] = {
    **{name: ZOO[name] for name in ("late", "kart", "vacuum", "classroom", "lab 104")},
    "lab 104, late": replace(ZOO["lab 104"], delay=0.1),
    "lab 105, late": replace(ZOO["lab 105"], delay=0.2),
}
PERIODS = (0.05, 0.1, 0.25)
SECONDS, DRIVES = 5.0, 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--rows", type=int, default=150)
    parser.add_argument("--within", action="store_true", help="poses within commands as well")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if not options.json:
        print("robot, commands every ... s: error over distance, drifting and all but held")
    results = []
    for name in options.robots:
        robot = ROBOTS[name]
        simulator = learned(robot, options.rows, options.within)
        drive = simulator.drive
        assert drive is not None
        results.append({"robot": name, "delay": float(drive.delay), "true": robot.delay})
        for period in PERIODS:
            errors = [
                np.median([error(robot, simulator, period, kind, n) for n in range(DRIVES)])
                for kind in ("drifting", "held")
            ]
            results[-1][str(period)] = [float(one) for one in errors]
        if not options.json:
            columns = "  ".join(f"{p}: {100 * a:5.1f} {100 * b:5.1f} %" for p, (a, b) in
                             ((p, results[-1][str(p)]) for p in PERIODS))  # fmt: skip
            print(
                f"{name:14} delay {results[-1]['delay']:.3f} ({robot.delay:.3f})  {columns}",
                flush=True,
            )
    if options.json:
        print(json.dumps(results))


def learned(robot: Robot, count: int, within: bool) -> MotionNetwork:
    """Return a simulator of rows of a robot."""
    driven = rows(robot, count, 5)
    parts = poses_within(driven) if within else None
    data = TrainingData(robot.inputs, torch.tensor(driven.x), torch.tensor(driven.y), parts)
    return learn(data, 1, members=1, noise=False)


def error(robot: Robot, simulator: MotionNetwork, period: float, kind: str, seed: int) -> float:
    """Return the distance between robot and simulator at the end, over the distance driven."""
    commands = random_commands(robot, period, kind, np.random.default_rng([seed, 7]))
    times = commands[:, -1:] * np.linspace(1 / LOOKS, 1.0, LOOKS)
    moved = robot.drive(commands, seed, noisy=False, times=times).y
    pose, path = np.zeros(3), [np.zeros(3)]
    for one in moved:
        pose = se2.compose(pose, one)
        path.append(pose)
    state, stepper = simulator.standing(np.zeros((1, 3))), simulator.stepper()
    for command in commands:
        state = stepper.step(state, command[None], None)
    distance = np.linalg.norm(np.diff(np.array(path)[:, :2], axis=0), axis=1).sum()
    return float(np.linalg.norm(state[0, :2] - pose[:2]) / max(distance, 1e-3))


def random_commands(robot: Robot, period: float, kind: str, rng: np.random.Generator) -> NDArray:
    """Return commands [N, C + 1] of :data:`SECONDS`."""
    count, largest = round(SECONDS / period), np.array(robot.largest)
    if kind == "held":
        base = 0.6 * largest * np.sign(rng.uniform(-1.0, 1.0, len(largest)))
        base[1:] *= rng.uniform(0.3, 1.0, len(largest) - 1)
        fraction = 1.0 + 0.005 * (-1.0) ** np.arange(count)[:, None]
        return np.column_stack([base * fraction, np.full(count, period)])
    kept, value, result = np.exp(-period / 0.7), rng.uniform(-0.6, 0.6, len(largest)), []
    for _ in range(count):
        value = kept * value + np.sqrt(1 - kept**2) * 0.45 * rng.standard_normal(len(largest))
        result.append(np.clip(value, -1.0, 1.0) * largest)
    return np.column_stack([np.array(result), np.full(count, period)])


if __name__ == "__main__":
    main()
