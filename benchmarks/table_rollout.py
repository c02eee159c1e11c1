"""How fast robots are driven in tables, compared with Kheperax and a plain PyTorch step.

Robot steps per second in batches of 100 and of 1,000 networks of 500 steps each, with

  - ours, compiled, with uniform noise and without: 8 sensors interpolated from 4 walls and 3
    obstacles, a network, motion, collisions, and the fitness of equation (1);
  - PyTorch: the same simulator's own sense() and step() for the whole batch at once;
  - Kheperax: its robot and its kind of network (three laser beams and two bumpers), in JAX, 4
    walls and 3 segments for obstacles, with the same fitness of its readings.

And seconds of the whole evolution: 200 generations of 100 networks of 500 steps.

    python benchmarks/table_rollout.py                  about a minute
    python benchmarks/table_rollout.py --quick

With --samples the tables are of .sample files; by default they are made up, of the same size.
Kheperax is optional: pip install kheperax.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch

from neurosim.base.trajectory import Trajectory
from neurosim.controllers import Network
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import Evolution
from neurosim.loop.settings import default_settings
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance, avoidance

STEPS = 500
FAMILY = Network(tuple(f"sensor_{number}" for number in range(8)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--samples", type=Path, nargs="+", help=".sample files")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    table = SensorTable.from_files(options.samples) if options.samples else made_up()
    repeats = 3 if options.quick else 15
    rows = []
    for batch in (100, 1000):
        for noise in ("uniform", "none"):
            simulator = TableSimulator(table, noise=noise)
            rate = ours(simulator, batch, repeats)
            rows.append({"name": f"ours, noise {noise}", "batch": batch, "steps_per_second": rate})
        result = pytorch(simulator, batch, 5 if options.quick else 25)
        rows.append({"name": "PyTorch", "batch": batch, "steps_per_second": result})
        result = kheperax(batch, 1 if options.quick else 3)
        if result is not None:
            rows.append({"name": "Kheperax (JAX)", "batch": batch, "steps_per_second": result})
    generations, simulator = 20 if options.quick else 200, TableSimulator(table)
    evolved = [evolution(simulator, generations, seed) for seed in range(1 if options.quick else 5)]
    seconds = 200 / generations * statistics.median(one["seconds"] for one in evolved)
    ends = {key: sorted(one[key] for one in evolved) for key in ("first_mean", "last_mean")}
    if options.json:
        machine = {"cores": os.cpu_count(), "numba_threads": numba.get_num_threads()}
        document = {"machine": machine, "rows": rows, "seconds_of_200_generations": seconds}
        print(json.dumps({**document, **ends}))
        return
    print(f"{'':22}  batch    robot steps/s   ours is faster by")
    for row in rows:
        base = next(r for r in rows if r["batch"] == row["batch"])["steps_per_second"]
        rate = row["steps_per_second"]
        print(f"{row['name']:22}  {row['batch']:5}  {rate:15,.0f}  {base / rate:18.1f}")
    print(f"200 generations of 100 networks of {STEPS} steps: {seconds:.2f} s")
    first, last = ends.values()
    print(
        f"mean fitness of the population, {len(evolved)} seeds: {first[0]:.0f} to {first[-1]:.0f} "
        f"in the first generation, {last[0]:.0f} to {last[-1]:.0f} in the last"
    )


def made_up() -> SensorTable:
    """Return tables of 180 angles and 20 distances, of sensors that are all alike."""
    looks = np.radians([90.0, 45.0, 10.0, -10.0, -45.0, -90.0, -170.0, 170.0])
    seen = np.maximum(np.cos(-2 * np.pi * np.arange(180)[:, None] / 180 - looks), 0) ** 4
    distance = 0.005 + 0.002 * np.arange(20)
    near = np.minimum(4 * np.exp(-distance / 0.008), 1)
    samples = Samples(near[:, None, None] * seen, 0.005, 0.002)
    return SensorTable.from_samples({"wall": [samples], "cylinder": [samples]})


def networks(count: int) -> np.ndarray:
    """Return networks that have been bred for a while: they drive, and meet walls now and then."""
    rng = np.random.default_rng(0)
    genes = rng.normal(0, 1, (count, 18))
    genes[:, [8, 17]] = rng.normal(1, 0.3, (count, 2))
    return genes


def ours(simulator: TableSimulator, batch: int, repeats: int) -> float:
    evaluator = Evaluator(simulator, ObstacleAvoidance(steps=STEPS), FAMILY)
    genes, rng = networks(batch), np.random.default_rng(0)

    def drive() -> None:
        evaluator.merit(genes, evaluator.draw(1, rng))

    drive()
    return batch * STEPS / median(drive, repeats)


def pytorch(simulator: TableSimulator, batch: int, steps: int) -> float:
    task, rng = ObstacleAvoidance(steps=STEPS), np.random.default_rng(0)
    robots = batch * task.starts
    weights = torch.from_numpy(networks(batch)).repeat_interleave(task.starts, 0).view(robots, 2, 9)
    poses = simulator.place.free_poses(robots, simulator.radius, rng)

    def drive() -> None:
        state = simulator.start(torch.from_numpy(poses))
        duration, all_readings, all_commands = torch.full((robots, 1), 0.1).double(), [], []
        for _ in range(steps):
            readings = simulator.sense(state)
            sums = (weights[..., :8] @ readings.unsqueeze(-1)).squeeze(-1) + weights[..., 8]
            commands = 100 * torch.tanh(sums)
            state = simulator.step(state, torch.cat([commands, duration], dim=1))
            all_readings.append(readings)
            all_commands.append(commands)
        readings, commands = (torch.stack(v, 1).numpy() for v in (all_readings, all_commands))
        avoidance(Trajectory(None, commands, 0.1, readings))

    drive()
    return robots * steps / median(drive, 3)


def kheperax(batch: int, repeats: int) -> float | None:
    try:
        import jax
        import jax.numpy as jnp
        from kheperax.simu.geoms import Pos, Segment
        from kheperax.simu.maze import Maze
        from kheperax.tasks.config import KheperaxConfig
        from kheperax.tasks.main import KheperaxTask
    except ImportError:
        return None
    for name in ("tree_leaves", "tree_map"):  # Kheperax 0.2 needs names that JAX has moved
        if not hasattr(jax, name):
            setattr(jax, name, getattr(jax.tree_util, name))
    config = KheperaxConfig.get_default()
    config.maze = Maze.create(
        segments_list=[Segment(Pos(x, 0.4), Pos(x, 0.5)) for x in (0.3, 0.5, 0.7)]
    )
    config.mlp_policy_hidden_layer_sizes = ()
    key = jax.random.PRNGKey(0)
    env, policy, _ = KheperaxTask.create_default_task(config, key)
    keys = jax.random.split(key, batch)
    first = jnp.zeros((batch, env.observation_size))
    parameters = jax.vmap(policy.init)(keys, first)

    def episode(weights, key):
        def step(carry, _):
            state, total = carry
            action = policy.apply(weights, state.obs)
            near = jnp.max(1.0 - jnp.clip(state.obs[:3], 0.0, 1.0))
            speed, difference = jnp.abs(action).mean(), (action[0] - action[1]) / 2
            total = total + speed * (1 - difference**2) * (1 - near)
            return (env.step(state, action), total), None

        (_, total), _ = jax.lax.scan(step, (env.reset(key), 0.0), None, length=STEPS)
        return total

    drive = jax.jit(jax.vmap(episode))
    drive(parameters, keys).block_until_ready()
    return batch * STEPS / median(lambda: drive(parameters, keys).block_until_ready(), repeats)


def evolution(simulator: TableSimulator, generations: int, seed: int) -> dict[str, float]:
    """Return seconds of generations, and the population's mean fitness in the first and the last.

    The first generation, which may wait for kernels to compile, does not count as seconds.
    """
    evaluator = Evaluator(simulator, ObstacleAvoidance(steps=STEPS), FAMILY)
    search = Evolution(evaluator, default_settings(FAMILY, evaluator.task), seed).stages[0]
    search.generation()
    began = time.perf_counter()
    for _ in range(generations):
        search.generation()
    seconds = time.perf_counter() - began
    first, last = (float(search.mean[which].mean()) for which in (0, -1))
    return {"seconds": seconds, "first_mean": first, "last_mean": last}


def median(call: Callable[[], object], repeats: int) -> float:
    """Return the median seconds of a call."""
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


if __name__ == "__main__":
    main()
