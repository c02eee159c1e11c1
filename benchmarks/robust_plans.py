"""How much robust evolution helps, and whether predicted probabilities of success hold.

In a simulator learned from the reference dataset plans of 10 and 13 commands are evolved twice:
without noise, and robustly from there. Each is driven many times in the virtual lab, with the
lab's own variation (placing, slip, caster), and judged by its true path. To bound open-loop plans,
some of these are evolved further, robustly, in the lab's own physics; the
results of these first plans ("begun with") are printed too.
Reliability: plans of all qualities (both kinds, and stages on the way), predicted probability
against the result, Brier score against always predicting the base rate.

    python benchmarks/robust_plans.py                    30 plans of each length
    python benchmarks/robust_plans.py --quick            6 plans of each length, 2 for the bound
    python benchmarks/robust_plans.py --kept FILE        go on where FILE ends; keep each set there
    python benchmarks/robust_plans.py --tell FILE FILE   the tables of what such files hold
    python benchmarks/robust_plans.py --rows 400 --plans 10
                                                         a simulator of 400 other rows for each

With --kept the work can be shared out: --first-plan 15 --plans 15 is another process's half.

Drives are of the lab's physics itself, and end where the guard of a trial would end them; the first
drive of every plan is repeated through brick, radio and driver (--brick 0 leaves that out).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numba import njit, prange

from neurosim.base.generations import run_generations
from neurosim.base.perimeter import Board, Perimeter
from neurosim.base.trajectory import RUN_DOWN, Trajectory
from neurosim.controllers import FixedPlan, Plan, SavedController
from neurosim.lab import VirtualRig
from neurosim.lab.nxt import physics
from neurosim.lab.nxt.params import LabParams
from neurosim.loop.check import check
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import Evolution, evolve
from neurosim.loop.settings import EvolveSettings, RobustSettings
from neurosim.recording.commands import Command, FixedCommands
from neurosim.recording.record import Guard, RecordSettings, Rig, record
from neurosim.robots.base import LIGHT_AHEAD, LIGHT_ASIDE
from neurosim.simulators import read_simulator
from neurosim.simulators.base import Simulator
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.training.train import learn, train, training_data
from tracking.datasets.dataset import Dataset
from tracking.datasets.recordings import Recording

REFERENCE = Path(__file__).resolve().parents[1] / "data" / "reference"
TASK = NineRectangles()
#: The lab's board and its robots' light sensors: where the guard of a trial ends a drive.
PERIMETER = Perimeter(Board(), ((LIGHT_AHEAD, LIGHT_ASIDE), (LIGHT_AHEAD, -LIGHT_ASIDE)))
#: The lab's motors, caster and slip need no finer step for a plan's rollout.
COARSE = 0.01
#: Time between the judged poses of a true path, s.
DENSE = 0.02


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--simulator", type=Path, help="a folder; trained if not given")
    parser.add_argument("--dataset", type=Path, default=REFERENCE)
    parser.add_argument("--rows", type=int, help="to learn from, others for each number of a plan")
    parser.add_argument("--lengths", default="10,13", help="commands in a plan")
    parser.add_argument("--plans", type=int, default=30, help="of each length")
    parser.add_argument("--first-plan", type=int, default=0, help="number of the first")
    parser.add_argument("--kept", type=Path, help="a file that each plan is added to when driven")
    parser.add_argument("--tell", type=Path, nargs="+", help="such files; nothing is evolved")
    parser.add_argument("--runs", type=int, default=4, help="of evolution, for each plan")
    parser.add_argument("--generations", type=int, default=1000)
    parser.add_argument("--robust-generations", type=int, default=300)
    parser.add_argument("--bound-every", type=int, default=3, help="plans, one for the bound too")
    parser.add_argument("--bound-generations", type=int, default=40)
    parser.add_argument("--drives", type=int, default=20, help="of each plan")
    parser.add_argument("--brick", type=int, default=1, help="of these again through the brick")
    parser.add_argument("--lab-seed", type=int, default=0, help="the robot that was recorded")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.plans = min(options.plans, 6)
    plans = gather(options) if options.tell is None else kept(options.tell)
    result = {
        "settings": {key: str(value) for key, value in vars(options).items()},
        "completed": [
            summary(plans, int(length), kind)
            for length in options.lengths.split(",")
            for kind in ("without noise", "robust", "begun with", "bound")
        ],
        "reliability": reliability(plans),
        "plans": plans,
    }
    if options.json:
        print(json.dumps(result))
    else:
        print_tables(result)


def gather(options: argparse.Namespace) -> list[dict]:
    """Evolve and drive all plans but those that are kept already; return all of them."""
    plans = kept([options.kept] if options.kept else [])
    there = {(plan["length"], plan["number"]) for plan in plans}
    simulator = None if options.rows else learned(options)
    lengths = [int(length) for length in options.lengths.split(",")]
    for number in range(options.first_plan, options.first_plan + options.plans):
        missing = [length for length in lengths if (length, number) not in there]
        if options.rows and missing:
            simulator = learned_from_few(options, number)
        for length in missing:
            began = time.perf_counter()
            result = one_set(simulator, length, number, options)
            plans += result
            if options.kept:
                with open(options.kept, "a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
            seconds = time.perf_counter() - began
            say = f"{length} commands, plan {number}: {seconds:.1f} s"
            print(say, file=sys.stderr, flush=True)
    return plans


def kept(paths: list[Path]) -> list[dict]:
    """Return the plans that files hold, a set of plans in each whole line."""
    texts = [path.read_text("utf-8") for path in paths if path.exists()]
    lines = [line for text in texts for line in text.splitlines(keepends=True)]
    return [plan for line in lines if line.endswith("\n") for plan in json.loads(line)]


def learned(options: argparse.Namespace):
    if options.simulator is not None:
        return read_simulator(options.simulator)
    with tempfile.TemporaryDirectory() as folder:
        return train(options.dataset, Path(folder) / "simulator")


def learned_from_few(options: argparse.Namespace, number: int):
    data = training_data(Dataset.read(options.dataset))
    some = slice(number * options.rows, (number + 1) * options.rows)
    if some.stop > len(data.x):
        raise SystemExit(f"{options.dataset} has no {some.stop} rows: a smaller --rows or --plans")
    simulator = learn(data.part(some), number)
    simulator.perimeter = PERIMETER
    return simulator


def one_set(simulator, length: int, number: int, options: argparse.Namespace) -> list[dict]:
    """Evolve plans of the three kinds and some of lesser quality; drive them all."""
    seed = 1000 * length + number
    settings = EvolveSettings(runs=options.runs, generations=options.generations)
    robust = replace(settings, robust=RobustSettings(generations=options.robust_generations))
    half = replace(robust, robust=RobustSettings(generations=options.robust_generations // 8))
    family = Plan(slots=length)
    start = evolve(simulator, TASK, family, settings=settings, seed=seed, progress=False)
    result = {"without noise": start}
    for kind, how in (("robust", robust), ("halfway", half)):
        result[kind] = improved(simulator, start, family, how, seed)
    result["lesser runs"] = result["without noise"][1:3] + result["robust"][1:3]
    if number % options.bound_every == 0:
        result["bound"] = bound(result["robust"][:1], length, seed, options)
    return [
        {"number": number, **driven(simulator, plan, kind, length, seed, options)}
        for kind, results in result.items()
        for plan in (results if kind == "lesser runs" else results[:1])
        if any(plan.commands)
    ]


def improved(simulator, start: list[SavedController], family: Plan, how: EvolveSettings, seed: int):
    """Evolve plans further, robustly, each in a run of its own."""
    genes = np.stack([family.encode(plan.commands) for plan in start])
    how = replace(how, runs=len(genes))
    evaluator = Evaluator(simulator, TASK, family, placing=how.placing)
    evolution = Evolution(evaluator, how, seed)
    first = np.repeat(genes[:, None], how.robust.genetic.population, axis=1)
    stage = evolution.robust_stage(genes, first)
    evolution.stages.append(stage)
    run_generations(stage, how.robust.generations, "", progress=False)
    return evolution.results(False)


def bound(start: list[SavedController], length: int, seed: int, options: argparse.Namespace):
    """Evolve plans further, robustly, in the lab's own physics."""
    how = RobustSettings(generations=options.bound_generations, draws=16, selection_draws=128)
    how = replace(how, genetic=replace(how.genetic, population=50))
    settings = EvolveSettings(runs=1, robust=how, final_draws=200)
    lab = LabPhysics(LabParams.sampled(options.lab_seed))
    return improved(lab, start, Plan(slots=length), settings, seed)


def driven(simulator, plan: SavedController, kind, length, seed, options) -> dict:
    """Return a plan's prediction and the results of its drives."""
    given = plan.given
    alone = SavedController(FixedPlan(tuple(given)), np.empty(0), TASK.describe(), TASK.start)
    prediction = check(alone, simulator, TASK, draws=2048, seed=seed + 77)
    truth = [drive(given, options.lab_seed, 100 * seed + n) for n in range(options.drives)]
    brick = [
        drive_brick(given, options.lab_seed, 100 * seed + n)
        for n in range(options.brick if kind in ("without noise", "robust") else 0)
    ]
    return {
        "kind": kind,
        "length": length,
        "commands": given,
        "predicted": prediction.probability,
        "members": prediction.members,
        "completed": int(sum(truth)),
        "drives": len(truth),
        "completed_brick": int(sum(brick)),
        "drives_brick": len(brick),
    }


# The lab, driven directly


@njit(cache=True)
def _dense_path(state, commands, p, field, dense):
    """Drive commands and let the motors run down; return poses and their commands' numbers."""
    inputs = np.zeros(6)
    inputs[2:4], inputs[4:6] = physics.REGULATED, np.nan
    total = 0
    for k in range(len(commands)):
        total += int(np.ceil(commands[k, 2] / dense))
    poses, segment = np.empty((total + 1, 3)), np.zeros(total + 1, np.int64)
    poses[0], at = state[1:4], 1
    for k in range(len(commands)):
        for wheel in range(2):
            inputs[wheel] = commands[k, wheel]
            physics.begin_command(state, wheel, p)
        began, slices = state[0], int(np.ceil(commands[k, 2] / dense))
        for n in range(slices):
            physics.advance(state, inputs, p, field, began + commands[k, 2] * (n + 1) / slices)
            poses[at], segment[at] = state[1:4], k
            at += 1
    return poses, segment


_FIELDS: dict[int, np.ndarray] = {}


def ground(params: LabParams) -> np.ndarray:
    key = int(params.slip_seed)
    if key not in _FIELDS:
        _FIELDS[key] = physics.slip_field(params)
    return _FIELDS[key]


def drive(given: list, lab_seed: int, seed: int, changes: dict[str, float] | None = None) -> bool:
    """Drive a plan once in the lab's physics; return whether it completed the course."""
    params = replace(LabParams.sampled(lab_seed), **(changes or {}))
    rng = np.random.default_rng([seed, 0xD21])
    pose = np.asarray(TASK.start) + rng.standard_normal(3) * (PLACING[0], PLACING[0], PLACING[1])
    state = physics.new_state(params, seed, tuple(pose))
    commands = np.array([*given, (0.0, 0.0, 2 * RUN_DOWN)])
    path, segment = _dense_path(state, commands, params.coefficients(), ground(params), DENSE)
    return judged(path, segment, len(given))


def drive_brick(given: list, lab_seed: int, seed: int) -> bool:
    """Drive a plan once through driver, radio and brick, without the perimeter's guard."""
    commands = [Command.of(command) for command in given]
    settings = RecordSettings(len(commands), Guard(at_line="ignore"))
    with (
        tempfile.TemporaryDirectory() as folder,
        VirtualRig(lab_seed, noise_seed=seed, start=TASK.start, camera=False) as rig,
    ):
        out = Path(folder) / "drive"
        record(out, Rig(rig.robot), FixedCommands(commands), settings, say=lambda _: None)
        lines = [line for line in Recording(out).commands().itertuples() if line.is_motor]
        truth = rig.lab.truth
    boundaries = [line.time for line in lines][: len(commands) + 1]
    inside = (truth.times >= boundaries[0]) & (truth.times <= boundaries[-1] + 2 * RUN_DOWN)
    segment = np.searchsorted(boundaries, truth.times[inside], side="right") - 1
    return judged(truth.poses[inside], segment, len(commands))


def judged(path: np.ndarray, segment: np.ndarray, commands: int) -> bool:
    given = np.append(np.ones(commands, bool), False)
    sent = np.zeros((commands + 1, 3))
    track = Trajectory.of_track(np.arange(len(path)), path, segment, sent, given)
    return bool(TASK.within_perimeter(PERIMETER).judge(track).success)


class LabPhysics(Simulator):
    """The lab's own physics as a simulator, which no learner has."""

    kind, has_noise, perimeter = "lab-physics", True, PERIMETER
    state_names = ("x", "y", "theta", *(f"lab_{n}" for n in range(int(physics.S.SIZE))))
    command_names = ("left", "right", "duration")

    def __init__(self, params: LabParams):
        self._params, self._field = params, ground(params)

    def start(self, pose, generator=None):
        """Return the states of robots at ``pose``; a generator gives the seeds of their slip."""
        states = np.stack([physics.new_state(self._params, 0, tuple(p)) for p in pose[:1].numpy()])
        states = np.repeat(states, len(pose), 0)
        states[:, 1:4] = pose.numpy()
        if generator is not None:
            seeds = torch.randint(2**52, (len(pose),), generator=generator)
            states[:, physics.S.SEED] = seeds.double().numpy()
        return torch.cat([pose, torch.from_numpy(states)], dim=1)

    def step(self, state, command, generator=None):
        """Return the states after a command; without a generator there is no noise."""
        params = self._params
        if generator is None:
            params = replace(params, slip_draw=0.0, caster_draw=0.0)
        states = state[:, 3:].numpy().copy()
        _coarse(states, command.numpy(), params.coefficients(), self._field)
        return torch.from_numpy(np.concatenate([states[:, 1:4], states], axis=1))


@njit(cache=True, parallel=True)
def _coarse(states, commands, p, field):
    for b in prange(len(states)):
        inputs = np.zeros(6)
        inputs[2:4], inputs[4:6] = physics.REGULATED, np.nan
        for wheel in range(2):
            inputs[wheel] = commands[b, wheel]
            physics.begin_command(states[b], wheel, p)
        count = int(np.ceil(commands[b, 2] / COARSE))
        for _ in range(count):
            physics.step(states[b], inputs, p, field, commands[b, 2] / count)


# What came of it


def summary(plans: list[dict], length: int, kind: str) -> dict:
    chosen = [plan for plan in plans if plan["length"] == length]
    if kind == "begun with":
        bounded = {plan["number"] for plan in chosen if plan["kind"] == "bound"}
        chosen = [plan for plan in chosen if plan["number"] in bounded]
    chosen = [p for p in chosen if p["kind"] == ("robust" if kind == "begun with" else kind)]
    drives = sum(plan["drives"] for plan in chosen)
    brick = sum(plan["drives_brick"] for plan in chosen)
    return {
        "length": length,
        "kind": kind,
        "plans": len(chosen),
        "predicted": float(np.mean([plan["predicted"] for plan in chosen])) if chosen else None,
        "completed": sum(plan["completed"] for plan in chosen) / drives if drives else None,
        "drives": drives,
        "completed_brick": sum(p["completed_brick"] for p in chosen) / brick if brick else None,
        "drives_brick": brick,
    }


def reliability(plans: list[dict], bins: int = 10) -> dict:
    """Return the reliability diagram of predicted probabilities, and Brier scores.

    Scores are over drives: mean squared difference between the predicted probability and the
    result, 0 or 1 (Brier 1950); the base rate's is that of always predicting the mean.
    """
    plans = [plan for plan in plans if plan["kind"] != "bound"]
    expected = np.array([plan["predicted"] for plan in plans])
    happened = np.array([plan["completed"] / plan["drives"] for plan in plans])
    base = happened.mean()
    place = np.minimum((expected * bins).astype(int), bins - 1)
    diagram = [
        {
            "from": low / bins,
            "plans": int((place == low).sum()),
            "predicted": float(expected[place == low].mean()),
            "completed": float(happened[place == low].mean()),
        }
        for low in range(bins)
        if (place == low).any()
    ]
    return {
        "plans": len(plans),
        "brier": float(np.mean(happened * (1 - expected) ** 2 + (1 - happened) * expected**2)),
        "brier_base_rate": float(base * (1 - base)),
        "base_rate": float(base),
        "diagram": diagram,
    }


def print_tables(result: dict) -> None:
    print("commands  plans evolved   number   predicted   completed   through the brick")
    for row in result["completed"]:
        if row["plans"]:
            brick = row["completed_brick"]
            print(
                f"{row['length']:8}  {row['kind']:14}{row['plans']:8}{row['predicted']:12.1%}"
                f"{row['completed']:12.1%}" + (f"{brick:20.1%}" if brick is not None else "")
            )
    score = result["reliability"]
    print(f"\n{score['plans']} plans of all qualities\n   predicted   completed   plans")
    for part in score["diagram"]:
        print(f"{part['predicted']:12.1%}{part['completed']:12.1%}{part['plans']:8}")
    print(
        f"Brier score {score['brier']:.3f}; always saying the base rate "
        f"({score['base_rate']:.1%}): {score['brier_base_rate']:.3f}"
    )


if __name__ == "__main__":
    main()
