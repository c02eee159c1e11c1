"""The Bluetooth back end against a fake of Python's socket module."""

import errno
import struct
import types

import nxt.locator
import pytest
from brick_body import Body, LabClock

from neurosim.base.errors import LinkLost, RobotError
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.robots.nxt import bluetooth
from neurosim.robots.nxt.driver import NXT

HOST = "00:16:53:0A:0B:0C"


class FakeSocket:
    """RFCOMM to a virtual brick that hands its bytes out in pieces of ``piece``."""

    def __init__(self, piece=1000, refuse=None):
        self.brick = VirtualBrick(Body(), "Pippin", address=HOST)
        self.piece, self.refuse = piece, refuse
        self.frames, self.waiting = [], b""
        self.connected = self.closed = False
        self.mute = self.ended = False
        self.timeouts = []

    def settimeout(self, seconds):
        self.timeouts.append(seconds)

    def connect(self, address):
        if self.refuse:
            raise self.refuse
        self.connected = address

    def sendall(self, data):
        self.frames.append(data)
        (length,) = struct.unpack("<H", data[:2])
        assert length == len(data) - 2
        reply = self.brick.handle(data[2:])
        if reply is not None and not self.mute:
            self.waiting += struct.pack("<H", len(reply)) + reply

    def recv(self, count):
        if self.ended:
            return b""
        if not self.waiting:
            raise TimeoutError("timed out")
        count = min(count, self.piece)
        data, self.waiting = self.waiting[:count], self.waiting[count:]
        return data

    def close(self):
        self.closed = True


@pytest.fixture
def radio(monkeypatch):
    """Replace the socket module by a fake; ``radio(sock)`` sets the socket that it returns."""

    def install(made):
        def make(*kind):
            assert kind == (31, 1, 3)
            if isinstance(made, Exception):
                raise made
            return made

        fake = types.SimpleNamespace(AF_BLUETOOTH=31, SOCK_STREAM=1, BTPROTO_RFCOMM=3, socket=make)
        monkeypatch.setattr(bluetooth, "socket", fake)
        return made

    return install


@pytest.mark.parametrize("piece", [1, 3, 1000])
def test_the_driver_over_bluetooth(radio, piece):
    sock = radio(FakeSocket(piece))
    with NXT(host=HOST, clock=LabClock()) as robot:
        assert sock.connected == (HOST, 1)
        robot.drive((30, -30))
        assert [output.power for output in sock.brick.hardware.outputs] == [0, 30, -30]
        assert robot.read_sensors()["line_left"] == pytest.approx(0.55, abs=0.001)
    assert sock.frames[0] == b"\x02\x00\x01\x9b"
    assert sock.closed
    assert all(output.power == 0 for output in sock.brick.hardware.outputs)


def test_as_a_back_end_of_nxt_python(radio):
    radio(FakeSocket(piece=2))
    with nxt.locator.find(backends=[bluetooth.get_backend()], host=HOST, config=None) as brick:
        assert brick.get_device_info()[:2] == ("Pippin", HOST)
        assert brick._sock.type == "bluetooth"


def test_a_brick_out_of_range_is_lost(radio):
    sock = radio(FakeSocket())
    with NXT(host=HOST, clock=LabClock(), deadline=0.2) as robot:
        sock.mute = True
        with pytest.raises(LinkLost, match=rf"brick at {HOST} \(Bluetooth\) stopped answering"):
            robot.battery()
    sock = radio(FakeSocket())
    with NXT(host=HOST, clock=LabClock()) as robot:
        sock.ended = True
        with pytest.raises(LinkLost, match="line was closed"):
            robot.battery()
    assert sock.closed


def test_an_end_in_the_middle_of_a_telegram_is_an_error(radio):
    sock = radio(FakeSocket())
    brick = next(bluetooth.Backend().find(host=HOST))
    sock.ended = True
    with pytest.raises(ConnectionError, match=HOST):
        brick.get_battery_level()


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.EHOSTDOWN, "is it on"),
        (errno.ECONNREFUSED, "pair it"),
        (errno.EBUSY, "busy"),
        (errno.EPERM, "not permitted"),
    ],
)
def test_no_brick_there(radio, code, words):
    sock = radio(FakeSocket(refuse=OSError(code, "x")))
    with pytest.raises(RobotError, match=f"(?i){HOST}: .*{words}"):
        NXT(host=HOST).connect()
    assert sock.closed


def test_connecting_takes_too_long_or_there_is_no_adapter(radio):
    radio(FakeSocket(refuse=TimeoutError("timed out")))
    with pytest.raises(RobotError, match="does not answer"):
        NXT(host=HOST).connect()
    radio(OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol"))
    with pytest.raises(RobotError, match="no Bluetooth adapter"):
        NXT(host=HOST).connect()


def test_a_python_without_bluetooth_names_the_ways_that_remain(monkeypatch):
    monkeypatch.setattr(bluetooth, "socket", types.SimpleNamespace(SOCK_STREAM=1))
    with pytest.raises(RobotError) as error:
        NXT(host=HOST).connect()
    text = str(error.value)
    assert "built without Bluetooth" in text
    assert "/dev/rfcomm0" in text
    assert "USB" in text
    assert "nxt-server" in text
    assert "\n" not in text


def test_the_address_must_be_given_and_be_one():
    with pytest.raises(RobotError, match="cannot search"):
        next(bluetooth.Backend().find())
    for wrong in ("NXT", "00:16:53", "00:16:53:01:02:0G"):
        with pytest.raises(RobotError, match="not a Bluetooth address"):
            NXT(host=wrong).connect()
