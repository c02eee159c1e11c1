"""How fast networks are driven in closed loop, compiled, compared with the same steps in PyTorch.

Robot steps per second of a population of networks, each through the same random samples, with

  - ours: the simulator's compiled rollouts, on all cores;
  - PyTorch: the controllers' own act() and the simulator's own step(), for the whole batch at once.

In a motion network of the size that the default trainer yields (eight members and a mean network,
with a drive model, kernel units and noise) networks see their heading and the next goal; in
tables (4 walls, 3 obstacles, uniform noise) they see eight sensors. The weights of the motion
network are random: their values make no difference to the time.

    python benchmarks/closed_loop.py                  about two minutes, when compiled before
    python benchmarks/closed_loop.py --quick
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time

import numba
import numpy as np
import torch

from neurosim.base.trajectory import Episode
from neurosim.controllers import Controller, Network, Recurrent
from neurosim.loop.stepped import SteppedRollouts
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork, TableSimulator
from neurosim.simulators.base import Simulator
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.drive import CURVES, DriveModel
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.noise import NoiseModel
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable

STEPS, SAMPLES, HIDDEN = 200, 10, 5
#: Kernel units, as many as the default trainer keeps at most.
UNITS = 150
#: PyTorch drives fewer steps: its time for each step hardly depends on their number.
PEER_STEPS, PEER_REPEATS = 10, 3
INPUTS = ("cos_heading", "sin_heading", "goal_x", "goal_y", "goal_cos", "goal_sin")
GOALS = np.array([[0.5, 0.2, 0.0], [1.0, -0.2, 1.0], [0.3, 0.6, 3.0]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    population, repeats = (20, 5) if options.quick else (100, 15)
    rows = []
    for simulator in (motion_network(), tables()):
        for name, family in families(simulator.reading_names or INPUTS).items():
            ours, peer = rates(simulator, family, population, repeats)
            about = {"simulator": simulator.kind, "controller": name}
            rows.append({**about, "steps_per_second": ours, "pytorch_steps_per_second": peer})
    if options.json:
        machine = {"cores": os.cpu_count(), "numba_threads": numba.get_num_threads()}
        print(json.dumps({"machine": machine, "population": population, "rows": rows}))
        return
    print("simulator       controller     ours, steps/s   PyTorch, steps/s   ours is faster by")
    for row in rows:
        ours, peer = row["steps_per_second"], row["pytorch_steps_per_second"]
        label = f"{row['simulator']:14}  {row['controller']:12}"
        print(f"{label}  {ours:14,.0f}   {peer:16,.0f}   {ours / peer:17.1f}")


def families(inputs: tuple[str, ...]) -> dict[str, Controller]:
    """Return a controller of every kind that has compiled rollouts."""
    return {
        "no hidden": Network(inputs, scale=45.0),
        "hidden": Network(inputs, (HIDDEN,), scale=45.0),
        "elman": Recurrent(inputs, HIDDEN, "elman", scale=45.0),
        "ctrnn": Recurrent(inputs, HIDDEN, "ctrnn", scale=45.0),
    }


def motion_network() -> MotionNetwork:
    """Return a random ensemble of the size that the default trainer yields."""
    names = ("prev_left", "prev_right", "left", "right", "duration")
    derived = Derived(swing=0.03)
    network = ProductSummationNetwork(len(names) + len(derived), 10, 1)
    torch.manual_seed(0)
    genes = 0.1 * torch.randn(9, 3, network.genes, dtype=torch.float64)
    fractions = torch.tensor([[0.1, 0.0, -1.0], [0.1, 0.0, 1.0]])
    drive = DriveModel(
        lag=torch.full((2,), 0.1),
        slowing=torch.ones(2),
        braking=torch.full((2,), 0.5),
        rate=torch.full((2,), 8.0),
        stick=torch.full((2,), 0.01),
        curve=torch.zeros(2, CURVES),
        delay=torch.tensor([0.03]),
        kinematics=torch.cat([fractions, torch.zeros(3, 3)]),
    )
    units = KernelUnits(
        torch.randn(UNITS, network.inputs, dtype=torch.float64),
        torch.ones(network.inputs, dtype=torch.float64),
        0.001 * torch.randn(9, 3, UNITS, dtype=torch.float64),
    )
    noise = {name: torch.zeros(shape) for name, shape in NoiseModel.SHAPES.items()}
    noise["unit"] = torch.tensor([0.5, 0.2, 0.2])
    noise["log_scale"][:, 0] = -5.0
    return MotionNetwork(
        [{"name": name, "unit": "s" if name == "duration" else "%"} for name in names],
        network,
        genes,
        torch.tensor([50.0, 50.0, 50.0, 50.0, 3.0]),
        torch.full((3,), 0.05),
        "residual-twist",
        noise=NoiseModel(**noise),
        dead_band=torch.tensor([0.07, 0.07, 0.07, 0.07, 0.0]),
        central=True,
        derived=derived,
        drive=drive,
        kernel_units=units,
    )


def tables() -> TableSimulator:
    """Return tables of 180 angles and 20 distances, of sensors that are all alike."""
    looks = np.radians([90.0, 45.0, 10.0, -10.0, -45.0, -90.0, -170.0, 170.0])
    seen = np.maximum(np.cos(-2 * np.pi * np.arange(180)[:, None] / 180 - looks), 0) ** 4
    distance = 0.005 + 0.002 * np.arange(20)
    near = np.minimum(4 * np.exp(-distance / 0.008), 1)
    samples = Samples(near[:, None, None] * seen, 0.005, 0.002)
    return TableSimulator(SensorTable.from_samples({"wall": [samples], "cylinder": [samples]}))


def rates(
    simulator: Simulator, family: Controller, population: int, repeats: int
) -> tuple[float, float]:
    """Return the median steps a second, compiled and in PyTorch, measured in turn."""
    rng = np.random.default_rng(0)
    genes = rng.normal(0.0, 1.0, (population, family.genes))
    free = simulator.free_poses(SAMPLES, rng)
    goals = GOALS if free is None else None
    starts = rng.normal(0.0, 0.2, (SAMPLES, 3)) if free is None else free
    compiled = simulator.rollouts(family, Episode(0.1, STEPS, goals=goals))
    assert compiled is not None
    stepped = SteppedRollouts(simulator, family, Episode(0.1, PEER_STEPS, goals=goals))
    draws, peer_draws = compiled.draw(starts, 0), stepped.draw(starts, 0)
    compiled.run(genes, draws, reuse=True)
    seconds: tuple[list[float], list[float]] = [], []
    for repeat in range(repeats):
        began = time.perf_counter()
        compiled.run(genes, draws, reuse=True)
        seconds[0].append(time.perf_counter() - began)
        if repeat < PEER_REPEATS:
            began = time.perf_counter()
            stepped.run(genes, peer_draws)
            seconds[1].append(time.perf_counter() - began)
    trials = population * SAMPLES
    ours, peer = (statistics.median(each) for each in seconds)
    return trials * STEPS / ours, trials * PEER_STEPS / peer


if __name__ == "__main__":
    main()
