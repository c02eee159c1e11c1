"""A controller that avoids obstacles, in arenas in which it was not evolved."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurosim.controllers.base import WHEELS
from neurosim.controllers.network import braitenberg
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.simulators.base import InPlace, Rollouts
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance, avoidance

#: Number of arenas without evolution in them, and of drives in them. Arenas differ far more than
#: starts, and one drive in thirty tells a good network from a better one.
ARENAS, DRIVES = 200, 600
#: Distance of the rim from a surface, m, that ends a drive where runs are compared. A robot differs
#: from its tables by one or two millimetres: of five networks that touched something in 0.1 to
#: 0.4 % of the drives in tables, those that came so near more often touched more often in the lab.
NEAR = 0.003


@dataclass(frozen=True)
class Unmet:
    """The result of drives in arenas in which the controller was not evolved.

    Attributes:
        drives: number of drives.
        touched: number of drives in which the robot touched something.
        fitness: mean fitness, in which nothing counts after the robot was nearer than :data:`NEAR`.
        vehicle: number of drives in which a hand-written vehicle touched something; None: unknown.
    """

    drives: int
    touched: int
    fitness: float
    vehicle: int | None = None

    def __str__(self) -> str:
        often = f"{self.touched} of {self.drives} drives" if self.touched else "no drive"
        text = f"In arenas that it was not evolved in, it touches something in {often}"
        if self.worse:
            text += (
                f", more often than a hand-written vehicle (in {self.vehicle or 'none'} of them); "
                "evolve with --arenas 100 --contacts end, or more --runs"
            )
        return f"{text}."

    @property
    def worse(self) -> bool:
        """Whether the controller touches something more often than the hand-written vehicle.

        The difference is more than two standard deviations of the two counts.
        """
        if self.vehicle is None:
            return False
        return self.touched - self.vehicle > 2.0 * math.sqrt(self.touched + self.vehicle)

    def describe(self) -> dict[str, float | None]:
        """Return the result for controller.json."""
        return asdict(self)


def in_unmet_arenas(evaluator: Evaluator, genes: NDArray, seed: int) -> list[Unmet] | None:
    """Drive individuals [N, G] in new random arenas, all from the same starts.

    A hand-written vehicle drives there, too, if the robot has two wheels.

    Returns:
        The result of each; None if the task is not the avoidance of obstacles, or the simulator has
        no arenas.
    """
    task, own = evaluator.task, evaluator.simulator
    if not isinstance(task, ObstacleAvoidance) or task.fitness != "avoidance":
        return None
    if not isinstance(own, InPlace):
        return None
    elsewhere = own.elsewhere(ARENAS, seed + 0x0BE7)

    rng = np.random.default_rng([seed, 0x0BE7])
    starts = elsewhere.free_poses(DRIVES, rng)
    assert starts is not None

    def drive(rollouts: Rollouts, genes: NDArray) -> tuple[int, float]:
        draws = rollouts.draw(starts, np.random.default_rng([seed, 0xD21E]))
        driven = rollouts.run(genes[None], draws)
        assert driven.poses is not None
        near = elsewhere.touching(driven.poses[..., 1:, :], NEAR)
        assert near is not None
        touched = elsewhere.touching(driven.poses[0, near[0].any(-1), 1:])
        assert touched is not None
        fitness = avoidance(replace(driven, touching=near), task.duration)
        return int(touched.any(-1).sum()), float(fitness.mean())

    vehicle = None
    if tuple(own.command_names) == (*WHEELS, "duration"):
        controller, weights = braitenberg(own.reading_names, own.bearings)
        vehicle = drive(rollouts_of(elsewhere, controller, task.episode), weights)[0]
    rollouts = rollouts_of(elsewhere, evaluator.controller, task.episode)
    each = (drive(rollouts, one) for one in genes)  # one at a time, because of memory
    return [Unmet(DRIVES, touched, fitness, vehicle) for touched, fitness in each]
