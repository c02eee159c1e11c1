"""Gaits of a four-legged robot: a trot of 20 parameters (Zagal et al. 2004, section 5.1.1).

Each foot moves along a locus in the plane that the turn rate skews: on the ground straight back,
then lifting, through the air, and descending. Two legs that stand diagonally move together, and
the other two half a cycle later. The paper names the parameters, but not their formulas and bounds;
these are neurosim's own.

The locus is between a half ellipse (Kohl and Stone 2004) and a trapezoid, by the shape factor. Its
heights are those at the end of lifting, in the middle of the air stage and at the beginning of
descending, times the lift factor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from neurosim.base.errors import UserError
from neurosim.controllers.base import Controller
from neurosim.networks.control import TIME_INPUTS
from neurosim.robots.quadruped import (
    FRONT,
    HIPS,
    JOINTS,
    KNEE,
    LEGS,
    SIDE,
    angles_of,
    standing,
)


class GaitParameter(NamedTuple):
    """A parameter of a gait.

    Attributes:
        name: of it.
        low, high: bounds.
        unit: SI, or nothing.
    """

    name: str
    low: float
    high: float
    unit: str = ""


#: In the order of the genes: 9 of the locus, 7 of the operating point, 3 of timing, 1 of the stage.
GAIT_PARAMETERS = (
    GaitParameter("length", 0.01, 0.10, "m"),
    GaitParameter("shape", 0.0, 1.0),
    GaitParameter("lift", 0.3, 1.5),
    GaitParameter("front_lift_height", 0.0, 0.04, "m"),
    GaitParameter("front_air_height", 0.005, 0.05, "m"),
    GaitParameter("front_descend_height", 0.0, 0.04, "m"),
    GaitParameter("rear_lift_height", 0.0, 0.04, "m"),
    GaitParameter("rear_air_height", 0.005, 0.05, "m"),
    GaitParameter("rear_descend_height", 0.0, 0.04, "m"),
    GaitParameter("front_x", -0.04, 0.08, "m"),
    GaitParameter("front_y", 0.0, 0.05, "m"),
    GaitParameter("front_z", 0.06, 0.125, "m"),
    GaitParameter("rear_x", -0.08, 0.04, "m"),
    GaitParameter("rear_y", 0.0, 0.05, "m"),
    GaitParameter("rear_z", 0.06, 0.125, "m"),
    GaitParameter("turn", -0.6, 0.6, "rad/s"),
    GaitParameter("ground_speed", 0.05, 0.4, "m/s"),
    GaitParameter("lift_time", 0.02, 0.2, "s"),
    GaitParameter("ground_fraction", 0.4, 0.75),
    GaitParameter("air_points", 1.0, 12.0),
)
NAMES = tuple(one.name for one in GAIT_PARAMETERS)

#: Shortest and longest cycle, s: gaits that tremble, or barely move, are excluded.
CYCLE = (0.4, 2.0)
#: Time in which the loci grow from a stand, s.
BEGIN = 0.5
#: Diagonal legs are in phase, the two pairs half a cycle apart.
PHASE = np.array([0.0, 0.5, 0.5, 0.0])
#: Number of computed points of each stage except the air stage.
_GROUND, _LIFT = 12, 4


#: Tuned by hand before any learning, and not to be changed: learning starts from it and is compared
#: with it.
HAND_TUNED = {
    "length": 0.055,
    "shape": 0.5,
    "lift": 1.0,
    "front_lift_height": 0.012,
    "front_air_height": 0.02,
    "front_descend_height": 0.012,
    "rear_lift_height": 0.012,
    "rear_air_height": 0.02,
    "rear_descend_height": 0.012,
    "front_x": 0.02,
    "front_y": 0.015,
    "front_z": 0.095,
    "rear_x": -0.02,
    "rear_y": 0.015,
    "rear_z": 0.1,
    "turn": 0.0,
    "ground_speed": 0.14,
    "lift_time": 0.06,
    "ground_fraction": 0.55,
    "air_points": 6.0,
}


def genes_of(
    values: Mapping[str, float] | ArrayLike,
    parameters: Sequence[GaitParameter] = GAIT_PARAMETERS,
) -> NDArray[np.float64]:
    """Return the genes [G] in 0..1 of a gait's parameters in their units.

    Args:
        values: all values by name, or [G] in the order of the parameters.
        parameters: those of the gait; by default the 20 of a trot.

    Raises:
        UserError: if one is missing, unknown, not finite or out of bounds.
    """
    names = [one.name for one in parameters]
    if isinstance(values, Mapping):
        wrong = [*(set(names) - set(values)), *(set(values) - set(names))]
        if wrong:
            raise UserError(
                f"a gait has the parameters {', '.join(names)}; {wrong[0]} is missing or unknown"
            )
        values = [values[name] for name in names]
    given = np.asarray(values, np.float64)
    if given.shape != (len(names),):
        raise UserError(f"a gait has {len(names)} parameters, not {given.shape}")
    for one, value in zip(parameters, given, strict=True):
        if not one.low <= value <= one.high:
            raise UserError(
                f"the gait's {one.name} is {value:g}, outside of {one.low:g} to {one.high:g}"
                f"{' ' * bool(one.unit)}{one.unit}"
            )
    low, width = _bounds(parameters)
    return (given - low) / width


def values_of(
    genes: NDArray[np.float64], parameters: Sequence[GaitParameter] = GAIT_PARAMETERS
) -> NDArray[np.float64]:
    """Return parameters [..., G] in their units of genes [..., G], which are cut to 0..1."""
    low, width = _bounds(parameters)
    return low + width * np.clip(genes, 0.0, 1.0)


def _bounds(parameters: Sequence[GaitParameter]) -> tuple[NDArray, NDArray]:
    """Return the lowest values of parameters, and the widths of their ranges."""
    low = np.array([one.low for one in parameters])
    return low, np.array([one.high for one in parameters]) - low


def loci(genes: NDArray[np.float64]) -> tuple[NDArray, NDArray, float]:
    """Return the points of a gait's loci.

    Args:
        genes: [20] in 0..1.

    Returns:
        Feet [4, N, 3] m from their hips (forward, outwards, up), the time of each point [N] as a
        fraction of the cycle, 0 to 1, and the cycle, s. The last point is the first one again.
    """
    value = dict(zip(NAMES, values_of(np.asarray(genes, np.float64)).tolist(), strict=True))
    ground = value["ground_fraction"]
    cycle = float(np.clip(value["length"] / value["ground_speed"] / ground, *CYCLE))
    lifting = min(value["lift_time"] / cycle, 0.4 * (1.0 - ground))
    air = 1.0 - ground - 2.0 * lifting
    points = round(value["air_points"])
    stages = [
        np.linspace(0.0, ground, _GROUND, endpoint=False),
        ground + np.linspace(0.0, lifting, _LIFT, endpoint=False),
        ground + lifting + np.linspace(0.0, air, points, endpoint=False),
        1.0 - lifting + np.linspace(0.0, lifting, _LIFT + 1),
    ]
    times = np.concatenate(stages)
    swing = np.clip((times - ground) / (1.0 - ground), 0.0, 1.0)
    forward = np.where(times < ground, 0.5 - times / ground, 0.0)
    rises = np.clip((times - ground) / lifting, 0.0, 1.0)
    falls = np.clip((1.0 - times) / lifting, 0.0, 1.0)
    crossing = np.clip((times - ground - lifting) / air, 0.0, 1.0)
    shape, feet = value["shape"], np.empty((4, len(times), 3))
    for leg in range(4):
        end = "front" if FRONT[leg] else "rear"
        heights = [value[f"{end}_{stage}_height"] for stage in ("lift", "air", "descend")]
        height = value["lift"] * np.interp(crossing, [0.0, 0.5, 1.0], heights)
        trapezoid = crossing - 0.5, np.minimum(rises, falls) * height
        ellipse = -0.5 * np.cos(np.pi * swing), np.sin(np.pi * swing) * height
        ahead, up = (shape * a + (1.0 - shape) * b for a, b in zip(trapezoid, ellipse, strict=True))
        ahead = value["length"] * np.where(times < ground, forward, ahead)
        up = np.where(times < ground, 0.0, up)
        x, y, z = (value[f"{end}_{axis}"] for axis in "xyz")
        # The turn moves each hip forward or back and to a side; the locus follows that direction.
        at_x, at_y = HIPS[leg, 0] + x, HIPS[leg, 1] + SIDE[leg] * y
        speed = max(value["length"] / (ground * cycle), 1e-6)
        skew = np.arctan2(value["turn"] * at_x, speed - value["turn"] * at_y)
        feet[leg] = np.stack(
            [x + ahead * np.cos(skew), y + SIDE[leg] * ahead * np.sin(skew), up - z], axis=1
        )
    return feet, times, cycle


class Gaits(Controller):
    """Gaits whose commands, joint angles in rad, depend on time alone; give :meth:`over`.

    Genes are the parameters' fractions of their ranges.

    Attributes:
        parameters: the genes' meaning.
    """

    parameters: ClassVar[tuple[GaitParameter, ...]]
    inputs = tuple(TIME_INPUTS)
    unit = "rad"
    gene_range = (0.0, 1.0)

    def over(self, genes: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands [P, T, joints] rad of individuals [P, G] at times [T] s."""
        raise NotImplementedError

    def first(self, count: int, generator: torch.Generator) -> Tensor:
        """Return a first population [count, G]: anywhere within the bounds."""
        return torch.rand(count, self.genes, generator=generator, dtype=torch.float64)

    def act(self, genes: Tensor, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the commands [B, joints] rad at the observed times; there is no memory."""
        times, row = np.unique(observation[:, 0].numpy(), return_inverse=True)
        angles = np.empty((len(genes), len(self.outputs)))
        for place, time in enumerate(times):  # a single time if all began together
            angles[row == place] = self.over(genes.numpy()[row == place], np.array([time]))[:, 0]
        return torch.from_numpy(angles), memory

    def from_named(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the genes [G] of parameters by name, in their units; undoes :meth:`named`.

        Raises:
            UserError: if one is missing, unknown or out of bounds.
        """
        return genes_of(values, self.parameters)

    def named(self, genes: NDArray[np.float64]) -> dict[str, Any]:
        """Return the parameters of a gait [G] by name, in their units."""
        names = [one.name for one in self.parameters]
        return dict(zip(names, values_of(genes, self.parameters).tolist(), strict=True))


class Gait(Gaits):
    """The trots of a four-legged robot."""

    kind = "gait"
    parameters = GAIT_PARAMETERS
    outputs = JOINTS
    genes = len(NAMES)

    def over(self, genes: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands [P, T, 12] rad of individuals [P, 20] at times [T] s."""
        stand, begin = standing(), np.clip(np.asarray(times) / BEGIN, 0.0, 1.0)[:, None]
        joints = np.empty((len(genes), len(times), len(JOINTS)))
        for row, each in enumerate(genes):
            feet, at, cycle = loci(each)
            angles, _ = angles_of(feet, KNEE[:, None])
            for leg in range(4):
                phase = (np.asarray(times) / cycle + PHASE[leg]) % 1.0
                for joint in range(3):
                    # Outwards is to the right on the right side.
                    sign = SIDE[leg] if joint == 1 else 1.0
                    joints[row, :, 3 * leg + joint] = np.interp(
                        phase, at, sign * angles[leg, :, joint]
                    )
            joints[row] = stand + begin * (joints[row] - stand)
        return joints

    def check(self, genes: NDArray[np.float64]) -> None:
        """Raise an error for a gait [20] whose feet are out of the legs' reach.

        In a search such a gait moves as its joints allow; a person's gait is a mistake.

        Raises:
            UserError: naming the leg and the point.
        """
        feet, _, _ = loci(genes)
        _, reached = angles_of(feet, KNEE[:, None])
        if not reached.all():
            leg, place = np.argwhere(~reached)[0]
            x, y, z = 100.0 * feet[leg, place]
            raise UserError(
                f"the {LEGS[leg].replace('_', ' ')} foot cannot reach {x:.1f} cm forward, "
                f"{y:.1f} cm outwards and {-z:.1f} cm down from its hip"
            )

    def hand_tuned(self) -> NDArray[np.float64]:
        """Return the genes [20] of the gait that was tuned by hand."""
        return genes_of(HAND_TUNED)
