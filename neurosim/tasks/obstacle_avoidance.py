"""Obstacle avoidance: Lund and Miglino 1996, equation (1), and other fitness of a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.base.declared import Count, Number, Step
from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Episode, Trajectory
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Interval, Judgement, Task

#: Side of the squares for counting visits, m.
CELL = 0.05
_NONE = -(2.0**60)


@dataclass(frozen=True)
class ObstacleAvoidance(Task):
    """The task: drive fast and straight, and keep away from walls and obstacles.

    The paper defines no success; here it is a fitness of at least ``enough`` from a start.

    Attributes:
        fitness: The fitness: avoidance, equation (1) of Lund and Miglino; or cells, the number of
            different visited squares of 5 cm.
        steps: Steps of a trial, over all its starts together.
        starts: Number of random poses from which a trial starts, each with an equal part of the
            steps.
        duration: Duration of a step, s.
        contacts: The cost of a contact: free, nothing, as in the paper; or end: the time after the
            first contact counts nothing. On a robot contacts are unknown.
        enough: Fitness from one start that counts as success; by default, for avoidance, half of
            its steps, and 0 for other fitness.
        place: Place of the trials, a JSON file or a name; by default that of the simulator.
    """

    name: ClassVar[str] = "obstacle-avoidance"
    reasons: ClassVar[tuple[str, ...]] = ("drove too slowly, or too near to things",)
    senses: ClassVar[tuple[str, ...]] = ("proximity",)  # type: ignore[misc]

    fitness: Literal["avoidance", "cells"] = "avoidance"
    steps: Count = 500
    starts: Count = 5
    duration: Step = 0.1
    contacts: Literal["free", "end"] = "free"
    enough: Number | None = None
    place: Place | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps % self.starts:
            raise UserError(
                f"steps must be a multiple of starts: {self.steps} steps, {self.starts} starts"
            )
        if self.contacts == "end" and self.fitness != "avoidance":
            raise UserError(f"contacts='end' needs fitness='avoidance', not {self.fitness!r}")

    @property
    def trial_starts(self) -> int:  # type: ignore[override]
        """Number of starts of a trial."""
        return self.starts

    @property
    def highest_fitness(self) -> float | None:  # type: ignore[override]
        """The highest value of equation (1), 1 for each step."""
        return float(self.steps) if self.fitness == "avoidance" else None

    @property
    def episode(self) -> Episode:
        """An equal part of the steps from each start; the robot is not stopped at the end."""
        steps = self.steps // self.starts
        return Episode(self.duration, steps, readings=True, contacts=self.contacts == "end")

    def draw_starts(
        self, simulator: Simulator, count: int, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """Return random poses at which the robot touches nothing."""
        return simulator.free_poses(count, rng)

    @property
    def scored_by(self) -> tuple[str, ...]:  # type: ignore[override]
        """Equation (1) takes commands and readings; cells take poses."""
        if self.fitness == "cells":
            return ("poses",)
        return "commands", "readings"

    def first_record(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return records [K, 2] of contact and sum; of cells [K, 2 + M], with squares visited."""
        squares = self.episode.steps + 2 if self.fitness == "cells" else 0
        record = np.full((len(poses), 2 + squares), _NONE)
        record[:, :2] = 0.0
        if squares:
            self._visit(record, poses)
        return record

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval; nothing counts after a contact if contacts end a drive."""
        if self.fitness == "cells":
            return self._visit(record, interval.poses)
        if self.contacts == "end" and interval.touching is not None:
            record[:, 0] = (record[:, 0] > 0) | interval.touching
        assert interval.readings is not None
        assert interval.commands is not None
        steps = np.full(len(record), interval.duration) / self.duration
        _add(interval.readings, interval.commands, steps, record)

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return the sum of equation (1), or the number of visited squares."""
        fitness = record[:, 1]
        return Judgement.of(fitness, fitness >= self.least)

    def _visit(self, record: NDArray[np.float64], poses: NDArray[np.float64]) -> None:
        """Add the squares of poses [K, 3] to records; a robot that was not seen visits none."""
        column, row = np.floor(poses[:, :2] / CELL).T
        cell = np.where(np.isnan(column + row), _NONE, column * 1_000_003 + row)
        new = (record[:, 2:] != cell[:, None]).all(axis=1) & (cell != _NONE)
        at = np.flatnonzero(new & (record[:, 1] < record.shape[1] - 2))
        record[at, 2 + record[at, 1].astype(np.int64)] = cell[at]
        record[at, 1] += 1

    @property
    def least(self) -> float:
        """The fitness from one start that counts as success."""
        if self.enough is not None:
            return self.enough
        return 0.5 * self.episode.steps if self.fitness == "avoidance" else 0.0

    def whole(self, fitness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum over the starts [..., starts], which form a trial."""
        return fitness.sum(axis=-1)


def avoidance(trajectory: Trajectory, step: float = 0.1) -> NDArray[np.float64]:
    """Return equation (1) [...] of trajectories, for a step's duration in seconds.

    If contacts are known, the time after the first one counts nothing.
    """
    return ObstacleAvoidance(duration=step, contacts="end").judge(trajectory).fitness


@njit(error_model="numpy", fastmath={"contract", "nsz"}, inline="always")
def _worth(readings, command):  # type: ignore[no-untyped-def]
    """Return the value of a step with readings [S] and a command [2 or more]: equation (1).

    It is V (1 - DV^2) (1 - I): V is the mean of the wheels' absolute speeds over full speed, DV
    half the difference of the signed ones over full speed, I the highest sensor; all in 0..1 (DV
    in -1..1). Its maximum, 1, is reached by driving fast, straight and far from objects.
    """
    highest = np.float64(0.0)
    for s in range(len(readings)):
        highest = max(highest, np.float64(readings[s]))
    left, right = command[0] / 100.0, command[1] / 100.0
    difference = 0.5 * (left - right)
    speed = 0.5 * (abs(left) + abs(right))
    return speed * (1.0 - difference * difference) * (1.0 - highest)


@njit(error_model="numpy")
def _add(readings, commands, steps, record):  # type: ignore[no-untyped-def]
    """Add to records [K, 2] the value of intervals of readings [K, S] and commands [K, C]."""
    for k in range(len(record)):
        if record[k, 0] == 0.0:
            record[k, 1] += steps[k] * _worth(readings[k], commands[k])
