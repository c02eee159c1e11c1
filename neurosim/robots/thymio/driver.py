"""Driver of a Thymio II, which loads a small program into it, so that it stops by itself."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurosim.base.commands import TWO_WHEELS, Commands
from neurosim.base.declared import Count, Seconds, checks
from neurosim.base.errors import RobotError, UserError
from neurosim.robots.base import Clock, Geometry, SystemClock
from neurosim.robots.serial_line import SerialDriver, SerialLine
from neurosim.robots.thymio import aseba
from neurosim.robots.thymio.aseba import (
    Description,
    Message,
    Reader,
    call,
    encode,
    load,
    push,
    store,
)

#: Number of requests before the robot counts as lost.
TRIES = 3
#: The USB cable has no speed; this is any valid baud rate.
BAUD = 115_200
#: Extra time of a command, s, because the next one may be a little late.
LATE = 0.3
#: Duration of a command without one, s; the robot counts in 16 bits.
LONGEST = 300.0
#: Runs of the program per second, at the event ``motor``.
RATE = 100
#: Full speed in the robot's own unit, and m/s; the body (m, the radius that of its round front);
#: the ground sensors (m ahead of the axle, to the left) and the proximity sensors (and rad, their
#: directions) and the range of these (m): as in Enki, the simulator of its makers (Thymio2.cpp).
FULL, FULL_SPEED = 500, 0.166
BODY = Geometry(radius=0.08, wheel_base=0.094)
GROUND = {"line_left": (0.072, 0.0115), "line_right": (0.072, -0.0115)}
PROXIMITY = np.array([
    (0.062, 0.0485, 0.69813), (0.075, 0.0255, 0.34907), (0.0795, 0.0, 0.0),
    (0.075, -0.0255, -0.34907), (0.062, -0.0485, -0.69813),
    (-0.0295, 0.0295, math.pi), (-0.0295, -0.0295, math.pi),
])  # fmt: skip
REACH = 0.14
#: Time between two readings of the robot's sensors, s (the event ``prox`` of its programming
#: language).
SCAN = 0.1
#: Largest readings of the sensors: near an object, and on a white ground.
NEAR, WHITE = 4500, 1000
#: Sum of speeds over the runs of the program for one count.
PER_COUNT = 32
#: Variant of the virtual lab's firmware.
VIRTUAL = 0x4E53

_NEEDED = ("motor.left.target", "motor.right.target", "motor.left.speed", "motor.right.speed",
           "prox.horizontal", "prox.ground.delta", "_fwversion")  # fmt: skip
#: The program's own words, from the first free address on.
_TOKEN, _LEFT_OVER, _LEFT, _RIGHT, _NUMBER, _LIGHT, _SUMS, _COUNTS, _WORDS = (
    0, 1, 2, 3, 4, 5, 8, 10, 12,
)  # fmt: skip
#: Colour of the lamp, red, green and blue of 32.
_LAMP = (32, 32, 32)

#: Largest number of reads of waiting bytes.
_AT_MOST = 64

T = TypeVar("T")


class Thymio(SerialDriver):
    """A Thymio II on its USB cable, or behind its dongle, in the protocol of Aseba.

    Follows :class:`neurosim.robots.base.Robot`, ``Proximity``, ``SelfStopping``, ``Counters``,
    ``WholeSpeeds`` and ``Lamp``. Connecting loads a program, which replaces a loaded one until the
    robot is switched off. It holds a command for its duration and then stops both wheels, even if
    the computer or the cable fails. The program also sums up the measured speeds as counters. They
    are coarse, because the robot has no encoders and measures its motors' induced voltage.

    Args:
        port: Serial port, such as ``/dev/ttyACM0`` or COM3, or a URL such as socket://host:port.
        node: Number of the robot, if a dongle reaches several; by default the first that answers.
        timeout: Wall-clock seconds that an answer may take, at each attempt.
        clock: the robot's clock; the virtual lab gives its own.

    Attributes:
        geometry: radius and wheel base, m.
        pulses_per_metre: of the counters.
        full_speed: speed at 100 %, in the robot's own unit.
        speed_unit: the wheel speed of the number 1, m/s.
        angles: directions of the proximity sensors, [7] rad counter-clockwise from straight ahead.
        scan: time between two readings of the robot's sensors, s.
        reach: range of the proximity sensors, m.
        reboots: number of observed restarts of the robot.
    """

    geometry = BODY
    pulses_per_metre = RATE * FULL / PER_COUNT / FULL_SPEED
    full_speed, speed_unit = FULL, FULL_SPEED / FULL
    angles, scan, reach = PROXIMITY[:, 2], SCAN, REACH
    commands: Commands = TWO_WHEELS.measured(
        full=FULL_SPEED, track=BODY.wheel_base, radius=BODY.radius
    )
    #: Seven of reflected infra-red light, in front from left to right and behind left and right;
    #: two of the light of the ground.
    sensor_names = (*(f"sensor_{number}" for number in range(7)), *GROUND)

    @checks
    def __init__(
        self,
        port: str,
        *,
        node: Count | None = None,
        timeout: Seconds = 0.35,
        clock: Clock | None = None,
    ):
        self.clock: Clock = SystemClock() if clock is None else clock
        self.reboots = 0
        self._timeout, self._wanted = timeout, node
        self._line = SerialLine(port, baud=BAUD)
        self._node = 0
        self._known = Description()
        self._firmware: tuple[int, ...] = ()
        self._counts, self._last = [0, 0], [0, 0]
        self._token = self._number = 0
        self._loading = False
        self._reader, self._halt = Reader(), b""

    def drive(self, command: Sequence[float]) -> None:
        """Set both wheels, in percent of full speed, for five minutes or until the next command.

        Raises:
            UserError: if it is not a speed.
            LinkLost: if the robot does not acknowledge it.
        """
        self._hold(command, LONGEST)

    def drive_for(self, command: Sequence[float], seconds: float) -> None:
        """Set both wheels, like :meth:`drive`, for a duration (s).

        Without another command the robot stops by itself :data:`LATE` later.

        Raises:
            UserError, LinkLost: as :meth:`drive`, and for a duration beyond the robot's limit.
        """
        if not 0 < seconds <= LONGEST:
            raise UserError(
                f"a command of {seconds:g} s is not one of this robot's: they last up to "
                f"{LONGEST:g} s"
            )
        self._hold(command, seconds + LATE)

    def set_speeds(self, left: int, right: int) -> None:
        """Set both wheels' speeds in the robot's own unit, 500 at full speed; see :meth:`drive`."""
        self.drive((100 * left / FULL, 100 * right / FULL))

    def stop(self) -> None:
        """Stop both wheels, with the program and without it."""
        self._carry_out(0, 0, 0)

    def read_sensors(self) -> dict[str, float]:
        """Read all sensors, each from 0 to 1, by name: near and white are 1."""
        near, ground = (self._known.addresses[name] for name in _NEEDED[4:6])
        first = min(near, ground)
        count = max(near + 7, ground + 2) - first
        words = self._get(first, count)
        read = [*(words[near - first + n] / NEAR for n in range(7)),
                *(words[ground - first + n] / WHITE for n in range(2))]  # fmt: skip
        values = (min(max(value, 0.0), 1.0) for value in read)
        return dict(zip(self.sensor_names, values, strict=True))

    def activations(self) -> NDArray[np.float64]:
        """Read the proximity sensors, [7] from 0 to 1, 1 near an object."""
        return np.array(list(self.read_sensors().values())[: len(PROXIMITY)])

    def read_counts(self) -> tuple[int, int]:
        """Read both counters, left and right, in pulses.

        The robot's own have 16 bits; at full speed they must be read every 20 s.
        """
        words = self._block(b"", lambda words: True)
        for wheel, word in enumerate(words[_COUNTS:_WORDS]):
            # The difference from the last reading, of 16 bits with a sign.
            self._counts[wheel] += (word - self._last[wheel] + 0x8000) % 0x10000 - 0x8000
            self._last[wheel] = word
        return self._counts[0], self._counts[1]

    def set_counts(self, left: int, right: int) -> None:
        """Set both counters, in pulses; the robot's own are not changed."""
        self.read_counts()
        self._counts = [int(left), int(right)]

    def lamp(self, on: bool) -> None:
        """Switch the lights on the robot's top."""
        colour = _LAMP if on else (0, 0, 0)
        self._block(self._set(_LIGHT, colour), lambda words: words[_LIGHT:_SUMS] == colour)

    def describe(self) -> dict[str, Any]:
        """Describe this robot for a recording."""
        about: dict[str, Any] = {"kind": "thymio", "port": self._line.port}
        if self._firmware:
            version, variant = self._firmware
            about |= {
                "node": self._node,
                "firmware": version,
                "virtual": variant == VIRTUAL,
                "reboots": self.reboots,
                "light_sensors": {name: list(place) for name, place in GROUND.items()},
            }
        return about

    def _hold(self, command: Sequence[float], seconds: float) -> None:
        left, right = (round(value / 100 * FULL) for value in self.commands.check(command))
        self._carry_out(math.ceil(RATE * seconds) + 1, left, right)

    def _carry_out(self, runs: int, left: int, right: int) -> None:
        """Set both wheels, in the robot's unit, for a number of runs of the program."""
        self._number = self._number % 0x7FFF + 1
        number = self._number
        change = self._set(_LEFT_OVER, (runs, left, right, number))
        if not runs:
            change = self._halt + change
        self._block(change, lambda words: words[_NUMBER] == number)

    # Connecting

    def _greet(self) -> None:
        """Find the robot, stop it, and load the program."""
        self._reader, self._node, self._firmware = Reader(), 0, ()
        self._node = self._ask(
            encode(aseba.LIST_NODES, [aseba.VERSION]), self._is_robot, self._nobody
        )
        self._known = self._describe()
        if self._known.name != "thymio-II":
            raise RobotError(
                f"the robot on {self._line.port} is not a Thymio II; "
                f"its name is {self._known.name[:40]!r}"
            )
        missing = [name for name in _NEEDED if name not in self._known.addresses]
        if missing or "motor" not in self._known.events or "leds.top" not in self._known.natives:
            raise RobotError(
                f"the firmware of the Thymio on {self._line.port} is too old: update it with "
                "Thymio Suite"
            )
        targets = [self._known.addresses[name] for name in _NEEDED[:2]]
        self._halt = self._set(_LEFT_OVER, (0, 0, 0)) + b"".join(
            encode(aseba.SET_VARIABLES, [self._node, address, 0]) for address in targets
        )
        self._line.farewell = self._halt
        version = self._get(self._known.addresses["_fwversion"], 2)
        self._firmware = version
        self._load()

    def _is_robot(self, message: Message) -> int | None:
        """Return the number of a present robot, if it can be the wanted one."""
        if message.type != aseba.PRESENT or self._wanted not in (None, message.source):
            return None
        return message.source

    def _nobody(self) -> RobotError:
        which = "" if self._wanted is None else f" of the number {self._wanted}"
        return RobotError(
            f"no Thymio{which} answers on {self._line.port}: is it on, and its dongle or cable in "
            "this port? Close Thymio Suite, which holds the robot"
        )

    def _describe(self) -> Description:
        for _ in range(TRIES):
            known = Description()
            self._send(encode(aseba.GET_DESCRIPTION, [self._node, aseba.VERSION]))
            for message in self._heard():
                if message.source != self._node:
                    continue
                try:
                    known.take(message)
                except ValueError:
                    break
                if known.whole:
                    return known
        raise RobotError(
            f"the Thymio on {self._line.port} does not describe itself whole: is the dongle too "
            "far away?"
        )

    def _load(self) -> None:
        """Load the program into the robot, and check that it runs."""
        self._loading = True
        try:
            self._token = random.randrange(1, 0x8000)
            self._last = [0, 0]
            code = [self._node, 0, *_program(self._known)]
            fresh = self._set(_TOKEN, [self._token, 5, *[0] * (_WORDS - 2)])
            start = encode(aseba.SET_BYTECODE, code) + encode(aseba.RUN, [self._node]) + fresh
            self._block(self._halt + start, lambda words: True)
            # Five of its runs take 0.05 s.
            self.clock.sleep_until(self.clock.now() + 0.1)
            self._block(b"", lambda words: words[_LEFT_OVER] == 0)
        finally:
            self._loading = False

    # Messages

    def _set(self, place: int, values: Sequence[int]) -> bytes:
        """Return the message that sets words of the program's own."""
        return encode(aseba.SET_VARIABLES, [self._node, self._known.free + place, *values])

    def _get(self, address: int, count: int) -> tuple[int, ...]:
        """Return words of the robot's memory."""
        request = encode(aseba.GET_VARIABLES, [self._node, address, count])
        return self._ask(request, lambda message: self._words(message, address, count), self._gone)

    def _words(self, message: Message, address: int, count: int) -> tuple[int, ...] | None:
        """Return a message's words from an address on, if it has them."""
        if message.type != aseba.VARIABLES or message.source != self._node:
            return None
        first, *words = message.words or (-1,)
        return tuple(words) if first == address and len(words) == count else None

    def _block(self, change: bytes, done: Callable[[tuple[int, ...]], bool]) -> tuple[int, ...]:
        """Send a change; return the program's words after they have the wanted values.

        A restarted robot has lost the program, which is loaded again.
        """
        request = change + encode(aseba.GET_VARIABLES, [self._node, self._known.free, _WORDS])

        def answer(message: Message) -> tuple[int, ...] | None:
            words = self._words(message, self._known.free, _WORDS)
            if words is None:
                return None
            return words if words[_TOKEN] != self._token or done(words) else None

        words = self._ask(request, answer, self._gone)
        if words[_TOKEN] == self._token:
            return words
        if self._loading:
            raise RobotError(f"the Thymio on {self._line.port} does not take a program")
        self.reboots += 1
        self._load()
        return self._block(change, done)

    def _ask(
        self, request: bytes, wanted: Callable[[Message], T | None], gone: Callable[[], RobotError]
    ) -> T:
        """Send a request until a wanted answer comes, and return it."""
        for _ in range(TRIES):
            self._send(request)
            for message in self._heard():
                answer = wanted(message)
                if answer is not None:
                    return answer
        raise gone()

    def _gone(self) -> RobotError:
        return self._line.lose(
            f"the Thymio on {self._line.port} stopped answering: nothing within {self._timeout:g} "
            f"s, {TRIES} times; is it on and its cable or dongle in place?"
        )

    def _send(self, data: bytes) -> None:
        # Late messages do not answer this request.
        for _ in range(_AT_MOST):
            if not (early := self._line.read_some(0.0)):
                break
            self._reader.feed(early)
        self._line.write(data)

    def _heard(self) -> Iterator[Message]:
        """Give messages until none comes in time."""
        end = time.monotonic() + self._timeout
        while (left := end - time.monotonic()) > 0:
            for message in self._reader.feed(self._line.read_some(left)):
                if message.type in (aseba.DESCRIPTION, aseba.VARIABLE, aseba.EVENT, aseba.NATIVE):
                    end = time.monotonic() + self._timeout  # there are many of these
                yield message


def _program(known: Description) -> list[int]:
    """Return the program for the robot, as words to send.

    At the event ``motor``, a hundred times a second: ``left over`` is reduced by one if it is above
    0; both wheels get their speeds if it is still above 0, and 0 otherwise; the lights get their
    colour; the measured speeds are added up, and each :data:`PER_COUNT` of the sum is one count. It
    has no branches, which versions of the virtual machine encode differently.
    """
    own = known.free
    left = own + _LEFT_OVER
    runs = [load(left), push(0), aseba.GREATER]
    code = [load(left), *runs, aseba.SUBTRACT, store(left)]
    for place, name in ((_LEFT, _NEEDED[0]), (_RIGHT, _NEEDED[1])):
        target = known.addresses[name]
        code += [load(own + place), *runs, aseba.MULTIPLY, store(target)]
    code += [push(own + _LIGHT + part) for part in (2, 1, 0)]
    code += [call(known.natives.index("leds.top"))]
    for wheel, name in enumerate(_NEEDED[2:4]):
        total, count = own + _SUMS + wheel, own + _COUNTS + wheel
        code += [load(total), load(known.addresses[name]), aseba.ADD, store(total)]
        code += [load(count), load(total), push(PER_COUNT), aseba.DIVIDE, aseba.ADD, store(count)]
        code += [load(total), push(PER_COUNT), aseba.REMAINDER, store(total)]
    # The program begins with a table of its events and their addresses, here of one event.
    event = aseba.FIRST_EVENT - known.events.index("motor")
    return [3, event, 3, *code, aseba.STOP]
