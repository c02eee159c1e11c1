"""Radio, pseudo-terminal and socket in front of a virtual brick, reached by nxt-python."""

import os
import select
import socket
import subprocess
import sys
import threading

import numpy as np
import nxt.locator
import pytest
from brick_body import Body, LabClock
from nxt.motor import Mode, Port, RegulationMode, RunState
from patience import PATIENCE, wait_until

from neurosim.base.errors import RobotError
from neurosim.lab.nxt import serve
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.lab.nxt.serve import PtyServer, Radio, SocketServer
from neurosim.robots.base import SystemClock

RUN = (Mode.ON | Mode.REGULATED, RegulationMode.SPEED, 0, RunState.RUNNING, 0)

needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals on Windows")


class Stamped(Body):
    """Notes when each motor was set."""

    def __init__(self, clock):
        super().__init__()
        self.clock = clock
        self.log = []

    def set_output(self, port, power, *rest):
        super().set_output(port, power, *rest)
        self.log.append((port, power, self.clock.now()))


class World:
    def __init__(self, **radio):
        self.clock = LabClock()
        self.body = Stamped(self.clock)
        self.brick = VirtualBrick(self.body)
        rng = np.random.default_rng(radio.pop("seed", 1))
        radio.setdefault("patience", PATIENCE)
        self.radio = Radio(self.brick, self.clock, rng, **radio)


def find(server):
    if isinstance(server, PtyServer):
        return nxt.locator.find(backends=["devfile"], filename=server.path, config=None)
    host, port = server.address
    return nxt.locator.find(backends=["socket"], server_host=host, server_port=port, config=None)


@pytest.fixture(params=[pytest.param(PtyServer, marks=needs_pty), SocketServer])
def kind(request):
    return request.param


def test_a_reply_takes_two_delays():
    world = World(delay=0.020, jitter=0.0)
    assert world.radio.deliver(b"\x00\x0b")[:3] == b"\x02\x0b\x00"
    assert world.clock.now() == pytest.approx(0.040)


def test_telegrams_written_together_leave_together():
    world = World(delay=0.020, jitter=0.0)
    for port in (1, 2):
        world.radio.deliver(bytes([0x80, 4, port, 30, 7, 1, 0, 0x20, 0, 0, 0, 0]))
    assert world.clock.now() == 0.0
    assert world.radio.waiting
    world.radio.deliver(b"\x00\x06\x02")
    assert [(port, power) for port, power, _ in world.body.log] == [(1, 30), (2, 30)]
    assert [when for _, _, when in world.body.log] == pytest.approx([0.020, 0.02125])
    assert world.clock.now() == pytest.approx(0.0225 + 0.020)


def test_delays_have_the_mean_and_spread_asked_for_and_keep_order():
    world = World(delay=0.020, jitter=0.004)
    trips = []
    for _ in range(2000):
        start = world.clock.now()
        world.radio.deliver(b"\x00\x0d")
        trips.append(world.clock.now() - start)
    assert np.mean(trips) == pytest.approx(0.040, abs=0.0005)
    assert np.std(trips) == pytest.approx(0.004 * 2**0.5, rel=0.1)
    assert min(trips) >= 0.032
    for port in [0, 1, 2] * 20:
        world.radio.deliver(bytes([0x80, 4, port, 1, 1, 0, 0, 0x20, 0, 0, 0, 0]))
    world.radio.settle()
    assert [port for port, _, _ in world.body.log] == [0, 1, 2] * 20
    times = [when for _, _, when in world.body.log]
    assert times == sorted(times)


def test_radio_refuses_nonsense():
    world = World()
    with pytest.raises(ValueError, match="jitter"):
        Radio(world.brick, world.clock, delay=0.001, jitter=0.002)
    with pytest.raises(ValueError, match="generator"):
        Radio(world.brick, world.clock)


@pytest.mark.slow
def test_same_seed_same_times_over_the_line(kind):
    def drive():
        world = World(seed=7)
        with kind(world.radio) as server, find(server) as brick:
            for power in range(1, 30):
                brick.set_output_state(Port.B, power, *RUN)
                brick.set_output_state(Port.C, -power, *RUN)
                assert brick.get_output_state(Port.C)[1] == -power
                world.clock.sleep_until(world.clock.now() + 0.5)
        return world.body.log

    log = drive()
    assert len(log) == 58
    assert drive() == log


def test_nxt_test_passes(kind):
    world = World()
    with kind(world.radio) as server:
        if kind is PtyServer:
            arguments = ["--backend", "devfile", "--filename", server.path]
        else:
            host, port = "localhost", str(server.address[1])
            arguments = ["--backend", "socket", "--server-host", host, "--server-port", port]
        done = subprocess.run(
            [sys.executable, "-m", "nxt.command.test", *arguments],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
    assert done.returncode == 0, done.stderr
    assert "NXT brick name: NXT" in done.stdout
    assert "Firmware version 1.31" in done.stdout
    assert "Battery level 7900 mV" in done.stdout
    assert done.stdout.rstrip().endswith("done.")


def test_in_real_time_too(kind):
    clock = SystemClock()
    body = Stamped(clock)
    radio = Radio(VirtualBrick(body), clock, delay=0.005, jitter=0.0, patience=0.002)
    with kind(radio) as server, find(server) as brick:
        start = clock.now()
        brick.get_battery_level()
        assert clock.now() - start >= 0.010
        brick.set_output_state(Port.B, 40, *RUN)
        wait_until(lambda: body.log)


def test_a_telegram_without_reply_arrives_though_nothing_follows(kind):
    world = World(patience=0.01)
    with kind(world.radio) as server, find(server) as brick:
        brick.set_output_state(Port.A, 100, *RUN)
        wait_until(lambda: world.body.log)
    assert world.body.log[0][2] >= 0.016


def test_clients_come_and_go(kind):
    world = World()
    with kind(world.radio) as server:
        for name in ("Frodo", "Sam", "Merry"):
            with find(server) as brick:
                brick.set_brick_name(name)
                assert brick.get_device_info()[0] == name
    server.stop()


def watched(kind, radio):
    """Return a server with two events: all bytes were used, or an incomplete rest is left."""

    class Watched(kind):
        empty, rest = threading.Event(), threading.Event()

        def _wait_or_settle(self, readable, rest_due):
            (self.rest if rest_due else self.empty).set()
            return super()._wait_or_settle(readable, rest_due)

    return Watched(radio)


@needs_pty
def test_garbage_on_the_pty_is_dropped_and_the_line_goes_on(monkeypatch):
    monkeypatch.setattr(serve, "REST_WITHIN", 0.01)
    world = World()
    with watched(PtyServer, world.radio) as server:
        device = os.open(server.path, os.O_RDWR | os.O_NOCTTY)
        for garbage in (b"\xff" * 300, b"hello, modem\r\n", b"\x02\x00\x00", b"\x05\x00\x01"):
            assert server.empty.wait(PATIENCE)
            server.empty.clear()
            os.write(device, garbage)
            assert server.empty.wait(PATIENCE)
            while select.select([device], [], [], 0)[0]:
                os.read(device, 4096)
        os.close(device)
        with find(server) as brick:
            assert brick.get_battery_level() == 7900


def test_glued_and_broken_telegrams_over_tcp(monkeypatch):
    monkeypatch.setattr(serve, "REST_WITHIN", PATIENCE)
    world = World()
    with watched(SocketServer, world.radio) as server:
        with socket.create_connection(server.address, timeout=PATIENCE) as client:
            run = bytes([0x80, 4, 1, 30, 7, 1, 0, 0x20, 0, 0, 0, 0])
            client.sendall(b"\x98" + run + run[:2] + b"\2" + run[3:] + b"\x00\x0b")
            received = b""
            while len(received) < 14:
                received += client.recv(1)
            assert received == b"bluetooth\x02\x0b\x00\xdc\x1e"
            assert [port for port, _, _ in world.body.log] == [1, 2]
            server.rest.clear()
            client.sendall(b"\x00")
            assert server.rest.wait(PATIENCE)
            client.sendall(b"\x0b")
            assert client.recv(64) == b"\x02\x0b\x00\xdc\x1e"
            monkeypatch.setattr(serve, "REST_WITHIN", 0.01)
            client.sendall(b"\x00\x06")  # the byte of its port never comes
            assert client.recv(64)[:3] == b"\x02\x06\xbf"
            client.sendall(b"GET / HTTP/1.1\r\n")
            assert client.recv(64) == b""
        with find(server) as brick:
            assert brick.get_battery_level() == 7900


def test_a_client_that_vanishes_frees_the_socket():
    with SocketServer(World().radio) as server:
        rude = socket.create_connection(server.address)
        rude.sendall(b"\x00\x0b\x00\x0b\x00\x0b")
        rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        rude.close()
        with find(server) as brick:
            assert brick.get_battery_level() == 7900


def test_sockets_are_served_on_loopback_and_a_port_once():
    with SocketServer(World().radio) as server, pytest.raises(RobotError, match="cannot serve"):
        SocketServer(World().radio, port=server.address[1])
    assert server.address[0] == "127.0.0.1"


def test_a_brick_falls_silent_after_so_many_telegrams_or_at_a_time():
    world = World()
    world.radio.silent_after = 2
    answers = [world.radio.deliver(b"\x00\x0b") is not None for _ in range(4)]
    assert answers == [True, True, False, False]
    assert world.radio.silent
    world = World(delay=0.020, jitter=0.0)  # heard at 0.02, 0.06, 0.10 s
    world.radio.silent_at = 0.09
    answers = [world.radio.deliver(b"\x00\x0b") is not None for _ in range(4)]
    assert answers == [True, True, False, False]
    world = World()
    world.radio.silent = True
    world.radio.deliver(bytes([0x00, 4, 1, 30, 7, 1, 0, 0x20, 0, 0, 0, 0]))
    assert world.body.log == []


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_what_goes_wrong_in_the_lab_closes_the_line_and_is_kept(kind):
    world = World()

    def full(time):
        raise OSError(28, "No space left on device")

    world.clock.sleep_until = full
    server = kind(world.radio)
    try:
        with pytest.raises(Exception):  # noqa: B017, PT011  nxt-python's many ways to fail
            find(server).get_battery_level()
        wait_until(lambda: server.error is not None)
        assert server.error.errno == 28
    finally:
        server.stop()


def test_nothing_is_left_running(kind):
    before = threading.active_count()
    with kind(World().radio) as server, find(server) as brick:
        brick.get_battery_level()
    server.stop()
    assert threading.active_count() == before
