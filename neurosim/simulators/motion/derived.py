"""Inputs of a motion network that follow from its other inputs.

A product unit sees the sign and the power of each input by itself. Two things about a command it
cannot see in them, and both are sharp:

- whether the robot is told to move at all. A speed within the dead zone leaves a motor standing as
  a stop does, but a robot that is told to stop brakes, and one told to creep runs down.
- by which angle the direction of motion changes. A caster swings round by it, this way or that,
  and where the motion is reversed the two ways meet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neurosim.simulators.motion.noise import CommandFeatures

#: A direction that changes by less than this, half turns, does not: what rounding leaves of equal
#: directions must not say which way it changed.
SAME = 1e-9


@dataclass(frozen=True)
class Derived:
    """Which derived inputs stand after the others, in this order.

    Attributes:
        moving: whether there is one that is 1 where the command is to move and 0 for a stop.
        swing: if not None, there is one for the change of direction: the angle from (prev_a,
            prev_b) to (a, b), a and b being what a command drives, in half turns from -1 - swing up
            to 1 - swing; 0 where the robot stands before or after. So ``swing`` (in half turns)
            says which way round a reversal counts, and how nearly one it may be.
    """

    moving: bool = False
    swing: float | None = None

    def __len__(self) -> int:
        """Return how many there are."""
        return int(self.moving) + int(self.swing is not None)

    def tensor(self) -> Tensor:
        """Return it as numbers, [2]."""
        numbers = [float(self.moving), math.nan if self.swing is None else self.swing]
        return torch.tensor(numbers, dtype=torch.float64)

    @classmethod
    def of(cls, tensor: Tensor) -> Derived:
        """Return what :meth:`tensor` made numbers of."""
        moving, swing = tensor.tolist()
        return cls(bool(moving), None if math.isnan(swing) else swing)

    def append(self, columns: CommandFeatures, inputs: Tensor, scaled: Tensor) -> Tensor:
        """Return scaled inputs with the derived ones behind them, [B, I + len(self)].

        Args:
            columns: of the inputs.
            inputs: in the dataset's units, [B, I].
            scaled: the same, scaled, the dead zone applied, [B, I].
        """
        parts = [scaled]
        if self.moving:
            parts.append((inputs[:, list(columns.driven)] != 0).any(1, keepdim=True).to(scaled))
        if self.swing is not None:
            now, before = scaled[:, list(columns.driven)], scaled[:, list(columns.before)]
            angle = torch.atan2(now[:, 1], now[:, 0]) - torch.atan2(before[:, 1], before[:, 0])
            turns = angle / math.pi
            turns = turns - 2.0 * (turns >= 1.0 - self.swing) + 2.0 * (turns < -1.0 - self.swing)
            both = (now != 0).any(1) & (before != 0).any(1) & (turns.abs() >= SAME)
            parts.append(torch.where(both, turns, 0.0).unsqueeze(1))
        return torch.cat(parts, dim=1) if len(parts) > 1 else scaled


def can_swing(columns: CommandFeatures) -> bool:
    """Return whether a command drives two inputs, both remembered: a direction that changes."""
    return len(columns.driven) == 2 and min(columns.before) >= 0
