"""Plans survive the disk, and what is wrong with a file is named."""

import json

import pytest

from neurosim.base.errors import FileError, UserError
from neurosim.controllers import Plan


@pytest.fixture
def plan():
    return Plan(
        commands=((50.0, 42.5, 1.25), None, (-10.0, 0.1 + 0.2, 0.5)),
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
    read = Plan.read(tmp_path / "plan")
    assert read == plan
    assert read.given == [(50.0, 42.5, 1.25), (-10.0, 0.1 + 0.2, 0.5)]
    with pytest.raises(UserError, match="not empty"):
        plan.write(tmp_path / "plan")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 9}, "field 'version': this neurosim reads version 1, found 9"),
        ({"kind": "network"}, "field 'kind': expected 'plan', found 'network'"),
        ({"inputs": [{"name": "v"}]}, "field 'inputs': expected the names left, right, duration"),
        ({"commands": "none"}, "field 'commands': expected list"),
        ({"commands": [None, None]}, "gives no command at all"),
        ({"commands": [[1, 2]]}, r"field 'commands\[0\]': expected three numbers"),
        ({"commands": [None, [1, "2", 3]]}, r"field 'commands\[1\]': expected three numbers"),
        ({"commands": [[101, 0, 1]]}, "expected speeds in -100 to 100 %"),
        ({"commands": [[10, 0, 0]]}, "a duration above 0 s"),
        ({"commands": [[10, 0, 1]]}, r"field 'predicted.poses': expected 2 poses"),
        ({"start": [0, 0, True]}, "field 'start': expected three numbers"),
        ({"task": {}}, r"field 'task\.name'"),
        ({"predicted": {}}, r"field 'predicted\.poses'"),
    ],
)
def test_what_is_wrong_is_named(plan, tmp_path, change, message):
    plan.write(tmp_path / "plan")
    path = tmp_path / "plan" / "controller.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(FileError, match=message):
        Plan.read(tmp_path / "plan")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rest": [0, 0]}, r"field 'predicted\.rest'"),
        ({"fitness": "high"}, r"field 'predicted\.fitness': expected a number"),
        ({"completes": 1}, r"field 'predicted\.completes': expected true or false"),
        ({"poses": [[0, 0, 0], [1, 1, None], [0, 0, 0]]}, r"field 'predicted\.poses\[1\]'"),
    ],
)
def test_what_is_wrong_with_the_prediction_is_named(plan, tmp_path, change, message):
    plan.write(tmp_path / "plan")
    path = tmp_path / "plan" / "controller.json"
    content = json.loads(path.read_text())
    content["predicted"] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=message):
        Plan.read(tmp_path / "plan")


def test_missing_or_cut_short(plan, tmp_path):
    with pytest.raises(FileError, match="no such controller"):
        Plan.read(tmp_path / "nowhere")
    plan.write(tmp_path / "plan")
    path = tmp_path / "plan" / "controller.json"
    path.write_text(path.read_text()[:200])
    with pytest.raises(FileError, match="cut short"):
        Plan.read(tmp_path / "plan")
