"""How many plans of a population of a million are judged per second, and their memory.

The plans come in chunks, as from an optimiser that does not hold them all, and only their fitness
is kept; with --evolve, the genetic algorithm makes a whole generation instead, which holds the
genes of the population and of the next. Peak memory is that of this process, libraries included.

    python benchmarks/large_population.py                       a million plans
    python benchmarks/large_population.py --evolve              two generations of a million
    python benchmarks/large_population.py --workers ray         judged by a Ray cluster
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from pathlib import Path

import numpy as np
from planner_speed import papers_size

from neurosim.controllers import Plan
from neurosim.evolution.genetic import GeneticSettings
from neurosim.loop.evaluate import Evaluator, evaluate
from neurosim.loop.evolve import Evolution
from neurosim.loop.settings import default_settings
from neurosim.simulators import read_simulator
from neurosim.tasks.nine_rectangles import NineRectangles


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--simulator", type=Path, help="a folder; one of the paper's size if not")
    parser.add_argument("--plans", type=int, default=1_000_000)
    parser.add_argument("--chunk", type=int, default=100_000)
    parser.add_argument("--samples", type=int, default=0, help="drawn ones, needs --simulator")
    parser.add_argument("--workers", choices=["local", "ray"], default="local")
    parser.add_argument("--evolve", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    simulator = papers_size() if options.simulator is None else read_simulator(options.simulator)
    before = peak()
    evolved = (generations if options.evolve else streamed)(simulator, options)
    evolved |= {"plans": options.plans, "gigabytes_before": before, "gigabytes_peak": peak()}
    if options.json:
        print(json.dumps(evolved))
        return
    print(
        f"{evolved['plans_per_second']:,.0f} plans a second; best fitness {evolved['best']:.1f}; "
        f"peak memory {evolved['gigabytes_peak']:.2f} GB, {before:.2f} GB before the first plan"
    )


def streamed(simulator, options) -> dict:
    """Judge chunks of random plans."""
    task, plan = NineRectangles(), Plan()
    how = {"samples": options.samples, "workers": options.workers}
    fitness = evaluate(simulator, task, plan, **how)
    fitness(np.zeros((2, plan.genes)))  # compiled
    rng = np.random.default_rng(0)
    kept = np.empty(options.plans)
    began = time.perf_counter()
    for first in range(0, options.plans, options.chunk):
        count = min(options.chunk, options.plans - first)
        kept[first : first + count] = fitness(rng.random((count, plan.genes)))
    seconds = time.perf_counter() - began
    return {"plans_per_second": options.plans / seconds, "best": float(kept.max())}


def generations(simulator, options) -> dict:
    """Evolve two generations."""
    task, plan = NineRectangles(), Plan()
    genetic = GeneticSettings(population=options.plans, tournament=5)
    settings = default_settings(plan, task, runs=1, genetic=genetic, samples=options.samples)
    evaluator = Evaluator(simulator, task, plan, workers=options.workers)
    stage = Evolution(evaluator, settings, 0).stages[0]
    began = time.perf_counter()
    for _ in range(2):
        stage.generation()
    seconds = time.perf_counter() - began
    return {"plans_per_second": 2 * options.plans / seconds, "best": float(stage.best[-1].max())}


def peak() -> float:
    """Return the largest memory that this process has had so far, GB."""
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return (
        size
        / (1e9 if sys.platform == "darwin" else 1e6)
        * (1 if sys.platform == "darwin" else 1.024)
    )


if __name__ == "__main__":
    main()
