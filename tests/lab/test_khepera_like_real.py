"""The virtual Khepera's infra-red sensors compared with a real one's: similar, not equal."""

import math

import numpy as np
import pytest

from neurosim.base.place import THICKNESS, Place
from neurosim.lab import KheperaParams
from neurosim.lab.khepera import physics
from neurosim.lab.khepera.params import RADIUS, WHITE
from neurosim.simulators.tables.samples import Samples

OBJECTS = {
    "wall": Place(walls=((THICKNESS / 2, -1.0, THICKNESS / 2, 1.0),)),
    "cylinder": Place(obstacles=((0.0275, 0.0, 0.0275),)),
}


def sampled(seed, arena, samples):
    """Sample a random robot as the published samples were taken, [D, A, 8]."""
    params, rng = KheperaParams.sampled(seed), np.random.default_rng(seed)
    distances, angles, _ = samples.activations.shape
    out = np.empty(samples.activations.shape)
    for distance in range(distances):
        away = samples.first_distance + distance * samples.distance_step
        for angle in range(angles):
            out[distance, angle] = physics.proximity(
                np.array([-RADIUS - away, 0.0, 2 * math.pi * angle / angles]),
                params.angle,
                params.reach,
                params.threshold,
                params.offset,
                (params.noise, params.light_noise),
                0.0,
                arena.surfaces,
                arena.cylinders,
                WHITE,
                rng,
            )
    return out / 1023


def half_distance(activations):
    """Return where the best direction's reading falls below a half, [8] in steps."""
    best = np.sort(activations, axis=1)[:, -3:].mean(axis=1)
    return (best >= 0.5).sum(axis=0)


def widths(activations, distance):
    """Return the number of angles at which each sensor sees the object, [8]."""
    return (activations[distance] > 0.1).sum(axis=0)


@pytest.mark.parametrize("name", OBJECTS)
def test_range_width_saturation_and_floor(name, shared_data):
    samples = Samples.read(shared_data / "khepera" / f"khepera-{name}.sample")
    real = samples.activations
    lab = [sampled(seed, OBJECTS[name], samples) for seed in range(4)]
    half = np.mean([half_distance(robot) for robot in lab])
    assert half == pytest.approx(half_distance(real).mean(), abs=1.0)
    for distance in (0, 3, 6):
        width = np.mean([widths(robot, distance) for robot in lab])
        assert width == pytest.approx(widths(real, distance).mean(), rel=0.15)
    for robot in lab:
        assert (robot[0].max(axis=0) > 0.99).all()
        assert robot[-1].mean() == pytest.approx(real[-1].mean(), abs=0.003)
        # Similar, not copies: they differ by much more than the noise.
        assert np.abs(robot - real).mean() > 3 * 0.004
