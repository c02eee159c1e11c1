"""Small sensor tables, made up for tests."""

import numpy as np

from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable

#: Where the made-up sensors look, rad, to the left.
BEARINGS = np.radians([70.0, 45.0, 10.0, -10.0, -45.0, -70.0, -170.0, 170.0])


#: How bright objects are: walls most.
BRIGHT = {"wall": 0.8, "cylinder": 0.4}


def made_up(
    repeats: int = 1, noise: float = 0.0, *, ambient: float = 0.02, bright=BRIGHT, step=0.005
) -> SensorTable:
    """Return a table of 36 angles and 10 distances, by default 5 to 50 mm."""
    rng = np.random.default_rng(0)
    bearing = -2 * np.pi * np.arange(36) / 36
    distance = 0.005 + step * np.arange(10)
    looks = np.maximum(np.cos(bearing[:, None] - BEARINGS), 0) ** 4
    dims = np.exp(-((distance - 0.005) / (2.4 * step)))
    samples = {}
    for name, brightness in bright.items():
        mean = ambient + brightness * dims[:, None, None] * looks
        samples[name] = [
            Samples(np.clip(mean + noise * rng.standard_normal(mean.shape), 0, 1), 0.005, step)
            for _ in range(repeats)
        ]
    return SensorTable.from_samples(samples)


def made_up_lights(repeats: int = 1, noise: float = 0.0) -> SensorTable:
    """Return the same of a light, 5 to 185 mm."""
    return made_up(repeats, noise, ambient=0.1, bright={"light": 0.7}, step=0.02)
