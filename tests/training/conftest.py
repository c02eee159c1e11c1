"""Recordings of a synthetic robot, and datasets of them."""

import pytest
import torch
from synthetic_robot import synthetic

from tracking.datasets.dataset import MOTOR_INPUTS, make

torch.set_num_threads(1)  # tensors are small here; a second thread only waits


def dataset_of(inputs, outputs, names=MOTOR_INPUTS):
    """A dataset of these rows."""
    columns = (*names, "dx", "dy", "dtheta")
    rows = [
        {"recording": "r", "command": n, "quality": 1.0}
        | dict(zip(columns, map(float, (*i, *o)), strict=True))
        for n, (i, o) in enumerate(zip(inputs, outputs, strict=True))
    ]
    return make(rows, names, sources=[], left_out={}, settings={})


@pytest.fixture(scope="session")
def robot_data():
    """A function (count, seed) -> inputs (N, 5), outputs (N, 3) of the synthetic robot."""
    return synthetic


@pytest.fixture(scope="session")
def make_dataset():
    """A function (inputs, outputs[, names with units]) -> Dataset."""
    return dataset_of


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """A dataset folder of 400 commands of the synthetic robot."""
    folder = tmp_path_factory.mktemp("data") / "dataset"
    dataset_of(*synthetic(400, 1)).write(folder)
    return folder
