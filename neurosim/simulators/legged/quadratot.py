"""The model of QuadraTot, a real quadruped of nine servos, as MJCF.

From Yosinski et al. 2011: the mass with its computer, the servos (nine AX-12+), their limits, 40
commands a second. From the makers of the servos: 53.5 g each, a stall torque of 1.5 N m, no load
speed 6.2 rad/s at 12 V; a servo gives its full torque at 32 positions (0.16 rad) from its goal or
more. From the authors' programs (github.com/yosinski/QuadraTot): a speed limit of 250 units (2.9
rad/s). From their simulator of it (quadrasim, by Glette): the positions of the hips, the lengths of
the legs, the size of the two halves. The distribution of the mass, the servos' torque at their
voltage, all friction, the slip of the feet, and the position of the tracked light are guesses. They
were fixed before any comparison with the real robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Coordinate, Fraction
from neurosim.base.errors import UserError
from neurosim.robots.quadratot import FRAME, JOINTS, LEGS, LIMITS, READY, angles_of
from neurosim.simulators.legged.build import Amount, LeggedBuild, Positive, friction_of, numbers

#: Mass of each servo, kg.
SERVO = 0.0535
#: Positions of the hips: ahead of or behind the axis' middle, to the side, and below it, m.
HIP = (0.064, 0.07, 0.055)
UPPER = 0.10  # length of the upper legs, m
#: Each half: thickness along the axis, width, and the height of its top above the axis, m.
HALF = (0.036, 0.116, 0.016)
#: Radii of the upper legs and servos, and of the lower legs, m.
THICK, THIN = 0.018, 0.006
#: Fraction of a leg's mass that is in the upper leg: a guess.
UPPER_FRACTION = 0.45


@dataclass(frozen=True)
class QuadraTot(LeggedBuild):
    """The build of a QuadraTot.

    Its pose is that of a light on its back, which a camera above tracked. Falls do not end a trial.

    Attributes:
        mass: of the whole robot, kg.
        leg: mass of each leg, with the servo in it, kg.
        rear: fraction of the remaining mass that is in the rear half.
        shin: length of each lower leg, m.
        belly: height of the halves below the hips, m.
        light: distance of the light ahead of the middle, m.
        friction: Coulomb's coefficient of the lower legs, along them.
        belly_friction: of the halves and the upper legs.
        gravity: m/s^2.
        slip: time constant of the feet's creep, s.
        slip_ratio: ratio of a foot's creep to the side over that along the leg.
        p: gain of the servos, N m/rad.
        d: loss of a servo's torque with its speed, N m s/rad.
        torque: largest torque of a servo, N m.
        speed: largest speed of a servo's goal, rad/s.
        joint_friction: dry friction of each servo, N m.
        timestep: s.
        iterations: largest number of the solver's iterations in a step.
        cone: of friction, ``elliptic`` or ``pyramidal``.
        armature: inertia of each servo's motor and gear, kg m^2.
        damping: of each joint, N m s/rad.
    """

    robot: ClassVar[str] = "quadratot"
    joints: ClassVar[tuple[str, ...]] = JOINTS
    frame: ClassVar[float] = FRAME
    radius: ClassVar[float] = 0.19
    ranges: ClassVar[dict[str, tuple[float, float, str, bool]]] = {
        "leg": (0.15, 0.33, "kg", False),
        "rear": (0.35, 0.75, "", False),
        "shin": (0.12, 0.15, "m", False),
        "belly": (0.02, 0.045, "m", False),
        "light": (-0.08, 0.08, "m", False),
        "friction": (0.2, 1.2, "", True),
        "belly_friction": (0.1, 1.2, "", True),
        "slip": (0.003, 0.12, "s", True),
        "slip_ratio": (0.25, 4.0, "", True),
        "p": (3.0, 25.0, "N m/rad", True),
        "d": (0.05, 0.6, "N m s/rad", True),
        "torque": (0.6, 1.8, "N m", True),
        "speed": (1.5, 4.5, "rad/s", True),
        "joint_friction": (0.01, 0.2, "N m", True),
    }
    fallen: ClassVar[float] = -np.inf
    highest: ClassVar[float] = np.inf
    settles: ClassVar[float] = 1.5
    drop: ClassVar[float] = 0.15

    mass: Positive = 1.88
    leg: Positive = 0.24
    rear: Fraction = 0.55
    shin: Positive = 0.136
    belly: Positive = 0.037
    light: Coordinate = 0.0
    friction: Amount = 0.6
    belly_friction: Amount = 0.4
    gravity: Amount = 9.81
    slip: Amount = 0.02
    slip_ratio: Amount = 1.0
    p: Amount = 9.2
    d: Amount = 0.24
    torque: Amount = 1.2
    speed: Positive = 2.9
    joint_friction: Amount = 0.05
    timestep: Annotated[float, Meta(ge=1e-5, le=1)] = 0.005
    iterations: Annotated[int, Meta(ge=1, le=10000)] = 20
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    armature: Amount = 0.005
    damping: Amount = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        lower = (1.0 - UPPER_FRACTION) * self.leg
        if lower <= SERVO or 4.0 * self.leg >= self.mass:
            raise UserError(
                f"a leg of {self.leg:g} kg does not fit a robot of {self.mass:g} kg with a servo "
                f"of {SERVO:g} kg in each lower leg"
            )

    @classmethod
    def standing(cls) -> NDArray[np.float64]:
        return angles_of(READY)

    @classmethod
    def limits(cls) -> list[tuple[float, float]]:
        low, high = angles_of(LIMITS.T)
        return list(zip(low.tolist(), high.tolist(), strict=True))

    def mjcf(self) -> str:
        """Return the model as MJCF.

        The trunk is the rear half; its origin is below the light, on the axis between the halves.
        All parts touch the floor, and pass through each other.
        """
        body = self.mass - 4.0 * self.leg
        rear = self._half("rear", body * self.rear) + self._leg(2) + self._leg(3)
        front = self._half("front", body * (1.0 - self.rear)) + self._leg(0) + self._leg(1)
        rest = friction_of(self.belly_friction, self.belly_friction)
        others = [
            "front",
            "rear",
            *(f"{leg}_{part}" for leg in LEGS for part in ("upper", "motor")),
        ]
        pairs = self.feet(["floor"], LEGS) + "".join(
            f'<pair geom1="floor" geom2="{part}" condim="3" friction="{rest}" solref="0.012 1"/>'
            for part in others
        )
        actuators = "".join(
            f'<pid name="{joint}" joint="{joint}" input="pos" kp="{self.p}" kv="{self.d}" '
            f'slewmax="{self.speed}" forcerange="{-self.torque} {self.torque}"/>'
            for joint in JOINTS
        )
        return f"""<mujoco model="quadratot">
{self.options()}
<worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="trunk" pos="0 0 {self.drop}"><freejoint name="free"/>{rear}
<body name="front"><joint name="centre" axis="1 0 0" range="-0.7 0.7"/>{front}</body></body>
</worldbody>
<contact>{pairs}</contact>
<actuator>{actuators}</actuator>
</mujoco>"""

    def _half(self, name: str, mass: float) -> str:
        thick, wide, top = HALF
        middle = 0.5 * thick if name == "front" else -0.5 * thick
        high = top + HIP[2] + self.belly
        place = numbers([middle - self.light, 0.0, top - 0.5 * high])
        size = numbers([0.5 * thick, 0.5 * wide, 0.5 * high])
        return f'<geom name="{name}" type="box" pos="{place}" size="{size}" mass="{mass}"/>'

    def _leg(self, index: int) -> str:
        leg = LEGS[index]
        ahead = 1.0 if leg.endswith("front") else -1.0
        aside = 1.0 if leg.startswith("left") else -1.0
        place = numbers([ahead * HIP[0] - self.light, aside * HIP[1], -HIP[2]])
        heading = 0.5 * np.arctan2(aside, ahead)  # the legs point along the diagonals
        turned = numbers([np.cos(heading), 0.0, 0.0, np.sin(heading)])
        upper = UPPER_FRACTION * self.leg
        inner, outer = (numbers([low - 0.05, high + 0.05]) for low, high in self.limits()[:2])
        return f"""<body name="{leg}_hip" pos="{place}" quat="{turned}">
<joint name="{leg}_inner" axis="0 -1 0" range="{inner}"/>
<geom name="{leg}_upper" type="capsule" fromto="0.01 0 0 {UPPER} 0 0.004" size="{THICK}"
 mass="{upper}"/>
<body name="{leg}_knee" pos="{UPPER} 0 0.004">
<joint name="{leg}_outer" axis="0 -1 0" range="{outer}"/>
<geom name="{leg}_motor" type="capsule" fromto="0 0 0 0.035 0 0" size="{THICK}" mass="{SERVO}"/>
<geom name="{leg}_lower" type="capsule" fromto="0.035 0 0 {self.shin - THIN} 0 -0.016"
 size="{THIN}" mass="{self.leg - upper - SERVO}"/></body></body>
"""
