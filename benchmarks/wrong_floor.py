"""A simulator of another floor: 20 trials of back to reality, or 500 fresh commands?

A robot of the lab is recorded and its simulator learned; then the floor changes, or a wheel is
worn, or the battery is weak. Plans that complete the course are evolved robustly, with the same
settings, in four simulators:

  - as it was: the simulator of the old floor;
  - back to reality: that one, its motion corrected by back to reality after 20 trials at most,
    each driven by brick and radio, filmed and tracked;
  - fresh commands: one that is learned from as many fresh commands on the new floor, without the
    old ones;
  - the right floor: one that is learned from as many commands on the new floor as the first had
    on the old one.

Each plan is driven 30 times on the new floor, in the lab's physics.

    python benchmarks/wrong_floor.py            five floors, half an hour
    python benchmarks/wrong_floor.py --quick    one floor, fewer commands and drives
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
import torch
from guided_recording import random_rows
from robust_plans import PERIMETER, TASK, drive

from neurosim.back_to_reality import settings_named
from neurosim.back_to_reality.run import back_to_reality
from neurosim.controllers import Plan, SavedController
from neurosim.evolution.bits import BitSettings
from neurosim.loop.evolve import evolve
from neurosim.loop.settings import EvolveSettings, RobustSettings
from neurosim.simulators import read_simulator
from neurosim.training.train import learn
from neurosim.trials.filmed import VirtualNxt

#: Changes since the robot was recorded, by name. Nothing was tuned on robots 30 and up.
FLOORS: dict[str, dict[str, float]] = {
    "slippery": {"slip": 0.10},
    "slippery, left wheel worn": {"slip": 0.10, "worn": 0.03},
    "left wheel worn": {"worn": 0.05},
    "more slippery": {"slip": 0.15},
    "weak battery, worn": {"battery": 7.3, "worn": 0.04},
}
FIRST_ROBOT = 30
SLOTS = 10
#: Of back to reality.
HOW: dict[str, Any] = {
    "search": "ga",
    "generations": 300,
    "later_generations": 300,
    "genetic": BitSettings(population=40),
    "sets": 3,
    "cycles": 2,
    "trials": 1,
    "candidates": 6,
    "confirm": 1,
    "budget": 20,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--floors", type=int, default=len(FLOORS), help="the first so many")
    parser.add_argument("--commands", type=int, default=1000, help="on the old floor")
    parser.add_argument("--fresh", type=int, default=500, help="commands on the new floor")
    parser.add_argument("--runs", type=int, default=8, help="of evolution, for each plan")
    parser.add_argument("--drives", type=int, default=30, help="of each plan")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.floors, options.commands, options.fresh = 1, 300, 150
        options.runs, options.drives = 2, 10
    torch.set_num_threads(1)
    results = []
    for number, name in enumerate(list(FLOORS)[: options.floors]):
        began = time.monotonic()
        results.append(one_floor(number, name, options))
        if not options.json:
            print(line(results[-1]), flush=True)
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    if options.json:
        print(json.dumps({"settings": vars(options), "floors": results}))
        return
    for kind in results[0]["plans"]:
        done = sum(one["plans"][kind]["completed"] for one in results)
        print(f"{kind:16} {done} of {options.drives * len(results)} drives completed")


def line(one: dict[str, Any]) -> str:
    plans = "; ".join(
        f"{kind} {plan['completed']} (predicted {100 * plan['predicted']:.0f} %)"
        for kind, plan in one["plans"].items()
    )
    return f"{one['floor']}, {one['trials']} trials: completed {plans}"


def one_floor(number: int, name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return the results of plans of the four simulators on a floor."""
    robot, family = FIRST_ROBOT + number, Plan(slots=SLOTS)
    reality = VirtualNxt(family, TASK, robot, seed=number, **FLOORS[name])
    old, _ = random_rows(robot, number, options.commands)
    fresh, _ = random_rows(robot, 500 + number, options.fresh, reality.changes)
    many, _ = random_rows(robot, 700 + number, options.commands, reality.changes)
    simulator = learn(old, number)
    plans = {"as it was": best_plan(simulator, number, options)}
    start = family.encode(list(plans["as it was"].commands))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found"
        settings = settings_named("better", **HOW)
        report = back_to_reality(
            simulator, TASK, family, reality,
            out=out, start=start, settings=settings, seed=number, progress=False,
        )  # fmt: skip
        adapted = read_simulator(out / "simulator")
    plans["back to reality"] = best_plan(adapted, number, options)
    plans["fresh commands"] = best_plan(learn(fresh, number), number, options)
    plans["the right floor"] = best_plan(learn(many, number), number, options)
    return {
        "floor": name,
        "robot": robot,
        "changes": reality.changes,
        "trials": report["trials"],
        "L3": [cycle["L3"] for cycle in report["cycles"] if "L3" in cycle],
        "plans": {
            kind: {
                "predicted": plan.predicted["probability"],
                "completed": completed(plan, robot, number, reality.changes, options.drives),
                "commands": plan.commands,
            }
            for kind, plan in plans.items()
        },
    }


def best_plan(simulator: Any, seed: int, options: argparse.Namespace) -> SavedController:
    """Return the plan that is evolved robustly in a simulator, where the guard ends drives."""
    simulator.perimeter = PERIMETER
    settings = EvolveSettings(runs=options.runs, robust=RobustSettings())
    family = Plan(slots=SLOTS)
    return evolve(simulator, TASK, family, settings=settings, seed=seed, progress=False)[0]


def completed(
    plan: SavedController, robot: int, number: int, changes: dict[str, float], drives: int
) -> int:
    """Return how many drives of a plan complete the course."""
    given = plan.given
    if not given:
        return 0
    seeds = 1000 * number + np.arange(drives)
    return sum(drive(given, robot, int(seed), changes) for seed in seeds)


if __name__ == "__main__":
    main()
