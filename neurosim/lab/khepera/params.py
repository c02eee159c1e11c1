"""Parameters that differ from one virtual Khepera to the next."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

#: Of the body: radius and distance between the wheels (m).
RADIUS, WHEEL_BASE = 0.0275, 0.053
#: Pulses of the encoders for a metre of the nominal wheel, and the speed of the number 1 (m/s).
PULSES_PER_METRE, SPEED_UNIT = 10_000.0, 0.010
#: Directions of the sensors, degrees counter-clockwise from straight ahead, in reading order.
SENSOR_ANGLES = (80.0, 44.0, 12.0, -12.0, -44.0, -80.0, -168.0, 168.0)
#: Fraction of infra-red light that walls and obstacles reflect; all are of the same white paper.
WHITE = 0.9


def _eight(value: float) -> NDArray[np.float64]:
    return np.full(8, float(value))


@dataclass(frozen=True, eq=False)
class KheperaParams:
    """One robot: two values are its left and its right motor, eight its sensors.

    Attributes:
        gain: a wheel's speed over the commanded one.
        dead_band: m/s that a wheel loses to friction.
        lag: time constant of a wheel's speed, s.
        wheel: true over nominal distance of a turn of the wheel.
        slip: standard deviation of the distance that a wheel loses on the floor, relative.
        slip_time: correlation time of the slip, s.
        friction: of the rim along a wall.
        angle: directions of the sensors, rad.
        reach: m2; light from a white wall straight ahead, one metre away, over the light that
            makes a sensor read its full range.
        threshold: loss of light in the sensors' circuit, relative to the same.
        offset: counts that a sensor reads without light.
        noise: standard deviation of a reading, counts.
        light_noise: of the light, relative.
        ambient: counts of ambient light; fewer are more light.
        drift: standard deviation of the ambient light's drift, counts.
        drift_time: correlation time of the drift, s.
    """

    gain: NDArray[np.float64] = field(default_factory=lambda: np.ones(2))
    dead_band: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    lag: NDArray[np.float64] = field(default_factory=lambda: np.full(2, 0.04))
    wheel: NDArray[np.float64] = field(default_factory=lambda: np.ones(2))
    slip: float = 0.0
    slip_time: float = 0.3
    friction: float = 0.3
    angle: NDArray[np.float64] = field(default_factory=lambda: np.radians(SENSOR_ANGLES))
    reach: NDArray[np.float64] = field(default_factory=lambda: _eight(1.20e-3))
    threshold: NDArray[np.float64] = field(default_factory=lambda: _eight(0.6))
    offset: NDArray[np.float64] = field(default_factory=lambda: _eight(0.0))
    noise: float = 0.0
    light_noise: float = 0.0
    ambient: NDArray[np.float64] = field(default_factory=lambda: _eight(480.0))
    drift: float = 0.0
    drift_time: float = 60.0

    @classmethod
    def ideal(cls, **changes: object) -> KheperaParams:
        """Return a robot without faults, for hand-worked numbers."""
        return replace(cls(), **changes)

    @classmethod
    def sampled(cls, seed: int) -> KheperaParams:
        """Return the robot of this number."""
        rng = np.random.default_rng([seed, 0x6B4E])
        normal = rng.standard_normal
        return cls(
            gain=1.0 + 0.02 * normal(2),
            dead_band=rng.uniform(0.0005, 0.002, 2),
            lag=rng.uniform(0.03, 0.06, 2),
            wheel=1.0 + 0.01 * normal(2),
            slip=0.01,
            friction=float(rng.uniform(0.2, 0.4)),
            angle=np.radians(np.array(SENSOR_ANGLES) + 2.0 * normal(8)),
            reach=1.20e-3 * np.exp(0.15 * normal(8)),
            threshold=0.6 * np.exp(0.08 * normal(8)),
            offset=rng.uniform(0.0, 3.0, 8),
            noise=4.0,
            light_noise=0.025,
            ambient=480.0 + 15.0 * normal(8),
            drift=8.0,
        )

    def motor_row(self) -> NDArray[np.float64]:
        """Return the parameters for :func:`neurosim.lab.khepera.physics.advance`."""
        return np.concatenate(
            [
                self.gain,
                self.dead_band,
                self.lag,
                self.wheel,
                [self.slip, self.slip_time, self.friction],
                [self.drift, self.drift_time],
            ]
        )
