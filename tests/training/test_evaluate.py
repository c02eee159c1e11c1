import json

import numpy as np
import pytest
import torch

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.training import evaluate, train
from neurosim.training.base import TrainingData, root_mean_square
from neurosim.training.evaluate import Compared, errors
from neurosim.training.unicycle import unicycle

QUICK = {
    "trainer": "ga",
    "hidden": (3, 2),
    "progress": False,
    "population": 20,
    "tournament": 4,
}
VELOCITIES = {"prev_v": "m/s", "prev_w": "rad/s", "v": "m/s", "w": "rad/s", "duration": "s"}


def test_errors_worked_by_hand():
    actual = np.zeros((2, 3))
    predicted = np.array([[0.01, -0.02, np.pi / 180], [0.03, 0.0, -np.pi / 60]])
    table = errors(predicted, actual)
    assert table["dx"]["mse"] == pytest.approx((1 + 9) / 2)
    assert table["dx"]["mean_absolute_error"] == pytest.approx(2.0)
    assert table["dy"]["mse"] == pytest.approx(2.0)
    assert table["dtheta"]["mse"] == pytest.approx((1 + 9) / 2)
    assert table["dtheta"]["mean_absolute_error"] == pytest.approx(2.0)
    assert [table[name]["unit"] for name in table] == ["cm", "cm", "deg"]


def test_how_much_of_the_motion_is_explained_worked_by_hand():
    actual = np.array([[0.1, 0.0, 1.0], [0.3, 0.0, -1.0]])
    predicted = np.array([[0.1, 0.0, 1.0], [0.2, 0.001, 3.0]])
    explained = Compared(predicted, actual, None, None, None).explained()
    assert explained["dx"] == pytest.approx(1.0 - 0.005 / 0.01)
    assert explained["dtheta"] == pytest.approx(1.0 - 8.0 / 1.0)
    assert explained["dy"] == pytest.approx(1.0 - 5e-7 / 1e-6)  # it did not move


def test_only_held_out_rows_of_ones_own_dataset_and_all_of_another(
    tmp_path, dataset, robot_data, make_dataset
):
    train(dataset, tmp_path / "s", generations=3, **QUICK)
    own = evaluate(tmp_path / "s", dataset)
    described = json.loads((tmp_path / "s" / "simulator.json").read_text())
    assert (own["rows"], own["held_out"]) == (80, True)
    assert own["errors"] == described["test_errors"]
    everything = evaluate(tmp_path / "s", dataset, held_out_only=False)
    assert (everything["rows"], everything["held_out"]) == (400, False)
    make_dataset(*robot_data(50, 8)).write(tmp_path / "other")
    other = evaluate(tmp_path / "s", tmp_path / "other")
    assert (other["rows"], other["held_out"]) == (50, False)
    assert "another dataset" in other["which"]


def velocities(rng, count):
    inputs = rng.uniform(-0.5, 0.5, (count, 5))
    inputs[:, 3] *= 8
    inputs[:, 4] += 1.5
    v, w, t = inputs[:, 2:].T
    return inputs, se2.exp(np.stack([v * t, 0 * v, w * t], axis=-1))


def test_the_ideal_unicycle_stands_beside_a_simulator_of_velocities(tmp_path, make_dataset):
    inputs, outputs = velocities(np.random.default_rng(0), 60)
    outputs[:, 0] += 0.02
    make_dataset(inputs, outputs, VELOCITIES).write(tmp_path / "d")
    train(tmp_path / "d", tmp_path / "s", generations=3, **QUICK)
    table = evaluate(tmp_path / "s", tmp_path / "d")
    baseline = table["baseline"]
    assert baseline["description"] == "ideal unicycle"
    result = [baseline["errors"][name]["mean_absolute_error"] for name in ("dx", "dy", "dtheta")]
    assert result == pytest.approx([2.0, 0.0, 0.0], abs=1e-9)


def test_a_dataset_of_another_robot_is_refused(tmp_path, dataset, make_dataset):
    train(dataset, tmp_path / "s", generations=2, **QUICK)
    make_dataset(*velocities(np.random.default_rng(0), 30), VELOCITIES).write(tmp_path / "d")
    with pytest.raises(UserError, match="prev_v, prev_w"):
        evaluate(tmp_path / "s", tmp_path / "d")


def test_the_fitted_drive_finds_the_factors_of_an_ideal_robot(make_dataset):
    rng = np.random.default_rng(1)
    inputs = rng.uniform(-50, 50, (40, 5))
    inputs[:, 4] = rng.uniform(0.5, 3, 40)
    left, right, t = inputs[:, 2:].T
    # 0.5 m/s at 100 %, 0.13 m between the wheels: turns of more than a whole one occur.
    v, w = 0.005 * (left + right) / 2, 0.005 * (right - left) / 0.13
    outputs = se2.exp(np.stack([v * t, 0 * t, w * t], axis=-1))
    drive = unicycle(make_dataset(inputs, outputs))
    assert drive.forward == pytest.approx(0.005)
    assert drive.turning == pytest.approx(0.005 / 0.13)
    np.testing.assert_allclose(drive.displacement(inputs), outputs, atol=1e-12)


def test_velocities_in_other_units_are_fitted(make_dataset):
    inputs, outputs = velocities(np.random.default_rng(2), 50)
    names = dict(VELOCITIES, prev_v="cm/s", v="cm/s")
    scaled = inputs * np.where([name.endswith("v") for name in names], 100.0, 1.0)
    drive = unicycle(make_dataset(scaled, outputs, names))
    assert drive.description == "ideal unicycle, two factors fitted"
    assert (drive.forward, drive.turning) == pytest.approx((0.01, 1.0))
    np.testing.assert_allclose(drive.displacement(scaled), outputs, atol=1e-12)


def test_no_unicycle_for_a_robot_without_wheels(make_dataset):
    names = {"prev_gait": "", "gait": "", "duration": "s"}
    rows = make_dataset(np.ones((5, 3)), np.zeros((5, 3)), names)
    assert unicycle(rows) is None


def test_scales():
    assert root_mean_square(torch.tensor([[3.0, 0.0], [-4.0, 0.0]])).tolist() == pytest.approx(
        [12.5**0.5, 1.0]
    )
    data = TrainingData([], torch.tensor([[-50.0, 0.0], [20.0, 0.0]]), torch.zeros(2, 3))
    assert data.input_scale.tolist() == [50.0, 1.0]
    assert data.scaled_inputs.abs().max() == 1.0
