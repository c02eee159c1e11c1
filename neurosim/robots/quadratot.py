"""QuadraTot, a quadruped of nine servos: its joints, and its servos' positions.

Yosinski, Clune, Hidalgo, Nguyen, Zagal and Lipson, "Evolving robot gaits in hardware", ECAL 2011:
four legs of an inner and an outer servo each, and one servo between the front and the rear half.
Each leg moves in the vertical plane through the middle and its hip. A servo's positions
are 0 to 1023 over 300 degrees; at 512, the middle, all legs stretch out flat. A higher inner
position lifts the leg, a lower outer position folds the lower leg down.

Frames follow ROS REP 103: x forward, y left, z up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Time between two positions for the servos, s (40 Hz).
FRAME = 0.025
#: In the order of the servos' numbers: two of each leg, around the body; the last is the centre.
LEGS = ("left_front", "right_front", "right_rear", "left_rear")
JOINTS = (*(f"{leg}_{joint}" for leg in LEGS for joint in ("inner", "outer")), "centre")

#: A step of a servo's position, rad, and the position in the middle.
STEP, MIDDLE = np.radians(300.0) / 1024.0, 512
#: Lowest and highest position that each servo is given; outside of these the legs hit the body.
LIMITS = np.array([(150, 770), (30, 680)] * 4 + [(392, 632)])
#: Positions in the crouch before and after a trial.
READY = np.array([770, 40] * 4 + [512])


def angles_of(positions: NDArray) -> NDArray[np.float64]:
    """Return the joint angles [..., 9] rad of servo positions [..., 9].

    Positions are rounded to whole numbers within :data:`LIMITS`, like a servo's.
    """
    whole = np.clip(np.trunc(positions), LIMITS[:, 0], LIMITS[:, 1])
    return STEP * (whole - MIDDLE)
