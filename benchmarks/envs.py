"""How fast environments are stepped, compared with the bare kernels, Kheperax and MuJoCo.

Robot steps (0.1 s each) per second, of 1 to 10,000 robots at once, in two simulators:

  - look-up tables of a Khepera, 8 sensors, at obstacle avoidance;
  - a motion network of an NXT, learned from data/reference, at the nine rectangles.

For each, three ways in:

  - kernel: the compiled rollouts of networks, trajectories alone;
  - ns.evaluate: genes to fitness;
  - environment: steps of the vector environment with given actions, rewards and autoresets.

The peers are Kheperax (its robot, networks and maze in JAX, whole episodes in one call) and a robot
of two wheels and a caster in MuJoCo, 20 steps of 5 ms to a step, behind Gymnasium's AsyncVectorEnv.

    python benchmarks/envs.py                  a few minutes
    python benchmarks/envs.py --quick --json

Every figure is the median of several runs. Kheperax and MuJoCo are optional: pip install kheperax
mujoco.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path

import gymnasium
import numba
import numpy as np
from planner_speed import FULL_SPEED, ROBOT
from table_rollout import kheperax, made_up, median

import neurosim as ns
from neurosim.envs import TaskVectorEnv
from neurosim.simulators import TableSimulator

REFERENCE = Path(__file__).resolve().parents[1] / "data" / "reference"
#: Steps that are timed at once in an environment.
STEPS = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--simulator", type=Path, help="a motion network; trained if not given")
    parser.add_argument("--quick", action="store_true", help="1 and 100 robots, fewer repeats")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    counts = (1, 100) if options.quick else (1, 100, 1000, 10_000)
    repeats = 3 if options.quick else 11
    rows = []
    for count in (1, os.cpu_count() or 1, 16):  # processes that are forked before there are threads
        rate = asynchronous(count, repeats)
        rows += [] if rate is None else [row("MuJoCo, AsyncVectorEnv", count, rate)]
    for name, simulator, task in systems(options.simulator, options.quick):
        for count in counts:
            rows += [
                row(f"{name}: {direction}", count, rate)
                for direction, rate in ours(simulator, task, count, repeats).items()
            ]
    for count in counts:
        rate = kheperax(count, 1 if options.quick else 3)
        rows += [] if rate is None else [row("Kheperax", count, rate)]
    compared = counts[-1] if options.quick else 1000
    result = ratios(rows, compared)
    if options.json:
        machine = {"cores": os.cpu_count(), "numba_threads": numba.get_num_threads()}
        machine["load"] = os.getloadavg()[0]
        rates = {one["name"]: one["steps_per_second"] for one in rows if one["robots"] == compared}
        print(json.dumps({"machine": machine, "rows": rows, "rates": rates, "ratios": result}))
        return
    for one in rows:
        print(f"{one['name']:28}  {one['robots']:6}  {one['steps_per_second']:14,.0f}")
    print(f"\nat {compared} robots; load of the machine {os.getloadavg()[0]:.1f}")
    for name, value in result.items():
        print(f"{name:45} {value:10.2f}")


def row(name: str, robots: int, rate: float) -> dict:
    return {"name": name, "robots": robots, "steps_per_second": rate}


def systems(folder: Path | None, quick: bool) -> list[tuple[str, ns.Simulator, ns.Task]]:
    """Return name, simulator and task of both."""
    avoidance = ns.make_task("obstacle-avoidance", steps=500, starts=5)
    tables = ("tables", TableSimulator(made_up()), avoidance)
    with tempfile.TemporaryDirectory() as name:
        if folder is None:
            folder = Path(name) / "simulator"
            members = 2 if quick else 8
            ns.train(REFERENCE, folder, members=members, progress=False)
        network = ns.load(folder)
    return [tables, ("motion network", network, ns.make_task("nine-rectangles"))]


def ours(simulator: ns.Simulator, task: ns.Task, count: int, repeats: int) -> dict[str, float]:
    """Return robot steps per second of each interface, for this many robots at once."""
    family = ns.make_controller("network", simulator, task)
    genes = np.random.default_rng(0).normal(0, 0.5, (count, family.genes))
    fitness = ns.evaluate(simulator, task, family, samples=1)
    evaluator, draws = fitness.evaluator, fitness.draws
    steps = count * len(draws) * evaluator.episode.steps
    results = {}
    parts = max(len(genes) // 250, 1)  # in parts that memory holds, as evaluate() does

    def kernel() -> None:
        with evaluator.threads_for(len(genes) * len(draws)):
            for part in np.array_split(genes, parts):
                evaluator.run(part, draws, reuse=True)

    for name, call in {"kernel": kernel, "ns.evaluate": lambda: fitness(genes)}.items():
        call()
        results[name] = steps / median(call, min(repeats, 3) if count > 1000 else repeats)
    envs = TaskVectorEnv(simulator, task, num_envs=count)
    envs.reset(seed=0)
    rng, (low, high) = np.random.default_rng(1), (envs.action_space.low, envs.action_space.high)
    # They turn on the spot and go on a little, so that episodes last.
    actions = (0.2 * rng.uniform(low, high)).astype(np.float32)

    def drive() -> None:
        for _ in range(STEPS):
            envs.step(actions)

    drive()
    whole = max(task.episode.steps // STEPS, 1)  # a median over whole episodes, resets included
    results["environment"] = count * STEPS / mean(drive, max(repeats, whole))
    return results


def mean(call, repeats: int) -> float:
    """Return the mean seconds of a call: rare ones, with resets in them, count as well."""
    return median(lambda: [call() for _ in range(repeats)], 3) / repeats


def ratios(rows: list[dict], count: int) -> dict[str, float]:
    """Return how much faster environments are than others, at this many robots."""
    rates = {one["name"]: one["steps_per_second"] for one in rows if one["robots"] == count}
    best = [one["steps_per_second"] for one in rows if one["name"].startswith("MuJoCo")]
    results = {}
    for name in ("tables", "motion network"):
        own = rates[f"{name}: environment"]
        results[f"{name}: environment over kernel"] = own / rates[f"{name}: kernel"]
        if "Kheperax" in rates:
            results[f"{name}: environment over Kheperax"] = own / rates["Kheperax"]
        if best:
            results[f"{name}: environment over MuJoCo's best"] = own / max(best)
    return results


class WheelsInMuJoCo(gymnasium.Env):
    """Two wheels and a caster in MuJoCo, 0.1 s a step, rewarded for going ahead."""

    def __init__(self):
        import mujoco

        self._mujoco, self._model = mujoco, mujoco.MjModel.from_xml_string(ROBOT)
        self._data = mujoco.MjData(self._model)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._mujoco.mj_resetData(self._model, self._data)
        self._steps = 0
        return self._data.qpos[:7].astype(np.float32), {}

    def step(self, action):
        before = self._data.qpos[0]
        self._data.ctrl[:] = action * FULL_SPEED
        self._mujoco.mj_step(self._model, self._data, nstep=20)
        self._steps += 1
        seen = self._data.qpos[:7].astype(np.float32)
        return seen, float(self._data.qpos[0] - before), False, self._steps >= 600, {}


def asynchronous(count: int, repeats: int) -> float | None:
    """Return robot steps per second of MuJoCo behind this many processes."""
    try:
        import mujoco  # noqa: F401
    except ImportError:
        return None
    envs = gymnasium.vector.AsyncVectorEnv([WheelsInMuJoCo] * count)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = 0.5 * envs.action_space.sample()

    def drive() -> None:
        for _ in range(STEPS):
            envs.step(actions)

    drive()
    driven = count * STEPS / median(drive, repeats)
    envs.close()
    return driven


if __name__ == "__main__":
    main()
