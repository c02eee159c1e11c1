"""Sensors learned from computed readings: their positions, their maps, and their accuracy."""

import numpy as np
import pandas as pd
import pytest
import torch

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.cli.train import _sensors_in_words
from neurosim.training.sensors import learn_sensors
from tracking.datasets.readings import PLACE

LEFT, RIGHT = np.array([0.06, 0.03]), np.array([0.06, -0.03])


def board(places):
    """A dark ring of 6 cm around the middle of a bright board, with soft edges."""
    away = np.abs(np.hypot(places[..., 0], places[..., 1]) - 0.25)
    return 0.6 - 0.3 / (1 + np.exp((away - 0.03) / 0.005))


def readings(count=3000, seed=0, noise=0.01, after=0.06, mounts=(LEFT, RIGHT)):
    """A robot that wanders over the board; each sensor is read some time after the scan began."""
    rng = np.random.default_rng(seed)
    speed = np.array([0.3, 0.0, 2.0]) * rng.uniform([-1, 0, -1], 1, (count, 3))
    pose = np.concatenate([rng.uniform(-0.35, 0.35, (count, 2)), rng.uniform(-9, 9, (count, 1))], 1)
    motion = speed.copy()
    motion[:, 0], motion[:, 1] = (
        speed[:, 0] * np.cos(pose[:, 2]),
        speed[:, 0] * np.sin(pose[:, 2]),
    )
    table = pd.DataFrame(np.concatenate([pose, motion], axis=1), columns=list(PLACE))
    table.insert(0, "time", 0.1 * np.arange(count))
    table.insert(0, "recording", "r")
    for number, mount in enumerate(mounts):
        then = se2.compose(pose + after * motion, np.array([*mount, 0.0]))
        seen = board(then[:, :2]) + noise * rng.standard_normal(count)
        table[f"eye_{number}"] = np.clip(seen, 0, 1)
    return table


@pytest.mark.slow
def test_mounting_map_and_noise_are_found():
    sensors, about = learn_sensors(readings(), progress=False)
    assert sensors.names == ("eye_0", "eye_1")
    np.testing.assert_allclose(sensors.mount, [LEFT, RIGHT], atol=0.003)
    assert [one["after"] for one in about["sensors"]] == pytest.approx([0.06, 0.06], abs=0.02)
    assert sensors.place.tolist() == [0, 0]  # both see the same board
    # Where the robot was, the maps agree with the board.
    poses = np.random.default_rng(9).uniform(-0.3, 0.3, (500, 3))
    read = sensors.read(torch.from_numpy(poses)).numpy()
    for number, mount in enumerate((LEFT, RIGHT)):
        wanted = board(se2.compose(poses, np.array([*mount, 0.0]))[:, :2])
        assert np.sqrt(np.mean((read[:, number] - wanted) ** 2)) < 0.03
    assert sensors.noise[:, 0].numpy() == pytest.approx([0.01, 0.01], rel=0.35)
    for one in about["sensors"]:
        assert one["rms_error"] < 0.4 * one["rms"]
    assert about["rows"] == 3000
    assert about["held_out"] == 600


@pytest.mark.slow
def test_the_same_readings_give_the_same_sensors():
    first, again = (learn_sensors(readings(600), progress=False)[0] for _ in range(2))
    assert torch.equal(first.maps, again.maps)
    assert torch.equal(first.mount, again.mount)


@pytest.mark.slow
def test_what_does_not_follow_from_the_place_is_noise():
    table = readings(800, mounts=(LEFT,))
    rng = np.random.default_rng(1)
    table["whim"] = rng.uniform(0.2, 0.8, len(table))
    table["still"] = 0.5
    table["far"] = 0.001 * rng.uniform(size=len(table))  # a proximity sensor with nothing near
    sensors, about = learn_sensors(table, progress=False)
    whim, still = sensors.maps[sensors.place[1]], sensors.maps[sensors.place[2]]
    assert whim.std() < 0.02
    assert still.numpy() == pytest.approx(0.5)
    assert sensors.noise[1, 0] == pytest.approx(0.22, abs=0.05)
    assert sensors.noise[2].tolist() == [0.0, 0.0]
    assert sensors.mount[3].tolist() == [0.0, 0.0]
    assert sensors.maps[sensors.place[3]].numpy() == pytest.approx(0.0005, abs=1e-4)
    assert [one["flat"] for one in about["sensors"]] == [False, False, True, True]
    assert "far saw nothing on the board.\n" in _sensors_in_words(about)
    assert "eye_0, 5.9 cm ahead and 3.0 cm to the left" in _sensors_in_words(about)
    assert about["sensors"][1]["rms_error"] == pytest.approx(0.173, abs=0.02)


def test_too_few_readings_and_taken_names_are_refused():
    with pytest.raises(UserError, match="40 readings are too few"):
        learn_sensors(readings(40), progress=False)
    with pytest.raises(UserError, match="cannot be called goal_x"):
        learn_sensors(readings(100).rename(columns={"eye_0": "goal_x"}), progress=False)
