"""Coefficients of the virtual lab: one robot, one board, one camera.

No learner reads them. They are chosen so that the unpredictable part of a command of Pretorius et
al. 2009, section 5.1 (mainly slip) is 2 or 3 mm and 1 to 2 degrees. The predictable part (lag, dead
band, unequal motors, caster) is many times larger.
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import dataclass, fields, replace

import numpy as np

from neurosim.base.closed_line import distance_to
from neurosim.base.perimeter import Board
from neurosim.base.place import Line
from neurosim.robots.base import LIGHT_AHEAD, LIGHT_ASIDE

#: The board of a place without one, with its frame at its centre.
BOARD = Board()
#: Reflected light, 0..1, as a light sensor close to it sees it: of the board, of its perimeter
#: line, of a line that is printed on it, and of the floor around it.
BOARD_LIGHT, PERIMETER_LIGHT, PRINT_LIGHT, FLOOR_LIGHT = 0.55, 0.25, 0.2, 0.35


def printed_fraction(line: Line, x: float, y: float, spot: float) -> float:
    """Return the fraction of a round spot at a point that a line covers.

    Args:
        line: the line.
        x, y: m, board frame.
        spot: radius, m; small next to the line's bends.
    """
    away = distance_to(line.loop.points, x, y)
    near, far = line.width / 2 - away, line.width / 2 + away
    return _of_disc(near / spot) + _of_disc(far / spot) - 1.0


def _of_disc(depth: float) -> float:
    """Return the fraction of a unit disc inside an edge, with its centre at this depth."""
    d = min(max(depth, -1.0), 1.0)
    return 0.5 + (d * math.sqrt(1.0 - d * d) + math.asin(d)) / math.pi


@dataclass(frozen=True)
class LabParams:
    """An NXT robot and the ground it drives on. The defaults are a typical robot.

    Speeds of a wheel are angular (rad/s); "left" is the wheel at +y of the robot frame.
    """

    #: Motor: angular speed at 100 % (rad/s; 0.5 m/s at the rim of a 56 mm wheel), the voltage
    #: (V) at which that is also the fastest the motor can turn, and each motor's own gain.
    full_speed: float = 0.5 / 0.028
    rated_voltage: float = 7.5
    gain_left: float = 1.006
    gain_right: float = 0.994
    #: First-order lag (s) at the rated voltage, driven; braked; left to coast.
    lag_left: float = 0.100
    lag_right: float = 0.107
    brake_lag: float = 0.05
    coast_lag: float = 0.25
    #: Speed regulation: ripple as a fraction of the speed, and its periods per wheel turn.
    ripple: float = 0.012
    ripple_periods: float = 5.0
    #: Without regulation: speed lost to the load, as a fraction of full speed.
    load_droop: float = 0.06
    #: Power (%) under which the wheel does not turn, and the push (% s) that a standing wheel
    #: takes to break loose.
    dead_band_left: float = 4.3
    dead_band_right: float = 3.8
    breakaway: float = 0.6
    #: A stopping wheel slower than this stands (rad/s).
    stop_speed: float = 0.1

    #: Wheel diameters and track (m).
    diameter_left: float = 0.0560
    diameter_right: float = 0.0562
    track: float = 0.130
    #: The axle's midpoint is this far (m) ahead of the point that the robot turns about.
    pivot_offset: float = 0.002
    #: Sideways drift in a curve: m/s per (m/s)(rad/s).
    side_slip: float = 0.006

    #: Longitudinal slip: the mean, the smooth field over the board (standard deviation,
    #: correlation length in m), the draw for each new motor command, and the mean off the board.
    slip_mean: float = 0.01
    slip_field: float = 0.012
    slip_length: float = 0.4
    slip_draw: float = 0.010
    slip_floor: float = 0.05
    #: Seed of the slip field.
    slip_seed: float = 0.0

    #: Caster: distance behind the axle and trail (m); the fraction of speed it takes when it stands
    #: across; yaw (rad) per metre travelled when across; the push that decides which way it
    #: swings round, and how much that varies from command to command.
    caster_distance: float = 0.09
    caster_trail: float = 0.016
    caster_drag: float = 0.18
    caster_yaw: float = 1.0
    caster_bias: float = 0.16
    caster_draw: float = 0.05

    #: Battery: open-circuit voltage when the lab starts (V), voltage lost per hour standing and,
    #: on top, per hour at full load, and sag (V) at full load.
    battery: float = 8.1
    battery_idle_loss: float = 0.05
    battery_drive_loss: float = 0.35
    battery_sag: float = 0.6

    #: The room's walls stand this far (m) beyond the board's edge.
    room: float = 0.8

    #: Positions of the light sensors ahead of the axle and to either side (m).
    light_ahead: float = LIGHT_AHEAD
    light_aside: float = LIGHT_ASIDE
    #: Light sensors: noise of a reading (0..1) and the radius of the spot they see (m).
    light_noise: float = 0.006
    light_spot: float = 0.008
    #: Ambient light that a sensor sees with its own lamp off (0..1).
    light_ambient: float = 0.12
    #: Lamp: time constant of its filament (s).
    lamp_lag: float = 0.004

    @classmethod
    def sampled(cls, seed: int) -> LabParams:
        """Return the robot of a lab's seed, which differs from all other robots."""
        rng = np.random.default_rng([seed, 0x0B0D])
        typical = cls()
        asymmetry = rng.normal(0.0, 0.008)
        return replace(
            typical,
            gain_left=1.0 + asymmetry / 2 + rng.normal(0.0, 0.002),
            gain_right=1.0 - asymmetry / 2 + rng.normal(0.0, 0.002),
            lag_left=typical.lag_left * rng.uniform(0.9, 1.1),
            lag_right=typical.lag_right * rng.uniform(0.9, 1.1),
            dead_band_left=rng.uniform(3.5, 4.5),
            dead_band_right=rng.uniform(3.5, 4.5),
            diameter_left=typical.diameter_left + rng.normal(0.0, 1e-4),
            diameter_right=typical.diameter_right + rng.normal(0.0, 1e-4),
            track=typical.track + rng.normal(0.0, 5e-4),
            pivot_offset=rng.normal(0.0, 0.002),
            slip_seed=float(rng.integers(1, 2**31)),
            caster_drag=typical.caster_drag * rng.uniform(0.8, 1.2),
            caster_yaw=typical.caster_yaw * rng.uniform(0.8, 1.2),
            caster_bias=float(rng.choice([-1.0, 1.0]) * rng.uniform(0.12, 0.2)),
            battery=rng.uniform(7.9, 8.2),
        )

    @classmethod
    def ideal(cls) -> LabParams:
        """Return a perfect unicycle with lagging motors, for checks by hand."""
        off = dict.fromkeys(_IMPERFECTIONS, 0.0)
        return replace(
            cls(),
            **off,
            gain_left=1.0,
            gain_right=1.0,
            lag_right=cls.lag_left,
            diameter_right=cls.diameter_left,
            battery=cls.rated_voltage,
        )

    def coefficients(self) -> Coefficients:
        """Return the same numbers in the form that the compiled physics takes."""
        return Coefficients(*(float(getattr(self, field.name)) for field in fields(self)))


_IMPERFECTIONS = (
    *("ripple", "load_droop", "dead_band_left", "dead_band_right", "breakaway", "stop_speed"),
    *("pivot_offset", "side_slip", "slip_mean", "slip_field", "slip_draw", "slip_floor"),
    *("caster_drag", "caster_yaw", "battery_idle_loss", "battery_drive_loss", "battery_sag"),
    *("light_noise", "lamp_lag"),
)

#: :class:`LabParams` as a named tuple of floats: what Numba can read by name.
Coefficients = namedtuple("Coefficients", [field.name for field in fields(LabParams)])


@dataclass(frozen=True)
class CameraParams:
    """A roof camera: optics, sensor and clock. Lengths in metres, times in seconds."""

    size: tuple[int, int] = (640, 480)
    fps: float = 30.0
    #: Height of the optical centre above the board; the board fills the picture but for this
    #: margin on every side, before distortion.
    height: float = 2.6
    margin: float = 0.10
    #: Tilt about the board's x axis, and about its y axis, and roll about the line of sight (rad).
    tilt: float = 0.05
    pan: float = -0.02
    roll: float = 0.015
    #: Principal point off the picture's centre, as a fraction of its width and height.
    principal: tuple[float, float] = (0.012, -0.009)
    #: Brown-Conrady distortion k1, k2, p1, p2, k3, as OpenCV orders it.
    distortion: tuple[float, float, float, float, float] = (-0.13, 0.03, 0.0006, -0.0004, 0.0)
    exposure: float = 0.008
    #: Sensor noise (standard deviation, grey levels), and how much darker the picture's corners
    #: and the board's dark end are than the middle.
    noise: float = 2.0
    vignetting: float = 0.18
    gradient: float = 0.12
    #: The camera's clock reads ``clock_offset + (1 + clock_drift) * time``, with this jitter
    #: (standard deviation) on every frame's time stamp.
    clock_offset: float = 12.5
    clock_drift: float = 20e-6
    clock_jitter: float = 0.0002
    #: Probability that a frame never arrives.
    dropped: float = 0.0
