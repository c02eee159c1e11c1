"""A synthetic robot: first-order motor lag, unequal motors, and slip drawn per command."""

from typing import NamedTuple

import numpy as np

FULL_SPEED, TRACK, LAG = 0.5, 0.13, 0.08


class MotorLine(NamedTuple):
    """The columns of a command that clocks and tracks use: time (s) and two wheels (%)."""

    time: float
    left: float
    right: float

    @property
    def forward(self):
        return (self.left + self.right) / 2

    @property
    def turn(self):
        return (self.right - self.left) / 2


def random_commands(rng, count):
    """Commands as in Pretorius et al. 2009, section 5.1: left, right (%), duration (s)."""
    speeds = rng.uniform(-50, 50, (count, 2))
    kind = rng.random(count)
    speeds[kind < 0.3, 1] = speeds[kind < 0.3, 0]
    speeds[kind >= 0.8] = 0.0
    return np.column_stack([speeds, rng.uniform(0.5, 3.0, count)])


def drive(commands, rng, slip, dt=0.01):
    """Displacements (N, 3) of commands given in a row, wheel speeds following with a lag."""
    wheels = np.zeros(2)
    result = np.zeros((len(commands), 3))
    for n, (left, right, duration) in enumerate(commands):
        gain = FULL_SPEED / 100 * np.array([1.0, 0.97]) * (1 + slip * rng.standard_normal(2))
        target = np.array([left, right]) * gain
        t = np.linspace(0, duration, int(duration / dt) + 1)[:-1]
        step = duration / len(t)
        speeds = target + (wheels - target) * np.exp(-t / LAG)[:, None]
        theta = np.cumsum((speeds[:, 1] - speeds[:, 0]) / TRACK * step)
        forward = speeds.mean(1)
        x, y = forward @ np.cos(theta) * step, forward @ np.sin(theta) * step
        result[n] = x, y, theta[-1]
        wheels = target + (wheels - target) * np.exp(-duration / LAG)
    return result


def synthetic(count, seed, slip=0.015):
    """Inputs (N, 5) and outputs (N, 3) of a random recording."""
    rng = np.random.default_rng(seed)
    commands = random_commands(rng, count)
    outputs = drive(commands, rng, slip)
    previous = np.vstack([np.zeros(2), commands[:-1, :2]])
    return np.hstack([previous, commands]), outputs
