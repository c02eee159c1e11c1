"""How far each method gets with the same number of trials in reality, on walking robots of the lab.

Every method starts from the same gait that was tuned by hand and has the same number of
evaluations in reality, of three trials each. It is read after 60, 90 and 120 of them: the gait
that it believes in then is measured in ten trials that it never saw, and the mean of these counts.

    python benchmarks/back_to_reality.py -o table.jsonl                   # one seed, three places
    python benchmarks/back_to_reality.py -o table.jsonl --seeds 10        # the whole table
    python benchmarks/back_to_reality.py -o table.jsonl --show            # what there is so far
    python benchmarks/back_to_reality.py --speed                          # what a trial costs

Each run (a method, a seed, a place) is a line of the file, on the disk as soon as it is over; what
stands there is not run again. No parameter is tuned on carpet and parquet. ``--paper`` takes the
paper's 600 generations, 45 for L3 and trials of 20 s; without it there are 120, 20 and 5 s.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neurosim.back_to_reality import Alternation, Simulated, Trials, settings_named
from neurosim.back_to_reality.climb import BoundedCMA
from neurosim.back_to_reality.evaluations import Evaluations
from neurosim.back_to_reality.policy_gradient import PolicyGradient, PolicySettings
from neurosim.base.files import JsonLines
from neurosim.controllers.gait import HAND_TUNED, Gait, genes_of
from neurosim.lab.walker import PLACES, VirtualWalker
from neurosim.simulators.legged.simulator import LeggedSimulator
from neurosim.tasks.walking import Walking

READ_AT = (60, 90, 120)
AGAIN = 10
HAND = genes_of(HAND_TUNED)


class Job:
    """A run of a method: where it walks, its seed, its budget."""

    def __init__(self, place: str, seed: int, size: dict[str, Any], folder: Path):
        self.seed, self.size, self.budget = seed, size, size["budget"]
        self.simulated = Simulated(LeggedSimulator(), Walking(size["seconds"]), Gait())
        self.trials = Trials(VirtualWalker(Gait(), place, seed), folder / "trials.jsonl")

    def alternate(self, settings: str, **changes: Any) -> tuple[Evaluations, dict[str, Any]]:
        """Run the alternation."""
        how = settings_named(settings, **{"budget": self.budget, **changes})
        run = Alternation(
            self.simulated, self.trials, HAND, how, seed=self.seed, progress=False
        ).run()
        kept = ("compared", "held_out", "left_out", "neighbours")
        about = [
            {
                "transfer": cycle["transfer"]["works"] if "transfer" in cycle else None,
                **{name: cycle["L3"][name] for name in kept if name in cycle.get("L3", {})},
            }
            for cycle in run.cycles
        ]
        return run.record, {"cycles": about, "confirm": how.confirm}

    def learn(self, learner: Any, order: Evaluations, count: int) -> Evaluations:
        """Let an optimiser learn in reality, until the budget is used."""
        while len(order) < self.budget:
            asked = learner.ask()[: self.budget - len(order)]
            fitness = self.trials.evaluate(asked, "learn")
            order.add(asked, fitness)
            if len(asked) == count:
                learner.tell(fitness)
        return order

    def hand(self) -> Evaluations:
        """Try the gait that was tuned by hand."""
        tried = Evaluations()
        tried.add(HAND[None], self.trials.evaluate(HAND[None], "start"))
        return tried


def paper(job: Job, **changes: Any) -> tuple[Evaluations, dict[str, Any]]:
    size = job.size
    settings = {
        "cycles": 9,
        "generations": size["generations"],
        "later_generations": size["generations"] // 2,
        "adapt_generations": size["adapt_generations"],
    }
    return job.alternate("paper", **{**settings, **changes})


def policy_gradient(job: Job) -> tuple[Evaluations, dict[str, Any]]:
    learner = PolicyGradient(HAND, PolicySettings(), [job.seed, 7])
    return job.learn(learner, job.hand(), 13), {}


def cma(job: Job) -> tuple[Evaluations, dict[str, Any]]:
    return job.learn(BoundedCMA(HAND, 0.1, 12, [job.seed, 8]), job.hand(), 12), {}


def once(job: Job, **changes: Any) -> tuple[Evaluations, dict[str, Any]]:
    """Evolve in the simulator, and try what came of it for the whole budget."""
    settings = {"adapt": "none", "policy_steps": 0, "candidates": job.budget}
    return paper(job, **{**settings, **changes})


#: Of domain randomisation: controllers are evolved over so many simulators, drawn at random.
RANDOM = {"search": "cma", "generations": 40, "sets": 6, "caution": 1.0}


def randomised_then_cma(job: Job) -> tuple[Evaluations, dict[str, Any]]:
    order, about = once(job, **RANDOM, budget=20)
    best = order.believed().genes
    return job.learn(BoundedCMA(best, 0.05, 12, [job.seed, 9]), order, 12), about


METHODS: dict[str, Callable[[Job], tuple[Evaluations, dict[str, Any]]]] = {
    "back to reality, better choices": lambda job: job.alternate("better"),
    "the same without L3": lambda job: job.alternate("better", adapt="none"),
    "CMA-ES from the hand-tuned gait": cma,
    "domain randomisation, then CMA-ES": randomised_then_cma,
    "domain randomisation once": lambda job: once(job, **RANDOM),
    "back to reality, as in the paper": paper,
    "policy gradient from the hand-tuned gait": policy_gradient,
    "simulation once": once,
}


def run(method: str, place: str, seed: int, size: dict[str, Any]) -> dict[str, Any]:
    """Run a method, and measure what it believed in."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        job = Job(place, seed, size, Path(folder))
        order, about = METHODS[method](job)
        again = VirtualWalker(Gait(), place, 10_000 + seed)
        numbers = np.arange(AGAIN) * 13
        read, known = {}, {}
        for count in [at for at in READ_AT if at <= job.budget] or [job.budget]:
            genes = order.believed(about.get("confirm", 1), count).genes
            if genes.tobytes() not in known:
                found = again.trials(np.tile(genes, (AGAIN, 1)), numbers)
                known[genes.tobytes()] = [float(found.mean()), float(found.std(ddof=1))]
            read[str(count)] = known[genes.tobytes()]
        hand = float(again.trials(np.tile(HAND, (AGAIN, 1)), numbers).mean())
    return {
        "method": method,
        "place": place,
        "seed": seed,
        "size": size,
        "read": read,
        "hand": hand,
        "trials": job.trials.used,
        "simulated": job.simulated.tried,
        "seconds": time.monotonic() - began,
        **about,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table, cm/s."""
    text = ""
    for place in PLACES:
        there = [row for row in rows if row["place"] == place]
        if not there:
            continue
        hand = 100 * np.mean([row["hand"] for row in there])
        text += f"\n{place}: hand-tuned {hand:.1f} cm/s\n"
        text += f"| {'method':40} | seeds | at 60 | at 90 | at 120 | times hand | minutes |\n"
        text += "|---|---|---|---|---|---|---|\n"
        for method in METHODS:
            own = [row for row in there if row["method"] == method]
            if own:
                read = [
                    f"{100 * np.median([row['read'][str(at)][0] for row in own]):.1f}"
                    if all(str(at) in row["read"] for row in own)
                    else "-"
                    for at in READ_AT
                ]
                last = [list(row["read"].values())[-1][0] / row["hand"] for row in own]
                minutes = np.median([row["seconds"] for row in own]) / 60
                text += f"| {method:40} | {len(own)} | {' | '.join(read)} | "
                text += f"{np.median(last):.2f} | {minutes:.1f} |\n"
    return text


def speed() -> str:
    """Return what trials of the hand-tuned gait cost, and the paper's 27,000."""
    text, gaits = "", np.clip(HAND + np.linspace(-0.02, 0.02, 24)[:, None], 0.0, 1.0)
    simulated = Simulated(LeggedSimulator(), Walking(20.0), Gait())
    walker = VirtualWalker(Gait())
    tries = {
        "simulated trial of 20 s": lambda: simulated.fitness(gaits, simulated.as_is),
        "trial in reality": lambda: walker.trials(gaits, np.arange(len(gaits))),
    }
    for name, work in tries.items():
        work()
        wall, cpu = time.monotonic(), time.process_time()
        work()
        wall, cpu = time.monotonic() - wall, time.process_time() - cpu
        text += f"{name}: {wall / len(gaits):.3f} s, {cpu / len(gaits):.3f} s of a core\n"
        if "simulated" in name:
            hours = 27_000 * cpu / len(gaits) / 3600
            text += f"27,000 of them: {60 * hours:.0f} minutes of a core\n"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--out", type=Path, help="file of the runs")
    parser.add_argument("--speed", action="store_true", help="measure what a trial costs")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--places", nargs="+", choices=list(PLACES), default=list(PLACES))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--paper", action="store_true", help="at the paper's size")
    parser.add_argument("--quick", action="store_true", help="a small size, to try the benchmark")
    parser.add_argument("--show", action="store_true", help="run nothing")
    parser.add_argument("--json", action="store_true", help="print the runs as JSON")
    options = parser.parse_args()
    if options.speed:
        print(speed())
        return
    if options.out is None:
        parser.error("name a file of the runs: -o")
    size = {"seconds": 5.0, "generations": 120, "adapt_generations": 20, "budget": READ_AT[-1]}
    if options.paper:
        size |= {"seconds": 20.0, "generations": 600, "adapt_generations": 45}
    if options.quick:
        size |= {"seconds": 1.0, "generations": 3, "adapt_generations": 2, "budget": 4}
    file = JsonLines(options.out, "neurosim-table", 1, {"size": size})
    rows = list(file.rows)
    known = {(row["method"], row["place"], row["seed"]) for row in rows}
    for seed in range(0 if options.show else options.seeds):
        for place in options.places:
            for method in options.methods:
                if (method, place, seed) not in known:
                    rows.append(run(method, place, seed, size))
                    file.append(rows[-1])
                    print(f"{place}, seed {seed}: {method}", flush=True)
    print(json.dumps(rows, indent=2) if options.json else table(rows))


if __name__ == "__main__":
    main()
