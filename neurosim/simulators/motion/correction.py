"""Five numbers that correct a motion network: for another floor, battery or wheel.

If two wheels travel l and r times as far as was learned, the track has another width and the robot
drifts, its motion is a linear map of forward distance and turn: four numbers, which fit any planar
robot. The fifth is slip to the outside of bends, in proportion to the acceleration to the side.

It is a correction of twists, not of displacements: within a command a robot may turn by more than a
whole turn, and then a displacement does not determine its twist. A drive model's pieces and the
networks' additions to them are twists, and linear. So a corrected simulator is as fast as before,
and a command may be cut as before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base.declared import Checked, Number
from neurosim.simulators.adjustable import Adjustable, adjustables
from neurosim.simulators.motion.drive import DriveModel

_RANGES = {
    "forward": (1 / 1.5, 1.5, "", True),
    "turn": (1 / 1.5, 1.5, "", True),
    "yaw": (-1.0, 1.0, "rad/m", False),
    "drift": (-0.02, 0.02, "m/rad", False),
    "slip": (-0.1, 0.1, "s", False),
}


@dataclass(frozen=True)
class Correction(Checked):
    """Corrections of the motion; by default none.

    Attributes:
        forward: factor of the distance forward.
        turn: factor of the turn.
        yaw: additional left turn per metre driven forward, rad/m.
        drift: additional distance forward per radian of turn, m/rad.
        slip: speed to the left per acceleration to the left, which is the product of the drive
            model's forward speed and turn rate, s.

    Raises:
        UserError: if one is not finite, or a factor not above 0.
    """

    forward: Annotated[float, Meta(gt=0, le=1e9)] = 1.0
    turn: Annotated[float, Meta(gt=0, le=1e9)] = 1.0
    yaw: Number = 0.0
    drift: Number = 0.0
    slip: Number = 0.0

    @property
    def parameters(self) -> tuple[Adjustable, ...]:
        """Return the five, with bounds that no robot of two wheels should leave."""
        return adjustables(self, _RANGES)

    def of_twists(self, twists: Tensor) -> Tensor:
        """Return corrected twists [..., 3] (m, m, rad), without the slip."""
        vx, vy, turn = twists.unbind(-1)
        ahead, turned = self.forward * vx + self.drift * turn, self.yaw * vx + self.turn * turn
        return torch.stack([ahead, vy, turned], dim=-1)

    def of_drive(self, drive: DriveModel) -> DriveModel:
        """Return a corrected drive model.

        The slip follows from the part of the motion that is linear in the speeds; it is a sum of
        their products, which a drive model has.
        """
        if self == Correction():
            return drive
        kinematics, count = self.of_twists(drive.kinematics), len(drive.lag)
        ahead, turn = kinematics[:count, 0], kinematics[:count, 2]
        # In the order of motion_features.
        pairs = [(i, j) for i in range(count) for j in range(i, count)]
        both = [ahead[i] * turn[j] + (ahead[j] * turn[i] if i != j else 0.0) for i, j in pairs]
        kinematics[count:, 1] += self.slip * torch.stack(both)
        return replace(drive, kinematics=kinematics, losses=self.of_twists(drive.losses))
