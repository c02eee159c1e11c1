"""Plans: command sets, driven in open loop (Pretorius et al. 2009, section 6.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.declared import Count, Number, Percent, Seconds
from neurosim.base.errors import UserError
from neurosim.controllers.base import Controller
from neurosim.evolution.command_sets import decode, encode

#: Its numbers, and the duration, s: of two wheels (left %, right %, duration s).
Command = tuple[float, ...]
COMMAND_NAMES = ("left", "right", "duration")


@dataclass(frozen=True)
class Plan(Controller):
    """Plans of a fixed number of commands, some of which may be null (not given).

    Attributes:
        slots: Commands in a plan, null ones included.
        max_speed: Largest motor speed, percent of full speed.
        durations: Shortest and longest command, s.
        names: Names of a command's numbers; by default those of the simulator.
        units: Units of a command's numbers.
        limits: Least and greatest value of each number; by default -max_speed and max_speed.
    """

    kind: ClassVar[str] = "plan"
    open_loop = True
    gene_range = (0.0, 1.0)

    slots: Count = 10
    max_speed: Percent = 50.0
    durations: tuple[Seconds, Seconds] = (0.5, 3.0)
    names: tuple[str, ...] = COMMAND_NAMES[:-1]
    units: tuple[str, ...] = ("%", "%")
    limits: tuple[tuple[Number, Number], ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("names", "units"):  # lists, which files have, become tuples
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if len(self.units) != len(self.names) or len(self._limits) != len(self.names):
            raise UserError(
                f"a plan's commands have {len(self.names)} numbers ({', '.join(self.names)}): give "
                "a unit and limits for each"
            )
        for name, (least, most) in zip(self.names, self._limits.tolist(), strict=True):
            if least > most:
                raise UserError(f"limits: the least {name}, {least:g}, is above the most, {most:g}")
        low, high = self.durations
        if low > high:
            raise UserError(f"the shortest duration, {low:g} s, is above the longest, {high:g} s")

    @property
    def genes(self) -> int:  # type: ignore[override]
        """Of each command: null, its numbers, duration, each in 0..1."""
        return (len(self.names) + 2) * self.slots

    @property
    def outputs(self) -> tuple[str, ...]:  # type: ignore[override]
        """The numbers of a command, and its duration."""
        return (*self.names, "duration")

    @property
    def _limits(self) -> NDArray[np.float64]:
        """Least and greatest of each number, [C, 2]."""
        if self.limits is None:
            return np.tile([-self.max_speed, self.max_speed], (len(self.names), 1))
        return np.array(self.limits, np.float64).reshape(-1, 2)

    def first(self, count: int, generator: torch.Generator) -> Tensor:
        """Return a first population, [count, genes], uniform in 0..1."""
        return torch.rand(count, self.genes, generator=generator, dtype=torch.float64)

    def commands(self, genes: NDArray, rest: float) -> tuple[NDArray, NDArray]:
        """Return commands [P, T, C] and active [P, T]; see the base class."""
        low, high = map(float, self.durations)
        least, most = (np.ascontiguousarray(ends) for ends in self._limits.T)
        # Percents are whole ones, other numbers have four decimals.
        steps = np.array([1.0 if unit == "%" else 1e4 for unit in self.units])
        commands, active = decode(np.ascontiguousarray(genes), least, most, steps, low, high)
        return with_rest(commands, active, rest, self.units)

    def encode(self, commands: Sequence[Command | None]) -> NDArray[np.float64]:
        """Return the genes of a command set."""
        least, most = self._limits.T
        return encode(commands, least, most, self.durations)

    def settings(self) -> dict[str, Any]:
        return {
            "slots": self.slots,
            "max_speed": self.max_speed,
            "durations": list(self.durations),
            **(self._own if self.limits is not None else {}),
        }

    @property
    def _own(self) -> dict[str, Any]:
        limits = self._limits.tolist()
        return {"names": list(self.names), "units": list(self.units), "limits": limits}


@dataclass(frozen=True)
class FixedPlan(Controller):
    """One plan, evolved or written by hand; it has no genes.

    Attributes:
        slots: its commands, None for a null one.
        names: numbers of a command.
        units: their units.
    """

    kind: ClassVar[str] = "plan"
    open_loop = True
    genes = 0

    slots: tuple[Command | None, ...]
    names: tuple[str, ...] = COMMAND_NAMES[:-1]
    units: tuple[str, ...] = ("%", "%")

    @property
    def outputs(self) -> tuple[str, ...]:  # type: ignore[override]
        """The numbers of a command, and its duration."""
        return (*self.names, "duration")

    @property
    def given(self) -> list[Command]:
        """The commands that are sent, without the null ones."""
        return [command for command in self.slots if command is not None]

    def commands(self, genes: NDArray, rest: float) -> tuple[NDArray, NDArray]:
        """Return the commands [P, T, C] of as many rows as ``genes`` has, and active [P, T]."""
        rows = np.array(self.given, np.float64).reshape(-1, len(self.outputs))
        commands = np.tile(rows, (len(genes), 1, 1))
        return with_rest(commands, np.ones(commands.shape[:2], np.bool_), rest, self.units)


def commands_of(controller: Controller, genes: NDArray[np.float64]) -> list[Command | None]:
    """Return the commands of an individual [G] of an open-loop controller, None for a null one."""
    commands, active = controller.commands(genes[None], 0.0)
    pairs = zip(commands[0].tolist(), active[0], strict=True)
    return [tuple(command) if given else None for command, given in pairs]


def stop_after(command: Sequence[float], units: Sequence[str]) -> list[float]:
    """Return the numbers of a stop after a command: angles, such as a car's steering, are held.

    Args:
        command: its numbers; others may follow.
        units: of the numbers.
    """
    return [
        float(value) if unit == "rad" else 0.0 for value, unit in zip(command, units, strict=False)
    ]


def with_rest(
    commands: NDArray, active: NDArray, rest: float, units: Sequence[str] = ()
) -> tuple[NDArray, NDArray]:
    """Return commands [P, K + 1, C] and active [P, K + 1] with the stop at the end.

    Args:
        commands: [P, K, C], the last column the duration.
        active: [P, K].
        rest: duration of the stop, s; 0: both are returned unchanged.
        units: of a command's numbers; the angles of the last given one are held.
    """
    if rest <= 0:
        return commands, active
    plans, slots, width = commands.shape
    longer, more = np.zeros((plans, slots + 1, width)), np.zeros((plans, slots + 1), np.bool_)
    longer[:, :slots], more[:, :slots] = commands, active
    longer[:, slots, -1] = rest
    if slots and "rad" in units:
        held = [place for place, unit in enumerate(units) if unit == "rad"]
        last = slots - 1 - active[:, ::-1].argmax(axis=1)
        some = np.any(active, axis=1, keepdims=True)
        longer[:, slots, held] = np.where(some, commands[np.arange(plans), last][:, held], 0.0)
    return longer, more
