"""Readings of sensors, joined with tracked poses."""

from types import SimpleNamespace

import numpy as np

from tracking.datasets.readings import readings_of
from tracking.datasets.recordings import Observations, Poses


def recording(times, values):
    """Return a recording of a robot that drives 10 cm/s ahead, read at ``times``."""
    seen = np.arange(0.0, 3.0, 1 / 30)
    ones, count = np.ones(len(seen), int), len(times)
    pose = np.stack([0.1 * seen, 0.0 * seen, 0.0 * seen], axis=1)
    poses = Poses(ones, np.arange(len(seen)), seen, pose, ones.astype(float))
    nowhere = np.full((count, 3), np.nan)
    looks = Observations(
        np.ones(count, int), np.zeros(count, int), times, nowhere, ("line_left",), values[:, None]
    )
    return SimpleNamespace(observations=lambda: looks, poses=lambda: poses)


def test_what_is_only_read_again_counts_once():
    """Measured ten times a second, read 250 times: each change counts when it was first seen."""
    times = np.arange(0.5, 2.5, 0.004)
    kept = readings_of(recording(times, np.floor(times * 10 + 1e-9) / 100), "r")
    changes = np.round(np.arange(0.5, 2.5, 0.1), 6)
    assert len(kept) == len(changes)
    np.testing.assert_allclose(kept["time"], changes, atol=0.0041)
    np.testing.assert_allclose(kept["x"], 0.1 * kept["time"], atol=1e-6)


def test_a_sensor_that_always_reads_the_same_is_kept_ten_times_a_second():
    kept = readings_of(recording(np.arange(0.5, 2.5, 0.004), np.full(500, 0.25)), "r")
    assert 20 <= len(kept) <= 21


def test_every_reading_of_a_slow_link_counts():
    times = np.arange(0.5, 2.5, 0.03)
    assert len(readings_of(recording(times, np.full(len(times), 0.25)), "r")) == len(times)
