"""A world without legs for the alternation: a block that is pushed and slides.

One command for a whole trial, its push; friction and mass are what the simulator does not know.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from neurosim.base.trajectory import Episode
from neurosim.controllers.base import Controller
from neurosim.simulators.adjustable import Adjustable
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Judgement, Task


class Block(Simulator):
    """Moves by push over mass in a step, less friction; sideways it drifts."""

    kind = "block"
    state_names = ("x", "y", "theta")
    command_names = ("push", "aside")

    def __init__(self, mass=1.0, friction=0.1):
        self.mass, self.friction = mass, friction

    @property
    def parameters(self):
        return (
            Adjustable("mass", self.mass, 0.5, 4.0, "kg", log=True),
            Adjustable("friction", self.friction, 0.0, 0.5, "m"),
        )

    def adjusted(self, values):
        return type(self)(*np.asarray(values).tolist())

    def start(self, pose, generator=None):
        return pose

    def step(self, state, command, generator=None):
        distance = (command[:, 0] / self.mass - self.friction).clamp(min=0.0)
        side = 0.5 * (command[:, 1] - 0.3 * command[:, 0])
        return state + torch.stack([distance, side, torch.zeros_like(distance)], dim=1)


class Push(Controller):
    """Two genes: how hard, and how much to the side."""

    kind = "push"
    outputs = ("push", "aside")
    genes = 2
    gene_range = (0.0, 1.0)

    def act(self, genes, observation, memory):
        return genes, memory


@dataclass(frozen=True)
class Slide(Task):
    """Far ahead, and not to the side."""

    name: ClassVar[str] = "slide"

    @property
    def episode(self):
        return Episode(step=1.0, steps=2)

    def worth(self, record):
        x, y = record[:, 4:6].T  # where the block is
        fitness = x - np.abs(y)
        return Judgement.of(fitness, fitness > 0.0)


def reality_of(mass=2.0, friction=0.2):
    """Return a function of genes that returns the fitness of another block."""

    def fitness(genes):
        push, aside = np.asarray(genes, float)
        distance = 2.0 * max(push / mass - friction, 0.0)
        return distance - abs(2.0 * 0.5 * (aside - 0.3 * push))

    return fitness
