"""What a controller that avoids obstacles does in arenas that it was not evolved in."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim.loop.evaluate import Evaluator, with_contacts
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance, avoidance

#: Arenas that nobody was evolved in, and drives in them.
ARENAS, DRIVES = 10, 20


@dataclass(frozen=True)
class Unmet:
    """What came of drives in arenas that the controller was not evolved in.

    Attributes:
        drives: how many there were.
        touched: in how many of them the robot touched something.
        fitness: their mean, where what comes after the first contact counts nothing.
    """

    drives: int
    touched: int
    fitness: float

    def __str__(self) -> str:
        often = f"in {self.touched} of {self.drives} drives" if self.touched else "in no drive"
        return f"In arenas that it was not evolved in, it touches something {often}."

    def describe(self) -> dict[str, float]:
        """Return it for controller.json."""
        return asdict(self)


def in_unmet_arenas(evaluator: Evaluator, genes: NDArray, seed: int) -> list[Unmet] | None:
    """Drive individuals [N, G] in arenas drawn for this alone, all from the same starts.

    Returns:
        What came of each; None where the task is another than avoiding obstacles, or the simulator
        knows of no arenas.
    """
    task, own = evaluator.task, evaluator.simulator
    if not isinstance(task, ObstacleAvoidance) or task.fitness != "avoidance":
        return None
    if not hasattr(own, "arena"):
        return None
    elsewhere = own.elsewhere(ARENAS, seed + 0x0BE7)
    there = Evaluator(elsewhere, task, evaluator.controller)
    rng = np.random.default_rng([seed, 0x0BE7])
    starts = elsewhere.free_poses(DRIVES, rng)
    assert starts is not None
    driven = with_contacts(elsewhere, there.run(genes, there.rollouts.draw(starts, rng)))
    assert driven.touching is not None
    touched = driven.touching.any(-1).sum(axis=1)
    fitness = avoidance(driven, task.duration).mean(axis=1)
    return [
        Unmet(DRIVES, int(times), float(value))
        for times, value in zip(touched, fitness, strict=True)
    ]
