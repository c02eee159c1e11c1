"""The model of the walking robot, as MJCF that is written here (extra ``mujoco``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

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
)

#: Share of a leg's mass that is in the upper leg.
UPPER_SHARE = 0.6


#: Quantities that are above 0, or not below.
Positive = Annotated[float, Meta(gt=0, le=10_000)]
Amount = Annotated[float, Meta(ge=0, le=1e12)]


@dataclass(frozen=True)
class Build(Checked):
    """How the robot and the place are built; the defaults are the simulator's, not a real robot's.

    Attributes:
        head, neck, body, leg: masses, kg; of each leg.
        friction: Coulomb's coefficient of the feet, ahead.
        gravity: m/s^2.
        slip: time constant of the feet's creep, s.
        slip_ratio: how much more a foot creeps to the side than ahead.
        p, i, d: gains of each joint's controller, N m/rad, N m/(rad s), N m s/rad.
        torque: most that a joint gives, N m.
        timestep: s.
        iterations: most that the solver makes in a step.
        cone: of friction, ``elliptic`` or ``pyramidal``.
        armature: inertia of each joint's motor and gear, kg m^2.
        damping: of each joint, N m s/rad.
        joint_friction: dry friction of each joint, N m.
        backlash: how far each joint can be turned with its motor standing still, rad; 0: none.
        legs: length of each lower leg, as a share of what it should be.
        bumps: (x, y, radius, height) of flat spherical caps on the floor, m.
    """

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
    legs: tuple[Positive, Positive, Positive, Positive] = (1.0, 1.0, 1.0, 1.0)
    bumps: tuple[tuple[Coordinate, Coordinate, Coordinate, Coordinate], ...] = field(default=())

    def __post_init__(self) -> None:
        super().__post_init__()
        steps = FRAME / self.timestep
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
            raise UserError(f"the timestep must divide {FRAME:g} s evenly, not {self.timestep:g} s")


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


def compile_model(build: Build) -> Any:
    """Return the compiled model, an ``MjModel``; one that blows up is not begun anew."""
    package = mujoco()
    model = package.MjModel.from_xml_string(mjcf(build))
    model.opt.disableflags |= int(package.mjtDisableBit.mjDSBL_AUTORESET)
    return model


def mjcf(build: Build) -> str:
    """Return the model as MJCF.

    The head and the neck do not move. Lower legs, elbows included, the trunk and the head touch
    the floor; the legs pass through each other.
    """
    legs = "".join(_leg(build, index) for index in range(len(LEGS)))
    actuators = "".join(
        f'<pid name="{joint}" joint="{joint}" input="pos" kp="{build.p}" ki="{build.i}" '
        f'kv="{build.d}" imax="{build.torque / 4}" forcerange="{-build.torque} {build.torque}"/>'
        for joint in JOINTS
    )
    sideways = build.friction / np.sqrt(build.slip_ratio)
    feet = _friction(build.friction, sideways)
    floors = ["floor", *(f"bump_{n}" for n in range(len(build.bumps)))]
    pairs = "".join(
        f'<pair geom1="{floor}" geom2="{leg}_lower" condim="3" friction="{feet}" '
        f'solref="0.012 1" solimp="0.9 0.95 0.002" solreffriction="{build.slip} 1"/>'
        for floor in floors
        for leg in LEGS
    )
    pairs += "".join(
        f'<pair geom1="floor" geom2="{part}" condim="3" friction="{_friction(0.4, 0.4)}"/>'
        for part in ("body", "head")
    )
    bumps = "".join(
        f'<geom name="bump_{n}" type="ellipsoid" pos="{x} {y} 0" size="{radius} {radius} {height}" '
        'contype="0" conaffinity="0"/>'
        for n, (x, y, radius, height) in enumerate(build.bumps)
    )
    return f"""<mujoco model="quadruped">
<compiler angle="radian" autolimits="true"/>
<option timestep="{build.timestep}" iterations="{build.iterations}" cone="{build.cone}"
 integrator="implicitfast" gravity="0 0 {-build.gravity}"/>
<default><geom contype="0" conaffinity="0"/>
<joint damping="{build.damping}" armature="{build.armature}"
 frictionloss="{build.joint_friction}"/></default>
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


def _friction(ahead: float, sideways: float) -> str:
    """Return a pair's coefficients; the contact's first tangent is along the lower leg."""
    return _numbers([ahead, sideways, 0.005, 0.0001, 0.0001])


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _leg(build: Build, index: int) -> str:
    leg, lower = LEGS[index], LOWER * build.legs[index]
    side, knee = SIDE[index], KNEE[index]
    fold = sorted((knee * FOLD[0], knee * FOLD[1]))
    spread = sorted((side * SPREAD[0], side * SPREAD[1]))

    def joint(name: str, axis: str, limits: Sequence[float]) -> str:
        made = f'<joint name="{leg}_{name}" axis="{axis}" range="{_numbers(limits)}"/>'
        if build.backlash > 0.0:
            half = 0.5 * build.backlash
            made += (
                f'<joint name="{leg}_{name}_play" axis="{axis}" range="{-half} {half}" '
                'damping="0.002" frictionloss="0" armature="0.0001" solreflimit="0.01 1"/>'
            )
        return made

    upper_mass = UPPER_SHARE * build.leg
    return f"""<body name="{leg}_hip" pos="{_numbers(HIPS[index])}">
{joint("swing", "0 1 0", SWING)}{joint("spread", "1 0 0", spread)}
<geom name="{leg}_upper" type="capsule" fromto="0 0 0 0 0 {-UPPER}" size="0.014"
 mass="{upper_mass}"/>
<body name="{leg}_knee" pos="0 0 {-UPPER}">{joint("knee", "0 1 0", fold)}
<geom name="{leg}_lower" type="capsule" fromto="0 0 0 0 0 {-lower}" size="{FOOT}"
 mass="{build.leg - upper_mass}"/></body></body>
"""
