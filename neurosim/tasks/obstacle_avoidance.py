"""Obstacle avoidance: Lund and Miglino 1996, equation (1), and other fitness of a trajectory."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from neurosim.base.declared import Count, Number, Step
from neurosim.base.errors import UserError
from neurosim.base.trajectory import Episode, Trajectory
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.score import Interval, Rows, Score

#: A trajectory's fitness [...], the higher the better; the second argument is the task's step, s.
Fitness = Callable[[Trajectory, float], NDArray[np.float64]]


def avoidance(trajectory: Trajectory, step: float = 0.1) -> NDArray[np.float64]:
    """Return equation (1): the sum over steps of V (1 - DV^2) (1 - I).

    V is the mean of the wheels' absolute speeds over full speed, DV half the difference of the
    signed ones over full speed, I the highest sensor: all in 0..1 (DV in -1..1). To drive fast,
    straight and far from everything is best; a step is worth at most 1. An interval of another
    duration than ``step`` (s) counts as so many steps. Where it is known when the robot touches
    something, what comes after the first contact counts nothing.
    """
    if trajectory.readings is None:
        raise UserError("obstacle avoidance can only be judged where the sensors were read")
    readings, commands = trajectory.readings, trajectory.commands
    shape = trajectory.shape
    rows = math.prod(shape)
    weight = np.empty((0, 0))
    if np.ndim(trajectory.durations):
        durations = np.asarray(trajectory.durations) / step
        weight = np.broadcast_to(durations, readings.shape[:-1]).reshape(rows, -1)
    if trajectory.touching is not None:
        free = ~np.logical_or.accumulate(trajectory.touching, axis=-1).reshape(rows, -1)
        weight = free if weight.size == 0 else weight * free
    found = _avoidance(
        np.ascontiguousarray(readings).reshape(rows, *readings.shape[-2:]),
        np.ascontiguousarray(commands[..., :2]).reshape(rows, commands.shape[-2], 2),
        np.ascontiguousarray(weight, np.float64),
    )
    return found.reshape(shape)


def cells_visited(
    trajectory: Trajectory, step: float = 0.1, size: float = 0.05
) -> NDArray[np.float64]:
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
class ObstacleAvoidance(Task):
    """The task: drive fast and straight and keep away from everything.

    The paper knows no success beside the fitness; here it is a fitness of at least ``enough`` from
    a start.

    Attributes:
        fitness: The fitness: avoidance, equation (1) of Lund and Miglino; or cells, how many
            different squares of 5 cm were visited. One of :data:`FITNESS`.
        steps: Steps of a trial, over all its starts together.
        starts: Random poses from which a trial starts, each for an equal share of the steps.
        duration: Duration of a step, s.
        contacts: What touching something costs: free, nothing, as in the paper; or end: what comes
            after the first contact counts nothing. On a robot nobody knows of contacts.
        enough: Fitness from one start that counts as success; by default, for avoidance, half of
            its steps, and 0 for other fitness.
    """

    name: ClassVar[str] = "obstacle-avoidance"
    reasons: ClassVar[tuple[str, ...]] = ("drove too slowly, or too near to things",)

    fitness: str = "avoidance"
    steps: Count = 500
    starts: Count = 5
    duration: Step = 0.1
    contacts: Literal["free", "end"] = "free"
    enough: Number | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fitness not in FITNESS:
            raise UserError(f"fitness is one of {', '.join(FITNESS)}, not {self.fitness!r}")
        if self.steps % self.starts:
            raise UserError(
                f"{self.steps} steps cannot be shared out evenly among {self.starts} starts"
            )
        if self.contacts == "end" and FITNESS[self.fitness] is not avoidance:
            raise UserError("contacts that end a drive are those of the fitness avoidance")

    @property
    def trial_starts(self) -> int:  # type: ignore[override]
        """A trial is made from so many starts."""
        return self.starts

    @property
    def highest_fitness(self) -> float | None:  # type: ignore[override]
        """Of equation (1): a step is worth at most 1."""
        return float(self.steps) if FITNESS[self.fitness] is avoidance else None

    @property
    def episode(self) -> Episode:
        """From each start an equal share of the steps; the robot is not stopped at the end."""
        steps = self.steps // self.starts
        return Episode(self.duration, steps, readings=True, contacts=self.contacts == "end")

    def draw_starts(
        self, simulator: Simulator, count: int, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """Return random poses where the robot touches nothing."""
        return simulator.free_poses(count, rng)

    def judge(self, trajectory: Trajectory) -> Judgement:
        """Judge what happened from each start; see :data:`FITNESS`."""
        if trajectory.readings is None:
            raise UserError("obstacle avoidance can only be judged where the sensors were read")
        fitness = FITNESS[self.fitness](trajectory, self.duration)
        last = trajectory.commands.shape[-2] - 1
        if trajectory.segment is not None:
            last = int(trajectory.segment[-1])
        return Judgement.of(fitness, fitness >= self.least, 0, last)

    @property
    def least(self) -> float:
        """The fitness from one start that counts as success."""
        if self.enough is not None:
            return self.enough
        return 0.5 * self.episode.steps if FITNESS[self.fitness] is avoidance else 0.0

    def score(self, count: int, columns: int, sensors: int) -> Score:
        """Return what follows equation (1) step by step: it is a sum."""
        if FITNESS[self.fitness] is avoidance and sensors:
            return _Sum(self, count)
        return super().score(count, columns, sensors)

    def whole(self, fitness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum over the starts [..., starts]: a trial is all of them."""
        return fitness.sum(axis=-1)


class _Sum(Score):
    """Equation (1) of trials under way."""

    def __init__(self, task: ObstacleAvoidance, count: int):
        super().__init__(task, count)
        self._every = np.arange(count)

    def begin(self, rows: Rows, poses: NDArray[np.float64]) -> None:
        self.progress[rows] = 0.0
        self.success[rows] = self.task.least <= 0.0

    def add(self, rows: Rows, interval: Interval) -> None:
        assert interval.readings is not None
        steps = interval.duration / self.task.duration
        _add(self._every[rows], interval.readings, interval.commands, steps, self.progress)
        self.success[rows] = self.progress[rows] >= self.task.least


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, inline="always")
def _worth(readings, command):  # type: ignore[no-untyped-def]
    """Return what a step with readings [S] and a command [2 or more] is worth."""
    highest = np.float64(0.0)
    for s in range(len(readings)):
        highest = max(highest, np.float64(readings[s]))
    left, right = command[0] / 100.0, command[1] / 100.0
    difference = 0.5 * (left - right)
    speed = 0.5 * (abs(left) + abs(right))
    return speed * (1.0 - difference * difference) * (1.0 - highest)


@njit(cache=True, error_model="numpy")
def _add(rows, readings, commands, steps, total):  # type: ignore[no-untyped-def]
    """Add to rows [K] of a total what a step of readings [K, S] and commands [K, C] is worth."""
    for k in range(len(rows)):
        total[rows[k]] += steps * _worth(readings[k], commands[k])


@njit(cache=True, parallel=True, error_model="numpy", fastmath={"contract", "nsz"})
def _avoidance(readings: NDArray, commands: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """Return equation (1) [B] of readings [B, T, S], commands [B, T, 2].

    Steps count ``weight`` [B, T] times; where that is empty, once.
    """
    fitness = np.empty(len(readings))
    for b in prange(len(readings)):
        total = 0.0
        for k in range(readings.shape[1]):
            worth = _worth(readings[b, k], commands[b, k])
            total += worth if len(weight) == 0 else weight[b, k] * worth
        fitness[b] = total
    return fitness
