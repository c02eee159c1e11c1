"""The input of a motion network that is computed from its other inputs.

A caster swings round by the change of the direction of motion, to either side. At a reversal the
side changes: a jump that smooth functions of the other inputs cannot have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neurosim.simulators.motion.noise import CommandFeatures

#: A change of direction below this, in half turns, counts as none: the rest of an earlier command,
#: or rounding in float32, must not determine its side.
SAME = 1e-4


@dataclass(frozen=True)
class Derived:
    """The derived input after the others, if any.

    Attributes:
        swing: if not None, there is one for the change of direction: the angle from (prev_a,
            prev_b) to (a, b), a and b being the driven inputs, in half turns from -1 - swing up
            to 1 - swing; 0 if the robot stands before or after. So ``swing`` (in half turns)
            defines the side of a reversal, and how close to a reversal this holds.
    """

    swing: float | None = None

    def __len__(self) -> int:
        """Return the number of derived inputs."""
        return int(self.swing is not None)

    def append(self, columns: CommandFeatures, x: Tensor) -> Tensor:
        """Return scaled inputs [B, I] followed by the derived one, [B, I + len(self)].

        Args:
            columns: of the inputs.
            x: scaled inputs, the dead band applied.
        """
        if self.swing is None:
            return x
        now, before = x[:, list(columns.driven)], x[:, list(columns.before)]
        both = (now != 0).any(1) & (before != 0).any(1)
        # The angle of a standing robot is not used; at 0, 0 its gradient would not be finite.
        now, before = (torch.where(both.unsqueeze(1), speeds, 1.0) for speeds in (now, before))
        angle = torch.atan2(now[:, 1], now[:, 0]) - torch.atan2(before[:, 1], before[:, 0])
        turns = angle / math.pi
        turns = turns - 2.0 * (turns >= 1.0 - self.swing) + 2.0 * (turns < -1.0 - self.swing)
        both = both & (turns.abs() >= SAME)
        return torch.cat([x, torch.where(both, turns, 0.0).unsqueeze(1)], dim=1)


def can_swing(columns: CommandFeatures) -> bool:
    """Return whether a command drives two inputs with previous values, which have a direction."""
    return len(columns.driven) == 2 and min(columns.before) >= 0
