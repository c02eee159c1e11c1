"""Bodies of virtual robots behind the text-line protocol, and their descriptions."""

from __future__ import annotations

import math

from neurosim.base.commands import TWO_WHEELS
from neurosim.lab.nxt.body import (
    MODE_BRAKE,
    MODE_ON,
    MODE_REGULATED,
    TYPE_LIGHT_ACTIVE,
    NxtBody,
)
from neurosim.lab.nxt.params import LabParams
from neurosim.robots.lines.protocol import Counter, Greeting, Sensor

_TYPICAL = LabParams()
_HELD = MODE_ON | MODE_BRAKE | MODE_REGULATED
_SPEED_REGULATION, _RUNNING, _FULL_SCALE = 1, 0x20, 1023


class TwoWheels:
    """The virtual NXT's motors, light sensors, lamp and battery behind other electronics.

    Args:
        body: the body in the lab.
    """

    def __init__(self, body: NxtBody):
        self.body = body
        wiring = body.wiring
        self._wheels = (wiring.left, wiring.right)
        self._lights = (wiring.light_left, wiring.light_right)
        for port in self._lights:
            body.set_input(port, TYPE_LIGHT_ACTIVE, 0)
        params = body.params
        places = {
            name: {"x": params.light_ahead, "y": side * params.light_aside}
            for name, side in (("line_left", 1), ("line_right", -1))
        }
        per_metre = round(360 / (math.pi * _TYPICAL.diameter_left), 1)
        self.greeting = Greeting(
            name="two-wheels",
            firmware="neurosim-lab",
            commands=TWO_WHEELS.measured(
                full=_TYPICAL.full_speed * _TYPICAL.diameter_left / 2,
                track=_TYPICAL.track,
                radius=0.12,
            ),
            longest=60.0,
            sensors=tuple(Sensor(name, _FULL_SCALE, place) for name, place in places.items()),
            counters=(Counter("left", per_metre), Counter("right", per_metre)),
            lamp=True,
            battery=True,
            virtual=True,
        )

    @property
    def time(self) -> float:
        """Seconds since the lab was made."""
        return self.body.time

    def move(self, command: tuple[float, ...]) -> None:
        """Set both wheels, in percent, rounded to whole numbers."""
        for port, value in zip(self._wheels, command, strict=True):
            self.body.set_output(port, round(value), _HELD, _SPEED_REGULATION, 0, _RUNNING, 0)

    def halt(self) -> None:
        """Hold both wheels."""
        self.move((0.0, 0.0))

    def values(self) -> list[int]:
        """Return light (0..1023), pulses and millivolts."""
        lights = [_FULL_SCALE - self.body.input(port).raw for port in self._lights]
        pulses = [self.body.output(port).rotation_count for port in self._wheels]
        return [*lights, *pulses, self.body.battery_millivolts()]

    def lamp(self, on: bool) -> None:
        """Switch the lamp."""
        port = self.body.wiring.lamp
        assert port is not None
        self.body.set_output(port, 100 * on, MODE_ON, 0, 0, _RUNNING if on else 0, 0)
