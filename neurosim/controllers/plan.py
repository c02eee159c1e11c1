"""Plans: command sets that are driven blindly, Pretorius et al. 2009, section 6.2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.declared import Count, Percent, Seconds
from neurosim.base.errors import UserError
from neurosim.controllers.base import Controller
from neurosim.evolution.command_sets import GENES, decode, encode

#: (left %, right %, duration s).
Command = tuple[float, float, float]
COMMAND_NAMES = ("left", "right", "duration")


@dataclass(frozen=True)
class Plan(Controller):
    """Plans of a fixed number of commands, some of which may be null (not given).

    Attributes:
        slots: Commands in a plan, null ones included.
        max_speed: Largest motor speed, percent of full speed.
        durations: Shortest and longest command, s.
    """

    kind: ClassVar[str] = "plan"
    blind = True
    gene_range = (0.0, 1.0)
    outputs = COMMAND_NAMES

    slots: Count = 10
    max_speed: Percent = 50.0
    durations: tuple[Seconds, Seconds] = (0.5, 3.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.durations
        if low > high:
            raise UserError(f"the shortest duration, {low:g} s, is above the longest, {high:g} s")

    @property
    def genes(self) -> int:  # type: ignore[override]
        """Four a command: null, left, right, duration, each in 0..1."""
        return GENES * self.slots

    def first(self, count: int, generator: torch.Generator) -> Tensor:
        """Return a first population, [count, genes], uniform in 0..1."""
        return torch.rand(count, self.genes, generator=generator, dtype=torch.float64)

    def commands(self, genes: NDArray, rest: float) -> tuple[NDArray, NDArray]:
        """Return commands [P, T, 3] and active [P, T]; see the base class."""
        low, high = map(float, self.durations)
        commands, active = decode(np.ascontiguousarray(genes), self.max_speed, low, high)
        return with_rest(commands, active, rest)

    def encode(self, commands: Sequence[Command | None]) -> NDArray[np.float64]:
        """Return the genes of a command set."""
        return encode(commands, self.max_speed, self.durations)

    def settings(self) -> dict[str, Any]:
        return {
            "slots": self.slots,
            "max_speed": self.max_speed,
            "durations": list(self.durations),
        }


@dataclass(frozen=True)
class FixedPlan(Controller):
    """One plan, as it was evolved or written by hand; it has no genes.

    Attributes:
        slots: its commands, None for a null one.
    """

    kind: ClassVar[str] = "plan"
    blind = True
    outputs = COMMAND_NAMES
    genes = 0

    slots: tuple[Command | None, ...]

    @property
    def given(self) -> list[Command]:
        """The commands that are sent, without the null ones."""
        return [command for command in self.slots if command is not None]

    def commands(self, genes: NDArray, rest: float) -> tuple[NDArray, NDArray]:
        """Return the commands [P, T, 3] of as many rows as ``genes`` has, and active [P, T]."""
        commands = np.tile(np.array(self.given, np.float64).reshape(-1, 3), (len(genes), 1, 1))
        return with_rest(commands, np.ones(commands.shape[:2], np.bool_), rest)


def commands_of(controller: Controller, genes: NDArray[np.float64]) -> list[Command | None]:
    """Return the commands of an individual [G] of a blind controller, None for a null one."""
    commands, active = controller.commands(genes[None], 0.0)
    pairs = zip(commands[0].tolist(), active[0], strict=True)
    return [tuple(command) if given else None for command, given in pairs]


def with_rest(commands: NDArray, active: NDArray, rest: float) -> tuple[NDArray, NDArray]:
    """Return commands [P, K + 1, 3] and active [P, K + 1] with the stop at the end.

    Args:
        commands: [P, K, 3].
        active: [P, K].
        rest: how long the motors are stopped, s; 0: both are returned as they are.
    """
    if rest <= 0:
        return commands, active
    plans, slots, _ = commands.shape
    longer, more = np.zeros((plans, slots + 1, 3)), np.zeros((plans, slots + 1), np.bool_)
    longer[:, :slots], more[:, :slots] = commands, active
    longer[:, slots, 2] = rest
    return longer, more
