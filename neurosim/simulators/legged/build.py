"""Builds of legged robots, among them the walking robot's, as MJCF (extra ``mujoco``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Checked, Coordinate
from neurosim.base.errors import UserError
from neurosim.robots.quadruped import (
    FOLD,
    FOOT,
    FRAME,
    HIPS,
    JOINTS,
    KNEE,
    LEGS,
    LOWER,
    SIDE,
    SPREAD,
    SWING,
    UPPER,
    standing,
)

#: Name of a model's numbers lag and speed; a model without them has ideal servos.
SERVO = "servo"

#: Fraction of a leg's mass that is in the upper leg.
UPPER_FRACTION = 0.6


#: Quantities that must be above 0, or not below 0.
Positive = Annotated[float, Meta(gt=0, le=10_000)]
Amount = Annotated[float, Meta(ge=0, le=1e12)]


@dataclass(frozen=True)
class LeggedBuild(Checked):
    """The build of a legged robot and its place; each robot has a subclass.

    The model's free body is named ``trunk``; its pose is the robot's.

    Attributes:
        robot: its name in files.
        joints: in the order of the columns of commands.
        frame: time between two commands of the joints, s.
        radius: of the robot, m.
        ranges: adjustable quantities: name -> lowest, highest, unit, whether the scale is
            logarithmic.
        fallen: cosine of the angle of the back from straight up beyond which the robot has fallen.
        highest: largest height of a walking robot's trunk, m.
        settles: time of standing before a trial, s, after a fall from the height ``drop`` (m); 0:
            it is placed with its feet on the floor.
        friction: Coulomb's coefficient of the lower legs, along them.
        gravity: m/s^2.
        slip: time constant of the feet's creep, s.
        slip_ratio: ratio of a foot's creep to the side over that ahead.
        joint_friction: dry friction of each joint, N m.
        timestep: s.
        iterations: largest number of the solver's iterations in a step.
        cone: of friction, ``elliptic`` or ``pyramidal``.
        armature: inertia of each joint's motor and gear, kg m^2.
        damping: of each joint, N m s/rad.
    """

    robot: ClassVar[str]
    joints: ClassVar[tuple[str, ...]]
    frame: ClassVar[float]
    radius: ClassVar[float]
    ranges: ClassVar[dict[str, tuple[float, float, str, bool]]]
    fallen: ClassVar[float]
    highest: ClassVar[float]
    settles: ClassVar[float] = 0.0
    drop: ClassVar[float] = 0.0

    friction: Amount
    gravity: Amount
    slip: Amount
    slip_ratio: Amount
    joint_friction: Amount
    timestep: Annotated[float, Meta(ge=1e-5, le=1)]
    iterations: Annotated[int, Meta(ge=1, le=10000)]
    cone: Literal["elliptic", "pyramidal"]
    armature: Amount
    damping: Amount

    def __post_init__(self) -> None:
        super().__post_init__()
        steps = self.frame / self.timestep
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
            raise UserError(
                f"the timestep must divide {self.frame:g} s evenly, not {self.timestep:g} s"
            )

    @classmethod
    def standing(cls) -> NDArray[np.float64]:
        """Return the angles of all joints of a standing robot, rad."""
        raise NotImplementedError

    @classmethod
    def limits(cls) -> list[tuple[float, float]]:
        """Return the lowest and highest angle of each joint, rad."""
        raise NotImplementedError

    def mjcf(self) -> str:
        """Return the model as MJCF."""
        raise NotImplementedError

    def options(self) -> str:
        """Return the beginning of the model: units, solver, and properties of all joints."""
        return f"""<compiler angle="radian" autolimits="true"/>
<option timestep="{self.timestep}" iterations="{self.iterations}" cone="{self.cone}"
 jacobian="sparse" integrator="implicitfast" gravity="0 0 {-self.gravity}"/>
<default><geom contype="0" conaffinity="0"/>
<joint damping="{self.damping}" armature="{self.armature}"
 frictionloss="{self.joint_friction}"/></default>"""

    def feet(self, floors: Sequence[str], legs: Sequence[str]) -> str:
        """Return the contacts of all lower legs with all floors."""
        friction = friction_of(self.friction, self.friction / np.sqrt(self.slip_ratio))
        return "".join(
            f'<pair geom1="{floor}" geom2="{leg}_lower" condim="3" friction="{friction}" '
            f'solref="0.012 1" solimp="0.9 0.95 0.002" solreffriction="{self.slip} 1"/>'
            for floor in floors
            for leg in legs
        )


@dataclass(frozen=True)
class Build(LeggedBuild):
    """The build of the walking robot; the defaults are the simulator's, not a real robot's.

    Attributes:
        head, neck, body, leg: masses, kg; of each leg.
        friction: Coulomb's coefficient of the feet, ahead.
        gravity: m/s^2.
        slip: time constant of the feet's creep, s.
        slip_ratio: ratio of a foot's creep to the side over that ahead.
        p, i, d: gains of each joint's controller, N m/rad, N m/(rad s), N m s/rad.
        torque: largest torque of a joint, N m.
        timestep: s.
        iterations: largest number of the solver's iterations in a step.
        cone: of friction, ``elliptic`` or ``pyramidal``.
        armature: inertia of each joint's motor and gear, kg m^2.
        damping: of each joint, N m s/rad.
        joint_friction: dry friction of each joint, N m.
        backlash: play of each joint while its motor stands, rad; 0: none.
        lag: time constant with which the goal of a joint's controller follows its commands, s; 0:
            none.
        speed: fastest change of this goal, rad/s; 0: no limit.
        legs: length of each lower leg, as a fraction of the nominal one.
        bumps: (x, y, radius, height) of flat spherical caps on the floor, m.
    """

    robot: ClassVar[str] = "walker"
    joints: ClassVar[tuple[str, ...]] = JOINTS
    frame: ClassVar[float] = FRAME
    radius: ClassVar[float] = 0.15
    ranges: ClassVar[dict[str, tuple[float, float, str, bool]]] = {
        "head": (0.08, 0.4, "kg", False),
        "neck": (0.03, 0.2, "kg", False),
        "body": (0.3, 1.2, "kg", False),
        "leg": (0.06, 0.3, "kg", False),
        "friction": (0.3, 1.5, "", True),
        "gravity": (8.0, 11.5, "m/s^2", False),
        "slip": (0.003, 0.12, "s", True),
        "slip_ratio": (0.25, 4.0, "", True),
        "p": (1.5, 15.0, "N m/rad", True),
        "i": (0.3, 15.0, "N m/(rad s)", True),
        "d": (0.02, 0.4, "N m s/rad", True),
        "torque": (0.25, 2.0, "N m", True),
    }
    fallen: ClassVar[float] = 0.5
    highest: ClassVar[float] = 0.35

    head: Positive = 0.20
    neck: Positive = 0.08
    body: Positive = 0.60
    leg: Positive = 0.15
    friction: Amount = 0.8
    gravity: Amount = 9.81
    slip: Amount = 0.02
    slip_ratio: Amount = 1.0
    p: Amount = 6.0
    i: Amount = 3.0
    d: Amount = 0.1
    torque: Amount = 0.9
    timestep: Annotated[float, Meta(ge=1e-5, le=1)] = 0.004
    iterations: Annotated[int, Meta(ge=1, le=10000)] = 20
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    armature: Amount = 0.0015
    damping: Amount = 0.01
    joint_friction: Amount = 0.0
    backlash: Amount = 0.0
    lag: Amount = 0.0
    speed: Amount = 0.0
    legs: tuple[Positive, Positive, Positive, Positive] = (1.0, 1.0, 1.0, 1.0)
    bumps: tuple[tuple[Coordinate, Coordinate, Coordinate, Coordinate], ...] = field(default=())

    @classmethod
    def standing(cls) -> NDArray[np.float64]:
        return standing()

    @classmethod
    def limits(cls) -> list[tuple[float, float]]:
        legs = [(SWING, SPREAD, tuple(sorted(knee * fold for fold in FOLD))) for knee in KNEE]
        return [(float(low), float(high)) for leg in legs for low, high in leg]

    def mjcf(self) -> str:
        """Return the model as MJCF.

        The head and the neck do not move. Lower legs, elbows included, the trunk and the head
        touch the floor; the legs pass through each other.
        """
        return _mjcf(self)


@dataclass(frozen=True)
class ServoBuild(Build):
    """The walking robot with the properties of its servos, which can be adjusted, too.

    The paper's twelve parameters do not have them, and with the true values of these twelve a
    simulator predicts the lab's gaits no better than with wrong ones.
    """

    robot: ClassVar[str] = "walker-with-servos"
    ranges: ClassVar[dict[str, tuple[float, float, str, bool]]] = {
        **Build.ranges,
        "joint_friction": (0.003, 0.1, "N m", True),
        "backlash": (0.003, 0.06, "rad", True),
        "lag": (0.003, 0.06, "s", True),
        "speed": (3.0, 15.0, "rad/s", True),
    }

    joint_friction: Amount = 0.015
    backlash: Amount = 0.012
    lag: Amount = 0.015
    speed: Amount = 8.0


def mujoco() -> Any:
    """Return the package MuJoCo.

    Raises:
        UserError: if it is not installed, or has no ``<pid>`` actuator yet.
    """
    try:
        import mujoco
    except ImportError:
        raise UserError(
            "the walking robot needs the package mujoco: pip install 'neurosim[mujoco]'"
        ) from None
    if not hasattr(mujoco.mjtDyn, "mjDYN_PID"):
        raise UserError(f"the walking robot needs mujoco 3.12 or newer, not {mujoco.__version__}")
    return mujoco


def compile_model(build: LeggedBuild) -> Any:
    """Return the compiled model, an ``MjModel``, which is not reset after a numerical blow-up."""
    package = mujoco()
    model = package.MjModel.from_xml_string(build.mjcf())
    model.opt.disableflags |= int(package.mjtDisableBit.mjDSBL_AUTORESET)
    return model


def _mjcf(build: Build) -> str:
    legs = "".join(_leg(build, index) for index in range(len(LEGS)))
    actuators = "".join(
        f'<pid name="{joint}" joint="{joint}" input="pos" kp="{build.p}" ki="{build.i}" '
        f'kv="{build.d}" imax="{build.torque / 4}" forcerange="{-build.torque} {build.torque}"/>'
        for joint in JOINTS
    )
    floors = ["floor", *(f"bump_{n}" for n in range(len(build.bumps)))]
    pairs = build.feet(floors, LEGS)
    pairs += "".join(
        f'<pair geom1="floor" geom2="{part}" condim="3" friction="{friction_of(0.4, 0.4)}"/>'
        for part in ("body", "head")
    )
    bumps = "".join(
        f'<geom name="bump_{n}" type="ellipsoid" pos="{x} {y} 0" size="{radius} {radius} {height}" '
        'contype="0" conaffinity="0"/>'
        for n, (x, y, radius, height) in enumerate(build.bumps)
    )
    servo = f'<custom><numeric name="{SERVO}" data="{build.lag} {build.speed}"/></custom>'
    return f"""<mujoco model="quadruped">
{build.options()}{servo if build.lag or build.speed else ""}
<worldbody><geom name="floor" type="plane" size="0 0 1"/>{bumps}
<body name="trunk" pos="0 0 0.2"><freejoint name="free"/>
<geom name="body" type="capsule" fromto="-0.06 0 0.01 0.06 0 0.01" size="0.045"
 mass="{build.body}"/>
<body name="neck" pos="0.085 0 0.05">
<geom name="neck" type="capsule" fromto="0 0 -0.02 0.03 0 0.04" size="0.018" mass="{build.neck}"/>
<body name="head" pos="0.05 0 0.06">
<geom name="head" type="ellipsoid" pos="0.02 0 0.01" size="0.06 0.035 0.035"
 mass="{build.head}"/></body></body>
{legs}</body></worldbody>
<contact>{pairs}</contact>
<actuator>{actuators}</actuator>
</mujoco>"""


def friction_of(ahead: float, sideways: float) -> str:
    """Return a pair's coefficients; the contact's first tangent is along a leg's capsule."""
    return numbers([ahead, sideways, 0.005, 0.0001, 0.0001])


def numbers(values: Sequence[float]) -> str:
    """Return numbers as text for MJCF."""
    return " ".join(f"{value:.9g}" for value in values)


def _leg(build: Build, index: int) -> str:
    leg, lower = LEGS[index], LOWER * build.legs[index]
    side, knee = SIDE[index], KNEE[index]
    fold = sorted((knee * FOLD[0], knee * FOLD[1]))
    spread = sorted((side * SPREAD[0], side * SPREAD[1]))

    def joint(name: str, axis: str, limits: Sequence[float]) -> str:
        made = f'<joint name="{leg}_{name}" axis="{axis}" range="{numbers(limits)}"/>'
        if build.backlash > 0.0:
            half = 0.5 * build.backlash
            made += (
                f'<joint name="{leg}_{name}_play" axis="{axis}" range="{-half} {half}" '
                'damping="0.002" frictionloss="0" armature="0.0001" solreflimit="0.01 1"/>'
            )
        return made

    upper_mass = UPPER_FRACTION * build.leg
    return f"""<body name="{leg}_hip" pos="{numbers(HIPS[index])}">
{joint("swing", "0 1 0", SWING)}{joint("spread", "1 0 0", spread)}
<geom name="{leg}_upper" type="capsule" fromto="0 0 0 0 0 {-UPPER}" size="0.014"
 mass="{upper_mass}"/>
<body name="{leg}_knee" pos="0 0 {-UPPER}">{joint("knee", "0 1 0", fold)}
<geom name="{leg}_lower" type="capsule" fromto="0 0 0 0 0 {-lower}" size="{FOOT}"
 mass="{build.leg - upper_mass}"/></body></body>
"""
