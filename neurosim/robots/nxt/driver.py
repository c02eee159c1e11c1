"""Driver of a LEGO MINDSTORMS NXT with two driving motors, through nxt-python."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import nxt.brick
import nxt.error
from nxt.motor import Mode, RegulationMode, RunState
from nxt.motor import Port as MotorPort
from nxt.sensor import Mode as SensorMode
from nxt.sensor import Port as SensorPort
from nxt.sensor import Type as SensorType
from nxt.telegram import Opcode, Telegram

from neurosim.base.commands import TWO_WHEELS
from neurosim.base.declared import Coordinate, Port, Seconds, checks
from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.robots.base import LIGHT_AHEAD, LIGHT_ASIDE, Clock, Driver, SystemClock
from neurosim.robots.nxt.link import GARBAGE, Guard, open_brick

T = TypeVar("T")

#: A light sensor reads 0 (dark) to this.
FULL_SCALE = 1023
#: A sensor whose type was just set needs up to 0.4 s (the colour sensor) to give a value.
VALID_WITHIN = 2.0
POLL_EVERY = 0.02
#: The brick switches itself off after some minutes, at least 2, and commands alone do not prevent
#: this.
KEEP_AWAKE_EVERY = 45.0

#: Number of stops sent to a brick that does not answer correctly, and the seconds between them,
#: because not every telegram is lost.
STOPS, STOP_EVERY = 4, 0.03
#: A command's limit: degrees per second at 1 %, more than any motor turns, and seconds that the
#: next command may be late.
DEGREES, LATE = 12.0, 1.0
#: Duration of a command without one, s, unless another one follows.
LONGEST = 60.0
#: Duration, s, from which both motors are asked whether they took a command; for shorter ones,
#: which are soon replaced, one motor in turn.
ASK_BOTH = 0.5
#: The number for all motor ports.
ALL_PORTS = 0xFF

#: Beginning of virtual bricks' Bluetooth addresses: locally administered, so no real brick has it.
VIRTUAL_ADDRESS = "02:16:53"

_LINKS = {
    "host": "Bluetooth",
    "filename": "device file",
    "server_host": "nxt-server",
    "server_port": "nxt-server",
}
_HELD = Mode.ON | Mode.BRAKE | Mode.REGULATED
#: Power in percent, without regulation, at which no motor turns.
_IDLING = 1
_LAMP_ON, _LAMP_OFF = SensorType.COLOR_RED, SensorType.COLOR_NONE


class NXT(Driver):
    """An NXT robot: a motor left and right, a lamp, a light sensor on either side.

    The brick is reached by one of: Bluetooth (``host``), a device file (``filename``),
    nxt-server (``server_host``, ``server_port``), or USB if none of them is given. Follows
    :class:`neurosim.robots.base.Robot`, ``SelfStopping``, ``Battery``, ``Sensors`` and, with a
    lamp, ``Lamp``.

    When the brick's replies fail, are late or report that a command was not taken, the motors get a
    stop, several times, without waiting for an answer. All commands end by themselves if the line
    is cut: each motor has a limit, or stands, after every telegram.

    Args:
        host: Bluetooth address, such as ``00:16:53:01:02:03``.
        filename: Device file, such as ``/dev/rfcomm0`` or a serial port on macOS.
        server_host: Computer on which nxt-python's nxt-server runs.
        server_port: Port of nxt-server.
        left: Port of the left motor: A, B or C.
        right: Port of the right motor.
        lamp: The lamp: a motor port; color:3 for the red lamp of the NXT 2.0 colour sensor on
            sensor port 3; or none.
        light_left: Port of the left light sensor, 1 to 4, or none.
        light_right: Port of the right light sensor, 1 to 4, or none.
        light_ahead: Distance of the light sensors ahead of the axle, m.
        light_aside: Distance of the light sensors to either side of the robot's middle, m.
        invert: The motors are mounted in reverse: forward turns them backward.
        clock: the robot's clock; the virtual lab gives its own.
        deadline: Wall-clock seconds after which a silent brick counts as lost; the robot drives
            unguarded meanwhile.

    Attributes:
        alone: whether the brick may outlive this program, and may still run a command of an earlier
            one: then it is stopped on connecting, commands have limits, and both motors are asked.
            The virtual lab, which ends with the program, sets it to False.

    Raises:
        UserError: if a port does not exist or is given twice.
    """

    @checks
    def __init__(
        self,
        *,
        host: str | None = None,
        filename: str | None = None,
        server_host: str | None = None,
        server_port: Port | None = None,
        left: str = "B",
        right: str = "C",
        lamp: str | None = "A",
        light_left: int | str | None = 1,
        light_right: int | str | None = 2,
        light_ahead: Coordinate = LIGHT_AHEAD,
        light_aside: Coordinate = LIGHT_ASIDE,
        invert: bool = False,
        clock: Clock | None = None,
        deadline: Seconds = LATE,
    ):
        self.clock: Clock = SystemClock() if clock is None else clock
        self._address = {
            "host": host,
            "filename": None if filename is None else str(filename),
            "server_host": server_host,
            "server_port": server_port,
        }
        self._deadline = deadline
        self._left = _motor_port(left, "left")
        self._right = _motor_port(right, "right")
        self._lamp = _lamp_port(lamp)
        self._lights = {
            "line_left": _sensor_port(light_left, "light_left"),
            "line_right": _sensor_port(light_right, "light_right"),
        }
        self._light_at = {
            "line_left": [light_ahead, light_aside],
            "line_right": [light_ahead, -light_aside],
        }
        _all_different([self._left, self._right, self._lamp, *self._lights.values()])
        if self._lamp is not None:
            self.lamp = self._switch_lamp
        self._sign = -1 if invert else 1
        self._brick: nxt.brick.Brick | None = None
        self._about: dict[str, Any] = {}
        self._kept_awake = 0.0
        self._asked_left = False
        self.alone = True

    def connect(self) -> None:
        """Open the line, ask for the brick's name, and switch its sensors on.

        Raises:
            RobotError: if the line cannot be opened, nothing answers, or something else does.
        """
        if self._brick is not None:
            return
        brick = open_brick(**self._address, deadline=self._deadline)
        self._brick = brick
        try:
            try:
                name, address, _, _ = self._ask(brick.get_device_info)
                protocol, firmware = self._ask(brick.get_firmware_version)
                self._ask(brick.keep_alive)
                self._kept_awake = self.clock.now()
            except LinkLost:
                guard = self._guard
                raise RobotError(f"no NXT brick answers {guard.place}: {guard.lost}") from None
            self._about = {
                "name": name,
                "address": address,
                "virtual": address.startswith(VIRTUAL_ADDRESS),
                "firmware": "{}.{}".format(*firmware),
                "protocol": "{}.{}".format(*protocol),
            }
            if self.alone:
                self.stop()
            for port in self._lights.values():
                if port is not None:
                    self._set_sensor(port, SensorType.LIGHT_ACTIVE)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the motors, switch the lamps off and close the line; raises only Ctrl-C."""
        brick, guard = self._brick, self._guard
        if brick is None:
            return
        try:
            for step in (self.stop, self._lamp_out, self._lights_out):
                with suppress(Exception):
                    step()
        finally:
            self._brick = None
            guard.close()
            brick._sock = None

    #: Both wheels, in percent of full speed.
    commands = TWO_WHEELS

    def drive(self, command: Sequence[float]) -> None:
        """Set both motors, in percent of full speed, and return when the brick has taken it.

        The motors turn with the firmware's speed regulation and keep a speed, also zero, until the
        next call, at most for a minute. Percentages are rounded to whole ones.

        Raises:
            UserError: for a speed that is not within -100 to 100.
            LinkLost: if the brick does not acknowledge it.
            RobotError: if a motor did not take it; both got a stop.
        """
        self._drive(*command, LONGEST)

    def drive_for(self, command: Sequence[float], seconds: float) -> None:
        """Set both motors, like :meth:`drive`, for a duration (s).

        Without another command each motor stops by its limit, the largest possible rotation at this
        speed in that time plus a second. It stops at the latest after 1.2 times that time, or later
        if it is slower than commanded.

        Raises:
            UserError, LinkLost, RobotError: as :meth:`drive` does.
        """
        self._drive(*command, seconds)

    def _drive(self, left: float, right: float, seconds: float) -> None:
        speeds = [self._sign * _percent(left, "left"), self._sign * _percent(right, "right")]
        wheels = list(zip((self._left, self._right), speeds, strict=True))
        limits = [0, 0]
        if self.alone:
            limits = [math.ceil(DEGREES * abs(power) * (seconds + LATE)) for power in speeds]
            # The firmware counts a limit from where the last one would have ended, unless the motor
            # ran without one in between (dOutputTachoLimitControl of LEGO's d_output.c). So it
            # first runs without a limit, at a power that does not move it if the line is cut here.
            for port, power in wheels:
                if power:
                    self._set_motor(port, _IDLING, mode=Mode.ON)
        for (port, power), limit in zip(wheels, limits, strict=True):
            self._set_motor(port, power, limit)
        taken = [(*wheel, limit) for wheel, limit in zip(wheels, limits, strict=True)]
        if self.alone and seconds < ASK_BOTH:
            self._asked_left = not self._asked_left
            taken = taken[:1] if self._asked_left else taken[1:]
        self._acknowledge(taken if self.alone else taken[1:])

    def stop(self) -> None:
        """Stop both motors; the regulation holds them.

        Raises:
            RobotError: if the brick does not acknowledge it; the stop was then sent several times.
        """
        try:
            self.drive((0, 0))
        except BaseException:
            self._halt()
            raise

    def _halt(self) -> None:
        """Send a stop to all motors, several times, in any state of the line; never raises."""
        if self._guard is None:
            return
        telegram = Telegram(Opcode.DIRECT_SET_OUT_STATE, reply_req=False)
        telegram.add_u8(ALL_PORTS)
        telegram.add_s8(0)
        telegram.add_u8(_HELD.value)
        telegram.add_u8(RegulationMode.SPEED.value)
        telegram.add_s8(0)
        telegram.add_u8(RunState.RUNNING.value)
        telegram.add_u32(0)
        for _ in range(STOPS):
            self._guard.post(telegram.to_bytes())
            time.sleep(STOP_EVERY)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """``line_left`` and ``line_right``, as far as configured."""
        return tuple(name for name, port in self._lights.items() if port is not None)

    def read_sensors(self) -> dict[str, float]:
        """Return the light sensors' readings by name, each 0 (dark) to 1."""
        return {name: self.read_sensor(name) for name in self.sensor_names}

    def read_sensor(self, name: str) -> float:
        """Return one light sensor's reading, 0 (dark) to 1, by its name in ``sensor_names``."""
        return self._read_valid(self._lights[name], SensorType.LIGHT_ACTIVE) / FULL_SCALE

    def battery(self) -> float:
        """Return the battery's voltage in volts."""
        return self._ask(self._connected().get_battery_level) / 1000.0

    def describe(self) -> dict[str, Any]:
        """Return kind, ports, kind of link and, after connecting, the brick's name.

        Device file and server are left out, because they may change for the same robot.
        """
        lamp = self._lamp
        return {
            "kind": "nxt",
            **self._about,
            "link": next(
                (_LINKS[key] for key, given in self._address.items() if given is not None), "USB"
            ),
            "ports": {
                "left": self._left.name,
                "right": self._right.name,
                "lamp": f"color:{lamp.value + 1}" if isinstance(lamp, SensorPort) else _name(lamp),
                "light_left": _number(self._lights["line_left"]),
                "light_right": _number(self._lights["line_right"]),
            },
            "light_sensors": {n: self._light_at[n] for n, port in self._lights.items() if port},
            "invert": self._sign < 0,
            "regulation": "speed",
        }

    @property
    def _guard(self) -> Guard | None:
        return None if self._brick is None else self._brick._sock

    def _connected(self) -> nxt.brick.Brick:
        if self._brick is None:
            raise RobotError("the NXT is not connected: call connect() first")
        return self._brick

    def _ask(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call a method of nxt-python's brick; turn every error into one sentence."""
        try:
            return function(*arguments)
        except (nxt.error.SystemProtocolError, nxt.error.DirectProtocolError) as error:
            raise self._refused(str(error)) from None
        except (nxt.error.ProtocolError, struct.error, ValueError, IndexError):
            raise self._guard.lose(GARBAGE) from None

    def _refused(self, why: str) -> RobotError:
        return RobotError(f"the brick {self._guard.place} did not take a command: {why}")

    def _set_motor(self, port: MotorPort, power: int, limit: int = 0, mode: Mode = _HELD) -> None:
        regulation = RegulationMode.SPEED if mode is _HELD else RegulationMode.IDLE
        self._ask(
            self._connected().set_output_state,
            port,
            power,
            mode,
            regulation,
            0,
            RunState.RUNNING,
            limit,
        )

    def _acknowledge(self, commands: list[tuple[MotorPort, int, int]]) -> None:
        """Ask motors for the power and the limit that they took, after all earlier telegrams.

        Raises:
            RobotError: if they differ; the motors got a stop.
        """
        if self.clock.now() - self._kept_awake > KEEP_AWAKE_EVERY:
            telegram = Telegram(Opcode.DIRECT_KEEP_ALIVE, reply_req=False)
            self._ask(self._connected()._cmd_noreply, telegram)
            self._kept_awake = self.clock.now()
        for port, power, limit in commands:
            state = self._ask(self._connected().get_output_state, port)
            if (state[1], state[6]) != (power, limit):
                self._halt()
                wrong = f"is at {state[1]} % instead of {power} %"
                if state[1] == power:
                    wrong = f"stops after {state[6]} degrees instead of {limit}"
                raise self._refused(f"motor port {port.name} {wrong}; it was commanded to stop")

    def _set_sensor(self, port: SensorPort, type_: SensorType) -> None:
        self._ask(self._connected().set_input_mode, port, type_, SensorMode.RAW)
        self._read_valid(port, type_)

    def _read_valid(self, port: SensorPort, type_: SensorType) -> int:
        """Return the normalised value after the brick marks it as valid and of this type."""
        end = self.clock.now() + VALID_WITHIN
        while True:
            values = self._ask(self._connected().get_input_values, port)
            if values[1] and values[3] is type_:
                return values[6]
            if self.clock.now() >= end:
                raise RobotError(
                    f"the brick {self._guard.place} gives no value for the sensor on port "
                    f"{port.value + 1}"
                )
            self.clock.sleep_until(self.clock.now() + POLL_EVERY)

    def _switch_lamp(self, on: bool) -> None:
        """Switch the lamp that the camera sees."""
        brick = self._connected()
        if isinstance(self._lamp, MotorPort):
            power = 100 if on else 0
            self._ask(
                brick.set_output_state,
                self._lamp,
                power,
                Mode.ON if on else Mode.IDLE,
                RegulationMode.IDLE,
                0,
                RunState.RUNNING if on else RunState.IDLE,
                0,
            )
            self._acknowledge([(self._lamp, power, 0)])
        else:
            wanted = _LAMP_ON if on else _LAMP_OFF
            self._ask(brick.set_input_mode, self._lamp, wanted, SensorMode.RAW)
            taken = self._ask(brick.get_input_values, self._lamp)[3]
            if taken is not wanted:
                raise self._refused(f"its sensor port {self._lamp.value + 1} is {taken.name}")

    def _lamp_out(self) -> None:
        if self._lamp is not None:
            self._switch_lamp(False)

    def _lights_out(self) -> None:
        ports = [port for port in self._lights.values() if port is not None]
        for port in ports:
            self._ask(
                self._connected().set_input_mode, port, SensorType.LIGHT_INACTIVE, SensorMode.RAW
            )
        if ports:
            self._ask(self._connected().get_input_values, ports[-1])


def _is_none(value: object) -> bool:
    return value is None or str(value).strip().lower() in ("", "none")


def _motor_port(value: str, option: str) -> MotorPort:
    try:
        return MotorPort[str(value).strip().upper()]
    except KeyError:
        raise UserError(f"{option}: {value!r} is not a motor port; use A, B or C") from None


def _sensor_port(value: int | str | None, option: str) -> SensorPort | None:
    if _is_none(value):
        return None
    try:
        return SensorPort[f"S{str(value).strip()}"]
    except KeyError:
        raise UserError(
            f"{option}: {value!r} is not a sensor port; use 1, 2, 3, 4 or none"
        ) from None


def _lamp_port(value: str | None) -> MotorPort | SensorPort | None:
    if _is_none(value):
        return None
    kind, colon, port = str(value).partition(":")
    if colon and kind.strip().lower() == "color" and not _is_none(port):
        return _sensor_port(port, "lamp")
    try:
        return _motor_port(value, "lamp")
    except UserError:
        raise UserError(
            f"lamp: {value!r} is neither a motor port (A, B, C), nor color:1 to color:4, nor none"
        ) from None


def _all_different(ports: list[MotorPort | SensorPort | None]) -> None:
    used = [port for port in ports if port is not None]
    for port in used:
        if used.count(port) > 1:
            kind = "motor" if isinstance(port, MotorPort) else "sensor"
            label = port.name if kind == "motor" else port.value + 1
            raise UserError(f"{kind} port {label} is used twice; give each device its own port")


def _percent(value: float, side: str) -> int:
    if not math.isfinite(value) or abs(value) > 100:
        raise UserError(f"{side} motor: {value} is not a speed; use -100 to 100 percent")
    return round(value)


def _name(port: MotorPort | None) -> str | None:
    return None if port is None else port.name


def _number(port: SensorPort | None) -> int | None:
    return None if port is None else port.value + 1
