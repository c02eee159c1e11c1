"""A small sensor table, made up for tests."""

import numpy as np

from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable

#: Where the made-up sensors look, rad, to the left.
BEARINGS = np.radians([70.0, 45.0, 10.0, -10.0, -45.0, -70.0, -170.0, 170.0])


def made_up(repeats: int = 1, noise: float = 0.0, *, ambient: float = 0.02) -> SensorTable:
    """Return a table of 36 angles and 10 distances, 5 to 50 mm; walls twice as bright."""
    rng = np.random.default_rng(0)
    bearing = -2 * np.pi * np.arange(36) / 36
    distance = 0.005 + 0.005 * np.arange(10)
    looks = np.maximum(np.cos(bearing[:, None] - BEARINGS), 0) ** 4
    dims = np.exp(-((distance - 0.005) / 0.012))
    samples = {}
    for name, brightness in (("wall", 0.8), ("cylinder", 0.4)):
        mean = ambient + brightness * dims[:, None, None] * looks
        samples[name] = [
            Samples(np.clip(mean + noise * rng.standard_normal(mean.shape), 0, 1), 0.005, 0.005)
            for _ in range(repeats)
        ]
    return SensorTable.from_samples(samples)
