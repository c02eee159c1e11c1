"""Any Python function as a controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from neurosim.controllers.base import WHEELS, Controller

#: Takes the observations, name -> [B], and the genes [B, G], if the controller has any; returns one
#: array (or number) for each output.
Rule = Callable[..., Sequence[ArrayLike]]


@dataclass(frozen=True)
class Function(Controller):
    """A controller that is a Python function, with or without genes.

    The function works on a whole batch: it gets arrays with one number for each robot.

    >>> def away(seen):
    ...     return 60 - 80 * seen["sensor_3"], 60 - 80 * seen["sensor_2"]
    >>> vehicle = ns.Function(away, inputs=("sensor_2", "sensor_3"))
    >>> ns.evaluate("tables", "obstacle-avoidance", vehicle)(np.empty((1, 0))).shape
    (1,)

    Attributes:
        function: see :data:`Rule`.
        inputs: names of its observations.
        genes: number of genes, which evolution chooses.
        outputs: columns of the command.
        name: its registered name, by which it is found when a controller is read from a file.
    """

    function: Rule
    inputs: tuple[str, ...] = ()
    genes: int = 0
    outputs: tuple[str, ...] = WHEELS
    name: str = "function"

    @property
    def kind(self) -> str:  # type: ignore[override]
        """The registered name."""
        return self.name

    def act(self, genes: Tensor, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        seen: Mapping[str, NDArray] = dict(
            zip(self.inputs, observation.cpu().numpy().T, strict=True)
        )
        returned = self.function(seen, genes.cpu().numpy()) if self.genes else self.function(seen)
        columns = [np.broadcast_to(np.asarray(one, float), len(observation)) for one in returned]
        return torch.from_numpy(np.stack(columns, axis=1)).to(observation), memory

    def settings(self) -> dict[str, Any]:
        """Return no settings: a function is found by its registered name."""
        return {}
