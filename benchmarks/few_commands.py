"""Whether predictions of plans hold after few commands: random commands against chosen ones.

For each seed another robot of the virtual lab is driven by random commands, and by the same number
that ``neurosim record --guided`` would choose (both as benchmarks/guided_recording.py does it). A
simulator with its ensemble is learned from each, robust plans are evolved in it, and driven many
times in the lab's physics (as benchmarks/robust_plans.py does it).

    python benchmarks/few_commands.py            5 robots, 2 plans each, a quarter of an hour
    python benchmarks/few_commands.py --quick    one robot, one plan
"""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np
import torch
from guided_recording import guided_rows, random_rows
from robust_plans import PERIMETER, TASK, drive

from neurosim.controllers import Plan
from neurosim.loop.evolve import evolve
from neurosim.loop.settings import EvolveSettings, RobustSettings
from neurosim.recording.rounds import Rounds
from neurosim.simulators import MotionNetwork
from neurosim.training.train import learn

KINDS = ("random", "guided")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--commands", type=int, default=400)
    parser.add_argument("--round", type=int, default=50)
    parser.add_argument("--plans", type=int, default=2, help="of each simulator")
    parser.add_argument("--length", type=int, default=10, help="commands in a plan")
    parser.add_argument("--runs", type=int, default=4, help="of evolution, for each plan")
    parser.add_argument("--drives", type=int, default=100, help="of each plan")
    parser.add_argument("--quick", action="store_true", help="one robot, one plan")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.seeds, options.plans, options.runs = 1, 1, 2
    torch.set_num_threads(1)
    results = []
    for seed in range(options.seeds):
        for kind in options.kinds:
            if kind == "random":
                data, _ = random_rows(seed, seed, options.commands)
            else:
                data, _ = guided_rows(seed, seed, Rounds(options.commands, options.round))
            simulator = learn(data, seed)
            simulator.perimeter = PERIMETER
            for number in range(options.plans):
                results.append(
                    {"robot": seed, "kind": kind, **one_plan(simulator, seed, number, options)}
                )
                print(json.dumps(results[-1]), file=sys.stderr, flush=True)
    print(
        json.dumps({"settings": vars(options), "plans": results})
        if options.json
        else words(results)
    )


def one_plan(
    simulator: MotionNetwork, robot: int, number: int, options: argparse.Namespace
) -> dict:
    """Evolve a robust plan and drive it; return its predicted and its measured probability."""
    settings = EvolveSettings(runs=options.runs, robust=RobustSettings())
    family, seed = Plan(slots=options.length), 77 + number
    plan = evolve(simulator, TASK, family, settings=settings, seed=seed, progress=False)[0]
    given = plan.given
    done = [drive(given, robot, 1000 * number + n) for n in range(options.drives)]
    return {"predicted": plan.predicted["probability"], "completed": float(np.mean(done))}


def words(result: list[dict]) -> str:
    """Return the table for a person: means, errors in percentage points, and all plans."""
    lines = [
        "virtual lab          said   completed   off by   at most   said and completed, by robot"
    ]
    for kind in dict.fromkeys(plan["kind"] for plan in result):
        plans = [plan for plan in result if plan["kind"] == kind]
        predicted, done = (
            np.array([plan[k] for plan in plans]) for k in ("predicted", "completed")
        )
        off = np.abs(predicted - done)
        each = ", ".join(f"{s:.0%} {d:.0%}" for s, d in zip(predicted, done, strict=True))
        shown = f"{predicted.mean():12.0%}{done.mean():12.0%}{off.mean():9.0%}{off.max():10.0%}"
        lines.append(f"{kind:8s} mean {shown}   {each}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
