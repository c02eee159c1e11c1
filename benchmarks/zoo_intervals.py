"""Whether intervals hold the stated fraction of results, on robots of different make.

    python benchmarks/zoo_intervals.py [--robots "lab 101,car"] [--rows 1000] [--seeds 1] [--json]
    python benchmarks/zoo_intervals.py --robots fresh --logs gravel,sand --rows 20,50,200 --seeds 6
    python benchmarks/zoo_intervals.py --kept FILE ...     in parts, or on where it was stopped

A simulator with members and noise model is learned of each robot of the zoo. Then the robot is
driven by fresh commands, with noise: random ones, as for learning, and typical commands of plans
(forward, fast, long). Printed are the fractions of results within the central intervals of 50, 80
and 95 %: of dx, dy and dtheta of single commands; of parts of commands, until an instant
within each; and, after ten commands in a row, of the position (regions of that probability) and
the heading.

``--logs``: robots of :mod:`real_robots`, each learned from successive rows, anywhere in its log.
Fractions are those of dx, dy and dtheta of held-out windows, their means over lengths.

The last table has the means over robots and seeds: with few rows one recording's intervals may be
too narrow and another's too wide. How noise is learned from few rows was chosen on ``classroom``,
``large``, ``tracked``, ``car``, ``omni``, ``lab 101`` and the log of ``asphalt``; by how much
members of a short log differ, on the logs of ``dart`` and ``boat``. The others are only reported.

On one idle core about a minute for a robot and 1,000 rows. ``--kept FILE`` keeps results; it knows
nothing of changes to robots or trainer: delete it then.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import real_robots as logs
import torch
from numpy.typing import NDArray
from torch import Tensor
from zoo import Known, poses_within
from zoo_robots import FRESH, ZOO, Drives, plan_commands, random_commands, rows

from neurosim.base.se2 import tensors as se2
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData
from neurosim.training.coverage import LEVELS, central, draw_displacements, region
from neurosim.training.train import learn

#: Fresh commands of each kind, how many are driven in a row, and number of samples.
COMMANDS, ROW, DRAWS = 2000, 10, 300
#: Largest number of held-out windows of each length of a log, and number of samples of each.
WINDOWS, OF_WINDOWS = 100, 100
KINDS: dict[str, Callable] = {"random": random_commands, "plan": plan_commands}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", help="a,b,... of the zoo; or fresh; all if no logs are named")
    parser.add_argument("--logs", default="", help="a,b,... of real_robots.py; or all")
    parser.add_argument("--rows", default="1000", help="to learn from, a,b,...")
    parser.add_argument("--seeds", type=int, default=1, help="recordings of each robot")
    parser.add_argument("--without", nargs="+", default=(), help="parts left out: spread")
    parser.add_argument("--kept", type=Path, metavar="FILE", help="keeps results")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.robots is None:
        options.robots = "" if options.logs else ",".join(ZOO)
    zoo = FRESH if options.robots == "fresh" else listed(options.robots)
    real = tuple(logs.ROBOTS) if options.logs == "all" else listed(options.logs)
    for names, there_are in ((zoo, ZOO), (real, logs.ROBOTS)):
        if unknown := set(names) - set(there_are):
            parser.error(f"no robots {', '.join(unknown)}; there are {', '.join(there_are)}")
    torch.set_num_threads(1)
    if not options.json:
        print("percent within the intervals of 50/80/95 percent")
        heads = ("dx", "dy", "dtheta", "x, y after ten", "heading")
        print(f"{'':32s}" + "".join(f"{head:>16s}" for head in heads))
    known, result = Known(options.kept), {}
    cases = [(name, name, of_zoo) for name in zoo]
    cases += [(f"log of {name}", name, of_log) for name in real]
    for count in map(int, listed(options.rows)):
        result[count] = {}
        for label, name, measured in cases:
            runs = []
            for seed in range(options.seeds):
                key = "|".join([f"{label}|{count}|{seed}", *options.without])
                run = known.get(key)
                if run is None:
                    known.put(key, run := measured(name, count, seed, tuple(options.without)))
                runs.append(run)
            result[count][label] = means(runs)
            if not options.json:
                show(f"{label}, {count}", result[count][label])
        result[count]["mean"] = means(list(result[count].values()))
    if options.json:
        print(json.dumps(result))
        return
    print("means over robots and seeds")
    for count, table in result.items():
        show(f"{count} rows", table["mean"])


def listed(names: str) -> tuple[str, ...]:
    """Return the names between commas."""
    return tuple(name.strip() for name in names.split(",") if name.strip())


def means(runs: list[dict[str, list]]) -> dict[str, list]:
    """Return of each kind of commands the mean fractions of the runs that have it."""
    kinds = dict.fromkeys(kind for run in runs for kind in run)
    return {
        kind: np.mean([run[kind] for run in runs if kind in run], axis=0).tolist() for kind in kinds
    }


def show(label: str, result: dict[str, list]) -> None:
    """Print the fractions of each kind of commands."""
    for kind, fractions in result.items():
        cells = ("/".join(f"{100 * fraction:.0f}" for fraction in row) for row in fractions)
        print(f"{label + ', ' + kind:32s}" + "".join(f"{c:>16s}" for c in cells), flush=True)


@cache
def _log(name: str) -> tuple[logs.Robot, TrainingData]:
    """Return a robot of the logs, and its rows."""
    robot = logs.ROBOTS[name]()
    return robot, logs.data_of(robot)


def of_log(name: str, count: int, seed: int, without: tuple[str, ...] = ()) -> dict[str, list]:
    """Return the fractions [3, L] of held-out windows that lie within the intervals of LEVELS.

    The result is empty if the log has fewer rows. ``without``: parts of the trainer, left out.
    """
    robot, data = _log(name)
    if len(data.x) < count:
        return {}
    start = int(np.random.default_rng([seed, 3]).integers(len(data.x) - count + 1))
    simulator = learn(data.part(slice(start, start + count)), seed, without=without)
    fractions = []
    for length in logs.lengths_of(robot):
        windows = logs.cut(robot.held_out, length, logs.APART, WINDOWS)
        sampled = logs.samples(simulator, robot.held_out, windows, OF_WINDOWS, seed)[1]
        fractions.append(_fractions(central(sampled, windows.moved).T))
    return {"windows": np.mean(fractions, axis=0).tolist()}


def of_zoo(name: str, count: int, seed: int, without: tuple[str, ...] = ()) -> dict[str, list]:
    """Return of each kind of commands the fractions [3 or 5, L] within the intervals of LEVELS."""
    robot = ZOO[name]
    drives = rows(robot, count, seed)
    x, y = torch.tensor(drives.x), torch.tensor(drives.y)
    data = TrainingData(robot.inputs, x, y, poses_within(drives))
    simulator = learn(data, seed, without=without)
    results = {}
    for number, (kind, commands) in enumerate(KINDS.items()):
        rng = np.random.default_rng([seed, number, 5])
        fresh = robot.drive(commands(robot, COMMANDS, rng), 1000 + seed)
        generator = torch.Generator().manual_seed(seed)
        given = simulator.chained(torch.tensor(fresh.x))
        sampled = draw_displacements(simulator, given, DRAWS, generator).numpy()
        single = _fractions(central(sampled, fresh.y).T)
        results[kind] = np.concatenate([single, _after_ten(simulator, given, fresh, generator)])
        results[f"{kind}, parts"] = _of_parts(simulator, given, fresh, rng, generator)
    return {kind: fractions.tolist() for kind, fractions in results.items()}


def _fractions(ranks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return fractions [K, L] of ranks [K, N] that are at most LEVELS."""
    return np.array([[(row <= level).mean() for level in LEVELS] for row in ranks])


def _of_parts(
    simulator: MotionNetwork,
    given: Tensor,
    fresh: Drives,
    rng: np.random.Generator,
    generator: torch.Generator,
) -> NDArray[np.float64]:
    """Return fractions [3, L] of displacements until an instant within each command."""
    which = rng.integers(fresh.times.shape[1] - 1, size=len(fresh.x))
    every = np.arange(len(fresh.x))
    time, moved = fresh.times[every, which], fresh.poses[every, which]
    cut = given.clone()
    cut[:, simulator.columns.duration] *= torch.tensor(time / fresh.x[:, -1])
    sampled = draw_displacements(simulator, cut, DRAWS, generator).numpy()
    return _fractions(central(sampled, moved).T)


def _after_ten(
    simulator: MotionNetwork, given: Tensor, fresh: Drives, generator: torch.Generator
) -> NDArray[np.float64]:
    """Return fractions [2, L] of positions and headings after ten commands in a row."""
    count = len(given) // ROW
    sampled = torch.zeros(DRAWS * count, 3, dtype=torch.float64)
    actual = torch.zeros(count, 3, dtype=torch.float64)
    member = torch.arange(DRAWS) % simulator.members
    assert simulator.noise is not None
    z = simulator.noise.draw(len(sampled), ROW, generator)
    for step in range(ROW):
        x = given[step::ROW][:count]
        mean = torch.stack([simulator.displacement_of(x, m) for m in range(simulator.members)])
        means = mean[member].flatten(0, 1)
        moved = simulator.disturbed(x.repeat(DRAWS, 1), means, z[:, step])
        sampled = se2.compose(sampled, moved)
        actual = se2.compose(actual, torch.tensor(fresh.y[step::ROW][:count]))
    poses, ends = sampled.unflatten(0, (DRAWS, count)).numpy(), actual.numpy()
    heading = central(poses[..., 2:], ends[:, 2:])[:, 0]
    return _fractions(np.stack([region(poses[..., :2], ends[:, :2]), heading]))


if __name__ == "__main__":
    main()
