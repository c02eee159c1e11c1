"""The protocol of controllers: genes <-> controller, and its command at each step.

A controller here is a family: its inputs, the columns of its commands, and the number of its genes,
which determine the rest. An individual is a row of genes. A batch of B individuals acts at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.declared import Checked
from neurosim.base.errors import UserError, unwritten
from neurosim.base.se2 import tensors as se2
from neurosim.networks.control import (
    GOAL_INPUTS,
    OF_GOALS,
    POLAR_INPUTS,
    POSE_INPUTS,
    TIME_INPUTS,
    NetworkArrays,
)

#: The command columns of a robot with two driven wheels, %.
WHEELS = ("left", "right")


class Controller(Checked):
    """A family of controllers; subclass it, give ``genes`` and :meth:`act`.

    Attributes:
        kind: its name in files and on the command line.
        inputs: its observations, by name: readings of sensors as the simulator and the robot name
            them, or :data:`POSE_INPUTS`, :data:`GOAL_INPUTS`, :data:`POLAR_INPUTS`,
            :data:`TIME_INPUTS`.
        outputs: columns of its commands, without a duration: a closed-loop controller gives a
            command at every step of the trial.
        genes: number of genes of an individual.
        memory: number of values that it keeps from step to step.
        open_loop: whether all its commands are known in advance, see :meth:`commands`.
        unit: of the commands.
        gene_range: bounds of each gene, for searches that need bounds.

    Example:
        >>> @dataclass(frozen=True)
        ... class Circle(ns.Controller):  # both wheels' speeds are genes
        ...     kind, genes, gene_range = "circle", 2, (-100.0, 100.0)
        ...
        ...     def act(self, genes, observation, memory):
        ...         return genes, memory
        >>> ns.evaluate("tables", "obstacle-avoidance", Circle())([[50, 40], [0, 0]]).shape
        (2,)
    """

    kind: ClassVar[str] = "controller"
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = WHEELS
    genes: int = 0
    memory: int = 0
    open_loop: bool = False
    unit: str = "%"
    gene_range: tuple[float, float] = (-3.0, 3.0)

    def first(self, count: int, generator: torch.Generator) -> Tensor:
        """Return a first population, [count, genes], float64: standard normal genes."""
        return torch.randn(count, self.genes, generator=generator, dtype=torch.float64)

    def start(self, rows: int) -> Tensor:
        """Return the memory [rows, memory] at the beginning of a trial: zeros."""
        return torch.zeros(rows, self.memory, dtype=torch.float64)

    def act(self, genes: Tensor, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return commands [B, C] (%) and memory [B, memory] after one step.

        Args:
            genes: [B, genes] of as many individuals.
            observation: [B, len(inputs)].
            memory: [B, memory] from :meth:`start` or the previous step.
        """
        raise unwritten(self, "act")

    def commands(self, genes: NDArray, rest: float) -> tuple[NDArray, NDArray]:
        """Return all commands of an open-loop controller.

        Args:
            genes: [P, genes].
            rest: duration of a stop at the end, s; 0: no stop.

        Returns:
            Commands [P, T, 3] (left %, right %, duration s) and active [P, T] bool; a command
            that is not active is not given. With ``rest`` the last is the stop, not active.
        """
        raise unwritten(self, "commands")

    def hand_tuned(self) -> NDArray | None:
        """Return hand-tuned genes [genes] as a start; None: there are none."""
        return None

    def named(self, genes: NDArray) -> dict[str, Any] | None:
        """Return the parameters of an individual [genes] by name; None: genes have no names."""
        return None

    def from_named(self, values: Mapping[str, float]) -> NDArray:
        """Return the genes [genes] of parameters by name; undoes :meth:`named`.

        Raises:
            UserError: if one is missing, unknown or out of bounds.
        """
        raise UserError(f"the genes of a {self.kind} have no names; give them as genes")

    def check(self, genes: NDArray) -> None:
        """Raise an error for an individual [genes] that is a mistake if a person writes it.

        Raises:
            UserError: with the reason.
        """

    def arrays(self) -> NetworkArrays | None:
        """Return the compiled form; None if this kind has none."""
        return None

    def settings(self) -> dict[str, Any]:
        """Return the settings of the family, for JSON."""
        return {}


def check_inputs(controller: Controller, readings: Sequence[str], goals: bool, where: str) -> None:
    """Raise an error for a controller that needs missing readings or goals.

    Args:
        controller: any controller.
        readings: names of the available sensors.
        goals: whether the task gives goals.
        where: the simulator or robot, for the message.

    Raises:
        UserError: naming the missing inputs.
    """
    known = {*readings, *POSE_INPUTS, *TIME_INPUTS, *(OF_GOALS if goals else ())}
    missing = [name for name in controller.inputs if name not in known]
    if missing:
        there = ", ".join(readings) if readings else "no sensors"
        why = "the task gives no goals" if set(missing) <= set(OF_GOALS) else f"it has {there}"
        raise UserError(
            f"the controller ({controller.kind}) needs {', '.join(missing)}, and {where} does not "
            f"have it: {why}"
        )


def observe(
    inputs: Sequence[str],
    readings: Tensor | None,
    reading_names: Sequence[str],
    pose: Tensor,
    goal: Tensor | None,
    time: float,
) -> Tensor:
    """Return the observations of controllers, [B, len(inputs)].

    Args:
        inputs: names, in order.
        readings: [B, S], or None where no input is a reading.
        reading_names: of the S sensors.
        pose: [B, 3] x (m), y (m), heading (rad).
        goal: [B, 3] the next goal's pose in the board's frame, or None.
        time: since the start, s.
    """
    columns = []
    for name in inputs:
        if name in POSE_INPUTS:
            place = POSE_INPUTS.index(name)
            columns.append(pose[:, place] if place < 2 else _circle(pose[:, 2], place - 2))
        elif name in GOAL_INPUTS:
            assert goal is not None
            place, away = GOAL_INPUTS.index(name), se2.between(pose, goal)
            columns.append(away[:, place] if place < 2 else _circle(away[:, 2], place - 2))
        elif name in POLAR_INPUTS:
            assert goal is not None
            columns.append(_polar(se2.between(pose, goal))[POLAR_INPUTS.index(name)])
        elif name in TIME_INPUTS:
            columns.append(torch.full_like(pose[:, 0], time))
        else:
            assert readings is not None
            columns.append(readings[:, list(reading_names).index(name)].to(pose))
    return torch.stack(columns, dim=1) if columns else pose.new_zeros(len(pose), 0)


def _polar(away: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return distance, bearing and approach [B] of goals [B, 3] in the robot's frame."""
    ahead, left, turn = away.unbind(1)
    side = torch.where(ahead >= 0.0, 1.0, -1.0).to(away)
    bearing = torch.atan2(side * left, side * ahead)
    approach = torch.remainder(turn - bearing + math.pi, 2.0 * math.pi) - math.pi
    return side * torch.hypot(ahead, left), bearing, approach


def _circle(angle: Tensor, place: int) -> Tensor:
    return angle.sin() if place else angle.cos()
