"""Whether intervals hold what they say they hold, on robots of different make.

    python benchmarks/zoo_intervals.py [--robots "lab 101,car"] [--rows 1000] [--seeds 1] [--json]

A simulator with members and noise model is learned of each robot of the zoo. Then the robot is
driven by fresh commands, with noise: random ones, as it was for learning, and ones that plans are
made of (forward, fast, long). Shares of what happened that lay within the central intervals of
50, 80 and 95 %: of dx, dy and dtheta of single commands; of parts of commands, until an instant
within each; and, after ten commands in a row, of the position (regions of that probability) and
the heading. On one idle core about a minute for a robot and 1,000 rows.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from zoo import poses_within
from zoo_robots import FRESH, ZOO, Drives, Robot, plan_commands, random_commands, rows

from neurosim.base.se2 import tensors as se2
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData
from neurosim.training.coverage import LEVELS, central, draw_displacements, region
from neurosim.training.train import learn

#: Fresh commands of each kind, how many are driven in a row, and samples drawn.
COMMANDS, ROW, DRAWS = 2000, 10, 300
KINDS: dict[str, Callable] = {"random": random_commands, "plan": plan_commands}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", default=",".join(ZOO), help="a,b,...; or fresh")
    parser.add_argument("--rows", type=int, default=1000, help="to learn from")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    names = FRESH if options.robots == "fresh" else options.robots.split(",")
    unknown = set(names) - set(ZOO)
    if unknown:
        parser.error(f"no robots {', '.join(unknown)}; there are {', '.join(ZOO)}")
    torch.set_num_threads(1)
    if not options.json:
        print("percent within the intervals of 50/80/95 percent")
        heads = ("dx", "dy", "dtheta", "x, y after ten", "heading")
        print(f"{'':22s}" + "".join(f"{head:>16s}" for head in heads))
    found = {}
    for name in names:
        runs = [measured(ZOO[name], options.rows, seed) for seed in range(options.seeds)]
        found[name] = {kind: np.mean([run[kind] for run in runs], axis=0) for kind in runs[0]}
        for kind, shares in [] if options.json else found[name].items():
            cells = ("/".join(f"{100 * share:.0f}" for share in row) for row in shares)
            print(f"{name + ', ' + kind:22s}" + "".join(f"{c:>16s}" for c in cells), flush=True)
    if options.json:
        print(json.dumps(found, default=np.ndarray.tolist))


def measured(robot: Robot, count: int, seed: int) -> dict[str, NDArray[np.float64]]:
    """Return of each kind of commands the shares [3 or 5, L] within the intervals of LEVELS."""
    drives = rows(robot, count, seed)
    x, y = torch.tensor(drives.x), torch.tensor(drives.y)
    simulator = learn(TrainingData(robot.inputs, x, y, poses_within(drives)), seed)
    found = {}
    for number, (kind, commands) in enumerate(KINDS.items()):
        rng = np.random.default_rng([seed, number, 5])
        fresh = robot.drive(commands(robot, COMMANDS, rng), 1000 + seed)
        generator = torch.Generator().manual_seed(seed)
        given = simulator.chained(torch.tensor(fresh.x))
        drawn = draw_displacements(simulator, given, DRAWS, generator).numpy()
        single = _shares(central(drawn, fresh.y).T)
        found[kind] = np.concatenate([single, _after_ten(simulator, given, fresh, generator)])
        found[f"{kind}, parts"] = _of_parts(simulator, given, fresh, rng, generator)
    return found


def _shares(ranks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return shares [K, L] of ranks [K, N] that are at most LEVELS."""
    return np.array([[(row <= level).mean() for level in LEVELS] for row in ranks])


def _of_parts(
    simulator: MotionNetwork,
    given: Tensor,
    fresh: Drives,
    rng: np.random.Generator,
    generator: torch.Generator,
) -> NDArray[np.float64]:
    """Return shares [3, L] of displacements until an instant within each command."""
    which = rng.integers(fresh.times.shape[1] - 1, size=len(fresh.x))
    every = np.arange(len(fresh.x))
    time, moved = fresh.times[every, which], fresh.poses[every, which]
    cut = given.clone()
    cut[:, simulator.columns.duration] *= torch.tensor(time / fresh.x[:, -1])
    drawn = draw_displacements(simulator, cut, DRAWS, generator).numpy()
    return _shares(central(drawn, moved).T)


def _after_ten(
    simulator: MotionNetwork, given: Tensor, fresh: Drives, generator: torch.Generator
) -> NDArray[np.float64]:
    """Return shares [2, L] of positions and headings after ten commands in a row."""
    count = len(given) // ROW
    drawn = torch.zeros(DRAWS * count, 3, dtype=torch.float64)
    actual = torch.zeros(count, 3, dtype=torch.float64)
    member = torch.arange(DRAWS) % simulator.members
    assert simulator.noise is not None
    z = simulator.noise.draw(len(drawn), ROW, generator)
    for step in range(ROW):
        x = given[step::ROW][:count]
        mean = torch.stack([simulator.displacement_of(x, m) for m in range(simulator.members)])
        means = mean[member].flatten(0, 1)
        moved = simulator.disturbed(x.repeat(DRAWS, 1), means, z[:, step])
        drawn = se2.compose(drawn, moved)
        actual = se2.compose(actual, torch.tensor(fresh.y[step::ROW][:count]))
    poses, ends = drawn.unflatten(0, (DRAWS, count)).numpy(), actual.numpy()
    heading = central(poses[..., 2:], ends[:, 2:])[:, 0]
    return _shares(np.stack([region(poses[..., :2], ends[:, :2]), heading]))


if __name__ == "__main__":
    main()
