"""The program on a Pybricks hub over Bluetooth, as a port: writes to its stdin, reads its stdout.

After the Pybricks profile 1.3 and later (pybricks/technical-info, pybricks-ble-profile.md; errors
and optional parameters: pybricks-micropython, lib/pbio/include/pbio/protocol.h): one characteristic
of Bluetooth Low Energy takes commands and gives events. The hub's program must be downloaded first,
with Pybricks Code or pybricksdev.
"""

from __future__ import annotations

import asyncio
import struct
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, TypeVar

from neurosim.base.errors import RobotError, UserError

#: Beginning of a port's name; the hub's name or Bluetooth address follows.
SCHEME = "pybricks://"

SERVICE = "c5f50001-8280-46da-89f4-6d8051e4aeef"
COMMAND_EVENT = "c5f50002-8280-46da-89f4-6d8051e4aeef"
CAPABILITIES = "c5f50003-8280-46da-89f4-6d8051e4aeef"
#: The characteristic with the version of the profile, in Bluetooth's device information.
VERSION = "00002a28-0000-1000-8000-00805f9b34fb"
#: The first version whose commands write to a program's stdin.
NEEDED = (1, 3)
#: Commands, events, the status flag of a running program, and the error of a hub whose stdin is
#: full or whose program runs already.
START_PROGRAM, WRITE_STDIN = 1, 6
STATUS, WROTE_STDOUT = 0, 1
RUNNING = 1 << 6
BUSY = 0x81
#: Longest times of the search and of connecting, s; and of the first status and of the program's
#: start.
FIND, CONNECT, TELL, START = 10.0, 20.0, 1.0, 5.0
#: Time after which a full stdin is written to again, s, and after which it is given up.
AGAIN, FULL = 0.01, 4.0

_PROGRAM = "firmware/micropython/main_pybricks.py"

T = TypeVar("T")


class PybricksPort:
    """A hub's program, as a port for :class:`neurosim.robots.serial_line.SerialLine`.

    Args:
        name: of the hub, or its address; empty: the first hub that is found.
        timeout: Seconds that :meth:`read` waits.

    Raises:
        RobotError: if Bluetooth cannot be used, the hub is not found, or its program does not run.
        UserError: if the package bleak is missing.
    """

    def __init__(self, name: str, *, timeout: float):
        try:
            import bleak
        except ImportError:
            raise UserError(
                "a Pybricks hub needs the package bleak: pip install 'neurosim[pybricks]'"
            ) from None
        self._bleak: Any = bleak
        self.timeout, self.write_timeout = timeout, 5.0
        self._which = f"the Pybricks hub {name!r}" if name else "the Pybricks hub"
        self._name, self._longest = name, 0
        self._received, self._gone = b"", ""
        self._running: bool | None = None
        self._changed = threading.Condition()
        self._client: Any = None
        self._runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self._loop, self._over = self._runner.get_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._serve, name="bluetooth", daemon=True)
        self._thread.start()
        try:
            self._connect()
            self._start()
        except BaseException:
            self.close()
            raise

    @property
    def in_waiting(self) -> int:
        """Number of received bytes."""
        with self._changed:
            self._check()
            return len(self._received)

    def read(self, count: int) -> bytes:
        """Return at most ``size`` bytes after the first ones arrive; empty if none arrive."""
        with self._changed:
            self._until(lambda: self._received, self.timeout)
            self._check()
            data, self._received = self._received[:count], self._received[count:]
        return data

    def write(self, data: bytes) -> None:
        """Send bytes; return when the hub has them."""
        with self._changed:
            self._check()
        self._wait(self._write(data), self.write_timeout)

    def close(self) -> None:
        """End the connection; the program continues. Never raises."""
        if self._client is not None:
            with suppress(Exception):
                self._wait(self._client.disconnect(), 2.0)
            self._client = None
        with suppress(RuntimeError):  # if it is closed already
            self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join(2.0)

    def _serve(self) -> None:
        with self._runner:
            self._runner.run(self._over.wait())

    def _connect(self) -> None:
        """Find the hub, and connect to it."""
        try:
            device = self._wait(self._find(), FIND + CONNECT)
        except OSError as error:
            raise RobotError(
                f"Bluetooth cannot be used on this computer ({error}): plug in an adapter or "
                "switch it on, and allow this program to use it"
            ) from None
        if device is None:
            which = f"no Pybricks hub {self._name!r}" if self._name else "no Pybricks hub"
            raise RobotError(
                f"{which} is found by Bluetooth: switch it on, and disconnect it from Pybricks Code"
            )
        try:
            version = self._wait(self._open(device), CONNECT)
        except OSError as error:
            raise RobotError(
                f"{self._which} is found, but not connected ({error}): bring it nearer, and try "
                "again"
            ) from None
        if version < NEEDED:
            raise RobotError(
                f"{self._which} has firmware that is too old: install the newest of Pybricks on it"
            )

    async def _find(self) -> Any:
        wanted = self._name.casefold()

        def is_it(device: Any, advertised: Any) -> bool:
            names = (advertised.local_name, device.name, device.address)
            return not wanted or wanted in (str(each).casefold() for each in names)

        return await self._bleak.BleakScanner.find_device_by_filter(
            is_it, timeout=FIND, service_uuids=[SERVICE]
        )

    async def _open(self, device: Any) -> tuple[int, ...]:
        """Connect to a hub and receive its events; return the version of its profile."""
        client = self._client = self._bleak.BleakClient(device, self._left)
        await client.connect()
        text = bytes(await client.read_gatt_char(VERSION)).decode("ascii", "replace")
        version = tuple(int(word) for word in text.split(".")[:2] if word.isdigit())
        if version >= NEEDED:
            about = bytes(await client.read_gatt_char(CAPABILITIES))
            self._longest = struct.unpack_from("<H", about)[0]
            await client.start_notify(COMMAND_EVENT, self._event)
        return version

    def _start(self) -> None:
        """Check that the hub's program runs; start it if it does not."""
        # A hub sends its status after the request for events.
        self._until(lambda: self._running is not None, TELL)
        if self._running:
            return
        if self._wait(self._send(START_PROGRAM), self.write_timeout) not in (0, BUSY):
            raise RobotError(
                f"{self._which} has no program: download {_PROGRAM} to it with Pybricks Code"
            )
        if not self._until(lambda: self._running, START):
            raise RobotError(
                f"the program of {self._which} does not run: download {_PROGRAM} to it with "
                "Pybricks Code, and read there what it prints"
            )

    def _until(self, condition: Callable[[], object], seconds: float) -> bool:
        """Return whether a condition becomes true in time, while the hub is connected."""
        with self._changed:
            self._changed.wait_for(lambda: condition() or self._gone, seconds)
            return bool(condition()) and not self._gone

    async def _write(self, data: bytes) -> None:
        room, end = self._longest - 1, self._loop.time() + FULL
        for begin in range(0, len(data), room):
            piece = data[begin : begin + room]
            while (error := await self._send(WRITE_STDIN, piece)) == BUSY:
                if self._loop.time() > end:
                    raise OSError(f"its program reads nothing: download {_PROGRAM} to the hub")
                await asyncio.sleep(AGAIN)
            if error:
                raise OSError(f"the hub refuses what it is sent: error {error:#x}")

    async def _send(self, command: int, payload: bytes = b"") -> int:
        """Send a command; return the hub's error, 0 if there is none."""
        try:
            await self._client.write_gatt_char(
                COMMAND_EVENT, bytes([command]) + payload, response=True
            )
        except self._bleak.exc.BleakGATTProtocolError as error:
            return int(error.code)
        return 0

    def _event(self, sender: object, data: bytearray) -> None:
        """Handle an event of the hub, in the thread of Bluetooth."""
        with self._changed:
            if data[0] == WROTE_STDOUT:
                self._received += bytes(data[1:])
            elif data[0] == STATUS and len(data) >= 5:
                before, flags = self._running, struct.unpack_from("<I", data, 1)[0]
                self._running = bool(flags & RUNNING)
                if before and not self._running:
                    self._gone = "the hub's program has ended"
            self._changed.notify_all()

    def _left(self, client: object) -> None:
        with self._changed:
            self._gone = self._gone or "the hub has disconnected"
            self._changed.notify_all()

    def _check(self) -> None:
        if self._gone:
            raise OSError(self._gone)

    def _wait(self, work: Coroutine[Any, Any, T], seconds: float) -> T:
        """Return the result of a task in the thread of Bluetooth.

        Raises:
            OSError: with the reason.
        """
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(seconds)
        except TimeoutError:
            future.cancel()
            raise OSError("it takes too long to answer") from None
        except (self._bleak.exc.BleakError, EOFError, OSError) as error:
            raise OSError(self._gone or _reason(error)) from None


def _reason(error: Exception) -> str:
    """Return the sentence of an error, without its numbers."""
    texts = [each for each in error.args if isinstance(each, str)]
    return " ".join(texts[-1].split()) if texts else type(error).__name__
