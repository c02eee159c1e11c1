"""A virtual Thymio II's firmware: Aseba's messages and its virtual machine, in front of a body.

After the sources of the robot's firmware (Mobsya/aseba-target-thymio2) and of Aseba 1.6. It shares
only the types of messages with the driver. Not modelled: events other than ``motor``, buttons,
sound, branches and events of programs; a program with another instruction stops.
"""

from __future__ import annotations

import struct
from contextlib import AbstractContextManager

from neurosim.lab.thymio.body import ThymioBody
from neurosim.robots.thymio.aseba import (
    DESCRIPTION,
    EVENT,
    FIRST_EVENT,
    GET_DESCRIPTION,
    GET_VARIABLES,
    LIST_NODES,
    NATIVE,
    PRESENT,
    RUN,
    SET_BYTECODE,
    SET_VARIABLES,
    VARIABLE,
    VARIABLES,
    encode,
)
from neurosim.robots.thymio.driver import SCAN, VIRTUAL

#: The robot's number, its firmware's version, and its kind.
NODE, VERSION, PRODUCT = 51, 14, 8
#: Time between two events ``motor``, s.
TICK = 0.01
#: Named variables with their sizes, in the firmware's order; events; native functions.
NAMED = {
    "_id": 1, "event.source": 1, "event.args": 32, "_fwversion": 2, "_productId": 1,
    "buttons._raw": 5, "button.backward": 1, "button.left": 1, "button.center": 1,
    "button.forward": 1, "button.right": 1, "buttons._mean": 5, "buttons._noise": 5,
    "prox.horizontal": 7, "prox.ground.ambiant": 2, "prox.ground.reflected": 2,
    "prox.ground.delta": 2, "motor.left.target": 1, "motor.right.target": 1, "_vbat": 2,
    "motor.left.speed": 1, "motor.right.speed": 1, "motor.left.pwm": 1, "motor.right.pwm": 1,
    "acc": 3, "temperature": 1, "rc5.address": 1, "rc5.command": 1, "mic.intensity": 1,
    "mic.threshold": 1, "mic._mean": 1, "timer.period": 2, "acc._tap": 1,
}  # fmt: skip
EVENTS = (
    "button.left", "button.right", "button.forward", "button.backward", "button.center", "buttons",
    "prox", "tap", "acc", "mic", "sound.finished", "temperature", "rc5", "motor", "timer0",
    "timer1",
)  # fmt: skip
NATIVES = ("_system.reboot", "math.copy", "math.fill", "leds.top", "leds.circle", "_poweroff")
#: Words of unnamed memory, of a program, and of its stack; largest number of instructions of a run.
FREE, PROGRAM, STACK, STEPS = 512, 1534, 32, 1000
#: The largest payload of a message.
LONGEST = 512


class ThymioFirmware:
    """Takes bytes, moves a body, and answers with bytes.

    Args:
        hardware: the body; all calls take effect at the lab's current time.
        lock: held while the body is used.

    Attributes:
        ends: time of the next event ``motor``, s; the object that advances the time calls
            :meth:`end` then.
        memory: of the virtual machine.
    """

    def __init__(self, hardware: ThymioBody, lock: AbstractContextManager):
        self.hardware, self._lock = hardware, lock
        self.ends = TICK
        self._addresses: dict[str, int] = {}
        free = 0
        for name, size in NAMED.items():
            self._addresses[name] = free
            free += size
        self._size = free + FREE
        self.reboot()

    def reboot(self) -> None:
        """Start again, as after the reset button: no program, motors off."""
        with self._lock:
            self._data = b""
            self.memory = [0] * self._size
            self._program, self._runs = [0] * PROGRAM, False
            for name, words in (("_id", [NODE]), ("_fwversion", [VERSION, VIRTUAL]),
                                ("_productId", [PRODUCT])):  # fmt: skip
                self._put(name, words)
            self._light, self._ticks = (0, 0, 0), 0
            self._scan()
            self.hardware.drive(0, 0)
            self.hardware.lamp(False)

    def feed(self, data: bytes) -> bytes:
        """Take bytes in pieces of any size; return the answers to complete messages."""
        self._data += data
        answers = b""
        while len(self._data) >= 6:
            length, _, type_ = struct.unpack_from("<HHH", self._data)
            if length > LONGEST:  # longer than the buffer: the port is closed and opened again
                self._data = b""
                break
            if len(self._data) < 6 + length:
                break
            payload, self._data = self._data[6 : 6 + length], self._data[6 + length :]
            words = struct.unpack(f"<{length // 2}H", payload[: length // 2 * 2])
            with self._lock:
                answers += self._carry_out(type_, words)
        return answers

    @property
    def targets(self) -> tuple[int, int]:
        """The commanded speeds of both wheels."""
        left = self._addresses["motor.left.target"]
        return self.memory[left], self.memory[left + 1]

    def end(self) -> None:
        """Measure, and run the program at the event ``motor``."""
        self.ends += TICK
        left, right = self.hardware.speeds()
        self._put("motor.left.speed", [left])
        self._put("motor.right.speed", [right])
        self._ticks += 1
        if self._ticks % round(SCAN / TICK) == 0:
            self._scan()
        if self._runs:
            self._at_event(FIRST_EVENT - EVENTS.index("motor"))
        self._act()

    def _scan(self) -> None:
        self._put("prox.horizontal", self.hardware.proximity())
        self._put("prox.ground.delta", self.hardware.ground())

    def _act(self) -> None:
        """Apply the memory's variables to the body."""
        self.hardware.drive(*self.targets)

    def _carry_out(self, type_: int, words: tuple[int, ...]) -> bytes:
        if type_ == LIST_NODES:
            return encode(PRESENT, [words[0] if words else 0], NODE)
        if not words or words[0] != NODE:
            return b""
        rest = list(words[1:])
        if type_ == GET_DESCRIPTION:
            return self._description()
        if type_ == SET_BYTECODE and rest and rest[0] + len(rest) - 1 <= PROGRAM:
            self._program[rest[0] : rest[0] + len(rest) - 1] = rest[1:]
            self._runs = False
        elif type_ == RUN:
            self._runs = True
        elif type_ == SET_VARIABLES and rest and rest[0] + len(rest) - 1 <= self._size:
            self.memory[rest[0] : rest[0] + len(rest) - 1] = [_signed(word) for word in rest[1:]]
            self._act()
        elif type_ == GET_VARIABLES and len(rest) == 2 and sum(rest) <= self._size:
            values = self.memory[rest[0] : rest[0] + rest[1]]
            return encode(VARIABLES, [rest[0], *values], NODE)
        return b""

    def _description(self) -> bytes:
        counts = (len(NAMED), len(EVENTS), len(NATIVES))
        sizes = struct.pack("<7H", 5, PROGRAM, STACK, self._size, *counts)
        messages = _message(DESCRIPTION, _text("thymio-II") + sizes)
        for name, size in NAMED.items():
            messages += _message(VARIABLE, struct.pack("<H", size) + _text(name))
        for name in EVENTS:
            messages += _message(EVENT, _text(name) + _text("an event"))
        for name in NATIVES:
            messages += _message(NATIVE, _text(name) + _text("a function") + struct.pack("<H", 0))
        return messages

    def _at_event(self, event: int) -> None:
        """Run the program's handler of an event, if it has one."""
        vector = self._program[1 : self._program[0]]
        places = dict(zip(vector[::2], vector[1::2], strict=False))
        if event in places:
            self._runs = self._run(places[event])

    def _run(self, at: int) -> bool:
        """Run the program from an instruction on; return whether it came to its end."""
        stack: list[int] = []
        for _ in range(STEPS):
            if not 0 <= at < PROGRAM or len(stack) > STACK:
                return False
            word = self._program[at]
            kind, operand = word >> 12, word & 0xFFF
            at += 1
            try:
                if kind == 0x0:
                    return True
                if kind == 0x1:
                    stack.append(operand - 0x1000 if operand & 0x800 else operand)
                elif kind == 0x2:
                    stack.append(_signed(self._program[at]))
                    at += 1
                elif kind == 0x3:
                    stack.append(self.memory[operand])
                elif kind == 0x4:
                    self.memory[operand] = stack.pop()
                elif kind == 0x8:
                    second, first = stack.pop(), stack.pop()
                    stack.append(_signed(_OPERATIONS[operand](first, second)))
                elif kind == 0xC and NATIVES[operand] == "leds.top":
                    colour = tuple(self.memory[stack.pop()] for _ in range(3))
                    if colour != self._light:
                        self._light = colour
                        self.hardware.lamp(any(colour))
                else:
                    return False
            except (IndexError, KeyError, ZeroDivisionError):
                return False
        return False

    def _put(self, name: str, words: list[int]) -> None:
        first = self._addresses[name]
        self.memory[first : first + len(words)] = words


def _divided(first: int, second: int) -> int:
    """Return a quotient rounded towards 0, like the robot's processor."""
    return int(first / second)


_OPERATIONS = {
    0x02: lambda a, b: a + b,
    0x03: lambda a, b: a - b,
    0x04: lambda a, b: a * b,
    0x05: _divided,
    0x06: lambda a, b: a - b * _divided(a, b),
    0x0A: lambda a, b: int(a == b),
    0x0B: lambda a, b: int(a != b),
    0x0C: lambda a, b: int(a > b),
    0x0D: lambda a, b: int(a >= b),
    0x0E: lambda a, b: int(a < b),
    0x0F: lambda a, b: int(a <= b),
}


def _signed(word: int) -> int:
    return (word + 0x8000) % 0x10000 - 0x8000


def _text(text: str) -> bytes:
    return bytes([len(text)]) + text.encode("ascii")


def _message(type_: int, payload: bytes) -> bytes:
    return struct.pack("<HHH", len(payload), NODE, type_) + payload
