import json
import sys
from itertools import pairwise

import numpy as np
import pytest
import torch

from neurosim.base import files
from neurosim.base.errors import UserError
from neurosim.simulators import read_simulator
from neurosim.training import evaluate, train
from neurosim.training.evaluate import PAPER, errors, predict
from neurosim.training.trainers.registry import trainer_class
from tracking.datasets.dataset import Dataset

QUICK = {
    "trainer": "ga",
    "hidden": (3, 2),
    "generations": 5,
    "progress": False,
    "population": 20,
    "tournament": 4,
}
QUICK_ENSEMBLE = {
    "trainer": "combined",
    "members": 3,
    "progress": False,
    "centres": 20,
}
QUICK_OF = {"ga": QUICK, "combined": QUICK_ENSEMBLE}


def outcome(folder):
    """All files of a training, without the seconds that it took."""
    described = json.loads((folder / "simulator.json").read_text())
    described.pop("wall_clock")
    return described, (folder / "weights.safetensors").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "better"),
    [
        ({"trainer": "ga", "generations": 100}, 2.0),
        pytest.param({"members": 1}, 8.0, marks=pytest.mark.slow),
    ],
)
def test_training_learns_far_more_than_the_mean(tmp_path, dataset, settings, better):
    simulator = train(dataset, tmp_path / "s", progress=False, **settings)
    earlier, later = Dataset.read(dataset).split(0.2)
    actual = later.output_array()
    of_the_mean = errors(earlier.output_array().mean(0) + 0 * actual, actual)
    for name, value in simulator.meta["test_errors"].items():
        limit = 1.1 if "trainer" in settings and name == "dy" else better
        assert value["mean_absolute_error"] < of_the_mean[name]["mean_absolute_error"] / limit
        assert value["mse"] < of_the_mean[name]["mse"]


def test_the_simulator_says_where_it_came_from(tmp_path, dataset):
    out = tmp_path / "s"
    simulator = train(dataset, out, seed=3, **QUICK | {"generations": 30})
    read = read_simulator(out)
    rows = Dataset.read(dataset)
    assert (predict(read, rows) == predict(simulator, rows)).all()
    assert read.meta["source"]["sha256"] == files.sha256(dataset / "dataset.csv")
    training = read.meta["training"]
    assert (training["seed"], training["trainer"], training["rows"]) == (3, "ga", 320)
    assert training["population"] == 20
    history = read.meta["history"]
    assert [entry["generation"] for entry in history] == list(range(1, 31))
    for before, after in pairwise(history):
        assert all(b >= a for b, a in zip(before["mse"], after["mse"], strict=True))
    # The last training error is that of the simulator itself, to single precision.
    earlier, _ = rows.split(0.2)
    residual = predict(read, earlier) - earlier.output_array()
    assert (residual**2).mean(0).tolist() == pytest.approx(history[-1]["mse"], rel=1e-3)


@pytest.mark.parametrize("trainer", ["ga", "combined"])
@pytest.mark.slow
def test_the_held_out_rows_change_nothing(tmp_path, robot_data, make_dataset, trainer):
    inputs, outputs = robot_data(100, 5)
    weights = []
    for name in "ab":
        make_dataset(inputs, outputs).write(tmp_path / name)
        train(tmp_path / name, tmp_path / f"s{name}", **QUICK_OF[trainer])
        weights.append((tmp_path / f"s{name}" / "weights.safetensors").read_bytes())
        inputs[80:, :4] *= 10
        outputs[80:] *= -7
    assert weights[0] == weights[1]


def test_the_same_seed_gives_the_same_simulator_and_another_one_another(tmp_path, dataset):
    made = {}
    for name, seed in {"a": 1, "b": 1, "c": 2}.items():
        train(dataset, tmp_path / name, seed=seed, **QUICK)
        made[name] = outcome(tmp_path / name)
    assert made["a"] == made["b"]
    assert made["a"][1] != made["c"][1]


@pytest.mark.slow
def test_the_device_is_the_one_that_computed(tmp_path, dataset, monkeypatch):
    module = sys.modules[train.__module__]
    monkeypatch.setattr(module, "check_device", lambda device: None)
    wanted = train(dataset, tmp_path / "s", device="cuda", **QUICK_ENSEMBLE)
    assert wanted.meta["training"]["device"] == "cpu"


def test_an_interrupted_training_leaves_nothing(tmp_path, dataset, monkeypatch):
    def pulled(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(trainer_class("ga"), "advance", pulled)
    with pytest.raises(KeyboardInterrupt):
        train(dataset, tmp_path / "s", **QUICK)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.slow
def test_what_cannot_be_is_refused_before_anything_is_written(
    tmp_path, dataset, robot_data, make_dataset
):
    make_dataset(*robot_data(19, 2)).write(tmp_path / "few")
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "thesis.txt").write_text("do not lose")
    out = tmp_path / "s"
    for says, arguments, options in [
        ("19 different rows", (tmp_path / "few", out), {}),
        ("not empty", (dataset, taken), {}),
        ("no trainer 'oracle'", (dataset, out), {"trainer": "oracle"}),
        ("no setting 'warp'", (dataset, out), {"warp": 9}),
        ("most_parts: expected a whole number from 1", (dataset, out), {"most_parts": 0}),
        ("centres: expected a whole number from 1", (dataset, out), {"centres": 0}),
        ("members: expected a whole number from 1", (dataset, out), {"members": 0}),
        ("no device 'abacus'", (dataset, out), {"device": "abacus"}),
        ("no such dataset", (tmp_path / "nowhere", out), {}),
    ]:
        with pytest.raises(UserError, match=says):
            train(*arguments, progress=False, **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["few", "taken"]


@pytest.mark.slow
def test_a_robot_that_never_moved_can_be_learned(tmp_path, robot_data, make_dataset):
    inputs, outputs = robot_data(30, 4)
    inputs[:, :4] = 0
    make_dataset(inputs, 0 * outputs).write(tmp_path / "d")
    simulator = train(tmp_path / "d", tmp_path / "s", **QUICK_ENSEMBLE)
    for value in simulator.meta["test_errors"].values():
        assert value["mean_absolute_error"] < 1e-3


def test_table_2_is_the_papers(tmp_path, dataset):
    train(dataset, tmp_path / "s", **QUICK)
    table = evaluate(tmp_path / "s", dataset)
    assert table["paper"]["dtheta"] == {"mse": 26.412, "mean_absolute_error": 3.585, "unit": "deg"}
    assert (table["paper"]["dx"]["mse"], table["paper"]["dy"]["mse"]) == (12.909, 18.559)
    assert set(PAPER) == set(table["errors"])


@pytest.fixture
def threads():
    """A function that sets the number of PyTorch's threads, until the test is over."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.slow
def test_a_simulator_of_many_rows_is_the_same_on_any_number_of_cores(
    tmp_path, threads, robot_data, make_dataset
):
    # PyTorch divides products over this many rows among its threads.
    make_dataset(*robot_data(1300, 1)).write(tmp_path / "data")
    for count in (1, 2):
        threads(count)
        train(tmp_path / "data", tmp_path / str(count), seed=1, **QUICK_ENSEMBLE)
    assert outcome(tmp_path / "1") == outcome(tmp_path / "2")


@pytest.mark.parametrize("distance", ["each three times in a row", "all three times"])
@pytest.mark.slow
def test_copies_of_rows_change_nothing_and_are_counted(tmp_path, dataset, distance):
    """They would be in both parts of every split: in the folds, and held out."""
    whole = Dataset.read(dataset).part(slice(0, 150))
    rows = np.repeat(np.arange(len(whole)), 3)
    if distance == "all three times":
        rows = np.tile(np.arange(len(whole)), 3)
    table = whole.table.iloc[rows].reset_index(drop=True)
    meta = {**whole.meta, "rows": len(table), "within": 0}
    Dataset(table, whole.inputs, whole.outputs, meta).write(tmp_path / "copied")
    plain = Dataset(whole.table, whole.inputs, whole.outputs, {**whole.meta, "within": 0})
    plain.write(tmp_path / "plain")
    by_name = {
        name: train(tmp_path / name, tmp_path / f"of-{name}", **QUICK_ENSEMBLE)
        for name in ("plain", "copied")
    }
    repeated = [one.meta["training"].pop("repeated_rows") for one in by_name.values()]
    assert repeated == [0, 2 * len(whole)]
    assert torch.equal(by_name["plain"].genes, by_name["copied"].genes)
    for name in ("training", "test_errors", "test_coverage"):
        assert by_name["plain"].meta[name] == by_name["copied"].meta[name]
    again = [evaluate(tmp_path / f"of-{name}", tmp_path / name) for name in by_name]
    assert again[0] == again[1]
