"""The text-line protocol: the driver and the virtual robot over real lines, cut, lossy or wrong."""

import json
import math
import os
import random
import socket
import threading
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from patience import PATIENCE
from processes import neurosim, started

from neurosim.base.commands import Commands, Number
from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.lab import VirtualLinesRig
from neurosim.lab.nxt.physics import S
from neurosim.robots import Battery, Counters, Lamp, Sensors, open_robot
from neurosim.robots.base import SelfStopping
from neurosim.robots.lines.driver import LATE
from neurosim.robots.lines.protocol import (
    Counter,
    Greeting,
    GreetingError,
    Sensor,
    checksum,
    decode,
    encode,
)
from neurosim.testing import check_lines

DEVICES = ["socket", *(["pty"] if os.name == "posix" else [])]


@contextmanager
def a_rig(**options):
    with VirtualLinesRig(1, **{"camera": False, **options}) as rig:
        yield rig


def moves(rig):
    """Return whether a wheel turns."""
    return bool(np.any(rig.lab.body.state[S.SPEED : S.SPEED + 2]))


def test_the_checksum_is_the_published_one():
    assert checksum(b"123456789") == 0x29B1  # CRC-16/CCITT-FALSE, as the catalogues check it
    assert encode("12 drive 500 20 -20") == b"12 drive 500 20 -20*6AE2\n"  # as in docs/lines.md


@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=40), st.data())
def test_a_line_with_another_byte_is_none(text, data):
    line = encode("1 " + text).rstrip(b"\n")
    assert decode(line) == ["1", *([text] if text else [])]
    place = data.draw(st.integers(0, len(line) - 1))
    byte = data.draw(st.integers(33, 126).filter(lambda byte: byte != line[place]))
    other = line[:place] + bytes([byte]) + line[place + 1 :]
    assert decode(other) is None or other.lower() == line.lower()


def test_a_checksum_has_four_digits():
    assert encode("1 ") == b"1 *0FC9\n"
    assert decode(b"1 *0fc9") == ["1"]
    assert [decode(b"1 *" + digits) for digits in (b"+FC9", b" FC9", b"FC9", b"0_FC9")] == [
        None
    ] * 4


def test_a_greeting_is_read_as_it_is_written():
    greeting = Greeting(
        "car",
        "1.0",
        Commands(
            (Number("speed", "m/s", -0.25, 0.5), Number("steer", "rad", -0.4, 0.4, speed=False)),
            "car",
            {"wheelbase": 0.15},
        ),
        2.5,
        (Sensor("sensor_0", 4095, {"angle": -45.0}), Sensor("light", 1)),
        (Counter("rear", 812.5),),
        lamp=True,
        battery=True,
    )
    words = [line.split() for line in greeting.lines()]
    assert Greeting.read([*words, ["colour", "red"]]) == greeting  # unknown keys are ignored
    assert greeting.values == 4


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("robot neurosim-lines 2 car 1.0", "speaks version 2, this program version 1"),
        ("robot karel 1 car 1.0", "another protocol"),
        ("command left % 100 -100 speed", "a least and a greatest value"),
        ("command left % -100 nan speed", "nan is not a number"),
        ("command left % -100 100", "it has other words"),
        ("command left % -100 100 wish", "is speed or angle"),
        ("body wheels track=0.1", "lacks full="),
        ("sensor light 0", "above 0"),
        ("counter left 0", "above 0"),
        ("longest soon", "it has other words"),
    ],
)
def test_greetings_that_are_wrong(line, why):
    good = ["robot neurosim-lines 1 car 1.0", "command v m/s -1 1 speed", "longest 1000"]
    Greeting.read([text.split() for text in good])
    with pytest.raises(GreetingError, match=why):
        Greeting.read([text.split() for text in [*good, line]])
    for left_out in range(3):
        with pytest.raises(GreetingError):
            Greeting.read([text.split() for text in good[:left_out] + good[left_out + 1 :]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("device", "kind"), [*((device, "wheels") for device in DEVICES), (None, "car"), (None, "omni")]
)
def test_the_virtual_robots_keep_to_the_protocol(device, kind):
    with a_rig(device=device, kind=kind) as rig:
        greeting = check_lines(rig.address, clock=rig.lab.clock)
        assert greeting == rig.firmware.greeting


@pytest.mark.parametrize("device", DEVICES)
def test_the_driver_drives_and_reads_it(device):
    with a_rig(device=device) as rig, rig.robot as robot:
        for kind in (Battery, Counters, Lamp, Sensors, SelfStopping):
            assert isinstance(robot, kind)
        assert robot.sensor_names == ("line_left", "line_right")
        assert all(abs(value - 0.55) < 0.05 for value in robot.read_sensors().values())
        assert 7 < robot.battery() < 9
        robot.lamp(True)
        assert rig.lab.body._lamp.port_level == 1.0
        begin = rig.lab.body.pose
        robot.set_counts(1000, -1000)
        robot.drive_for((40, 40), 1.0)
        robot.clock.sleep_until(robot.clock.now() + 1.0)
        assert moves(rig)
        robot.clock.sleep_until(robot.clock.now() + LATE + 0.5)
        assert not moves(rig)
        distance = np.hypot(*(rig.lab.body.pose - begin)[:2])
        assert distance == pytest.approx(0.2 * (1.0 + LATE), abs=0.03)
        left, right = robot.read_counts()
        assert (left - 1000) / robot.pulses_per_metre == pytest.approx(distance, rel=0.05)
        assert (right + 1000) / robot.pulses_per_metre == pytest.approx(distance, rel=0.05)
        assert robot.stamp == pytest.approx(rig.lab.time, abs=0.01)  # the robot's own time
        about = json.loads(json.dumps(robot.describe()))
        assert about["virtual"]
        assert about["light_sensors"] == {"line_left": [0.06, 0.09], "line_right": [0.06, -0.09]}


def test_what_the_robot_does_not_take_is_refused_before_it_is_sent():
    with a_rig() as rig, rig.robot as robot:
        for command in ((101, 0), (0, -100.5), (math.nan, 0)):
            with pytest.raises(UserError, match="is beyond its limits"):
                robot.drive(command)
        with pytest.raises(UserError, match="a command lasts up to 60 s"):
            robot.drive_for((1, 1), 61)
        with pytest.raises(UserError, match="right: -200 is beyond its limits; use -100 to 100 %"):
            robot.drive_for((0, -200), 1)
        with pytest.raises(UserError, match=r"has 2 numbers \(left, right\), not 3"):
            robot.drive((0, 0, 0))
        assert rig.standing
        moved = []
        rig.firmware.hardware.move = moved.append
        robot.drive((1e-7, -33.33333))  # never with an exponent
        assert moved == [(0.0, -33.3333)]


def test_wherever_the_line_is_cut_the_robot_stops_by_itself():
    """The line is cut after each byte of each request of a drive."""
    with a_rig() as rig:
        sent = []
        feed = rig.firmware.feed
        rig.firmware.feed = lambda data: sent.append(data) or feed(data)
        with rig.robot as robot:
            robot.drive_for((30, 30), 0.5)
            robot.drive_for((-30, 30), 0.5)
            drives = b"".join(sent)
        drives = drives[drives.index(b"drive") - 5 :]
        assert drives.count(b"drive") == 2
        for cut in range(len(drives) + 1):
            feed(b"\nstop\n" + drives[:cut])
            rig.lab.clock.sleep_until(rig.lab.time + 0.5 + LATE + 0.6)
            assert rig.standing, drives[:cut]
            assert not moves(rig), drives[:cut]


@pytest.mark.slow
def test_a_line_that_loses_and_changes_bytes():
    """No wrong command is carried out, no wrong value is read; lost lines are sent again."""
    with a_rig() as rig, rig.robot as robot:
        rng, done = random.Random(3), []
        hardware, exchange = rig.firmware.hardware, rig._cable.exchange
        move = hardware.move
        hardware.move = lambda command: done.append(command) or move(command)

        def worn(data):
            if rng.random() < 0.1:
                place = rng.randrange(len(data)) if data else 0
                middle = b"" if rng.random() < 0.5 else bytes([rng.randrange(256)])
                return data[:place] + middle + data[place + 1 :]
            return data

        rig._cable.exchange = lambda data: worn(exchange(worn(data)))
        robot._timeout = 0.2
        lost = 0
        for step in range(100):
            with suppress(RobotError):
                robot.drive_for((step % 7, -step % 7), 0.1)
            try:
                counts = robot.read_counts()
            except LinkLost:
                robot.connect()
                lost += 1
                continue
            assert all(abs(value) < 2000 for value in counts)
        assert lost < 5
        assert len(done) > 90
        assert set(done) <= {(step % 7, -step % 7) for step in range(100)} | {(0.0, 0.0)}


def test_a_robot_that_starts_anew_counts_on():
    with a_rig() as rig, rig.robot as robot:
        robot.set_counts(0, 0)
        robot.drive_for((50, 50), 1.0)
        robot.clock.sleep_until(robot.clock.now() + 2.0)
        before = robot.read_counts()
        assert min(before) > 100
        rig.lab.body._zeros = [[0.0, rig.lab.body._degrees(port)] for port in range(3)]
        rig.reboot()
        assert robot.read_counts() == before
        assert robot.reboots == 1
        assert robot.describe()["reboots"] == 1


def test_a_robot_whose_radio_fails_stops_by_itself():
    with a_rig() as rig, rig.robot as robot:
        robot.drive_for((50, 50), 1.0)
        rig.switch_off()
        robot._timeout = 0.05
        with pytest.raises(LinkLost, match="stopped answering: no good reply to 'stop'"):
            robot.stop()
        rig.lab.clock.sleep_until(rig.lab.time + 1.0 + LATE + 0.5)
        assert rig.standing
        assert not moves(rig)
        with pytest.raises(LinkLost, match="stopped answering"):
            robot.drive((1, 1))


@contextmanager
def answering(answer):
    """Serve a socket on which every line is answered by ``answer(line)``; give its URL."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            with suppress(OSError):
                client, _ = server.accept()
                with client, client.makefile("rb") as lines:
                    for line in lines:
                        client.sendall(answer(line))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda line: b"", "nothing answers on socket://"),
        (lambda line: b"z,Command not found\r\n", r"does not speak neurosim's lines \('z,Command"),
        (
            lambda line: (
                encode(f"{line.split()[0].decode()} robot neurosim-lines 7 x 1")
                + encode(f"{line.split()[0].decode()} ok 5 1")
                if line.strip()
                else b""
            ),
            "describes itself in a wrong way: .*it speaks version 7",
        ),
    ],
)
def test_other_things_on_the_line(monkeypatch, answer, why):
    monkeypatch.setattr("neurosim.robots.lines.driver.BOOT", 0.5)
    with answering(answer) as port, pytest.raises(RobotError, match=why):
        open_robot("lines", port=port, timeout=0.1)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="no pseudo-terminals")
@pytest.mark.parametrize("words", [[], ["--socket"]])
def test_the_command_line_keeps_one_running(tmp_path, words):
    """`lab lines` in a process of its own, recorded by `record` in another, in real time."""
    lab = started("lab", "lines", *words, "--seconds", PATIENCE, "--json")
    try:
        port = json.loads("".join(lab.stdout.readline() for _ in range(3)))["port"]
        assert port.startswith("socket://" if words else "/dev/")
        neurosim(
            "record", "r", "--robot", "lines", "--port", port, "--camera", "none",
            "--commands", "3", "--durations", "0.2..0.3", "--max-speed", "20", cwd=tmp_path,
        )  # fmt: skip
        about = json.loads((tmp_path / "r" / "recording.json").read_text())
        assert about["robot"]["name"] == "two-wheels"
        assert about["complete"]
    finally:
        lab.kill()
        lab.wait()
