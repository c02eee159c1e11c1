"""How far each method gets with the same number of trials in reality, on walking robots of the lab.

Every method starts from the same gait that was tuned by hand and has the same number of
evaluations in reality, of three trials each. After 60, 90 and 120 evaluations, the gait that the
method holds to be best is measured in ten further trials, of which the mean counts.

    python benchmarks/back_to_reality.py --show                   # what there is so far
    python benchmarks/back_to_reality.py --seeds 10               # continue
    python benchmarks/back_to_reality.py -o table.jsonl           # a new table: one seed, three
    floors
    python benchmarks/back_to_reality.py --change sets=3 -o 3.jsonl   # other settings next to ours
    python benchmarks/back_to_reality.py --servos --show     # a filmed robot, a third of the trials
    python benchmarks/back_to_reality.py --servos --repeats --floors tiles lawn
    python benchmarks/back_to_reality.py --speed                  # what a trial costs

Each run (a method, a seed, a floor) is a line of the file, written as soon as the run ends; runs in
the file are not repeated. The runs so far are in benchmarks/back_to_reality.jsonl. Settings are
tuned on main; the spread of the random parameter sets on carpet, too.

With ``--servos`` the simulator has the properties of servos, its trials last up to 20 s and end at
the circle, too, and there are 40 evaluations: once the robot is filmed, and L3 compares paths, and
once there is no L3; the runs, with ``--floors tiles lawn``, are in benchmarks/filmed.jsonl.
``--repeats`` evaluates gaits of the filmed robot twice: no prediction can be better than that.
``--paper`` takes the paper's 600 generations, 45 for L3 and trials of 20 s; without it there are
120, 20 and 5 s.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from neurosim.back_to_reality import Alternation, Journal, Simulated, settings_named
from neurosim.back_to_reality.adapt import rank_correlation
from neurosim.back_to_reality.evaluations import Evaluations
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import JsonLines
from neurosim.controllers.gait import HAND_TUNED, Gait, genes_of
from neurosim.evolution.bits import BitSettings
from neurosim.evolution.cma import CMA
from neurosim.evolution.policy_gradient import PolicyGradient, PolicySettings
from neurosim.evolution.space import SearchSpace
from neurosim.lab.walker import FLOORS, VirtualWalker
from neurosim.lab.walker.robot import RADIUS
from neurosim.simulators.legged.build import Build, ServoBuild
from neurosim.simulators.legged.simulator import LeggedSimulator
from neurosim.tasks.walking import Walking

READ_AT = (60, 90, 120)
#: Evaluations with ``--servos``.
FEW = 40
AGAIN = 10
HAND = genes_of(HAND_TUNED)
#: Least number of gaits whose ranks are compared; a budget may end with one or two.
RANKED = 5
#: The paper's 24.7 cm/s over its hand-tuned 10.
PAPER = 2.47
#: Gaits that L3 is judged on: those of its trials, the next round's, and the best one's neighbours.
GROUPS = ("compared", "held_out", "neighbours")
BETTER = "back to reality, better choices"
#: Methods whose simulator has the properties of servos; in the first one the robot is filmed.
FILMED = "servos, filmed"
SERVOS = (FILMED, "servos, without L3")
#: Methods that are compared with all others.
LEARNERS = (
    FILMED,
    BETTER,
    "the same with L3",
    "back to reality, as in the paper",
)
KEPT = Path(__file__).with_suffix(".jsonl")


class Remembering(Simulated):
    """Simulates no gait twice: with one seed many searches begin with the same gaits.

    ``tried`` counts all requested trials.
    """

    _known: ClassVar[dict[bytes, float]] = {}

    @classmethod
    def forget(cls) -> None:
        """Forget all trials, such as those of another seed."""
        cls._known.clear()

    def fitness(
        self, genes: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        keys = [parameters.tobytes() + one.tobytes() for one in genes]
        new = {key: n for n, key in enumerate(keys) if key not in self._known}
        if new:
            result = super().fitness(genes[list(new.values())], parameters)
            self._known.update(zip(new, result.tolist(), strict=True))
        self.tried += len(keys) - len(new)
        return np.array([self._known[key] for key in keys])


class Job:
    """A run of a method: where it walks, its seed, its budget, and whether it is filmed."""

    def __init__(self, method: str, floor: str, seed: int, size: dict[str, Any], folder: Path):
        self.seed, self.size, self.budget = seed, size, size["budget"]
        task = Walking(size["seconds"], circle=size.get("circle", 0.0))
        build = ServoBuild() if method in SERVOS else Build()
        self.simulated = Remembering(LeggedSimulator(build), task, Gait())
        walker = VirtualWalker(Gait(), floor, seed, task, "lab" if method == FILMED else None)
        self.trials = Journal(walker, folder / "trials.jsonl")

    def alternate(self, settings: str, **changes: Any) -> tuple[Evaluations, dict[str, Any]]:
        """Run the alternation."""
        how = settings_named(settings, **{"budget": self.budget, **changes})
        run = Alternation(
            self.simulated, self.trials, HAND, how, seed=self.seed, progress=False
        ).run()
        about = []
        for cycle in run.cycles:
            works = cycle["transfer"]["works"] if "transfer" in cycle else None
            about.append({"transfer": works})
            for group in GROUPS:
                if group in cycle.get("L3", {}):
                    commanded = cycle["L3"][group]
                    about[-1][group] = {when: commanded[when] for when in ("before", "after")}
        return run.record, {"cycles": about, "confirm": how.confirm}

    def learn(self, learner: Any, order: Evaluations, count: int) -> Evaluations:
        """Let an optimiser learn in reality, until the budget is used."""
        while len(order) < self.budget:
            asked = learner.ask()
            shape = asked.shape[:-1]
            asked = asked.reshape(-1, asked.shape[-1])[: self.budget - len(order)]
            fitness = self.trials.evaluate(asked, "learn")
            order.add(asked, fitness)
            if len(asked) == count:
                learner.tell(fitness.reshape(shape))
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
    return job.learn(new_cma(HAND, 0.1, (job.seed, 8)), job.hand(), 12), {}


def new_cma(start: NDArray[np.float64], spread: float, seed: tuple[int, ...]) -> CMA:
    """Return CMA-ES of populations of 12 within 0..1."""
    how = BitSettings(population=12)
    return CMA(SearchSpace(start[None], seed, how, spread, (0.0, 1.0), 12))


def once(job: Job, **changes: Any) -> tuple[Evaluations, dict[str, Any]]:
    """Evolve in the simulator, and try the result for the whole budget."""
    settings = {"adapt": "none", "policy_steps": 0, "candidates": job.budget}
    return paper(job, **{**settings, **changes})


#: Number of random simulators that domain randomisation evolves controllers over.
RANDOM = {"search": "cma", "generations": 40, "sets": 6, "caution": 1.0}


def randomised_then_cma(job: Job) -> tuple[Evaluations, dict[str, Any]]:
    order, about = once(job, **RANDOM, budget=20)
    best = order.believed().genes
    return job.learn(new_cma(best, 0.05, (job.seed, 9)), order, 12), about


METHODS: dict[str, Callable[[Job], tuple[Evaluations, dict[str, Any]]]] = {
    BETTER: lambda job: job.alternate("better"),
    FILMED: lambda job: job.alternate("better"),
    "servos, without L3": lambda job: job.alternate("better"),
    "the same with L3": lambda job: job.alternate("better", compare="recent"),
    "CMA-ES from the hand-tuned gait": cma,
    "domain randomisation, then CMA-ES": randomised_then_cma,
    "domain randomisation once": lambda job: once(job, **RANDOM),
    "domain randomisation once, confirmed": lambda job: once(job, **RANDOM, confirm=3, finalists=4),
    "back to reality, as in the paper": paper,
    "policy gradient from the hand-tuned gait": policy_gradient,
    "simulation once": once,
}


def changed(texts: list[str]) -> dict[str, Any]:
    """Return settings that are written as NAME=VALUE.

    Raises:
        UserError: if the form is another, a name is unknown, or a value is wrong.
    """
    ours, changes = vars(settings_named("better")), {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in ours or not value:
            raise UserError(f"expected SETTING=VALUE, such as sets=3, not {text!r}")
        try:
            changes[name] = type(ours[name])(value)
        except (TypeError, ValueError):
            raise UserError(f"{name} cannot be {value!r}") from None
    settings_named("better", **changes)
    return changes


def run(method: str, floor: str, seed: int, size: dict[str, Any]) -> dict[str, Any]:
    """Run a method, and measure the gaits that it held to be best."""
    with tempfile.TemporaryDirectory() as folder:
        job = Job(method, floor, seed, size, Path(folder))
        order, about = METHODS[method](job)
        again = VirtualWalker(Gait(), floor, 10_000 + seed)
        numbers = np.arange(AGAIN) * 13
        read, known = {}, {}
        for count in [at for at in READ_AT if at <= job.budget] or [job.budget]:
            genes = order.believed(about.get("confirm", 1), count).genes
            if genes.tobytes() not in known:
                result = again.trials(np.tile(genes, (AGAIN, 1)), numbers)
                known[genes.tobytes()] = [float(result.mean()), float(result.std(ddof=1))]
            read[str(count)] = known[genes.tobytes()]
        hand = float(again.trials(np.tile(HAND, (AGAIN, 1)), numbers).mean())
    return {
        "method": method,
        "floor": floor,
        "seed": seed,
        "size": size,
        "read": read,
        "hand": hand,
        "trials": job.trials.used,
        "simulated": job.simulated.tried,
        **about,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Return the tables: how far each method gets, which one wins, and how much L3 improves."""
    text, counts = "", list(rows[0]["read"]) if rows else []
    for floor in FLOORS:
        there = [row for row in rows if row["floor"] == floor]
        by = {m: {row["seed"]: row for row in there if row["method"] == m} for m in METHODS}
        by = {method: own for method, own in by.items() if own}
        if not there:
            continue
        hand = 100 * np.mean([row["hand"] for row in there])
        text += f"\n{floor}: hand-tuned {hand:.1f} cm/s\n"
        text += (
            f"| {'cm/s, medians of seeds':40} | seeds | at {' | at '.join(counts)} | times hand "
        )
        text += f"| {PAPER} and more | simulated |\n|{'---|' * (5 + len(counts))}\n"
        for method, own in by.items():
            read = [100 * np.median([row["read"][at][0] for row in own.values()]) for at in counts]
            times = [row["read"][counts[-1]][0] / row["hand"] for row in own.values()]
            simulated = int(np.median([row["simulated"] for row in own.values()]))
            text += f"| {method:40} | {len(own)} | {' | '.join(f'{v:.1f}' for v in read)} | "
            text += f"{np.median(times):.2f} | {sum(t >= PAPER for t in times)} of {len(times)} | "
            text += f"{simulated:,} |\n"
        learners = [method for method in LEARNERS if method in by]
        for n, first in enumerate(learners):
            for method in by:
                if method not in learners[: n + 1]:
                    text += against(first, method, by[first], by[method], counts)
        for method in learners:
            text += adapted(method, list(by[method].values()))
    return text


def medians(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each floor the hand-tuned gait's speed, and each method's: cm/s after all trials.

    A method has the median of its seeds, and how many passed :data:`PAPER` times the hand-tuned
    gait.
    """
    result: dict[str, dict[str, Any]] = {}
    for floor in FLOORS:
        there = [row for row in rows if row["floor"] == floor]
        if not there:
            continue
        methods = [method for method in METHODS if any(row["method"] == method for row in there)]
        result[floor] = {"hand-tuned": 100 * float(np.mean([row["hand"] for row in there]))}
        for method in methods:
            own = [row for row in there if row["method"] == method]
            speeds = [list(row["read"].values())[-1][0] for row in own]
            passed = sum(s >= PAPER * row["hand"] for s, row in zip(speeds, own, strict=True))
            result[floor][method] = {
                "speed": 100 * float(np.median(speeds)), "passed": passed, "seeds": len(own),
                **agreements([row.get("cycles", []) for row in own]),
            }  # fmt: skip
    return result


def agreements(runs: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """Return medians over runs: how well the simulator predicts gaits.

    ``transfer`` is the percentage of the first candidates that reach the predicted fitness within
    25 %; ``next`` has the RMS (cm/s) and the rank of the gaits after each L3, before and after it,
    where there are :data:`RANKED` or more.
    """
    first = [cycles[0]["transfer"] for cycles in runs if cycles]
    result: dict[str, Any] = {"transfer": 100 * float(np.median(first))} if first else {}
    held_out = [one["held_out"] for cycles in runs for one in cycles if "held_out" in one]
    held_out = [one for one in held_out if _individuals(one) >= RANKED]
    if held_out:
        result["next"] = {
            when: {
                "rms": 100 * float(np.median([one[when]["rms"] for one in held_out])),
                "rank": float(np.median([one[when]["rank"] or 0.0 for one in held_out])),
            }
            for when in ("before", "after")
        }
    return result


def _individuals(group: dict[str, Any]) -> int:
    """Return the number of gaits of a group, whose RMS is its norm over the root of that."""
    norm, rms = (group["after"][what] for what in ("norm", "rms"))
    return round((norm / rms) ** 2) if rms else 0


def against(
    first: str, second: str, own: dict[int, Any], other: dict[int, Any], counts: list[str]
) -> str:
    """Return a line of the differences of two methods, seed by seed, and how many are above 0."""
    parts, seeds = [], own.keys() & other.keys()
    for at in counts if seeds else []:
        apart = [100 * (own[seed]["read"][at][0] - other[seed]["read"][at][0]) for seed in seeds]
        parts.append(f"{np.median(apart):+.1f} ({sum(a > 0 for a in apart)} of {len(apart)})")
    return f"  {first}, less {second}: {', '.join(parts)}\n" if parts else ""


def adapted(method: str, own: list[dict[str, Any]]) -> str:
    """Return lines: how much L3 of a method improved in its first cycle, and in all later ones."""
    text = ""
    for name, part in (("first cycle", slice(0, 1)), ("later cycles", slice(1, None))):
        cycles = [cycle for row in own for cycle in row["cycles"][part]]
        for group in GROUPS:
            result = [cycle[group] for cycle in cycles if group in cycle]
            if not result:
                continue
            text += f"  {method}, {name}, {group} ({len(result)}): "
            for what, unit in (("norm", 100), ("rms", 100), ("median", 100), ("rank", 1)):
                both = [
                    np.median([one[when][what] or 0.0 for one in result]) * unit
                    for when in ("before", "after")
                ]
                text += f"{what} {both[0]:.2f} to {both[1]:.2f}, "
            fold = [one["before"]["norm"] / max(one["after"]["norm"], 1e-9) for one in result]
            text += f"norm divided by {np.median(fold):.2f}\n"
        works = [cycle["transfer"] for cycle in cycles if cycle["transfer"] is not None]
        if works:
            text += (
                f"  {method}, {name}, alike within 25 % in both: {100 * np.median(works):.0f} %\n"
            )
    return text


def speed() -> str:
    """Return the cost of trials of the hand-tuned gait, and of the paper's 27,000."""
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


def repeats(floor: str, seed: int, size: dict[str, Any]) -> str:
    """Return how much two evaluations in reality of the same gaits differ.

    The gaits are those of the filmed robot's rounds after L3, so that no simulator can predict them
    better than this.
    """
    with tempfile.TemporaryDirectory() as folder:
        job = Job(FILMED, floor, seed, size, Path(folder))
        order, about = METHODS[FILMED](job)
        first = [one for one in order.all if one.count == 1]
        # The gait to begin with and a round of candidates come before the first L3.
        after = first[1 + settings_named("better").candidates :]
        genes, fitness = (
            np.array([getattr(one, n) for one in after]) for n in ("genes", "fitness")
        )
        task = Walking(size["seconds"], circle=size["circle"])
        other = Journal(VirtualWalker(Gait(), floor, 20_000 + seed, task), Path(folder) / "again")
        again = other.evaluate(genes, "again")
    l3 = [one["held_out"]["after"] for one in about["cycles"] if "held_out" in one]
    return (
        f"{floor}, seed {seed}: {len(genes)} gaits, evaluated twice, differ by "
        f"{100 * np.sqrt(np.mean((again - fitness) ** 2)):.1f} cm/s (RMS), rank "
        f"{rank_correlation(again, fitness) or 0:.2f}; as predicted by L3: "
        + ", ".join(f"{100 * one['rms']:.1f} and {one['rank'] or 0:.2f}" for one in l3)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=KEPT, help="file of the runs")
    parser.add_argument("--speed", action="store_true", help="measure what a trial costs")
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--first-seed", type=int, default=0, help="the first of them")
    parser.add_argument("--floors", nargs="+", choices=list(FLOORS), default=list(FLOORS)[:3])
    parser.add_argument(
        "--methods",
        nargs="+",
        choices=list(METHODS),
        default=[m for m in METHODS if m not in SERVOS],
    )
    parser.add_argument(
        "--change", nargs="+", default=[], metavar="SETTING=VALUE",
        help="in place of --methods: the better choices as they are, and with other settings",
    )  # fmt: skip
    parser.add_argument("--budget", type=int, default=READ_AT[-1], help="evaluations in reality")
    parser.add_argument("--paper", action="store_true", help="at the paper's size")
    parser.add_argument("--quick", action="store_true", help="a small size, to try the benchmark")
    parser.add_argument("--show", action="store_true", help="run nothing")
    parser.add_argument("--json", action="store_true", help="print the medians as JSON")
    parser.add_argument("--servos", action="store_true", help="the methods with servos alone")
    parser.add_argument(
        "--repeats", action="store_true", help="with --servos: how much evaluations of a gait vary"
    )
    options = parser.parse_args()
    if options.servos:
        options.methods, options.budget = list(SERVOS), FEW
        options.out = KEPT.with_name("filmed.jsonl") if options.out == KEPT else options.out
    if options.speed:
        print(speed())
        return
    if options.change:
        if options.out == KEPT:
            parser.error("runs with other settings want a file of their own: -o")
        try:
            changes = changed(options.change)
        except UserError as error:
            parser.error(str(error))
        name = f"{BETTER}, {', '.join(options.change)}"
        METHODS[name] = lambda job: job.alternate("better", **changes)
        options.methods = [BETTER, name]
    size = {"seconds": 5.0, "generations": 120, "adapt_generations": 20, "budget": options.budget}
    if options.servos:
        size |= {"seconds": 20.0, "circle": RADIUS}
    if options.paper:
        size |= {"seconds": 20.0, "generations": 600, "adapt_generations": 45}
    if options.quick:
        size |= {"seconds": 1.0, "generations": 3, "adapt_generations": 2}
        size["budget"] = FEW if options.repeats else 8  # repeats need a second round
    if options.repeats:
        if not options.servos:
            parser.error("--repeats is for filmed robots: add --servos")
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            for floor in options.floors:
                print(repeats(floor, seed, size), flush=True)
        return
    try:
        file = JsonLines(options.out, "neurosim-table", 1, {"size": size})
    except FileError as error:  # such as runs of another size
        parser.error(f"{error}; name another file: -o")
    rows = list(file.rows)
    known = {(row["method"], row["floor"], row["seed"]) for row in rows}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        if options.show:
            break
        Remembering.forget()
        for floor in options.floors:
            for method in options.methods:
                if (method, floor, seed) not in known:
                    rows.append(run(method, floor, seed, size))
                    file.append(rows[-1])
                    print(f"{floor}, seed {seed}: {method}", flush=True)
    print(json.dumps(medians(rows)) if options.json else table(rows))


if __name__ == "__main__":
    main()
