"""Messages of Aseba for a Thymio II, and programs of its virtual machine.

A message is three 16-bit words, low byte first (length of the payload, number of the node that
sends it, type), and the payload. The description of a node lists its variables in the order of
their addresses, its events and native functions. Sources: Magnenat, Rétornaz,
Bonani, Longchamp and Mondada, ASEBA: a modular architecture for event-based control of complex
robots, IEEE/ASME Transactions on Mechatronics 16, 2011, and the sources of version 1.6.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

#: Version of the protocol, and the number of this computer as a node.
VERSION, HOST = 5, 1
#: Longest payload of a node; a longer one is garbage.
LONGEST = 1024

DESCRIPTION, VARIABLE, EVENT, NATIVE = 0x9000, 0x9001, 0x9002, 0x9003
VARIABLES, PRESENT = 0x9005, 0x900C
SET_BYTECODE, RUN = 0xA001, 0xA003
GET_VARIABLES, SET_VARIABLES = 0xA00B, 0xA00C
GET_DESCRIPTION, LIST_NODES = 0xA010, 0xA011
#: Types of messages that are used here; events of other programs are ignored.
_FROM_NODES = range(0x9000, 0x9010)

#: Number of the first local event; the others count down from there.
FIRST_EVENT = 0xFFFE

STOP, ADD, SUBTRACT, MULTIPLY, DIVIDE, REMAINDER, GREATER = (
    0x0000, 0x8002, 0x8003, 0x8004, 0x8005, 0x8006, 0x800C,
)  # fmt: skip


class Message(NamedTuple):
    """A message: its type, the node that sent it, its payload."""

    type: int
    source: int
    payload: bytes

    @property
    def words(self) -> tuple[int, ...]:
        """The payload as signed 16-bit words."""
        count = len(self.payload) // 2
        return struct.unpack(f"<{count}h", self.payload[: 2 * count])


def encode(type_: int, words: Sequence[int], source: int = HOST) -> bytes:
    """Return a message of 16-bit words, signed or not."""
    payload = b"".join(struct.pack("<H", word & 0xFFFF) for word in words)
    return struct.pack("<HHH", len(payload), source, type_) + payload


class Reader:
    """Cuts bytes into messages; bytes that cannot begin one are skipped."""

    def __init__(self) -> None:
        self._data = b""

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes; return the complete messages."""
        self._data += data
        messages = []
        while len(self._data) >= 6:
            length, source, type_ = struct.unpack_from("<HHH", self._data)
            if length > LONGEST or type_ not in _FROM_NODES:
                self._data = self._data[1:]
                continue
            if len(self._data) < 6 + length:
                break
            messages.append(Message(type_, source, self._data[6 : 6 + length]))
            self._data = self._data[6 + length :]
        return messages


@dataclass
class Description:
    """A node's description of itself, message by message.

    Attributes:
        name: name of its kind.
        addresses: addresses of its variables, by name; an array's is that of its first word.
        free: address of the first word after the named variables.
        events: names of its local events, in order.
        natives: names of its native functions, in order.
    """

    name: str = ""
    addresses: dict[str, int] = field(default_factory=dict)
    free: int = 0
    events: list[str] = field(default_factory=list)
    natives: list[str] = field(default_factory=list)
    _counts: tuple[int, ...] | None = None

    @property
    def whole(self) -> bool:
        """Whether the description is complete."""
        return self._counts == (len(self.addresses), len(self.events), len(self.natives))

    def take(self, message: Message) -> None:
        """Add a message; messages other than descriptions change nothing.

        Raises:
            ValueError: if a description is cut short.
        """
        type_, payload = message.type, message.payload
        try:
            if type_ == DESCRIPTION:
                self.name, rest = _text(payload)
                self._counts = struct.unpack_from("<HHHHHHH", rest)[4:]
            elif type_ == VARIABLE:
                name, _ = _text(payload[2:])
                self.addresses[name] = self.free
                self.free += struct.unpack_from("<H", payload)[0]
            elif type_ == EVENT:
                self.events.append(_text(payload)[0])
            elif type_ == NATIVE:
                self.natives.append(_text(payload)[0])
        except (struct.error, IndexError) as error:
            raise ValueError(f"a description is cut short: {error}") from None


def _text(data: bytes) -> tuple[str, bytes]:
    """Return a text after its length, and the bytes after it."""
    end = 1 + data[0]
    return data[1:end].decode("ascii", "replace"), data[end:]


def load(address: int) -> int:
    """Return the instruction that pushes a variable on the stack."""
    return 0x3000 | address


def store(address: int) -> int:
    """Return the instruction that pops a variable from the stack."""
    return 0x4000 | address


def push(value: int) -> int:
    """Return the instruction that pushes a number from -2048 to 2047."""
    return 0x1000 | (value & 0xFFF)


def call(native: int) -> int:
    """Return the instruction that calls a native function; it pops addresses, the first first."""
    return 0xC000 | native
