"""Training says where there were rows."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neurosim.base import se2
from neurosim.simulators import read_simulator
from neurosim.training.train import HELD_OUT, domain_of, learn, train, training_data
from tracking.datasets.dataset import Dataset

REFERENCE = Path(__file__).resolve().parents[2] / "data" / "reference"


QUICK = {"ga": {"generations": 2}, "combined": {"members": 1, "noise": False}}


@pytest.mark.parametrize("trainer", QUICK)
@pytest.mark.slow
def test_every_trainer_says_where_there_were_rows(tmp_path, dataset, trainer):
    out = tmp_path / "s"
    train(dataset, out, trainer=trainer, progress=False, **QUICK[trainer])
    earlier, _ = Dataset.read(dataset).split(HELD_OUT)
    content, messages = (
        read_simulator(out),
        json.loads((out / "simulator.json").read_text())["domain"],
    )
    names = list(content.command_names)
    inputs = earlier.input_array()[:, [content.input_names.index(name) for name in names]]
    assert messages["rows"] == len(earlier)
    assert messages["commands"]["left"] == [inputs[:, 0].min(), inputs[:, 0].max()]
    assert content.knows_gaps
    assert content.supported(inputs).mean() > 0.95


@pytest.mark.slow
def test_no_member_runs_off_where_rows_were_few():
    """Wherever 40 rows support commands, six in a row, eight members stay near each other.

    The farthest of 24,000 commands depends on the seed, and on how a processor rounds; the median
    of five simulators does not. The farthest of more members is farther off by chance.
    """
    data = training_data(Dataset.read(REFERENCE)).part(slice(1000, 1040))
    apart = np.median([farthest_members(data, seed) for seed in range(1, 6)], axis=0)
    assert (apart < [0.12, 0.12, np.radians(45.0)]).all()


def farthest_members(data, seed):
    """Return how far members are from their median, m, m, rad: the farthest of six commands."""
    simulator = learn(data, seed, members=8)
    simulator.known = domain_of(simulator, data, None)
    rng, rows = np.random.default_rng(0), 4000
    low, high = np.array(list(simulator.domain.values())).T
    random = rng.uniform(low, high, (20 * rows, 3))
    random = random[simulator.supported(random)][: 6 * rows]
    every = torch.arange(simulator.members).repeat_interleave(rows)
    start = torch.zeros(len(every), 3, dtype=torch.float64)
    state, stepper = simulator.start_as(start, every).numpy(), simulator.stepper()
    apart = np.zeros(3)
    for command in random.reshape(6, rows, 3):
        before = state
        state = stepper.step(before, np.tile(command, (simulator.members, 1)), None)
        distance = se2.between(before[:, :3], state[:, :3]).reshape(-1, rows, 3)
        off = np.abs(distance - np.median(distance, axis=0)).max(axis=(0, 1))
        apart = np.maximum(apart, off)
    return apart
