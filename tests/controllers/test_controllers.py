"""Controllers are written and read; an error names the mistake in a file."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from ideal_simulator import SlippingWheels
from khepera_data import made_up

from neurosim.base.errors import FileError, UserError
from neurosim.controllers import (
    FixedPlan,
    Function,
    Network,
    Plan,
    Recurrent,
    SavedController,
    read_controller,
)
from neurosim.controllers.base import observe
from neurosim.loop.check import check
from neurosim.loop.evaluate import Evaluator
from neurosim.networks.control import POLAR_INPUTS
from neurosim.simulators import TableSimulator
from neurosim.tasks.nine_rectangles import NineRectangles


@pytest.fixture
def plan():
    return SavedController(
        controller=FixedPlan(((50.0, 42.5, 1.25), None, (-10.0, 0.1 + 0.2, 0.5))),
        genes=np.empty(0),
        task={"name": "nine-rectangles", "settings": {"penalty": 32.0}},
        start=(-0.8, 0.0, 1.5707963267948966),
        predicted={
            "poses": [[-0.8, 0.0, 1.57], [-0.7, 0.2, 1.0], [-0.7, 0.1, 0.5]],
            "rest": [-0.7, 0.1, 0.4],
            "fitness": 0.9,
            "completes": False,
        },
        simulator={"path": "simulator", "sha256": "0" * 64},
        evolution={"seed": 1, "history": {"best": [0.5, 0.9]}},
    )


def test_round_trip(plan, tmp_path):
    plan.write(tmp_path / "plan")
    read = read_controller(tmp_path / "plan")
    same(read, plan)
    assert read.given == [(50.0, 42.5, 1.25), (-10.0, 0.1 + 0.2, 0.5)]
    with pytest.raises(UserError, match="not empty"):
        plan.write(tmp_path / "plan")


def same(read, written):
    assert read.controller == written.controller
    assert read.genes.tolist() == written.genes.tolist()
    for name in ("task", "start", "predicted", "simulator", "evolution"):
        assert getattr(read, name) == getattr(written, name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 9}, "field 'version': this neurosim reads version 1, found 9"),
        ({"kind": "oracle"}, "field 'kind': expected one of plan, .*, found 'oracle'"),
        ({"kind": "network"}, "field 'settings': is missing"),
        (
            {"inputs": [{"name": "v"}, {"name": "w"}]},
            "field 'inputs': expected the names of a command, such as left",
        ),
        ({"commands": "none"}, "field 'commands': expected a list"),
        ({"commands": [None, None]}, "gives no command at all"),
        ({"commands": [[1]]}, r"field 'commands\[0\]'"),
        ({"commands": [[1, 2]]}, r"field 'commands\[0\]': expected 3 numbers, found 2"),
        ({"commands": [None, [1, "2", 3]]}, r"field 'commands\[1\]"),
        ({"commands": [[101, 0, 1]]}, "a number from -100 to 100, found 101"),
        ({"commands": [[10, 0, 0]]}, "a number above 0, up to 3,600, found 0"),
        ({"commands": [[10, 0, 1e5]]}, "a number above 0, up to 3,600, found 1"),
        ({"commands": [[10, 0, 1]]}, r"field 'predicted.poses': expected 2 poses"),
        ({"start": [0, 0, True]}, r"field 'start\[2\]': expected a number"),
        ({"task": {}}, r"field 'task\.name'"),
        ({"predicted": {}}, r"field 'predicted\.poses'"),
    ],
)
def test_what_is_wrong_is_named(plan, tmp_path, change, message):
    plan.write(tmp_path / "plan")
    path = tmp_path / "plan" / "controller.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(FileError, match=message):
        read_controller(tmp_path / "plan")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rest": [0, 0]}, r"field 'predicted\.rest'"),
        ({"fitness": "high"}, r"field 'predicted\.fitness': expected a number"),
        ({"completes": 1}, r"field 'predicted\.completes': expected true or false"),
        ({"poses": [[0, 0, 0], [1, 1, None], [0, 0, 0]]}, r"field 'predicted\.poses\[1\]\[2\]'"),
    ],
)
def test_what_is_wrong_with_the_prediction_is_named(plan, tmp_path, change, message):
    plan.write(tmp_path / "plan")
    path = tmp_path / "plan" / "controller.json"
    content = json.loads(path.read_text())
    content["predicted"] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=message):
        read_controller(tmp_path / "plan")


def test_missing_or_cut_short(plan, tmp_path):
    with pytest.raises(FileError, match="no such controller"):
        read_controller(tmp_path / "nowhere")
    plan.write(tmp_path / "plan")
    path = tmp_path / "plan" / "controller.json"
    path.write_text(path.read_text()[:200])
    with pytest.raises(FileError, match="cut short"):
        read_controller(tmp_path / "plan")


SENSORS = tuple(f"sensor_{number}" for number in range(3))
FAMILIES = [
    Network(SENSORS),
    Network((*SENSORS, "x", "time"), (4, 3), scale=60.0),
    Network(("goal_x", "goal_sin"), outputs=("up",), scale=(20.0,)),
    Recurrent(SENSORS, 4),
    Recurrent(SENSORS, 2, "ctrnn", scale=(80.0, 90.0)),
    Plan(slots=3, max_speed=40.0),
]


def saved(family, seed=0):
    genes = family.first(1, torch.Generator().manual_seed(seed))[0].numpy()
    return SavedController(family, genes, {"name": "obstacle-avoidance"}, predicted={"fitness": 1})


@pytest.mark.parametrize("family", FAMILIES[:-1])
def test_networks_survive_the_disk(family, tmp_path):
    saved(family).write(tmp_path / "net")
    read = read_controller(tmp_path / "net")
    same(read, saved(family))
    assert read.kind == family.kind
    assert read.commands == ()
    assert read.given == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": [1]}, "field 'settings': expected an object"),
        ({"settings": {"inputs": []}}, "field 'settings': cannot be used"),
        ({"settings": {"inputs": ["a"], "speed": 1}}, "field 'settings': cannot be used"),
        ({"settings": {"inputs": ["a", "b"]}}, r"weights\.safetensors"),
        ({"kind": "recurrent"}, "field 'settings': cannot be used"),
        ({"inputs": [3]}, r"field 'inputs\[0\]': expected an object"),
        ({"predicted": {"probability": 1.5}}, r"field 'predicted\.probability'"),
    ],
)
def test_what_is_wrong_with_a_network_is_named(tmp_path, change, message):
    saved(Network(SENSORS, (2,))).write(tmp_path / "net")
    path = tmp_path / "net" / "controller.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(FileError, match=message):
        read_controller(tmp_path / "net")


def test_a_function_without_a_name_is_not_written(tmp_path):
    family = Function(lambda seen: (0.0, 0.0))
    with pytest.raises(UserError, match="register its family first"):
        saved(family).write(tmp_path / "rule")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("slots", [(), (None, None)])
@pytest.mark.parametrize("simulator", [SlippingWheels, lambda: TableSimulator(made_up())])
def test_a_plan_that_gives_no_command_stays_where_it_is(slots, simulator, tmp_path):
    task, family = NineRectangles(), FixedPlan(slots)
    for rest, steps in ((0.5, 1), (0.0, 0)):
        commands, active = family.commands(np.empty((2, 0)), rest)
        assert commands.shape == (2, steps, 3)
        assert active.shape == (2, steps)
        assert not active.any()
    plan = SavedController(family, np.empty(0), task.describe(), task.start)
    assert plan.given == []
    evaluator = Evaluator(simulator(), task, family)
    judged, driven = evaluator.judge(np.empty((1, 0)), evaluator.expectation())
    assert driven.poses.shape == (1, 1, 2, 3)
    assert np.isfinite(driven.poses).all()
    assert not judged.success[0, 0]
    checked = check(plan, simulator(), task, draws=20)
    assert (checked.probability, checked.after) == (0.0, (1,))
    with pytest.raises(UserError, match="without any command cannot be written"):
        plan.write(tmp_path / "plan")


@pytest.mark.parametrize("kind", [Network, Recurrent])
def test_a_scale_is_of_every_output(kind):
    with pytest.raises(UserError, match="scale has 3 numbers for the 2 outputs left, right"):
        kind(("a", "b"), scale=(100.0, 50.0, 20.0))


def test_a_network_without_hidden_units_by_hand():
    family = Network(("a", "b"), scale=(100.0, 50.0))
    genes = torch.tensor([[1.0, -2.0, 0.5, 0.0, 1.0, 0.0]], dtype=torch.float64)
    seen = torch.tensor([[0.25, 0.5]], dtype=torch.float64)
    command, _ = family.act(genes, seen, family.start(1))
    expected = [100 * np.tanh(0.25 - 1.0 + 0.5), 50 * np.tanh(0.5)]
    assert command[0].tolist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("pose", "goal", "polar"),
    [
        # Ahead to the left, with a final heading of half a turn.
        ((0.0, 0.0, 0.0), (1.0, 1.0, math.pi), (2**0.5, math.pi / 4, 3 * math.pi / 4)),
        # Behind to the left: a turn to the right puts it straight behind.
        ((0.0, 0.0, 0.0), (-1.0, 1.0, 0.0), (-(2**0.5), -math.pi / 4, math.pi / 4)),
        # Straight behind in another frame, with the same heading plus whole turns.
        ((2.0, 1.0, math.pi / 2), (2.0, 0.7, 4.5 * math.pi), (-0.3, 0.0, 0.0)),
        ((2.0, 1.0, 1.0), (2.0, 1.0, 1.5), (0.0, 0.0, 0.5)),
    ],
)
def test_goals_in_polar_coordinates_by_hand(pose, goal, polar):
    rows = [torch.tensor([one], dtype=torch.float64) for one in (pose, goal)]
    seen = observe(POLAR_INPUTS, None, (), *rows, 0.0)
    assert seen[0].tolist() == pytest.approx(polar, abs=1e-12)


@pytest.mark.parametrize("dynamics", ["elman", "ctrnn"])
def test_recurrent_networks_by_hand(dynamics):
    family = Recurrent(("a",), 1, dynamics, outputs=("up",), scale=10.0)
    own = [0.7] if dynamics == "ctrnn" else []
    genes = torch.tensor([[*own, 2.0, -1.5, 0.3, 1.2, -0.4]], dtype=torch.float64)
    memory, state = family.start(1), 0.0
    fraction = 1 / (1 + np.exp(0.7)) if own else 1.0
    for seen in (0.5, -0.25, 1.0):
        row = torch.tensor([[seen]], dtype=torch.float64)
        command, memory = family.act(genes, row, memory)
        state += fraction * (2.0 * seen - 1.5 * np.tanh(state) + 0.3 - state)
        assert memory.item() == pytest.approx(state)
        assert command.item() == pytest.approx(10 * np.tanh(1.2 * np.tanh(state) - 0.4))


@pytest.mark.parametrize("family", FAMILIES)
def test_settings_make_the_same_family_again(family):
    settings = json.loads(json.dumps(family.settings()))
    again = type(family)(**settings)
    assert again.genes == family.genes
    assert json.loads(json.dumps(asdict(again))) == json.loads(json.dumps(asdict(family)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Network(()), "needs inputs"),
        (lambda: Network(("a",), (0,)), r"hidden\[0\]: .* from 1 to 4,096, found 0"),
        (lambda: Recurrent(("a",), 0), "units: .* from 1 to 4,096, found 0"),
        (lambda: Recurrent(("a",), 2, "spiking"), "'elman', 'ctrnn', found 'spiking'"),
    ],
)
def test_networks_that_cannot_be_are_refused(make, message):
    with pytest.raises(UserError, match=message):
        make()


def test_a_plan_is_the_genes_that_it_is_encoded_in():
    family = Plan(slots=3)
    commands = ((50.0, -25.0, 1.25), None, (0.0, 10.0, 3.0))
    result, active = family.commands(family.encode(commands)[None], 0.5)
    assert active[0].tolist() == [True, False, True, False]
    assert result[0, [0, 2]].tolist() == [list(commands[0]), list(commands[2])]
    assert result[0, 3].tolist() == [0.0, 0.0, 0.5]


CAR = {"names": ("speed", "steer"), "units": ("m/s", "rad"), "limits": ((-0.1, 0.3), (-0.4, 0.4))}


def test_a_plan_of_a_car_has_its_numbers_and_holds_its_steering_when_it_stops(tmp_path):
    family = Plan(slots=3, **CAR)
    assert family.outputs == ("speed", "steer", "duration")
    commands = ((0.3, -0.4, 1.25), (-0.0512, 0.1234, 3.0), None)
    genes = family.encode(commands)
    result, active = family.commands(genes[None], 0.5)
    assert active[0].tolist() == [True, True, False, False]
    assert result[0, :2].tolist() == [pytest.approx(one) for one in commands[:2]]
    assert result[0, 3].tolist() == [0.0, 0.1234, 0.5]
    extremes = family.commands(np.random.default_rng(1).integers(0, 2, (50, 12)) * 1.0, 0.0)[0]
    assert np.unique(extremes[..., 0]).tolist() == [-0.1, 0.3]
    nothing = family.commands(family.encode([None] * 3)[None], 0.5)[0]
    assert nothing[0, 3].tolist() == [0.0, 0.0, 0.5]
    predicted = {
        "poses": [[0.0] * 3] * 3, "rest": [0.0] * 3, "fitness": 1.0, "completes": False,
    }  # fmt: skip
    saved = SavedController.of(family, genes, {"name": "go-to", "settings": {}}, (0, 0, 0))
    replace(saved, predicted=predicted).write(tmp_path / "plan")
    content = json.loads((tmp_path / "plan" / "controller.json").read_text())
    assert [tuple(one.values()) for one in content["inputs"]] == [
        ("speed", "m/s"), ("steer", "rad"), ("duration", "s"),
    ]  # fmt: skip
    read = read_controller(tmp_path / "plan")
    assert read.controller == saved.controller
    assert (read.controller.names, read.controller.units) == (CAR["names"], CAR["units"])
    content["commands"][1] = [0.1, 3.0]
    (tmp_path / "plan" / "controller.json").write_text(json.dumps(content))
    with pytest.raises(FileError, match=r"'commands\[1\]': expected 3 numbers, found 2"):
        read_controller(tmp_path / "plan")
    with pytest.raises(UserError, match=r"the least steer, 0\.4, is above the most, -0\.4"):
        Plan(**{**CAR, "limits": ((0.0, 1.0), (0.4, -0.4))})
    with pytest.raises(UserError, match=r"2 numbers \(speed, steer\): give a unit and limits"):
        Plan(**{**CAR, "limits": ((0.0, 1.0),)})
