"""A reality in which a person runs the robot and types the result."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray


class ByHand:
    """A person sets the robot's parameters, starts it, and types the fitness; there is no driver.

    As in Zagal et al. 2004, section 5.2: the robot starts in the middle of a circle, and is stopped
    where it crosses the circle.

    Attributes:
        instruction: the person's task before every trial.
        patient: a person may take any time.
    """

    instruction = "Put the robot back to the start and press Enter when it is ready"
    patient = True

    def __init__(
        self, controller: Any, task: Any = None, type_in: Callable[[str], str] | None = None
    ):
        """Prepare trials of a controller.

        Args:
            controller: the controller, whose parameters are shown.
            task: the task of the fitness.
            type_in: shows a message and returns the answer; by default on stderr and from stdin.
        """
        self._controller, self._type_in = controller, type_in or answer_to
        unit = "" if task is None else task.fitness_unit
        self._asked = f"Fitness{unit and f' in {unit}'} (0 if it fell): "

    def describe(self) -> dict[str, Any]:
        """Describe the reality."""
        return {"kind": "by-hand", "virtual": False}

    def trial(self, genes: NDArray[np.float64], number: int) -> float:
        """Show the individual [G], and return the fitness that is typed."""
        given = self._controller.named(genes)
        given = given or {f"gene {n}": v for n, v in enumerate(genes.tolist())}
        shown = json.dumps({name: float(f"{value:.4g}") for name, value in given.items()})
        asked = f"Trial {number + 1}: {shown}\n{self._asked}"
        while True:
            typed = self._type_in(asked)
            try:
                if math.isfinite(float(typed)):
                    return float(typed)
            except ValueError:
                pass
            asked = "A number, please: "


def answer_to(message: str) -> str:
    """Return the number that a person types."""
    print(message, end="", file=sys.stderr, flush=True)
    return input()
