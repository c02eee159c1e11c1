"""A virtual NXT brick: LEGO's telegrams on one side, a robot's body on the other.

The telegrams are those of LEGO MINDSTORMS NXT Bluetooth Developer Kit, appendix 1
("Communication protocol") and appendix 2 ("Direct commands"); in cases that the appendices do not
cover, the brick answers like LEGO's firmware 1.31. There are no programs, no files (the
flash is full) and no I2C devices on it.
"""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

from neurosim.lab.nxt.body import NxtBody
from neurosim.robots.nxt.driver import VIRTUAL_ADDRESS

DIRECT, SYSTEM, REPLY, NO_REPLY = 0x00, 0x01, 0x02, 0x80
ALL_PORTS = 0xFF
OUTPUTS, INPUTS = 3, 4

SUCCESS = 0x00
EMPTY_MAILBOX = 0x40
NO_SPACE = 0x82
FILE_NOT_FOUND = 0x87
MODULE_NOT_FOUND = 0x90
ILLEGAL_HANDLE = 0x93
UNKNOWN_OPCODE = 0xBE
INSANE_PACKET = 0xBF
OUT_OF_RANGE = 0xC0
BUS_ERROR = 0xDD
NOT_CONFIGURED = 0xE0
NO_PROGRAM = 0xEC
ILLEGAL_SIZE = 0xED
ILLEGAL_QUEUE = 0xEE

NO_SENSOR = 0x00
LIGHT_TYPES = (0x05, 0x06)
SOUND_TYPES = (0x07, 0x08)
I2C_TYPES = (0x0A, 0x0B)
DIGITAL_TYPES = (*I2C_TYPES, 0x0C)
COLOR_FULL, COLOR_NONE = 0x0D, 0x11
COLOR_TYPES = range(COLOR_FULL, COLOR_NONE + 1)
LAST_TYPE = 0x12
RAW, BOOLEAN, PERCENT, CELSIUS, FAHRENHEIT = 0x00, 0x20, 0x80, 0xA0, 0xC0
MODE_MASK, SLOPE_MASK = 0xE0, 0x1F

FULL_SCALE = 1023
MAILBOXES, MAILBOX_DEPTH, MESSAGE_SIZE = 20, 5, 59
I2C_SIZE = 16


class Refused(Exception):
    """A telegram answered by an error status and, as the firmware does, a padded body."""

    def __init__(self, status: int, body: bytes = b""):
        super().__init__(f"status {status:#04x}")
        self.status = status
        self.body = body


@dataclass(frozen=True)
class _Command:
    """How an opcode is answered: the possible lengths of its body, and the function."""

    answer: Callable[[VirtualBrick, bytes], bytes]
    lengths: range
    failed: bytes = b""


class VirtualBrick:
    """Answers LEGO's telegrams and moves a body by them.

    Args:
        hardware: the body; it is used with the lock held, at the lab's current time.
        name: the brick's name, up to 14 ASCII characters.
        address: its Bluetooth address; by default the one that marks a virtual brick.
        lock: held while a telegram is carried out; the lab gives its own.
    """

    protocol_version = (1, 124)
    firmware_version = (1, 31)
    sleep_milliseconds = 10 * 60 * 1000

    def __init__(
        self,
        hardware: NxtBody,
        name: str = "NXT",
        *,
        address: str = VIRTUAL_ADDRESS + ":00:00:01",
        lock: AbstractContextManager | None = None,
    ):
        self.hardware = hardware
        self.name = name
        self.address = address
        self._lock = lock if lock is not None else threading.RLock()
        self._mailboxes: list[deque[bytes]] = [
            deque(maxlen=MAILBOX_DEPTH) for _ in range(MAILBOXES)
        ]
        self._i2c_failed = [False] * INPUTS

    def handle(self, telegram: bytes) -> bytes | None:
        """Carry out one telegram; return the reply, or None if there is no reply.

        The content of a telegram never raises an error: an unknown opcode is answered by status
        0xBE, a body of the wrong length by 0xBF, a value out of range by 0xC0. Telegrams that are
        not commands (a reply, an unknown type, fewer than two bytes) are ignored.
        """
        if len(telegram) < 2 or telegram[0] & ~NO_REPLY not in (DIRECT, SYSTEM):
            return None
        opcode, body = telegram[1], telegram[2:]
        table = _DIRECT if telegram[0] & ~NO_REPLY == DIRECT else _SYSTEM
        command = table.get(opcode)
        try:
            if command is None:
                raise Refused(UNKNOWN_OPCODE)
            if len(body) not in command.lengths:
                raise Refused(INSANE_PACKET, command.failed)
            with self._lock:
                status, answer = SUCCESS, command.answer(self, body)
        except Refused as refused:
            status, answer = refused.status, refused.body
            if not answer and command is not None:
                answer = command.failed
        if telegram[0] & NO_REPLY:
            return None
        return bytes([REPLY, opcode, status]) + answer

    def _nothing(self, body: bytes) -> bytes:
        return b""

    def _set_output_state(self, body: bytes) -> bytes:
        port, power, mode, regulation, turn_ratio, run_state, limit = struct.unpack(
            "<BbBBbBI", body[:10]
        )
        _require(port < OUTPUTS or port == ALL_PORTS)
        _require(abs(power) <= 100 and abs(turn_ratio) <= 100)
        _require(mode <= 0x07 and regulation <= 2 and run_state in (0x00, 0x10, 0x20, 0x40))
        for each in range(OUTPUTS) if port == ALL_PORTS else (port,):
            self.hardware.set_output(each, power, mode, regulation, turn_ratio, run_state, limit)
        return b""

    def _get_output_state(self, body: bytes) -> bytes:
        port = body[0]
        _require(port < OUTPUTS)
        state = self.hardware.output(port)
        return struct.pack(
            "<BbBBbBIiii",
            port,
            state.power,
            state.mode,
            state.regulation,
            state.turn_ratio,
            state.run_state,
            state.tacho_limit,
            _int32(state.tacho_count),
            _int32(state.block_tacho_count),
            _int32(state.rotation_count),
        )

    def _reset_motor_position(self, body: bytes) -> bytes:
        _require(body[0] < OUTPUTS)
        self.hardware.reset_tacho(body[0], bool(body[1]))
        return b""

    def _set_input_mode(self, body: bytes) -> bytes:
        port, type_, mode = body
        _require(port < INPUTS and type_ <= LAST_TYPE)
        # The body is sampled on request, so events in between cannot be counted.
        _require(mode & MODE_MASK in (RAW, BOOLEAN, PERCENT, CELSIUS, FAHRENHEIT))
        self._i2c_failed[port] = False
        self.hardware.set_input(port, type_, mode)
        return b""

    def _get_input_values(self, body: bytes) -> bytes:
        port = body[0]
        _require(port < INPUTS)
        valid, raw, type_, mode = self.hardware.input(port)
        converter, normalised = _convert(int(raw), type_)
        scaled = _scale(normalised, type_, mode)
        return struct.pack(
            "<BBBBBHHhh",
            port,
            bool(valid),
            False,
            type_,
            mode,
            converter,
            normalised,
            scaled,
            normalised,
        )

    def _reset_input(self, body: bytes) -> bytes:
        _require(body[0] < INPUTS)
        return b""

    def _get_battery(self, body: bytes) -> bytes:
        return struct.pack("<H", min(max(self.hardware.battery_millivolts(), 0), 0xFFFF))

    def _keep_alive(self, body: bytes) -> bytes:
        return struct.pack("<I", self.sleep_milliseconds)

    def _i2c_status(self, port: int) -> None:
        _require(port < INPUTS)
        if self.hardware.input(port)[2] not in I2C_TYPES:
            raise Refused(NOT_CONFIGURED)
        if self._i2c_failed[port]:
            raise Refused(BUS_ERROR)

    def _ls_get_status(self, body: bytes) -> bytes:
        self._i2c_status(body[0])
        return b"\0"

    def _ls_write(self, body: bytes) -> bytes:
        port, count, expected = body[:3]
        _require(port < INPUTS)
        if self.hardware.input(port)[2] not in I2C_TYPES:
            raise Refused(NOT_CONFIGURED)
        if not 0 < count <= I2C_SIZE or expected > I2C_SIZE:
            raise Refused(ILLEGAL_SIZE)
        if len(body) != 3 + count:
            raise Refused(INSANE_PACKET)
        self._i2c_failed[port] = True
        return b""

    def _ls_read(self, body: bytes) -> bytes:
        self._i2c_status(body[0])
        return bytes(1 + I2C_SIZE)

    def _message_write(self, body: bytes) -> bytes:
        box, size = body[:2]
        if box >= MAILBOXES:
            raise Refused(ILLEGAL_QUEUE)
        if len(body) != 2 + size:
            raise Refused(INSANE_PACKET)
        _require(0 < size <= MESSAGE_SIZE and body[-1] == 0)
        self._mailboxes[box].append(body[2:])
        return b""

    def _message_read(self, body: bytes) -> bytes:
        remote, local, remove = body
        if remote >= MAILBOXES:
            raise Refused(ILLEGAL_QUEUE)
        box = self._mailboxes[remote]
        if not box:
            raise Refused(EMPTY_MAILBOX, bytes([local]) + bytes(1 + MESSAGE_SIZE))
        message = box.popleft() if remove else box[0]
        return bytes([local, len(message)]) + message.ljust(MESSAGE_SIZE, b"\0")

    def _versions(self, body: bytes) -> bytes:
        protocol, firmware = self.protocol_version, self.firmware_version
        return bytes([protocol[1], protocol[0], firmware[1], firmware[0]])

    def _set_name(self, body: bytes) -> bytes:
        self.name = body[:15].split(b"\0")[0][:14].decode("ascii", "replace").replace("\ufffd", "?")
        return b""

    def _address(self, body: bytes) -> bytes:
        return bytes.fromhex(self.address.replace(":", "")) + b"\0"

    def _device_info(self, body: bytes) -> bytes:
        name = self.name.encode("ascii", "replace")[:14].ljust(15, b"\0")
        signal_strengths, free_flash = bytes(4), 0
        return name + self._address(body) + signal_strengths + struct.pack("<I", free_flash)

    def _poll(self, body: bytes) -> bytes:
        _require(body[0] <= 1)
        return bytes([body[0], 0])


def _require(in_range: bool) -> None:
    if not in_range:
        raise Refused(OUT_OF_RANGE)


def _int32(count: float) -> int:
    """Return a counter as a 32-bit number that wraps, like the firmware's."""
    return (int(count) + 2**31) % 2**32 - 2**31


def _full_scale(converter: int, zero: int, percent: int) -> int:
    """Return cInputCalcFullScale of the firmware: a sensor's span stretched to 0..1023."""
    return min(max(converter - zero, 0) * 100 // percent, FULL_SCALE)


# Zero point and span in percent of the converter's range, from the firmware's c_input.c.
_LIGHT_ZERO, _LIGHT_SPAN = 200, 68
_SOUND_ZERO, _SOUND_SPAN = 162, 83
_COLOUR_ZERO, _COLOUR_SPAN = 71, 93
_COLOUR_BLACK, _COLOUR_WHITE, _BLACK_BELOW = 1, 6, 110


def _convert(raw: int, type_: int) -> tuple[int, int]:
    """Return the converter's value, and the firmware's normalised value of it.

    A light sensor uses only a part of the converter's range, so its normalised values have
    the coarse steps of a real brick's.
    """
    raw = min(max(raw, 0), FULL_SCALE)
    if type_ in LIGHT_TYPES or type_ in SOUND_TYPES:
        light = type_ in LIGHT_TYPES
        zero, span = (_LIGHT_ZERO, _LIGHT_SPAN) if light else (_SOUND_ZERO, _SOUND_SPAN)
        converter = zero + -(-raw * span // 100)
        return converter, FULL_SCALE - _full_scale(converter, zero, span)
    if type_ in COLOR_TYPES:
        # This sensor's own converter counts upwards with the light.
        converter = _COLOUR_ZERO + -(-(FULL_SCALE - raw) * _COLOUR_SPAN // 100)
        return min(converter, FULL_SCALE), _full_scale(converter, _COLOUR_ZERO, _COLOUR_SPAN)
    if type_ in (NO_SENSOR, *DIGITAL_TYPES) or type_ > COLOR_NONE:
        return raw, 0
    return raw, raw


def _scale(normalised: int, type_: int, mode: int) -> int:
    """Return cInputCalcSensorValue of the firmware for the modes that do not count."""
    if type_ == COLOR_FULL:
        return _COLOUR_WHITE if normalised >= _BLACK_BELOW else _COLOUR_BLACK
    kind, slope = mode & MODE_MASK, mode & SLOPE_MASK
    if kind == BOOLEAN:
        return int(normalised < (slope or FULL_SCALE * 45 // 100))
    if kind == PERCENT:
        return normalised * 100 // FULL_SCALE
    if kind in (CELSIUS, FAHRENHEIT):
        tenths = normalised * 900 // FULL_SCALE - 200
        return tenths if kind == CELSIUS else 180 * tenths // 100 + 320
    return normalised


def _exactly(length: int) -> range:
    return range(length, length + 1)


def _refused(status: int) -> Callable[[VirtualBrick, bytes], bytes]:
    """Return the answer of an opcode that always fails: the brick has no programs and no files."""

    def answer(brick: VirtualBrick, body: bytes) -> bytes:
        raise Refused(status)

    return answer


_B = VirtualBrick
_FILENAME = range(1, 21)
_NO_BODY = _exactly(0)

_DIRECT = {
    0x00: _Command(_refused(OUT_OF_RANGE), _FILENAME),
    0x01: _Command(_refused(NO_PROGRAM), _NO_BODY),
    0x02: _Command(_refused(OUT_OF_RANGE), range(2, 22)),
    0x03: _Command(_B._nothing, _exactly(4)),
    # Appendix 2 gives the tacho limit five bytes, and some clients send the fifth.
    0x04: _Command(_B._set_output_state, range(10, 12)),
    0x05: _Command(_B._set_input_mode, _exactly(3)),
    0x06: _Command(_B._get_output_state, _exactly(1), bytes(22)),
    0x07: _Command(_B._get_input_values, _exactly(1), bytes(13)),
    0x08: _Command(_B._reset_input, _exactly(1)),
    0x09: _Command(_B._message_write, range(2, 2 + MESSAGE_SIZE + 1)),
    0x0A: _Command(_B._reset_motor_position, _exactly(2)),
    0x0B: _Command(_B._get_battery, _NO_BODY, bytes(2)),
    0x0C: _Command(_B._nothing, _NO_BODY),
    0x0D: _Command(_B._keep_alive, _NO_BODY, bytes(4)),
    0x0E: _Command(_B._ls_get_status, _exactly(1), bytes(1)),
    0x0F: _Command(_B._ls_write, range(3, 3 + I2C_SIZE + 1)),
    0x10: _Command(_B._ls_read, _exactly(1), bytes(1 + I2C_SIZE)),
    0x11: _Command(_refused(NO_PROGRAM), _NO_BODY, bytes(20)),
    0x13: _Command(_B._message_read, _exactly(3), bytes(2 + MESSAGE_SIZE)),
}

_SYSTEM = {
    0x80: _Command(_refused(FILE_NOT_FOUND), _FILENAME, bytes(5)),
    0x81: _Command(_refused(NO_SPACE), range(5, 25), bytes(1)),
    0x82: _Command(_refused(ILLEGAL_HANDLE), _exactly(3), bytes(3)),
    0x83: _Command(_refused(ILLEGAL_HANDLE), range(1, 120), bytes(3)),
    0x84: _Command(_refused(ILLEGAL_HANDLE), _exactly(1), bytes(1)),
    0x85: _Command(_refused(FILE_NOT_FOUND), _FILENAME, bytes(20)),
    0x86: _Command(_refused(FILE_NOT_FOUND), _FILENAME, bytes(25)),
    0x87: _Command(_refused(ILLEGAL_HANDLE), _exactly(1), bytes(25)),
    0x88: _Command(_B._versions, _NO_BODY, bytes(4)),
    0x89: _Command(_refused(NO_SPACE), range(5, 25), bytes(1)),
    0x8A: _Command(_refused(FILE_NOT_FOUND), _FILENAME, bytes(5)),
    0x8B: _Command(_refused(NO_SPACE), range(5, 25), bytes(1)),
    0x8C: _Command(_refused(FILE_NOT_FOUND), _FILENAME, bytes(5)),
    0x90: _Command(_refused(MODULE_NOT_FOUND), _FILENAME, bytes(31)),
    0x91: _Command(_refused(ILLEGAL_HANDLE), _exactly(1), bytes(31)),
    0x92: _Command(_refused(ILLEGAL_HANDLE), _exactly(1), bytes(1)),
    0x94: _Command(_refused(MODULE_NOT_FOUND), _exactly(8), bytes(6)),
    0x95: _Command(_refused(MODULE_NOT_FOUND), range(8, 120), bytes(6)),
    0x98: _Command(_B._set_name, range(1, 17)),
    0x9A: _Command(_B._address, _NO_BODY, bytes(7)),
    0x9B: _Command(_B._device_info, _NO_BODY, bytes(30)),
    0xA0: _Command(_B._nothing, _NO_BODY),
    0xA1: _Command(_B._poll, _exactly(1), bytes(2)),
    0xA2: _Command(_B._poll, _exactly(2), bytes(2)),
}


def telegram_length(head: bytes) -> int | None:
    """Return the length of the telegram that ``head`` begins with, as nxt-python sends it.

    None if ``head`` is too short, or the length is not in the telegram. Over TCP telegrams have no
    frames and may arrive joined together; this function separates them.
    """
    if len(head) < 2:
        return None
    opcode, direct = head[1], head[0] & ~NO_REPLY == DIRECT
    sized = {0x09: (3, 4), 0x0F: (3, 5)} if direct else {0x95: (8, 10)}
    if opcode in sized:
        at, fixed = sized[opcode]
        return fixed + head[at] if len(head) > at else None
    command = (_DIRECT if direct else _SYSTEM).get(opcode)
    if command is None or (not direct and opcode == 0x83):
        return None
    if opcode == 0x04 and direct:
        return 12
    if opcode == 0x98 and not direct:
        return 17
    return 2 + command.lengths[-1]
