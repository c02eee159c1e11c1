"""How fast plans are evolved, compared with a PyTorch loop and MuJoCo.

Seconds for 1,000 generations of 250 plans of 13 commands, one run and 30 at once, and command
steps per second, of

  - ours, in a simulator of the paper's size (3 networks of 10 product units) and the default;
  - a straightforward PyTorch loop: the same simulator, one step() for all plans per command;
  - MuJoCo's rollouts of a robot with two driven wheels and a caster, for the same commands
    (no fitness; the physics it steps is not learned, and finer than a command).

A command step is one command of one plan. Ours and PyTorch's seconds are of whole generations:
decoding, rollout, fitness, selection, crossover, mutation.

    python benchmarks/planner_speed.py                   about 4 minutes, of which 2 to train
    python benchmarks/planner_speed.py --quick           100 generations, no training
    python benchmarks/planner_speed.py --settings        how many of 30 runs find a course

MuJoCo is optional: pip install mujoco.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import torch

from neurosim.controllers import Plan
from neurosim.evolution.genetic import GeneticSettings
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import Evolution, evolve
from neurosim.loop.search import Search
from neurosim.loop.settings import default_settings
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.simulators.motion.domain import Domain
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.training.train import train

REFERENCE = Path(__file__).resolve().parents[1] / "data" / "reference"
COMMANDS, POPULATION = 13, 250
#: Of --settings.
RUNS = 30

#: The robot of the lab, in metres and kilograms: 56 mm wheels 13 cm apart, a smooth caster.
ROBOT = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="3 3 0.1"/>
    <body pos="0 0 0.028">
      <freejoint/>
      <geom type="box" size="0.07 0.05 0.02" pos="-0.02 0 0.03" mass="0.5"/>
      <geom type="sphere" size="0.014" pos="-0.09 0 -0.014" mass="0.02" friction="0.01"/>
      <body pos="0 0.065 0">
        <joint name="left" axis="0 1 0"/>
        <geom type="cylinder" size="0.028 0.012" zaxis="0 1 0" mass="0.03"/>
      </body>
      <body pos="0 -0.065 0">
        <joint name="right" axis="0 1 0"/>
        <geom type="cylinder" size="0.028 0.012" zaxis="0 1 0" mass="0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="left" kv="0.02"/>
    <velocity joint="right" kv="0.02"/>
  </actuator>
</mujoco>
"""
#: rad/s of a wheel at 100 %.
FULL_SPEED = 0.5 / 0.028


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--simulator", type=Path, help="a folder; trained if not given")
    parser.add_argument("--dataset", type=Path, default=REFERENCE)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--settings", action="store_true", help="runs that find a course instead")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    generations = 100 if options.quick else 1000
    simulators = {"paper's size": papers_size()}
    if options.simulator is not None:
        simulators["default"] = read_simulator(options.simulator)
    elif options.settings or not options.quick:
        with tempfile.TemporaryDirectory() as folder:
            simulators["default"] = train(options.dataset, Path(folder) / "simulator")
    if options.settings:
        completing = {
            str(slots): finders(simulators["default"], slots, generations)
            for slots in (10, COMMANDS)
        }
        print(json.dumps({"runs": RUNS, "completing": completing}) if options.json else completing)
        return
    rows = []
    for name, simulator in simulators.items():
        for runs in (1, 30):
            rows.append(ours(simulator, f"ours, {name}, {runs} run(s)", runs, generations))
        few = max(generations // 50, 2)
        rows.append(pytorch(simulator, f"PyTorch loop, {name}", few))
    rows += mujoco_rollouts(plans=8 if options.quick else 100)
    if options.json:
        machine = {"cores": os.cpu_count(), "numba_threads": numba.get_num_threads()}
        print(json.dumps({"machine": machine, "generations": generations, "rows": rows}))
        return
    print(f"{'':42}  s per 1,000 generations of a run        command steps/s")
    for row in rows:
        seconds = row["seconds_per_1000_generations"]
        shown = f"{seconds:32.2f}" if seconds is not None else f"{'-':>32}"
        print(f"{row['name']:42}  {shown}   {row['command_steps_per_second']:20,.0f}")


def finders(simulator: MotionNetwork, slots: int, generations: int) -> dict[str, int]:
    """Return how many runs find a course, with the default settings, others, and the paper's."""
    task, family = NineRectangles(), Plan(slots=slots)
    usual = default_settings(family, task, runs=RUNS, generations=generations)
    choices = {
        "default": usual,
        "tournament of 50": replace(usual, genetic=replace(usual.genetic, tournament=50)),
        "paper": replace(usual, genetic=GeneticSettings(), insertion=False),
    }
    completing = {}
    for name, settings in choices.items():
        evolved = evolve(simulator, task, family, settings=settings, seed=904, progress=False)
        completing[name] = sum(one.predicted["completes"] for one in evolved)
    return completing


def papers_size() -> MotionNetwork:
    """Return a simulator of the paper's size that knows no more than a line fitted to a unicycle.

    The values of its weights make no difference to its time.
    """
    network = ProductSummationNetwork(inputs=5)
    genes = 0.3 * torch.randn(
        3, network.genes, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    names = ("prev_left", "prev_right", "left", "right", "duration")
    scale = torch.tensor([50.0, 50.0, 50.0, 50.0, 3.0])
    inputs = [{"name": name, "unit": "s" if name == "duration" else "%"} for name in names]
    rows = np.random.default_rng(0).uniform([-50, -50, 0.5], [50, 50, 3.0], (400, 3))
    known = Domain.of(("left", "right", "duration"), rows)
    return MotionNetwork(inputs, network, genes, scale, torch.full((3,), 0.1), known=known)


def ours(simulator: MotionNetwork, name: str, runs: int, generations: int) -> dict:
    generation = evolution(simulator, runs).generation
    seconds = timed(generation, generations if runs == 1 else max(generations // 10, 5))
    return row(name, seconds / runs)


def pytorch(simulator: MotionNetwork, name: str, generations: int) -> dict:
    return row(name, timed(evolution(simulator, 1, stepped=True).generation, generations))


def evolution(simulator: MotionNetwork, runs: int, *, stepped: bool = False) -> Search:
    """Return the first stage of an evolution, as ``neurosim evolve`` runs it."""
    task, family = NineRectangles(), Plan(slots=COMMANDS)
    settings = default_settings(family, task, runs=runs)
    assert settings.genetic.population == POPULATION
    evaluator = Evaluator(simulator, task, family, placing=settings.placing, stepped=stepped)
    return Evolution(evaluator, settings, 0).stages[0]


def mujoco_rollouts(plans: int) -> list[dict]:
    try:
        import mujoco
        from mujoco import rollout
    except ImportError:
        return []
    model = mujoco.MjModel.from_xml_string(ROBOT)
    threads = os.cpu_count() or 1
    data = [mujoco.MjData(model) for _ in range(threads)]
    rng = np.random.default_rng(0)
    control = [controls(rng, model.opt.timestep) for _ in range(plans)]
    # One after the other they would be of unequal length: all are cut to the shortest.
    steps = min(map(len, control))
    fraction = steps / np.mean([len(one) for one in control])
    control = np.stack([one[:steps] for one in control])
    mujoco.mj_forward(model, data[0])
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.empty(size)
    mujoco.mj_getState(model, data[0], state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.tile(state, (plans, 1))
    rollout.rollout([model] * 2, data, state[:2], control[:2, :10])
    began = time.perf_counter()
    rollout.rollout([model] * plans, data, state, control)
    seconds = time.perf_counter() - began
    rolled_out = row(f"MuJoCo, rollouts on {threads} threads, no fitness", None)
    rolled_out["command_steps_per_second"] = plans * COMMANDS * fraction / seconds
    rolled_out["physics_steps_per_second"] = plans * steps / seconds
    return [rolled_out]


def controls(rng: np.random.Generator, timestep: float) -> np.ndarray:
    """Return wheel speeds (rad/s) at every physics step of a random plan."""
    durations = rng.uniform(0.5, 3.0, COMMANDS)
    speeds = rng.uniform(-0.5, 0.5, (COMMANDS, 2)) * FULL_SPEED
    return np.repeat(speeds, np.round(durations / timestep).astype(int), axis=0)


def timed(generation, count: int) -> float:
    """Return the seconds of one generation, compilation apart."""
    for _ in range(2):
        generation()
    began = time.perf_counter()
    for _ in range(count):
        generation()
    return (time.perf_counter() - began) / count


def row(name: str, seconds: float | None) -> dict:
    steps = POPULATION * COMMANDS
    return {
        "name": name,
        "seconds_per_1000_generations": None if seconds is None else 1000 * seconds,
        "command_steps_per_second": None if seconds is None else steps / seconds,
    }


if __name__ == "__main__":
    main()
