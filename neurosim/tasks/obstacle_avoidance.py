"""Obstacle avoidance: Lund and Miglino 1996, equation (1), and other fitness of a trajectory.

A fitness is a function of a :class:`Trajectory`, simulated or driven; one of your own is a few
lines, see :func:`cells_visited`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from neurosim.base.errors import UserError


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What a robot met, did and where it was, step by step; leading axes are trials.

    Attributes:
        readings: [..., T, S] the sensors before each step, 0..1.
        commands: [..., T, 2] left and right, % of full speed, as the controller gave them.
        poses: [..., T + 1, 3] x (m), y (m), heading (rad) before the first step and after each,
            or None where nobody saw them.
    """

    readings: NDArray
    commands: NDArray
    poses: NDArray | None = None


#: A trajectory's fitness [...], the higher the better.
Fitness = Callable[[Trajectory], NDArray[np.float64]]


def avoidance(trajectory: Trajectory) -> NDArray[np.float64]:
    """Return equation (1): the sum over steps of V (1 - DV^2) (1 - I).

    V is the mean of the wheels' absolute speeds over full speed, DV half the difference of the
    signed ones over full speed, I the highest sensor: all in 0..1 (DV in -1..1). To drive fast,
    straight and far from everything is best; a step is worth at most 1.
    """
    readings, commands = trajectory.readings, trajectory.commands
    shape = readings.shape[:-2]
    found = _avoidance(
        np.ascontiguousarray(readings).reshape(math.prod(shape), *readings.shape[-2:]),
        np.ascontiguousarray(commands).reshape(math.prod(shape), *commands.shape[-2:]),
    )
    return found.reshape(shape)


def cells_visited(trajectory: Trajectory, size: float = 0.05) -> NDArray[np.float64]:
    """Return how many different squares of ``size`` (m) the robot's centre was in.

    The paper's outlook: a fitness that only a simulator (or a camera) can compute.
    """
    if trajectory.poses is None:
        raise UserError("cells visited cannot be counted without the robot's poses")
    column, row = np.floor(trajectory.poses[..., :2] / size).astype(np.int64).T
    cells = np.sort((column * 1_000_003 + row).T, axis=-1)
    return 1.0 + (np.diff(cells, axis=-1) != 0).sum(axis=-1)


FITNESS: dict[str, Fitness] = {"avoidance": avoidance, "cells": cells_visited}


@dataclass(frozen=True)
class ObstacleAvoidance:
    """The task: drive fast and straight and keep away from everything.

    Attributes:
        fitness: one of :data:`FITNESS`.
        steps: of a trial, over all its starts together.
        starts: random poses from which a trial starts, each for an equal share of the steps.
        duration: of a step, s.
    """

    name = "obstacle-avoidance"

    fitness: str = "avoidance"
    steps: int = 500
    starts: int = 5
    duration: float = 0.1

    def __post_init__(self) -> None:
        if self.fitness not in FITNESS:
            raise UserError(f"fitness is one of {', '.join(FITNESS)}, not {self.fitness!r}")
        if self.starts < 1 or self.steps < self.starts or self.steps % self.starts:
            raise UserError(
                f"{self.steps} steps cannot be shared out evenly among {self.starts} starts"
            )
        if not 0.001 <= self.duration <= 10:
            raise UserError(f"a step lasts 0.001 to 10 s, not {self.duration:g}")

    @property
    def steps_a_start(self) -> int:
        """Steps from each start."""
        return self.steps // self.starts

    def evaluate(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return a trial's fitness [...]: the sum over its starts, the last leading axis."""
        return FITNESS[self.fitness](trajectory).sum(axis=-1)

    def describe(self) -> dict[str, Any]:
        """Return name and settings, enough to make the same task again."""
        return {
            "name": self.name,
            "settings": {
                "fitness": self.fitness,
                "steps": self.steps,
                "starts": self.starts,
                "duration": self.duration,
            },
        }


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"contract", "nsz"})
def _avoidance(readings, commands):
    """Return equation (1) [B] of readings [B, T, S] and commands [B, T, 2]."""
    fitness = np.empty(len(readings))
    for b in prange(len(readings)):
        total = 0.0
        for k in range(readings.shape[1]):
            highest = np.float64(0.0)
            for s in range(readings.shape[2]):
                highest = max(highest, np.float64(readings[b, k, s]))
            left, right = commands[b, k, 0] / 100.0, commands[b, k, 1] / 100.0
            difference = 0.5 * (left - right)
            speed = 0.5 * (abs(left) + abs(right))
            total += speed * (1.0 - difference * difference) * (1.0 - highest)
        fitness[b] = total
    return fitness
