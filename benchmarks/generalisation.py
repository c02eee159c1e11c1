"""Do networks that were evolved to avoid obstacles avoid them in arenas that they have not met?

Networks are evolved in tables as in the paper (one arena, contacts are free) and in many arenas
where a contact ends the fitness. Of several runs the best is kept (--choices 4: also the others,
which shows what the choice is worth). They then drive for 60 s from random starts in new arenas,
and so does a hand-written Braitenberg vehicle. Printed are the fraction of drives that touch
something, with its standard error (arenas differ far more than starts: ten of them say little), and
the fitness. With --lab-drives N, a robot of the virtual lab also drives N times in each of the
first arenas. Up to --inner boards stand inside each arena; their ends and corners are seen less
well than a wall. 0 leaves them out.

    neurosim sample samples --grid 5 --repeats 2
    neurosim build-tables samples/*.sample --motors samples/motors.csv -o tables
    python benchmarks/generalisation.py tables             about ten minutes
    python benchmarks/generalisation.py tables --step 0.05 --lab-drives 10
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from typing import Any

import numpy as np

import neurosim as ns
from neurosim.base.trajectory import Episode
from neurosim.controllers.network import braitenberg
from neurosim.loop.evaluate import rollouts_of
from neurosim.simulators.tables.places import random_arena
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance, avoidance
from neurosim.trials.realities import REALITIES

SECONDS = 60.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("tables", help="folder of a table simulator")
    parser.add_argument("--robot", default="virtual-khepera", help="of the lab; or virtual-thymio")
    parser.add_argument("--lab-seed", type=int, default=0, help="which robot of the lab")
    parser.add_argument("--arenas", type=int, default=200, help="to be tried in")
    parser.add_argument("--inner", type=int, default=2, help="most walls inside each of them")
    parser.add_argument("--drives", type=int, default=20, help="in each of them")
    parser.add_argument("--generations", type=int, default=150)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--choices", type=int, default=1, help="of the runs, in order of choice")
    parser.add_argument("--step", type=float, default=0.1, help="s; the paper's is 0.1")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lab-arenas", type=int, default=20)
    parser.add_argument("--lab-drives", type=int, default=0, help="in each of these")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    tables = ns.load(options.tables)
    paper = ns.make_task("obstacle-avoidance")
    steps = 20 * round(30.0 / options.step)
    many = ns.make_task(
        "obstacle-avoidance", steps=steps, starts=20, contacts="end", duration=options.step
    )
    network = ns.make_controller("network", tables, paper)
    how = {"seed": options.seed, "generations": options.generations, "runs": options.runs}
    vehicle, weights = braitenberg(tables.reading_names, tables.bearings)
    assert vehicle.inputs == network.inputs
    result: dict[str, np.ndarray] = {"Braitenberg vehicle": weights}
    seconds = {}
    for name, task, more in (
        ("evolved, the paper's way", paper, {}),
        ("evolved in many arenas", many, {"arenas": 100, "objective": "fitness"}),
    ):
        began = time.monotonic()
        every = ns.evolve(tables, task, network, progress=False, **how, **more)
        result[name] = every[0].genes
        for place in range(1, min(options.choices, len(every))):
            result[f"{name}, choice {place + 1}"] = every[place].genes
        seconds[name] = time.monotonic() - began
    rng = np.random.default_rng(2**31 + options.seed)
    arenas = [random_arena(rng, tables.radius, inner=options.inner) for _ in range(options.arenas)]
    rows = []
    lab = partial(in_the_lab, REALITIES.get(options.robot))
    cases = (
        ("tables", in_tables, arenas, options.drives),
        ("lab", lab, arenas[: options.lab_arenas], options.lab_drives),
    )
    for where, drive, there, drives in cases:
        for name, genes in result.items() if drives else ():
            touched, fitness = drive(tables, network, genes, there, drives, options)
            row = {"where": where, "name": name, "drives": touched.size}
            of_arenas = touched.mean(1)
            row |= {"touched": of_arenas.mean(), "error": of_arenas.std() / len(there) ** 0.5}
            row |= {"fitness": fitness.mean(), "seconds": seconds.get(name, 0.0)}
            rows.append(row)
            if not options.json:
                print(
                    f"{where:6} {name:24} touches in {100 * row['touched']:5.1f} +- "
                    f"{100 * row['error']:.1f} % of {touched.size} drives; "
                    f"fitness {row['fitness']:5.1f} of {10 * SECONDS:.0f}",
                    flush=True,
                )
    if options.json:
        print(json.dumps({"rows": rows}))


def in_tables(
    tables: Any, network: Any, genes: np.ndarray, arenas: list[Any], drives: int, options: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether the drives in each arena touch something, and their fitness, [A, D] each."""
    rng, step = np.random.default_rng(options.seed), options.step
    episode = Episode(step, round(SECONDS / step), readings=True)
    touched, fitness = [], []
    for arena in arenas:
        simulator = tables.changed(place=arena)
        rollouts = rollouts_of(simulator, network, episode)
        draws = rollouts.draw(simulator.free_poses(drives, rng), rng)
        driven = rollouts.run(genes[None], draws)
        assert driven.poses is not None
        touched.append(simulator.touching(driven.poses)[0, :, 1:].any(-1))
        fitness.append(avoidance(driven)[0])
    return np.array(touched), np.array(fitness)


def in_the_lab(
    reality: Any,
    tables: Any,
    network: Any,
    genes: np.ndarray,
    arenas: list[Any],
    drives: int,
    options: Any,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the same arrays of drives of a robot of the virtual lab."""
    seed, step = options.seed, options.step
    rng = np.random.default_rng(seed)
    robot = {"lab_seed": options.lab_seed}
    robot |= {"baud": tables.meta["baud"]} if "baud" in tables.meta else {}
    touched, fitness = np.zeros((len(arenas), drives), bool), np.zeros((len(arenas), drives))
    for a, arena in enumerate(arenas):
        simulator = tables.changed(place=arena)
        task = ObstacleAvoidance(duration=step)
        with reality(network, task, simulator, seed=seed + a, **robot) as trials:
            for d, start in enumerate(simulator.free_poses(drives, rng)):
                trials.rest()
                trials._place(start)
                driven = trials.drive(genes, round(SECONDS / step), trials._pose(start))
                assert driven.poses is not None
                touched[a, d] = simulator.touching(driven.poses[1:]).any()
                fitness[a, d] = avoidance(driven)
    return touched, fitness


if __name__ == "__main__":
    main()
