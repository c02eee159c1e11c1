"""Results of fixed seeds, bit for bit, against the hashes in ``pinned.json``.

A change that is to leave results as they are leaves these hashes as they are. They hold for one
kind of processor and these versions of the libraries that compute; elsewhere the tests skip. To
pin anew, on a commit whose results are trusted::

    python tests/test_pinned.py --pin

Every result is one small function below, the only place that knows how the library is called for
it; what several of them start from (a recording, a simulator) is made once.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import llvmlite.binding
import numba
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from safetensors.numpy import load_file

from neurosim.base.trajectory import Draws, Episode
from neurosim.cli.main import cli
from neurosim.controllers import FixedPlan, Network, Plan, SavedController
from neurosim.controllers.plan import with_rest
from neurosim.evolution.genetic import GeneticSettings
from neurosim.lab import (
    KheperaParams,
    LabArena,
    LabParams,
    VirtualKheperaRig,
    VirtualRig,
    sampling_places,
)
from neurosim.lab.khepera.body import KheperaBody
from neurosim.lab.nxt import physics
from neurosim.loop.check import check
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import evolve_in, improve
from neurosim.loop.optimisers import make_optimiser
from neurosim.loop.search import Search
from neurosim.loop.settings import (
    NETWORK_GENETIC,
    PLAN_GENETIC,
    ROBUST_GENETIC,
    EvolveSettings,
    RobustSettings,
)
from neurosim.loop.stepped import SteppedRollouts
from neurosim.recording.commands import RandomCommands
from neurosim.recording.record import RecordSettings, record
from neurosim.sampling import SampleSettings, sample
from neurosim.simulators import TableSimulator, read_simulator
from neurosim.simulators.sampling import PLACING
from neurosim.simulators.tables.arena import Arena
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.reaction import Reaction
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance
from neurosim.training.guided import Committee, GuidedSettings, choose, motor_data
from neurosim.training.train import train
from tracking.datasets.dataset import Dataset
from tracking.datasets.recordings import Recording

PINNED = Path(__file__).with_name("pinned.json")
ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "data" / "reference"
KHEPERA = ROOT.parent / "shared" / "data" / "khepera"

#: What is pinned, by name: a function that returns the arrays, numbers or names to be hashed.
RESULTS: dict[str, Callable[[], Iterator[Any]]] = {}
#: Of these, those that need the published samples of a Khepera.
OF_SHARED_DATA: set[str] = set()


class NotHere(Exception):
    """What a result is made from is not on this computer."""


def result(name: str, *, shared: bool = False) -> Callable:
    def add(function: Callable) -> Callable:
        RESULTS[name] = function
        if shared:
            OF_SHARED_DATA.add(name)
        return function

    return add


def digest(*arrays: Any) -> str:
    """Return the SHA-256 of the types, shapes and bytes of arrays."""
    found = hashlib.sha256()
    for value in arrays:
        array = np.asarray(value, order="C")
        assert array.dtype != object, "objects have no bytes of their own"
        found.update(f"{array.dtype.str} {array.shape} ".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def machine() -> dict[str, str]:
    """Return what the last bits of a result depend on, beside the code."""
    features = llvmlite.binding.get_host_cpu_features().flatten()
    return {
        "torch": torch.__version__,
        "torch cpu": torch.backends.cpu.get_cpu_capability(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "opencv": cv2.__version__,
        "libc": " ".join(platform.libc_ver()),
        "cpu": llvmlite.binding.get_host_cpu_name(),
        "cpu features": hashlib.sha256(features.encode()).hexdigest()[:16],
    }


# What results start from, made once.


@cache
def _folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="pinned-")


def folder() -> Path:
    """Return the folder for all that is written, gone when the tests are over."""
    return Path(_folder().name)


def neurosim(*words: Any) -> None:
    """Run a verb of the command line."""
    done = CliRunner().invoke(cli, list(map(str, words)))
    assert done.exit_code == 0, f"{done.output}{done.exception!r}"


@cache
def calibrated() -> Path:
    """Return the calibration.json of photographs of the virtual lab."""
    photographs, out = folder() / "photographs", folder() / "calibration.json"
    neurosim("lab", "photographs", photographs, "--count", 8)
    points = photographs / "points.csv"
    neurosim("calibrate", photographs, "--square", 40, "--points", points, "-o", out)
    return out


@cache
def recorded() -> Path:
    """Return a recording of the virtual lab that was tracked while it was made."""
    out = folder() / "recording"
    neurosim("record", out, "--commands", 6, "--calibration", calibrated(), "--seed", 0)
    return out


def some_of_reference(rows: int) -> Dataset:
    """Return the first rows of the reference dataset."""
    return Dataset.read(REFERENCE).part(slice(rows))


@cache
def learned(trainer: str, rows: int) -> Path:
    """Return a simulator of some rows of the reference, learned in a few generations."""
    options = {
        "ga": {
            "generations": 12,
            "noise": True,
            "hidden": (4, 3),
            "settings": {"population": 30, "tournament": 6},
        },
        "combined": {
            "generations": 6,
            "members": 4,
            "hidden": (10, 1),
            "settings": {"candidates": 60, "parents": 6, "children": 30},
        },
        "gradient": {"generations": 8, "members": 2, "hidden": (12, 12)},
    }[trainer]
    data, out = folder() / f"rows-{rows}", folder() / f"{trainer}-{rows}"
    if not data.exists():
        some_of_reference(rows).write(data)
    train(data, out, trainer=trainer, seed=1, progress=False, **options)
    return out


def simulator() -> Any:
    """Return the simulator in which plans are evolved."""
    return read_simulator(learned("combined", 1300))


def made_up_sensors() -> SensorTable:
    """Return a small sensor table of formulas, with spread."""
    rng = np.random.default_rng(0)
    bearing = -2 * np.pi * np.arange(36) / 36
    distance = 0.005 + 0.005 * np.arange(10)
    looks = np.radians([70.0, 45.0, 10.0, -10.0, -45.0, -70.0, -170.0, 170.0])
    seen = np.maximum(np.cos(bearing[:, None] - looks), 0) ** 4
    dims = np.exp(-((distance - 0.005) / 0.012))
    samples = {}
    for name, brightness in (("wall", 0.8), ("cylinder", 0.4)):
        mean = 0.02 + brightness * dims[:, None, None] * seen
        samples[name] = [
            Samples(np.clip(mean + 0.01 * rng.standard_normal(mean.shape), 0, 1), 0.005, 0.005)
            for _ in range(3)
        ]
    return SensorTable.from_samples(samples)


def made_up_motors() -> MotorTable:
    """Return a motor table of formulas, with spread."""
    levels = np.linspace(-100, 100, 5)
    left, right = np.meshgrid(levels / 1000, levels / 1000, indexing="ij")
    twist = np.stack([0.48 * (left + right), 0.03 * (right - left), (right - left) / 0.05], -1)
    return MotorTable(levels, twist, 0.002 + 0.02 * np.abs(twist), 10.0)


def made_up_tables(noise: str = "uniform") -> TableSimulator:
    """Return a table simulator of formulas: a late robot in a room with all that a room can have.

    The room has a slanted wall, a corner that points inwards, a thin wall and obstacles.
    """
    corners = [(0, 0), (0.6, 0), (0.7, 0.4), (0.35, 0.25), (0, 0.4)]
    walls = tuple((*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True))
    arena = Arena(walls, ((0.15, 0.12, 0.0275), (0.45, 0.1, 0.02)), ((0.3, 0.05, 0.3, 0.2),))
    reaction = Reaction(0.03, 0.04, (0.03, 0.06))
    sensors, motors = made_up_sensors(), made_up_motors()
    return TableSimulator(sensors, motors, arena=arena, noise=noise, reaction=reaction)


def published_tables() -> TableSimulator:
    """Return the table simulator of the published samples of a Khepera, in the paper's arena."""
    if not KHEPERA.is_dir():
        raise NotHere(f"the reference data is not there ({KHEPERA})")
    files = [KHEPERA / f"khepera-{name}.sample" for name in ("wall", "cylinder")]
    return TableSimulator(SensorTable.from_files(files))


def random_plans(speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return commands [12, 6, 3] up to a speed (%), and which of them are given [12, 6]."""
    rng = np.random.default_rng(7)
    commands = rng.uniform((-speed, -speed, 0.3), (speed, speed, 3.0), (12, 6, 3))
    commands[0, :, :2] = 0.9 * speed
    commands[1, 2, :2] = 0.0
    commands[2, :, 1] = commands[2, :, 0]
    commands[3, 1:, :2] = -commands[3, :-1, :2]
    given = rng.random((12, 6)) < 0.8
    given[4] = False
    return commands, given


def numbers(value: Any) -> Iterator[float | str]:
    """Return the names and numbers of nested dicts and lists, in the order of the names."""
    if isinstance(value, Mapping):
        for name in sorted(value):
            yield name
            yield from numbers(value[name])
    elif isinstance(value, list | tuple):
        for part in value:
            yield from numbers(part)
    else:
        yield np.nan if value is None else value


# From a camera to a dataset.


@result("calibration")
def calibration():
    yield from numbers(json.loads(calibrated().read_text(encoding="utf-8")))


@result("recording commands")
def recording_commands():
    for line in Recording(recorded()).commands():
        yield line.kind
        yield np.array([line.time, line.left, line.right, line.duration], float)


@result("poses live")
def poses_live():
    yield from _poses("live")


@result("poses tracked")
def poses_tracked():
    yield from _poses("tracked")


@result("dataset")
def dataset():
    _poses("tracked")
    out = folder() / "dataset"
    neurosim("dataset", recorded(), "-o", out)
    table = Dataset.read(out).table
    for name in table.columns:
        if name != "recording":
            yield name
            yield table[name].to_numpy()


@cache
def _poses(which: str) -> tuple[np.ndarray, ...]:
    """Return poses.csv as it was made while recording, or of the film afterwards."""
    if which == "tracked":
        _poses("live")  # before they are overwritten
        neurosim("track", recorded())
    found = Recording(recorded()).poses()
    return found.session, found.frame, found.time, found.pose, found.quality


# From a dataset to a simulator.


def tensors(simulator: Path) -> Iterator[Any]:
    for name, values in sorted(load_file(simulator / "weights.safetensors").items()):
        yield name
        yield values


@result("weights ga")
def weights_of_ga():
    yield from tensors(learned("ga", 240))


@result("weights combined")
def weights_of_combined():
    yield from tensors(learned("combined", 240))


@result("weights combined, many rows")
def weights_of_many_rows():
    yield from tensors(learned("combined", 1300))


@result("weights gradient")
def weights_of_gradient():
    yield from tensors(learned("gradient", 240))


@result("errors and coverage")
def errors_and_coverage():
    for trainer in ("ga", "combined", "gradient"):
        meta = read_simulator(learned(trainer, 240)).meta
        for part in ("history", "test_errors", "test_coverage"):
            yield from numbers(meta[part])


@result("guided commands")
def guided_commands():
    some = some_of_reference(90)
    settings = GuidedSettings(members=3, candidates=6)
    committee = Committee(motor_data(some.input_array(), some.output_array()), 5, settings)
    for command in choose(committee, RandomCommands(seed=3), range(20, 30), settings=settings):
        yield np.array(astuple(command), float)


# From a simulator to plans.

TASK = NineRectangles()
FAMILY = Plan()
PLANS = EvolveSettings(
    generations=20, runs=2, genetic=replace(PLAN_GENETIC, population=40), final_draws=256
)
ROBUST = RobustSettings(
    generations=10,
    draws=8,
    refresh=5,
    selection_draws=64,
    genetic=replace(ROBUST_GENETIC, population=40),
)


def parts_of_plans(plans: Any) -> Iterator[Any]:
    for plan in plans:
        yield np.array([(np.nan,) * 3 if c is None else c for c in plan.commands])
        yield from (plan.poses, plan.rest, plan.fitness, plan.completes)
        yield from numbers([plan.probability, plan.expected_fitness, plan.draws, plan.run])
        for name in sorted(plan.history):
            yield name
            yield np.array(plan.history[name])


#: Until a run completes the task: robust evolution then gives its plan to the other runs.
LONG = replace(PLANS, generations=400, runs=3, genetic=replace(PLANS.genetic, population=250))


@cache
def evolved(settings: EvolveSettings) -> list:
    return evolve_in(simulator(), TASK, FAMILY, settings, seed=2, progress=False)


@result("plans")
def plans():
    yield from parts_of_plans(evolved(PLANS))


@result("plans, robust")
def robust_plans():
    yield from parts_of_plans(evolved(replace(PLANS, robust=ROBUST)))


@result("plans, long")
def long_plans():
    yield from parts_of_plans(evolved(LONG))


@result("plans, long, robust")
def long_robust_plans():
    yield from parts_of_plans(evolved(replace(LONG, robust=ROBUST)))


@result("plans, improved by expected fitness")
def improved_plans():
    settings = replace(LONG, robust=replace(ROBUST, objective="fitness"))
    genes = [FAMILY.encode(plan.commands) for plan in evolved(LONG)]
    found = improve(simulator(), TASK, FAMILY, genes, settings, seed=3, progress=False)
    yield from parts_of_plans(found)


@result("plans, as in the paper")
def plans_as_in_the_paper():
    settings = replace(PLANS, genetic=GeneticSettings(), insertion=False)
    yield from parts_of_plans(evolved(settings))


@result("plan check")
def plan_check():
    # These complete the task in about half of the outcomes.
    commands = [
        (42.0, 30.0, 2.778),
        (46.0, 42.0, 2.997),
        (47.0, 34.0, 2.949),
        (46.0, 38.0, 2.047),
        (50.0, 37.0, 2.742),
        (37.0, 33.0, 2.712),
        (41.0, 23.0, 1.903),
    ]
    plan = SavedController(FixedPlan(tuple(commands)), np.empty(0), {}, TASK.start)
    found = check(plan, simulator(), TASK, draws=512, seed=4)
    yield from (found.probability, found.interval, found.members, found.spread, found.turn)
    for failure in found.failures:
        yield from (failure.command, failure.reason, failure.share)


# Trajectories of fixed plans.


class GivenPlans(FixedPlan):
    """The fixed plans, one for each row of genes."""

    def commands(self, genes, rest):
        commands, given = random_plans(self.slots[0])
        return with_rest(commands[: len(genes)], given[: len(genes)], rest)


def trajectories(
    simulator: Any, speed: float, start: Any = TASK.start, stepped: bool = False
) -> Iterator[Any]:
    plans, episode = GivenPlans((speed,)), Episode(rest=0.5)
    drives = None if stepped else simulator.rollouts(plans, episode)
    drives = drives or SteppedRollouts(simulator, plans, episode)
    genes, start = np.empty((12, 0)), np.array([start])
    yield drives.run(genes, Draws(start)).poses[:, 0]
    draws = drives.draw(np.tile(start, (9, 1)), 11, PLACING)
    yield draws.starts
    if draws.member is not None:
        yield draws.member
    yield draws.noise
    yield drives.run(genes, draws).poses


@result("trajectories, motion network compiled")
def trajectories_compiled():
    yield from trajectories(simulator(), 50)


@result("trajectories, motion network of few rows")
def trajectories_of_few_rows():
    yield from trajectories(read_simulator(learned("combined", 240)), 50)


@result("trajectories, motion network stepped")
def trajectories_stepped():
    yield from trajectories(simulator(), 50, stepped=True)


@result("trajectories, one network of displacements")
def trajectories_of_displacements():
    yield from trajectories(read_simulator(learned("ga", 240)), 50)


@result("trajectories, perceptrons")
def trajectories_of_perceptrons():
    yield from trajectories(read_simulator(learned("gradient", 240)), 50)


@result("trajectories, tables, uniform noise")
def trajectories_in_tables():
    yield from trajectories(made_up_tables(), 100, (0.08, 0.2, 0.3))


@result("trajectories, tables, noise of the samples")
def trajectories_in_tables_by_samples():
    yield from trajectories(made_up_tables("samples"), 100, (0.08, 0.2, 0.3))


@result("trajectories, tables stepped")
def trajectories_in_tables_stepped():
    yield from trajectories(made_up_tables(), 100, (0.08, 0.2, 0.3), stepped=True)


# Tables, and networks that evolve in them.


@result("tables, made up")
def tables_made_up():
    yield from made_up_tables().arrays


@result("tables, published", shared=True)
def tables_published():
    yield from published_tables().arrays


@result("readings in tables")
def readings_in_tables():
    sim = made_up_tables("samples")
    poses = sim.arena.free_poses(50, sim.radius, np.random.default_rng(0))
    state = sim.start(torch.from_numpy(poses))
    yield poses
    yield sim.sense(state).numpy()
    yield sim.sense(state, torch.Generator().manual_seed(1)).numpy()


SENSORS = tuple(f"sensor_{index}" for index in range(8))


def networks(tables: TableSimulator) -> Iterator[Any]:
    family = Network(SENSORS)
    settings = EvolveSettings(genetic=replace(NETWORK_GENETIC, population=20, parents=4))
    search = Search(
        Evaluator(tables, ObstacleAvoidance(steps=300, starts=3), family),
        make_optimiser("ga", family, settings, 3),
        objective="steady",
        outcomes=1,
        rng=np.random.default_rng(3),
    )
    for _ in range(5):
        search.generation()
        yield search.shown[0]
        yield np.asarray(search.optimiser.ask())[0]
    yield from ([float(v[0]) for v in search.best], [float(v[0]) for v in search.mean])


@result("networks, uniform noise")
def networks_uniform():
    yield from networks(made_up_tables())


@result("networks, noise of the samples")
def networks_by_samples():
    yield from networks(made_up_tables("samples"))


@result("networks, published tables", shared=True)
def networks_published():
    yield from networks(published_tables())


@result("networks driven")
def networks_driven():
    sim = made_up_tables()
    family = Network(SENSORS)
    rng = np.random.default_rng(5)
    genes = rng.normal(0, 1.5, (8, 18)) + np.tile([0.0] * 8 + [1.0], 2)
    starts = sim.arena.free_poses(4, sim.radius, rng)
    for steps, drawn in ((100, False), (60, True)):
        drives = sim.rollouts(family, Episode(0.1, steps, readings=True))
        driven = drives.run(genes, drives.draw(starts, rng) if drawn else Draws(starts))
        yield from (driven.poses, driven.readings, driven.commands)


# The virtual lab, and a robot that samples itself in it.


@result("lab, NXT physics")
def nxt_physics():
    params = LabParams.drawn(3)
    state = physics.new_state(params, 1, (0.1, 0.2, 0.5))
    commands = [RandomCommands(seed=2).command(index) for index in range(40)]
    rows = np.array([astuple(command) for command in commands], float)
    yield physics.displacements(state, rows, params.coefficients(), physics.slip_field(params))
    yield state


@result("lab, NXT driven")
def nxt_driven():
    with VirtualRig(1, noise_seed=3, camera=False) as rig:
        settings = RecordSettings(12)
        record(folder() / "driven", rig.robot, None, RandomCommands(seed=3), settings)
        truth = rig.lab.truth
    yield from (truth.times, truth.poses, truth.voltage)


@result("lab, Khepera")
def khepera():
    body = KheperaBody(KheperaParams.drawn(1), LabArena.paper(), 4, (-0.22, 0.0, 0.0))
    for step in range(60):
        body.set_speeds(4 + step % 7, 9 - step % 5)
        body.advance(0.25 * (step + 1))
        yield body.pose
        yield from (body.proximity(), body.ambient(), body.counts(), body.speeds())
    yield body.touches


@result("lab, Khepera sampled")
def khepera_sampled():
    arena, poses = sampling_places()
    settings = SampleSettings(angles=36, distances=2, step=0.01, grid=3, held_out=4, duration=0.5)
    out = folder() / "samples"
    with (
        VirtualKheperaRig(1, arena=arena, start=poses["open"]) as rig,
        rig.robot as robot,
    ):
        found = sample(
            out, robot, settings, lambda where: rig.lab.place(*poses[where]), progress=False
        )
    yield from numbers(found)
    for name in ("wall", "cylinder"):
        yield Samples.read(out / f"{name}.sample").activations
    motors = MotorTable.read_csv(out / "motors.csv")
    yield from (motors.levels, motors.twist)


def hash_of(name: str) -> str:
    """Return the hash of a result, made in one thread of PyTorch.

    How PyTorch cuts up sums and products over many rows depends on the number of its threads, and
    so do the last bits of the read-outs from which the noise model of the many rows is learned.
    Nothing else here does, nor on the threads of compiled kernels.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return digest(*RESULTS[name]())
    finally:
        torch.set_num_threads(threads)


def pin() -> None:
    """Write the hashes of all results as they are now."""
    hashes = {}
    for name in RESULTS:
        began = time.perf_counter()
        with contextlib.suppress(NotHere):
            hashes[name] = hash_of(name)
        print(f"{time.perf_counter() - began:6.1f} s  {name}", file=sys.stderr)
    text = json.dumps({"machine": machine(), "hashes": hashes}, indent=2)
    PINNED.write_text(text + "\n", encoding="utf-8")


@cache
def pinned() -> dict[str, dict[str, str]]:
    return json.loads(PINNED.read_text(encoding="utf-8"))


ANEW = "pin anew with: python tests/test_pinned.py --pin"


@pytest.mark.parametrize("name", RESULTS)
def test_the_result_is_bit_for_bit_what_was_pinned(name):
    then, now = pinned()["machine"], machine()
    other = [part for part in {**then, **now} if then.get(part) != now.get(part)]
    if other:
        pytest.skip(
            f"pinned on another machine ({', '.join(other)}); on a commit whose results are "
            f"trusted {ANEW}"
        )
    if name not in pinned()["hashes"]:
        assert name in OF_SHARED_DATA, f"{name} is not pinned; {ANEW}"
        pytest.skip(f"pinned where the reference data was not; {ANEW}")
    try:
        found = hash_of(name)
    except NotHere as error:
        pytest.skip(str(error))
    assert found == pinned()["hashes"][name], f"{name}: not what it was; if that is meant, {ANEW}"


def test_nothing_is_pinned_that_is_not_made():
    assert set(pinned()["hashes"]) <= set(RESULTS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pin", action="store_true", required=True, help="write pinned.json")
    parser.parse_args()
    pin()
