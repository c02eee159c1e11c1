"""Training says where there were rows."""

import json

import pytest

from neurosim.simulators import read_simulator
from neurosim.training.train import HELD_OUT, train
from tracking.datasets.dataset import Dataset


@pytest.mark.parametrize("trainer", ["ga", "gradient", "combined"])
def test_every_trainer_says_where_there_were_rows(tmp_path, dataset, trainer):
    out = tmp_path / "s"
    train(dataset, out, trainer=trainer, members=1, noise=False, generations=2, progress=False)
    earlier, _ = Dataset.read(dataset).split(HELD_OUT)
    found, said = read_simulator(out), json.loads((out / "simulator.json").read_text())["domain"]
    names = list(found.command_names)
    inputs = earlier.input_array()[:, [found.input_names.index(name) for name in names]]
    assert said["rows"] == len(earlier)
    assert said["commands"]["left"] == [inputs[:, 0].min(), inputs[:, 0].max()]
    assert found.knows_gaps
    assert found.supported(inputs).mean() > 0.95
