"""A Pybricks hub in software, at the edge where bleak calls a system's own Bluetooth.

After the Pybricks profile (pybricks/technical-info, pybricks-ble-profile.md) and the hub's own code
(pybricks-micropython, lib/pbio/sys/command.c and host.c). Its user program is a process, whose
stdin and stdout are the program's. The bleak library is the real one.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import struct
import subprocess
import termios
import threading

import bleak
from bleak.backends.characteristic import BleakGATTCharacteristic
from bleak.backends.client import BaseBleakClient
from bleak.backends.scanner import AdvertisementData, BaseBleakScanner
from bleak.backends.service import BleakGATTService, BleakGATTServiceCollection
from bleak.exc import BleakError, BleakGATTProtocolError

SERVICE = "c5f50001-8280-46da-89f4-6d8051e4aeef"
COMMAND_EVENT = "c5f50002-8280-46da-89f4-6d8051e4aeef"
CAPABILITIES = "c5f50003-8280-46da-89f4-6d8051e4aeef"
DEVICE_INFORMATION = "0000180a-0000-1000-8000-00805f9b34fb"
VERSION = "00002a28-0000-1000-8000-00805f9b34fb"

WRONG_LENGTH, NOT_ALLOWED, INVALID_COMMAND, BUSY = 0x0D, 0x13, 0x80, 0x81


class Hub:
    """One hub.

    Args:
        program: words that run its user program; empty if the hub has no program.
        name, address: as a scan reports them.
        version: version of the profile.
        longest: bytes that a characteristic takes at once.
        room: bytes that its stdin holds.

    Attributes:
        refused: number of commands that were answered with "busy".
        process: its user program, while it runs.
        client: the connected client, or None.
    """

    def __init__(
        self, program=(), *, name="Pybricks Hub", address="A8:E2:C1:00:00:01", version="1.4.0",
        longest=20, room=21,
    ):  # fmt: skip
        self.program = list(program)
        self.name, self.address, self.version = name, address, version
        self.longest, self.room = longest, room
        self.refused = 0
        self.process = self.client = None
        self._stdin = None

    def start(self):
        """Start the user program, as the hub's button does; return an error, 0 if there is none."""
        if self.process is not None:
            return BUSY
        if not self.program:
            return NOT_ALLOWED
        self._stdin = os.pipe()
        self.process = subprocess.Popen(
            self.program, stdin=self._stdin[0], stdout=subprocess.PIPE, bufsize=0
        )
        threading.Thread(target=self._listen, args=(self.process,), daemon=True).start()
        self.say_status()
        return 0

    def _listen(self, process):
        while data := os.read(process.stdout.fileno(), 4096):
            # An event is no longer than what is written, its first byte among that.
            for begin in range(0, len(data), self.longest - 1):
                self._say(b"\x01" + data[begin : begin + self.longest - 1])
        process.stdout.close()
        process.wait()
        for end in self._stdin:
            os.close(end)
        self.process = None
        self.say_status()

    def say_status(self):
        """Send flags, program and slot to the connected client."""
        running = self.process is not None
        self._say(struct.pack("<BIBB", 0, running << 6 | 1 << 9, 0, 0))

    def _say(self, event):
        if self.client is not None:
            self.client.take(event)

    def capabilities(self):
        """Return the hub's capabilities."""
        return struct.pack("<HII", self.longest, 0b111, 261_512)

    def command(self, data):
        """Carry out a command; return an error, 0 if there is none."""
        if len(data) > self.longest:
            return WRONG_LENGTH
        error = INVALID_COMMAND
        if data[0] == 1:
            error = self.start() if len(data) <= 2 else NOT_ALLOWED
        elif data[0] == 6 and self.version >= "1.3":
            error = self._type(data[1:])
        self.refused += error == BUSY
        return error

    def _type(self, data):
        if self.process is None:
            return 0  # it goes nowhere
        waiting = fcntl.ioctl(self._stdin[0], termios.FIONREAD, bytes(4))
        if self.room - int.from_bytes(waiting, "little") < len(data):
            return BUSY
        os.write(self._stdin[1], data)
        return 0

    def leave(self):
        """Go out of reach: the connection is lost, the program goes on."""
        self.client.lose()

    def switch_off(self):
        """End the user program and the connection."""
        if (process := self.process) is not None:
            process.kill()
            process.wait()
        if self.client is not None:
            self.leave()


class Scanner(BaseBleakScanner):
    """Sees hubs."""

    hubs: list = []  # noqa: RUF012

    def __init__(self, callback, service_uuids, mode, **more):
        super().__init__(callback, service_uuids)
        self._begun = None

    async def start(self):
        self._begun = asyncio.get_running_loop().call_later(0.01, self._see)

    async def stop(self):
        self._begun.cancel()

    def _see(self):
        for hub in self.hubs:
            advertisement = AdvertisementData(hub.name, {}, {}, [SERVICE], 0, -50, ())
            device = self.create_or_update_device(
                hub.address, hub.address, hub.name, hub, advertisement
            )
            if hub.client is None and self.is_allowed_uuid(advertisement.service_uuids):
                self.call_detection_callbacks(device, advertisement)


class _Client(BaseBleakClient):
    def __init__(self, device, **options):
        options.pop("services", None)
        super().__init__(device, **options)
        self._hub, self._callback = device.details, None

    name = property(lambda self: self._hub.name)
    mtu_size = property(lambda self: self._hub.longest + 3)
    is_connected = property(lambda self: self._hub.client is self)

    async def connect(self, pair, **more):
        self._loop = asyncio.get_running_loop()
        services = BleakGATTServiceCollection()
        for begin, (service, characteristics) in enumerate(
            {
                DEVICE_INFORMATION: {VERSION: ["read"]},
                SERVICE: {COMMAND_EVENT: ["write", "notify"], CAPABILITIES: ["read"]},
            }.items()
        ):
            made = BleakGATTService(None, 10 * begin, service)
            services.add_service(made)
            for place, (uuid, does) in enumerate(characteristics.items(), 1):
                services.add_characteristic(
                    BleakGATTCharacteristic(
                        None, 10 * begin + place, uuid, does, lambda: self._hub.longest, made
                    )
                )
        self.services = services
        self._hub.client = self

    async def disconnect(self):
        if self.is_connected:
            self._ended()

    def _ended(self):
        self._hub.client = self._callback = None
        if self._disconnected_callback is not None:
            self._disconnected_callback()

    def lose(self):
        self._loop.call_soon_threadsafe(self._ended)

    def take(self, event):
        # Between two looks at it the loop may have ended.
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(
                lambda: self._callback is None or self._callback(bytearray(event))
            )

    def _still(self):
        if not self.is_connected:
            raise BleakError("Not connected")

    async def read_gatt_char(self, characteristic, **more):
        self._still()
        if characteristic.uuid == VERSION:
            return bytearray(self._hub.version.encode())
        return bytearray(self._hub.capabilities())

    async def write_gatt_char(self, characteristic, data, response):
        self._still()
        assert characteristic.uuid == COMMAND_EVENT
        assert response, "the profile takes no writing without a response"
        if error := self._hub.command(bytes(data)):
            raise BleakGATTProtocolError(error)

    async def start_notify(self, characteristic, callback, **more):
        self._still()
        self._callback = callback
        self._hub.say_status()

    async def stop_notify(self, characteristic):
        self._callback = None

    async def pair(self, *more, **others):
        raise NotImplementedError

    unpair = read_gatt_descriptor = write_gatt_descriptor = pair


def in_reach(monkeypatch, *hubs):
    """Put these hubs, and nothing else, within reach of this computer's Bluetooth."""
    monkeypatch.setattr(Scanner, "hubs", list(hubs))
    for what, kind in (("scanner", Scanner), ("client", _Client)):
        monkeypatch.setattr(
            bleak, f"get_platform_{what}_backend_type", lambda kind=kind: (kind, "made up")
        )
