"""Evolutions that are interrupted and resumed end as if nothing had happened."""

import os
import signal
from dataclasses import replace
from time import sleep

import numpy as np
import pytest
import torch
from hill_climber import HillClimber
from ideal_simulator import SlippingWheels
from khepera_data import made_up

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import UserError
from neurosim.controllers import Network, Plan, read_controller
from neurosim.evolution.genetic import GeneticSettings
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.loop.evolve import evolve
from neurosim.loop.search import Search
from neurosim.loop.settings import NETWORK_GENETIC, EvolveSettings, RobustSettings
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork, TableSimulator
from neurosim.simulators.registry import write_simulator
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance

GENETIC = GeneticSettings(population=20, tournament=4)
PLANS = EvolveSettings(generations=7, runs=2, genetic=GENETIC, final_draws=20)
ROBUST = RobustSettings(
    generations=7, draws=4, refresh=3, halving=3, selection_draws=10, genetic=GENETIC
)
FEW = replace(NETWORK_GENETIC, population=8, parents=3)
NETWORKS = EvolveSettings(
    generations=7, genetic=FEW, samples=1, objective="steady", selection=4, final_draws=8
)


def ensemble():
    """Return an ensemble of three motion networks."""
    generator = torch.Generator().manual_seed(0)
    network = ProductSummationNetwork(inputs=5)
    names = ("prev_left", "prev_right", "left", "right", "duration")
    return MotionNetwork(
        [{"name": name, "unit": ""} for name in names],
        network,
        0.2 * torch.randn(3, 3, network.genes, generator=generator, dtype=torch.float64),
        torch.tensor([50.0, 50.0, 50.0, 50.0, 3.0]),
        torch.full((3,), 0.1),
    )


def tables():
    return TableSimulator(made_up(2, 0.01), noise="uniform")


AVOIDANCE = ObstacleAvoidance(steps=20, starts=2)
SENSORS = tuple(f"sensor_{number}" for number in range(8))
CASES = {
    "plans": (ensemble, "nine-rectangles", Plan(slots=4), PLANS),
    "plans, robust": (
        SlippingWheels,
        "nine-rectangles",
        Plan(slots=4),
        replace(PLANS, robust=ROBUST),
    ),
    "networks": (tables, AVOIDANCE, Network(SENSORS), NETWORKS),
    "networks, robust": (
        tables,
        AVOIDANCE,
        Network(SENSORS),
        replace(NETWORKS, robust=replace(ROBUST, generations=5, genetic=FEW)),
    ),
    "cma": (ensemble, "nine-rectangles", Plan(slots=4), replace(PLANS, optimiser="cma")),
    "own": (tables, AVOIDANCE, Network(SENSORS), replace(NETWORKS, optimiser="own")),
    "own, robust": (
        SlippingWheels,
        "nine-rectangles",
        Plan(slots=4),
        replace(PLANS, optimiser="own", runs=1, robust=ROBUST),
    ),
}


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setitem(OPTIMISERS._registered, "own", HillClimber)


def needs(case):
    if case == "cma":
        pytest.importorskip("cma")


def run(case, out, **others):
    simulator, task, family, settings = CASES[case]
    options = {"settings": settings, "seed": 5, "progress": False, **others}
    return evolve(simulator(), task, family, out=out, **options)


@pytest.fixture
def interrupting(monkeypatch):
    """Return a function that raises Ctrl-C in the middle of the n-th generation from now on."""
    generation = Search.generation

    def at(number):
        left = [number]

        def interrupted(self):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGINT)
            return generation(self)

        monkeypatch.setattr(Search, "generation", interrupted)

    return at


def content(saved):
    """Return all results of an evolution with a seed."""
    return [
        (one.commands, one.genes.tolist(), one.start, one.predicted, one.evolution) for one in saved
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "at"),
    [
        ("plans", [1]),
        ("plans", [4]),
        ("plans", [3, 2]),
        ("plans, robust", [4]),
        ("plans, robust", [7]),
        # New samples are drawn in the first, fourth and seventh robust generation.
        ("plans, robust", [8]),
        ("plans, robust", [10]),
        ("plans, robust", [12]),
        ("plans, robust", [5, 4, 3]),
        ("networks", [1]),
        ("networks", [5]),
        ("networks, robust", [3]),
        ("networks, robust", [9, 2]),
        ("cma", [4]),
        ("own", [5]),
        ("own, robust", [4, 5]),
    ],
)
def test_a_resumed_evolution_ends_as_one_that_was_not_interrupted(tmp_path, interrupting, case, at):
    needs(case)
    whole, out = run(case, tmp_path / "whole"), tmp_path / "out"
    assert not (tmp_path / "whole.checkpoint").exists()
    for time, generation in enumerate(at):
        interrupting(generation)
        so_far = run(case, out, resume=time > 0)
        assert all(one.evolution["interrupted"] for one in so_far)
        history = so_far[0].evolution["history"]
        assert sum(map(len, history.values())) == 2 * sum(at[: time + 1])
        assert read_controller(out).evolution["interrupted"]
        assert (tmp_path / "out.checkpoint").exists()
    interrupting(0)
    resumed = run(case, out, resume=True)
    assert content(resumed) == content(whole)
    assert content([read_controller(out)]) == content([read_controller(tmp_path / "whole")])
    assert not (tmp_path / "out.checkpoint").exists()


@pytest.mark.slow
@pytest.mark.parametrize("case", ["plans", "networks"])
def test_a_checkpoint_is_of_its_settings(tmp_path, interrupting, case):
    simulator, task, _, settings = CASES[case]
    interrupting(2)
    run(case, tmp_path / "out")
    interrupting(0)
    for message, others in {
        "begun with seed = 5, not 6": {"seed": 6},
        "begun with generations = 7, not 8": {"settings": replace(settings, generations=8)},
        "begun with robust = None, not": {"settings": replace(settings, robust=ROBUST)},
    }.items():
        with pytest.raises(UserError, match=message):
            run(case, tmp_path / "out", resume=True, **others)
    another = Plan(slots=5) if case == "plans" else Network(SENSORS, (3,))
    with pytest.raises(UserError, match="begun with controller"):
        evolve(
            simulator(), task, another, out=tmp_path / "out", settings=settings, seed=5, resume=True
        )
    with pytest.raises(UserError, match="continue it"):
        run(case, tmp_path / "out")
    run(case, tmp_path / "out", resume=True)
    with pytest.raises(UserError, match="not empty"):
        run(case, tmp_path / "out", resume=True)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_damaged_checkpoint_is_named(tmp_path, interrupting, case):
    needs(case)
    interrupting(2)
    run(case, tmp_path / "out")
    interrupting(0)
    state = tmp_path / "out.checkpoint" / "state.safetensors"
    whole = state.read_bytes()
    state.write_bytes(whole[:200])
    with pytest.raises(UserError, match=r"state\.safetensors"):
        run(case, tmp_path / "out", resume=True)
    Checkpoint(tmp_path / "out", "evolution").save({"stage0.done": np.zeros(1)})
    with pytest.raises(UserError, match="is not the state of this evolution"):
        run(case, tmp_path / "out", resume=True)
    state.write_bytes(whole)
    assert not run(case, tmp_path / "out", resume=True)[0].evolution["interrupted"]


def test_a_plan_that_gives_no_command_is_not_written(tmp_path, interrupting):
    def empty(message, **others):
        with pytest.raises(UserError, match=message):
            evolve(
                SlippingWheels(),
                NineRectangles(length=0.01, width=0.01),
                Plan(slots=1),
                out=tmp_path / "out",
                settings=replace(PLANS, runs=1),
                progress=False,
                **others,
            )

    interrupting(3)
    empty("no plan has a command yet; continue with --resume")
    interrupting(0)
    empty("use more generations", resume=True)
    assert list(tmp_path.iterdir()) == []


def test_nothing_to_resume_is_said(tmp_path):
    with pytest.raises(UserError, match="no interrupted evolution"):
        run("plans", tmp_path / "out", resume=True)


def test_an_optimiser_that_does_not_keep_to_its_seed_is_not_resumed(
    tmp_path, interrupting, monkeypatch
):
    class Unseeded(HillClimber):
        def __init__(self, space):
            super().__init__(space)
            self.rng = np.random.default_rng()

    monkeypatch.setitem(OPTIMISERS._registered, "own", Unseeded)
    interrupting(3)
    run("own", tmp_path / "out")
    interrupting(0)
    with pytest.raises(UserError, match="asked for other individuals than before"):
        run("own", tmp_path / "out", resume=True)


def test_other_weights_in_the_same_folder_are_not_gone_on_with(tmp_path, interrupting):
    write_simulator(ensemble(), tmp_path / "simulator")

    def begun(**others):
        how = {"settings": PLANS, "progress": False, **others}
        return evolve(
            tmp_path / "simulator", "nine-rectangles", Plan(slots=4), out=tmp_path / "out", **how
        )

    interrupting(3)
    begun()
    interrupting(0)
    weights = tmp_path / "simulator" / "weights.safetensors"
    kept = weights.read_bytes()
    weights.write_bytes(kept[:-1] + bytes([kept[-1] ^ 1]))
    with pytest.raises(UserError, match="was begun with simulator_sha256 = "):
        begun(resume=True)
    weights.write_bytes(kept)
    assert not begun(resume=True)[0].evolution["interrupted"]


@pytest.mark.parametrize("progress", [True, False])
def test_an_estimate_that_takes_long_is_explained(progress, monkeypatch, capsys):
    def slow(*_):
        sleep(0.5)
        return []

    monkeypatch.setattr("neurosim.base.generations.COMPILES_AFTER", 0.01)
    monkeypatch.setattr("neurosim.loop.evolve.Evolution.results", slow)
    simulator, task, controller, settings = CASES["plans"]
    evolve(simulator(), task, controller, settings=settings, progress=progress)
    assert ("in further random samples" in capsys.readouterr().err) == progress
