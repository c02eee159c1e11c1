"""The virtual NXT's hardware: three outputs, four inputs, a battery, on top of the physics.

It is the interface for a brick's firmware. All calls take effect at the body's own time, which
:class:`neurosim.lab.nxt.world.Lab` advances. Mode, regulation and run state are the numbers of
LEGO's Direct Commands (LEGO MINDSTORMS NXT Bluetooth Developer Kit, appendix 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from neurosim.base.place import Place
from neurosim.lab.nxt import physics
from neurosim.lab.nxt.params import (
    BOARD,
    BOARD_LIGHT,
    FLOOR_LIGHT,
    PERIMETER_LIGHT,
    PRINT_LIGHT,
    LabParams,
    printed_fraction,
)
from neurosim.lab.nxt.physics import S, U

MODE_ON, MODE_BRAKE, MODE_REGULATED = 0x01, 0x02, 0x04
REGULATION_IDLE = 0
RUN_STATE_IDLE = 0x00
TYPE_LIGHT_ACTIVE, TYPE_LIGHT_INACTIVE = 5, 6
#: Full colour, red, green, blue: the types that light the colour sensor's lamp.
TYPES_COLOUR_LIT = (13, 14, 15, 16)


@dataclass(frozen=True)
class Wiring:
    """The wiring: outputs A, B, C are 0, 1, 2; inputs 1 to 4 are 0 to 3."""

    left: int = 1
    right: int = 2
    lamp: int | None = 0
    light_left: int = 0
    light_right: int = 1
    colour: int | None = 2


@dataclass
class Output:
    """An output as it was last set, with its three counters in whole degrees."""

    power: int = 0
    mode: int = 0
    regulation: int = 0
    turn_ratio: int = 0
    run_state: int = 0
    tacho_limit: int = 0
    tacho_count: int = 0
    block_tacho_count: int = 0
    rotation_count: int = 0


class InputValues(NamedTuple):
    """An input: ``raw`` is what the converter reads, 0..1023, lower where a sensor sees more."""

    valid: bool
    raw: int
    type: int
    mode: int


def ground_light(x: float, y: float, spot: float, around: Place = Place()) -> float:  # noqa: B008
    """Return the light (0..1) that the ground at (x, y) reflects to a sensor close to it.

    Edges are blurred by the sensor's round spot, as a linear ramp.

    Args:
        x, y: m, board frame.
        spot: its radius, m.
        around: the place, with its board and its lines.
    """
    board, light = around.board or BOARD, BOARD_LIGHT
    inside = min(board.length / 2 - abs(x), board.width / 2 - abs(y))
    if board.line_width:
        from_line = abs(inside - board.line_inset)
        fraction = _fraction((board.line_width / 2 - from_line) / spot)
        light += (PERIMETER_LIGHT - light) * fraction
    for line in around.lines:
        light += (PRINT_LIGHT - light) * printed_fraction(line, x, y, spot)
    return FLOOR_LIGHT + (light - FLOOR_LIGHT) * _fraction(inside / spot)


class NxtBody:
    """Motors B and C under the wheels, a lamp on A, light sensors on inputs 1 and 2.

    Not modelled: ramps (``run_state`` ramp-up and ramp-down drive as running does) and the
    synchronisation of two motors (each is speed-regulated on its own).

    Args:
        params: the robot.
        seed: of every random draw.
        pose: its first pose (m, m, rad, board frame).
        wiring: the wiring.
        around: the place around it.
    """

    def __init__(
        self,
        params: LabParams,
        seed: int,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
        wiring: Wiring | None = None,
        around: Place = Place(),  # noqa: B008 - frozen
    ):
        self.params = params
        self.wiring = wiring or Wiring()
        self.around = around
        self.state = physics.new_state(params, seed, pose)
        self._inputs = physics.new_inputs()
        self._coefficients = params.coefficients()
        self._field = physics.slip_field(params)
        self._rng = np.random.default_rng([seed, 0x5E45])
        self._outputs = [Output() for _ in range(3)]
        self._zeros = [[0.0, 0.0] for _ in range(3)]  # block and rotation, degrees
        self._ends = [0.0, 0.0]  # end of a wheel's last limit, degrees
        self._types = [(0, 0)] * 4
        self._lamp = Lamp(params.lamp_lag)
        #: Time of the first command that turns a wheel, s; None: there was none.
        self.driven_at: float | None = None
        self._compile()

    def _compile(self) -> None:
        """Compile the physics, on copies, before a client waits for the brick's answer."""
        state, coefficients = self.state.copy(), self._coefficients
        physics.begin_command(state, 0, coefficients)
        physics.advance(state, self._inputs.copy(), coefficients, self._field, 2 * physics.STEP)

    @property
    def time(self) -> float:
        """The time in seconds."""
        return float(self.state[S.TIME])

    @property
    def pose(self) -> np.ndarray:
        """The axle midpoint's true pose, [3] (m, m, rad unwrapped, board frame)."""
        return self.state[S.X : S.X + 3].copy()

    @property
    def voltage(self) -> float:
        """The battery's true voltage under its present load (V)."""
        return float(self.state[S.VOLTAGE])

    def place(self, x: float, y: float, theta: float) -> None:
        """Lift the robot and place it at a pose (m, m, rad, board frame)."""
        self.state[S.X], self.state[S.Y], self.state[S.THETA] = x, y, theta

    def shove(self, x: float, y: float) -> None:
        """Push the robot aside by these distances (m, board frame), with skidding wheels."""
        self.state[S.X] += x
        self.state[S.Y] += y

    def advance(self, until: float) -> None:
        """Drive on to the time ``until`` (s); earlier times change nothing."""
        while True:
            wheel = physics.advance(
                self.state, self._inputs, self._coefficients, self._field, until
            )
            if wheel < 0:
                return
            output = self._outputs[self._port_of(wheel)]
            # As in the firmware (dOutputMotorIdleControl), a motor that has reached its limit
            # coasts.
            output.run_state = RUN_STATE_IDLE
            self._inputs[U.MODE + wheel] = physics.COAST
            self._inputs[U.POWER + wheel] = 0.0
            self._inputs[U.LIMIT + wheel] = np.nan

    def set_output(
        self,
        port: int,
        power: int,
        mode: int,
        regulation: int,
        turn_ratio: int,
        run_state: int,
        tacho_limit: int,
    ) -> None:
        """Set an output now, in the terms of LEGO's SETOUTPUTSTATE.

        Args:
            port: 0..2.
            power: percent; clipped to -100..100.
            mode: sum of motor on (1), brake (2), regulated (4).
            regulation: 0 idle, 1 speed, 2 synchronised.
            turn_ratio: kept, without effect.
            run_state: 0 idle; anything else runs.
            tacho_limit: degrees to turn before the output goes idle; 0 for ever. As in LEGO's
                firmware (dOutputSetTachoLimit of d_output.c) they count from the end of the last
                limit; a motor that runs without a limit moves this end along.
        """
        output = self._outputs[port]
        ran = output.run_state != RUN_STATE_IDLE and bool(output.mode & MODE_ON)
        ran_free = ran and output.power != 0 and output.tacho_limit == 0
        output.power = max(-100, min(100, power))
        output.mode, output.regulation, output.turn_ratio = mode, regulation, turn_ratio
        output.run_state, output.tacho_limit = run_state, tacho_limit
        on = bool(mode & MODE_ON) and run_state != RUN_STATE_IDLE
        if port == self.wiring.lamp:
            self._lamp.port_level = abs(output.power) / 100.0 if on else 0.0
            self._lamp.switch(self.time)
            return
        wheel = self._wheel_at(port)
        if wheel is None:
            return
        regulated = bool(mode & MODE_REGULATED) and regulation != REGULATION_IDLE
        if on and output.power:
            drive = physics.REGULATED if regulated else physics.OPEN_LOOP
        elif on and (regulated or mode & MODE_BRAKE):
            drive = physics.BRAKE
        else:
            drive = physics.COAST
        moves = drive >= physics.OPEN_LOOP
        if moves and self.driven_at is None:
            self.driven_at = self.time
        self._inputs[U.MODE + wheel] = drive
        self._inputs[U.POWER + wheel] = output.power if moves else 0.0
        self._inputs[U.LIMIT + wheel] = np.nan
        if ran_free:
            self._ends[wheel] = self._degrees(port)
        if tacho_limit > 0:
            self._ends[wheel] += tacho_limit if output.power > 0 else -tacho_limit
            if moves:
                self._inputs[U.LIMIT + wheel] = math.radians(self._ends[wheel])
        physics.begin_command(self.state, wheel, self._coefficients)

    def output(self, port: int) -> Output:
        """Return an output's present settings and counters."""
        output = self._outputs[port]
        degrees = self._degrees(port)
        block, rotation = self._zeros[port]
        output.tacho_count = math.floor(degrees)
        output.block_tacho_count = math.floor(degrees - block)
        output.rotation_count = math.floor(degrees - rotation)
        return output

    def reset_tacho(self, port: int, relative: bool) -> None:
        """Zero an output's block counter (``relative``) or its rotation counter."""
        self._zeros[port][0 if relative else 1] = math.floor(self._degrees(port))

    def set_input(self, port: int, type: int, mode: int) -> None:
        """Set an input's sensor type and mode, in the numbers of LEGO's SETINPUTMODE."""
        self._types[port] = (type, mode)
        if port == self.wiring.colour:
            self._lamp.sensor_level = 1.0 if type in TYPES_COLOUR_LIT else 0.0
            self._lamp.switch(self.time)

    def input(self, port: int) -> InputValues:
        """Return the reading of an input now; nothing plugged in reads 1023."""
        type, mode = self._types[port]
        sides = (self.wiring.light_left, self.wiring.light_right)
        if port not in sides:
            return InputValues(True, 1023, type, mode)
        lit = self.params.light_ambient
        if type == TYPE_LIGHT_ACTIVE:
            lit = self.reflected_light(sides.index(port))
        value = lit + self.params.light_noise * self._rng.standard_normal()
        return InputValues(True, round(1023 * min(max(1.0 - value, 0.0), 1.0)), type, mode)

    def reflected_light(self, side: int) -> float:
        """Return the light (0..1) that the left (0) or the right (1) sensor sees."""
        ahead, aside = self.params.light_ahead, (1 - 2 * side) * self.params.light_aside
        x, y, theta = self.pose
        cos, sin = math.cos(theta), math.sin(theta)
        x, y = x + cos * ahead - sin * aside, y + sin * ahead + cos * aside
        return ground_light(x, y, self.params.light_spot, self.around)

    def battery_millivolts(self) -> int:
        """Return the battery's voltage as the brick measures it."""
        return round(1000.0 * self.voltage + 8.0 * self._rng.standard_normal())

    def lamp_light(self) -> float:
        """Return the integral of the lamp's brightness so far, in seconds of full brightness."""
        return self._lamp.sum(self.time)

    def _wheel_at(self, port: int) -> int | None:
        ports = (self.wiring.left, self.wiring.right)
        return ports.index(port) if port in ports else None

    def _port_of(self, wheel: int) -> int:
        return (self.wiring.left, self.wiring.right)[wheel]

    def _degrees(self, port: int) -> float:
        wheel = self._wheel_at(port)
        return 0.0 if wheel is None else math.degrees(self.state[S.ANGLE + wheel])


def _fraction(depth: float) -> float:
    """Return the fraction of a spot of unit radius that lies inside an edge at this depth."""
    return min(max(0.5 + 0.5 * depth, 0.0), 1.0)


class Lamp:
    """A lamp that follows its level with a first-order lag, and the sum of its light."""

    def __init__(self, lag: float):
        self.port_level = self.sensor_level = 0.0
        self._lag = lag
        self._since = self._level = self._target = self._sum = 0.0

    def switch(self, time: float) -> None:
        """Use the new levels from ``time`` on."""
        self._sum = self.sum(time)
        self._level = self._target + (self._level - self._target) * self._decay(time)
        self._since, self._target = time, max(self.port_level, self.sensor_level)

    def sum(self, time: float) -> float:
        """Return the integral of brightness (0..1) up to ``time``, in seconds."""
        gap = self._level - self._target
        steady = self._target * (time - self._since)
        return self._sum + steady + gap * self._lag * (1.0 - self._decay(time))

    def _decay(self, time: float) -> float:
        return math.exp(-(time - self._since) / self._lag) if self._lag > 0.0 else 0.0
