"""The build of the walking robot: its legs, their joints, and inverse kinematics.

It has four legs of three joints each, and about the size of the robot of Zagal et al. 2004, a Sony
AIBO. Frames follow ROS REP 103: x forward, y left, z up, from the middle of the trunk.

A leg hangs from its hip: a joint that swings it about y, one that spreads it outwards about x, the
upper leg, the knee about y, the lower leg. Angles are zero where the leg hangs straight down.
Positive swing moves the foot back, positive spread moves it outwards, positive knee folds the
lower leg back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2

#: Time between two commands of the joints, a frame (Zagal et al. 2004, section 5.2), s.
FRAME = 0.008
#: In the order of columns of commands.
LEGS = ("left_front", "right_front", "left_rear", "right_rear")
LEG_JOINTS = ("swing", "spread", "knee")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in LEG_JOINTS)
FRONT = np.array([True, True, False, False])
#: 1 if outwards is to the left.
SIDE = np.array([1.0, -1.0, 1.0, -1.0])
#: Sign of the knee: elbows of the front legs point back, knees of the rear legs forward, so that
#: the lower legs lead forward in front and back behind.
KNEE = np.array([-1.0, -1.0, 1.0, 1.0])

#: Positions of the hips in the trunk's frame, m, [4, 3].
HIPS = np.stack([np.where(FRONT, 0.06, -0.06), 0.055 * SIDE, np.zeros(4)], axis=1)
UPPER, LOWER = 0.064, 0.070  # lengths, m
FOOT = 0.009  # radius of the lower leg and of the foot, m

#: Lowest and highest angle of each joint of a leg, rad; the knee's is its fold.
SWING, SPREAD, FOLD = (-2.0, 2.0), (-0.2, 1.5), (0.1, 2.5)
#: Pose before walking: swing, spread and fold of the front and rear legs, rad.
STANCE = ((0.45, 0.15, 1.0), (-0.55, 0.15, 1.1))


def standing() -> NDArray[np.float64]:
    """Return the angles of all joints of a robot that stands, [12] rad."""
    legs = np.array([STANCE[0 if front else 1] for front in FRONT])
    legs[:, 2] *= KNEE
    return legs.ravel()


def foot(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions of feet, [..., 3] m from their hips: forward, outwards, up.

    Args:
        angles: [..., 3] swing, spread and knee of a leg, rad.
    """
    swing, spread, knee = np.moveaxis(np.asarray(angles, np.float64), -1, 0)
    along, down = -LOWER * np.sin(knee), UPPER + LOWER * np.cos(knee)
    drop = -down * np.cos(spread)
    return np.stack(
        [
            along * np.cos(swing) + drop * np.sin(swing),
            down * np.sin(spread),
            -along * np.sin(swing) + drop * np.cos(swing),
        ],
        axis=-1,
    )


def angles_of(
    feet: NDArray[np.float64], knee: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the joint angles for positions of the feet: inverse kinematics.

    A position out of reach is replaced by the nearest possible one, or one near it.

    Args:
        feet: [..., 3] m from the hips: forward, outwards, up.
        knee: [...] 1 or -1, the side to which the knee folds.

    Returns:
        Angles [..., 3] rad, and whether each position [...] is within reach.
    """
    x, y, z = np.moveaxis(np.asarray(feet, np.float64), -1, 0)
    square = x * x + y * y + z * z
    cosine = (square - UPPER**2 - LOWER**2) / (2.0 * UPPER * LOWER)
    fold = np.arccos(np.clip(cosine, -1.0, 1.0))
    bent = np.clip(fold, *FOLD)
    along, down = -LOWER * np.sin(knee * bent), UPPER + LOWER * np.cos(bent)
    sine = y / np.maximum(down, 1e-9)
    spread = np.arcsin(np.clip(sine, -1.0, 1.0))
    swing = se2.wrapped(np.arctan2(x, z) - np.arctan2(along, -down * np.cos(spread)))
    angles = np.stack(
        [np.clip(swing, *SWING), np.clip(spread, *SPREAD), knee * bent],
        axis=-1,
    )
    reached = (np.abs(cosine) <= 1.0) & (np.abs(sine) <= 1.0) & (np.abs(fold - bent) < 1e-12)
    reached &= (np.abs(angles[..., 0] - swing) < 1e-12) & (np.abs(angles[..., 1] - spread) < 1e-12)
    return angles, reached
