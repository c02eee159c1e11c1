"""The connection to a virtual brick: a radio with delay, behind a pseudo-terminal or a socket.

nxt-python reaches the first through its device-file back end and the second through its
socket back end; neither notices that the brick is virtual. The time base is the lab's clock. With a
clock that advances on request, a client's computation takes no time in the lab, and the same client
sees the same delays on every run. With a clock that
runs in real time the same classes serve any other program.
"""

from __future__ import annotations

import os
import socket
import struct
import threading

import numpy as np

from neurosim.lab.nxt.brick import DIRECT, NO_REPLY, SYSTEM, VirtualBrick, telegram_length
from neurosim.lab.server import PtyEnd, Server, SocketEnd, receive, send
from neurosim.robots.base import Clock

#: Longest telegram (nxt-python's largest block over a serial line, and its head).
LONGEST = 128
#: An incomplete telegram is dropped after this many seconds.
REST_WITHIN = 0.5
#: Bluetooth's shortest exchange, two slots of 625 microseconds.
SPACING = 0.00125


class Radio:
    """Carries telegrams to a brick and replies back, each with its own delay, in order.

    A delay is ``delay - jitter`` plus an exponentially distributed wait of mean ``jitter``
    for repeated packets: mean ``delay``, standard deviation ``jitter``, never shorter than
    ``delay - jitter``.

    A telegram that asks for no reply waits, and the clock stands, until one that asks for a reply
    follows or ``patience`` runs out. So telegrams that a client writes one after the other leave at
    the same time, even on a slow computer.

    Args:
        brick: the one that answers the telegrams.
        clock: the lab's clock; ``sleep_until`` advances the lab to a time.
        rng: draws the delays; may be None if ``jitter`` is 0.
        delay: mean delay one way, s.
        jitter: standard deviation of it, s, at most ``delay``.
        patience: wall-clock seconds that a telegram without reply waits for others. Use a
            few milliseconds with a clock that runs in real time.

    Attributes:
        silent: True if the brick no longer receives anything. Set it to switch the brick off.
        silent_at: the lab time from which it is silent, or None.
        silent_after: number of telegrams after which it is silent, or None.
        telegrams: number of telegrams sent to it so far.
    """

    def __init__(
        self,
        brick: VirtualBrick,
        clock: Clock,
        rng: np.random.Generator | None = None,
        *,
        delay: float = 0.020,
        jitter: float = 0.004,
        patience: float = 0.25,
    ):
        if not 0 <= jitter <= delay:
            raise ValueError(f"jitter must lie between 0 and the delay of {delay} s, not {jitter}")
        if jitter and rng is None:
            raise ValueError("a radio with jitter needs a random generator")
        self.brick = brick
        self.clock = clock
        self.patience = patience
        self.silent = False
        self.silent_at: float | None = None
        self.silent_after: int | None = None
        self.telegrams = 0
        self._rng = rng
        self._delay, self._jitter = delay, jitter
        self._lock = threading.Lock()
        self._under_way: list[tuple[float, bytes]] = []
        self._last_up = self._last_down = -np.inf

    @property
    def waiting(self) -> bool:
        """Whether telegrams without reply are waiting."""
        return bool(self._under_way)

    def deliver(self, telegram: bytes) -> bytes | None:
        """Send one telegram; return its reply after the clock has reached its arrival."""
        with self._lock:
            self._last_up = self._arrival(self._last_up)
            self._under_way.append((self._last_up, telegram))
            if telegram and telegram[0] & NO_REPLY:
                return None
            reply = self._arrive()
            if reply is None:
                return None
            self._last_down = self._arrival(self._last_down)
            self.clock.sleep_until(self._last_down)
            return reply

    def settle(self) -> None:
        """Deliver all waiting telegrams."""
        with self._lock:
            self._arrive()

    def _arrive(self) -> bytes | None:
        reply = None
        while self._under_way:
            arrival, telegram = self._under_way.pop(0)
            self.clock.sleep_until(arrival)
            reply = None if self._unheard() else self.brick.handle(telegram)
        return reply

    def _unheard(self) -> bool:
        self.telegrams += 1
        if self.silent_after is not None and self.telegrams > self.silent_after:
            self.silent = True
        if self.silent_at is not None and self.clock.now() >= self.silent_at:
            self.silent = True
        return self.silent

    def _arrival(self, last: float) -> float:
        delay = self._delay
        if self._jitter:
            delay += self._jitter * (self._rng.standard_exponential() - 1.0)
        spacing = SPACING if self._delay else 0.0
        return max(self.clock.now() + delay, last + spacing)


class _RadioServer(Server):
    """A server whose telegrams go through a radio."""

    radio: Radio

    def _wait_or_settle(self, readable: int | socket.socket, rest_due: bool) -> bool:
        """Wait for more bytes, and deliver telegrams meanwhile; return False if none came."""
        if self.radio.waiting:
            if self._wait(readable, self.radio.patience):
                return True
            self.radio.settle()
        return self._wait(readable, REST_WITHIN if rest_due else None)


class PtyServer(PtyEnd, _RadioServer):
    """Serves telegrams framed by their length, as over Bluetooth's serial port, on a pty.

    ``path`` is the device file that a client opens. A client may close it and another open
    it again. Bytes that are not a telegram are dropped, and the line continues.

    Raises:
        RobotError: if the system has no pseudo-terminals (Windows), or none is free.
    """

    def __init__(self, radio: Radio):
        self.radio = radio
        super().__init__()

    def _serve(self) -> None:
        buffer = b""
        while not self._stopping:
            if not self._wait_or_settle(self._master, bool(buffer)):
                buffer = b""
                continue
            try:
                buffer += os.read(self._master, 4096)
            except OSError:
                return
            buffer = self._take(buffer)

    def _take(self, buffer: bytes) -> bytes:
        while len(buffer) >= 2:
            (length,) = struct.unpack_from("<H", buffer)
            if not 2 <= length <= LONGEST:
                return b""
            if len(buffer) < 2 + length:
                break
            telegram, buffer = buffer[2 : 2 + length], buffer[2 + length :]
            reply = self.radio.deliver(telegram)
            if reply is not None:
                self._write(struct.pack("<H", len(reply)) + reply)
        return buffer


class SocketServer(SocketEnd, _RadioServer):
    """Serves nxt-python's socket back end, as its ``nxt-server`` does, on loopback.

    ``address`` is (host, port). One client at a time; the next is served when it leaves.

    Args:
        radio: the radio for the telegrams.
        port: 0 for any free one.

    Raises:
        RobotError: if the port is taken.
    """

    ASK_TYPE = 0x98
    TYPE = b"bluetooth"

    def __init__(self, radio: Radio, port: int = 0):
        self.radio = radio
        super().__init__(port)

    def _client_left(self) -> None:
        self.radio.settle()

    def _serve_client(self, client: socket.socket) -> None:
        buffer = b""
        while not self._stopping:
            whole = not self._wait_or_settle(client, bool(buffer))
            if not whole:
                received = receive(client)
                if not received:
                    return
                buffer += received
            while buffer:
                if buffer[0] == self.ASK_TYPE:
                    reply, buffer = self.TYPE, buffer[1:]
                elif buffer[0] & ~NO_REPLY not in (DIRECT, SYSTEM):
                    return
                else:
                    length = telegram_length(buffer) or len(buffer)
                    if len(buffer) < max(length, 2) and not whole:
                        break
                    reply = self.radio.deliver(buffer[:length])
                    buffer = buffer[length:]
                if reply is not None and not send(client, reply):
                    return
