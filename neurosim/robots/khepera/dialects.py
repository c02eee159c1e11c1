"""The dialects of the Kheperas and the e-pucks on the serial line.

All take a letter followed by numbers with commas, and answer with the same letter in lower case,
numbers with commas, CR LF. Sources: K-Team, Khepera User Manual 5.02 (1999) and Khepera II User
Manual 1.1 (2002), appendix A; Khepera III User Manual, appendix A; the Khepera IV's ``kh4server.c``
and ``khepera4.h`` of its libkhepera; the firmware ``asercom``/``sercom`` of the e-puck (EPFL,
GCtronic) and ``Asercom2.c``, ``e_motors.c``, ``proximity.c``, ``battery_level.h`` of the e-puck2's
(e-puck2_main-processor), with GCtronic's page "Advanced sercom protocol".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from neurosim.base.errors import UserError
from neurosim.robots.base import Geometry


@dataclass(frozen=True)
class Dialect:
    """The protocol of one robot.

    Attributes:
        name: its name on the command line.
        robot: its name in a sentence.
        baud: the line's speed as delivered.
        stop_bits: 1 or 2.
        version: command that asks for the firmware's version.
        read_counts: command that reads the position counters; None if there is none.
        set_counts: letter that sets the position counters; None if there is none: the driver then
            counts from their last values.
        long: prefix of a 32-bit number in a command.
        lamp: commands that switch the lamp on and off.
        banners: texts, anywhere in a line, that the robot sends when it is switched on.
        sensors: indices of the used infra-red sensors in the answer's numbers.
        values: number of numbers in an answer about the sensors.
        angles: directions of the sensors, degrees counter-clockwise from straight ahead.
        full_scale: largest proximity reading.
        dark: reading of a sensor of ambient light in the dark; it falls with light.
        scan: duration of reading all sensors in turn, s; a reading's mean age is half of it; 0 if
            unknown.
        pulses_per_metre: of the position counters.
        speed_unit: the wheel speed of the number 1, m/s.
        full_speed: default speed at 100 %, in the robot's own units.
        max_speed: the largest number for a speed.
        geometry: of the body.
        end: end of a command.
        error: beginning of an answer that rejects a command.
        battery: command that asks for the battery's voltage.
        battery_unit: voltage of the number 1 in its answer, V.
        not_this: a text in the version of another robot with similar answers, and its dialect.
    """

    name: str
    robot: str
    baud: int
    stop_bits: int
    version: str
    read_counts: str
    set_counts: str | None
    long: str
    lamp: tuple[str, str] | None
    banners: tuple[str, ...]
    sensors: tuple[int, ...]
    values: int
    angles: tuple[float, ...]
    full_scale: int
    dark: int
    scan: float
    pulses_per_metre: float
    speed_unit: float
    full_speed: int
    max_speed: int
    geometry: Geometry
    end: str = "\r"
    error: str = "z"
    battery: str | None = None
    battery_unit: float = 0.0
    not_this: tuple[str, str] | None = None


#: Khepera I and II. A speed of 1 is one pulse in 10 ms: 10 mm/s at the 10 pulses a millimetre of
#: Lund and Miglino 1996 (the manual's 12 pulses a millimetre make it 8 mm/s).
KHEPERA = Dialect(
    name="khepera",
    robot="Khepera",
    baud=9600,
    stop_bits=2,
    version="B",
    read_counts="H",
    set_counts="G",
    long="",
    lamp=("L,0,1", "L,0,0"),
    banners=("ROM of minirobot KHEPERA",),
    sensors=tuple(range(8)),
    values=8,
    angles=(90.0, 45.0, 10.0, -10.0, -45.0, -90.0, -170.0, 170.0),
    full_scale=1023,
    dark=512,
    scan=0.020,
    pulses_per_metre=10_000.0,
    speed_unit=0.010,
    full_speed=10,
    max_speed=127,
    geometry=Geometry(radius=0.0275, wheel_base=0.053),
)

#: Khepera III. Its sensors are put into the Khepera's order, if the Khepera has them: left 90, 45,
#: front left, front right, right 45, 90, back right, back left; the one straight behind and the
#: two under it are left out.
KHEPERA3 = Dialect(
    name="khepera3",
    robot="Khepera III",
    baud=115_200,
    stop_bits=1,
    version="B",
    read_counts="R",
    set_counts="I",
    long="l",
    lamp=None,
    banners=("Khepera III", "KheperaIII"),
    sensors=(1, 2, 3, 4, 5, 6, 7, 0),
    values=12,
    angles=(90.0, 45.0, 10.0, -10.0, -45.0, -90.0, -135.0, 135.0),
    full_scale=4095,
    dark=4095,
    scan=0.0,
    pulses_per_metre=1000 / 0.047,
    speed_unit=0.001 / 144.01,
    full_speed=14_400,  # 10 cm/s, in steps that a grid of speeds divides
    max_speed=43_000,
    geometry=Geometry(radius=0.065, wheel_base=0.0884),
)

#: Khepera IV, whose program kh4server answers on a serial port of the robot. Its sensors begin
#: behind to the left and go round to the right; the four under it are left out.
KHEPERA4 = Dialect(
    name="khepera4",
    robot="Khepera IV",
    baud=115_200,
    stop_bits=1,
    version="B",
    read_counts="R",
    set_counts=None,  # I sets them to 0 only
    long="",
    lamp=("K" + ",63" * 9, "K" + ",0" * 9),  # three lights of three colours
    banners=(),
    sensors=tuple(range(8)),
    values=12,
    angles=(135.0, 90.0, 45.0, 0.0, -45.0, -90.0, -135.0, 180.0),
    full_scale=1023,
    dark=1023,
    scan=0.0,
    pulses_per_metre=1 / 0.000_006_781,
    speed_unit=0.000_678_1,
    full_speed=150,  # 10 cm/s
    max_speed=1500,
    geometry=Geometry(radius=0.0704, wheel_base=0.1054),
    end="\n",  # its system reads whole lines at a time
    error="$",
    battery="V,0",
    battery_unit=0.001,
)

#: e-puck: stepper motors, 1000 steps a turn of a wheel 41 mm across; counters of 16 bits.
EPUCK = Dialect(
    name="epuck",
    robot="e-puck",
    baud=115_200,
    stop_bits=1,
    version="V",
    read_counts="Q",
    set_counts="P",
    long="",
    lamp=("B,1", "B,0"),
    banners=("SerCom protocol",),
    sensors=tuple(range(8)),
    values=8,
    angles=(-17.0, -49.0, -90.0, -150.0, 150.0, 90.0, 49.0, 17.0),
    full_scale=4095,
    dark=4095,
    scan=0.0,
    pulses_per_metre=1000 / (math.pi * 0.041),
    speed_unit=math.pi * 0.041 / 1000,
    full_speed=1000,
    max_speed=1000,
    geometry=Geometry(radius=0.035, wheel_base=0.053),
    not_this=("Version 2.0 January 2018", "epuck2"),  # an e-puck's may be 2.0.0 of 2008
)

#: e-puck2: as the e-puck, but P is answered and sets nothing, and its sensors are read in turn 100
#: times a second. Its battery is measured behind a divider of 0.6, at 12 bits of 3 V.
EPUCK2 = replace(
    EPUCK,
    name="epuck2",
    robot="e-puck2",
    set_counts=None,
    scan=0.010,
    battery="b",
    battery_unit=3.0 / (4096 * 0.6),
    not_this=("Version 1", "epuck"),
)

DIALECTS = {dialect.name: dialect for dialect in (KHEPERA, KHEPERA3, KHEPERA4, EPUCK, EPUCK2)}


def dialect_named(name: str) -> Dialect:
    """Return the dialect of this name.

    Raises:
        UserError: if the name is unknown.
    """
    try:
        return DIALECTS[name]
    except KeyError:
        known = ", ".join(DIALECTS)
        raise UserError(f"dialect {name!r} is not known; there are {known}") from None
