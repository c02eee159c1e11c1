"""A Thymio II: the driver and the virtual robot, whose line is cut, loses answers or ends."""

import json
import math
import random
import socket
import threading
from contextlib import contextmanager

import numpy as np
import pytest

from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.base.place import THICKNESS, Place
from neurosim.lab import VirtualThymioRig
from neurosim.lab.thymio.body import ThymioBody
from neurosim.lab.thymio.firmware import EVENTS, NODE
from neurosim.robots import Counters, Lamp, open_robot
from neurosim.robots.base import SelfStopping
from neurosim.robots.thymio import aseba
from neurosim.robots.thymio.driver import LATE, LONGEST, PROXIMITY, Thymio
from neurosim.sampling.settings import Sampler


@contextmanager
def a_rig(**options):
    with VirtualThymioRig(1, **{"camera": False, **options}) as rig:
        yield rig


@contextmanager
def a_usual_rig(**options):
    """Return a virtual Thymio whose sensors have their nominal values."""
    with a_rig(**options) as rig:
        rig.lab.body.sensors, rig.lab.body.brightness = PROXIMITY, np.ones(7)
        yield rig


def wait(rig, seconds):
    rig.lab.clock.sleep_until(rig.lab.time + seconds)


def test_messages_by_hand():
    # Length 6, from node 1, GET_VARIABLES; to node 51, from address 258, 3 words.
    assert aseba.encode(aseba.GET_VARIABLES, [51, 258, 3]).hex() == "060001000ba0330002010300"
    negative = aseba.encode(aseba.VARIABLES, [7, -2], source=51)
    assert negative.hex() == "0400330005900700feff"
    reader = aseba.Reader()
    # Garbage before it, and cut anywhere.
    data = b"\xff\xff\x00" + negative + negative
    result = [one for byte in data for one in reader.feed(bytes([byte]))]
    assert [one.words for one in result] == [(7, -2)] * 2
    assert (result[0].type, result[0].source) == (aseba.VARIABLES, 51)


def test_its_sensors_see_the_walls_and_obstacles_of_a_place():
    """By hand, as in Enki: the sum of three rays 15 degrees apart, less twice the middle one's.

    A ray answers 4505 (73 - 0.03^2) / (d^2 - 0.06 d + 73) at d cm, and nothing beyond 14 cm.
    """
    wall = (0.15 + THICKNESS / 2, -0.3, 0.15 + THICKNESS / 2, 0.3)
    place = Place(walls=(wall,), obstacles=((-0.18, 0.0295, 0.05),))
    with a_usual_rig(around=place) as rig, rig.robot as robot:
        rig.lab.body.place(0.0, 0.0, 0.0)  # exactly
        wait(rig, 0.1)
        read = robot.activations()

    def law(far):
        return 4505 * (73 - 0.0009) / (far**2 - 0.06 * far + 73) * (far <= 14) / 4500

    def reading(*far):
        return sum(map(law, far)) - 2 * law(far[1] / math.cos(math.radians(15)))

    def before_the_wall(ahead, degrees):
        return reading(*(ahead / math.cos(math.radians(degrees + turn)) for turn in (-15, 0, 15)))

    ahead, slanted = before_the_wall(15 - 7.95, 0), before_the_wall(15 - 7.5, 20)
    assert ahead == pytest.approx(law(7.05))
    outer = before_the_wall(15 - 6.2, 40)
    assert read[:5] == pytest.approx([outer, slanted, ahead, slanted, outer], abs=0.003)
    # Behind on the left a cylinder of 5 cm, 15.05 cm behind the sensor. The right sensor, 5.9 cm to
    # its side, sees it with one ray of three, 16.166 cm from its middle and 6.396 degrees off it.
    off = 15.05 * math.sin(math.radians(15))
    aside = 15.05 * math.cos(math.radians(15)) - math.sqrt(25 - off**2)
    assert read[5] == pytest.approx(reading(aside, 10.05, aside), abs=0.003)
    turned = math.radians(6.3936)
    once = 16.165 * math.cos(turned) - math.sqrt(25 - (16.165 * math.sin(turned)) ** 2)
    assert read[6] == pytest.approx(law(once), abs=0.003)


def test_robots_differ_in_their_sensors_and_wheels():
    bodies = [ThymioBody(seed, 0) for seed in (1, 2, 1)]
    for name in ("sensors", "brightness", "wheels"):
        first, other, again = (getattr(body, name) for body in bodies)
        assert (first == again).all()
        assert 0.001 < np.abs(first - other).max() < 0.5


def test_its_sensors_are_read_ten_times_a_second_by_the_robot():
    place = Place.rectangle(1.0, 1.0)
    with a_usual_rig(around=place) as rig, rig.robot as robot:
        rig.lab.place(0.38, 0.0, 0.0)
        wait(rig, 0.1)
        before = robot.activations()
        rig.lab.place(0.0, 0.0, 0.0)
        wait(rig, 0.005)
        assert (robot.activations() == before).all()
        wait(rig, 0.1)
        assert before[2] > 0.5 > 0.01 > robot.activations()[2]


def test_it_touches_as_a_disc_of_its_own_size():
    with a_rig(around=Place.rectangle(1.0, 1.0)) as rig, rig.robot as robot:
        robot.drive_for((100, 100), 4.0)
        wait(rig, 4.0)
        assert rig.lab.body.pose[0] == pytest.approx(0.5 - robot.geometry.radius, abs=1e-6)


def test_the_driver_drives_and_reads_it():
    with a_rig() as rig, rig.robot as robot:
        for kind in (Counters, Lamp, Sampler, SelfStopping):
            assert isinstance(robot, kind)
        assert robot.sensor_names == (*(f"sensor_{n}" for n in range(7)), "line_left", "line_right")
        read = robot.read_sensors()
        assert all(abs(read[name] - 0.55) < 0.03 for name in ("line_left", "line_right"))
        rig.lab.place(1.38 - 0.12 - 0.072, 0.0, 0.0)
        wait(rig, 0.1)
        assert max(robot.read_sensors()[name] for name in ("line_left", "line_right")) < 0.3
        rig.lab.body.proximity = lambda: [0, 450, 4500, 5000, 0, 0, 2250]
        wait(rig, 0.1)
        assert [*robot.read_sensors().values()][:7] == [0.0, 0.1, 1.0, 1.0, 0.0, 0.0, 0.5]
        rig.lab.place(0.0, 0.0, 0.0)
        robot.lamp(True)
        wait(rig, 0.05)
        assert rig.lab.body._lamp.port_level == 1.0
        robot.lamp(False)
        wait(rig, 0.05)
        assert rig.lab.body._lamp.port_level == 0.0
        robot.set_counts(1000, -1000)
        robot.drive_for((50, 50), 1.0)
        assert rig.firmware.targets == (0, 0)  # from the program's next run on
        wait(rig, 1.0)
        assert rig.firmware.targets == (250, 250)
        wait(rig, LATE + 0.6)
        assert rig.standing
        distance = np.hypot(*rig.lab.body.pose[:2])
        assert distance == pytest.approx(0.083 * (1.0 + LATE), abs=0.02)
        left, right = robot.read_counts()
        assert (left - 1000) / robot.pulses_per_metre == pytest.approx(distance, rel=0.05)
        assert (right + 1000) / robot.pulses_per_metre == pytest.approx(distance, rel=0.05)
        about = json.loads(json.dumps(robot.describe()))
        assert about["virtual"] is True
        assert about["firmware"] == 14
        assert about["light_sensors"]["line_right"] == [0.072, -0.0115]


def test_counters_count_on_where_the_robots_own_begin_again():
    with a_rig() as rig, rig.robot as robot:
        robot.set_counts(0, 0)
        for _ in range(3):
            robot.drive_for((100, 100), 15.0)
            rig.lab.place(0.0, 0.0, 0.0)
            wait(rig, 15.0)
            counts = robot.read_counts()
        assert min(counts) > 60_000  # of 16 bits are at most 32,767
        assert min(counts) / robot.pulses_per_metre == pytest.approx(0.166 * 45, rel=0.03)


def test_what_the_robot_does_not_take_is_refused_before_it_is_sent():
    with a_rig() as rig, rig.robot as robot:
        with pytest.raises(UserError, match="left: 101 is beyond its limits"):
            robot.drive((101, 0))
        with pytest.raises(UserError, match="they last up to 300 s"):
            robot.drive_for((1, 1), LONGEST + 1)
        wait(rig, 0.1)
        assert rig.standing


def test_wherever_the_line_is_cut_the_robot_stops_by_itself():
    """The line is cut after each byte of all messages that drive it."""
    with a_rig() as rig:
        sent, feed = [], rig.firmware.feed
        with rig.robot as robot:
            rig.firmware.feed = lambda data: sent.append(data) or feed(data)
            robot.drive_for((50, 50), 0.4)
            robot.drive_for((-50, 50), 0.4)
            rig.firmware.feed = feed
            drives = b"".join(sent)
            assert drives.count(bytes([0x0C, 0xA0])) == 2  # SET_VARIABLES
            for cut in range(len(drives) + 1):
                rig.firmware._data = b""  # the port is opened again
                feed(drives[:cut])
                wait(rig, 0.05)
                wait(rig, 0.4 + LATE + 0.1)
                assert rig.standing, cut


@pytest.mark.slow
def test_answers_that_are_lost_are_asked_for_again():
    with a_rig() as rig, rig.robot as robot:
        rng, exchange = random.Random(5), rig.cable.exchange
        rig.cable.exchange = lambda data: b"" if rng.random() < 0.25 else exchange(data)
        robot._timeout = 0.05
        done = 0
        for step in range(40):
            try:
                robot.drive_for((step, -step), 0.5)
            except LinkLost:  # three in a row
                robot.connect()
                continue
            done += 1
            wait(rig, 0.02)
            assert rig.firmware.targets == (5 * step, -5 * step)
        assert done > 30
        assert robot.reboots == 0


def test_an_old_answer_does_not_acknowledge_the_same_command():
    with a_rig() as rig, rig.robot as robot:
        robot.drive_for((40, 40), 0.5)
        wait(rig, 0.3)
        carry_out, asked = rig.firmware._carry_out, []

        def first_is_lost(type_, words):
            if type_ == aseba.SET_VARIABLES:
                asked.append(words)
                return b"" if len(asked) == 1 else carry_out(type_, words)
            return carry_out(type_, words)

        rig.firmware._carry_out = first_is_lost
        robot._timeout = 0.05
        robot.drive_for((40, 40), 0.5)
        assert len(asked) == 2
        wait(rig, 0.5)
        assert not rig.standing


def test_a_robot_that_starts_anew_is_given_its_program_again():
    with a_rig() as rig, rig.robot as robot:
        robot.set_counts(0, 0)
        robot.drive_for((50, 50), 1.0)
        wait(rig, 2.0)
        before = robot.read_counts()
        assert min(before) > 100
        rig.firmware.reboot()
        robot.drive_for((20, 20), 1.0)
        wait(rig, 0.1)
        assert rig.firmware.targets == (100, 100)
        assert robot.reboots == 1
        assert robot.read_counts()[0] >= before[0]
        assert robot.read_counts()[0] < before[0] + 100
        wait(rig, 1.0 + LATE)
        assert rig.standing


def test_a_robot_whose_radio_fails_stops_by_itself():
    with a_rig() as rig, rig.robot as robot:
        robot.drive((50, 50))
        robot.drive_for((50, 50), 1.0)
        rig.switch_off()
        robot._timeout = 0.05
        with pytest.raises(LinkLost, match=r"stopped answering: nothing within 0\.05 s, 3 times"):
            robot.stop()
        wait(rig, 1.0 + LATE + 0.1)
        assert rig.standing


def test_what_is_left_running_is_stopped_by_the_next_program():
    with a_rig() as rig:
        rig.robot.connect()
        rig.robot.drive((50, 50))
        wait(rig, 0.1)
        assert not rig.standing
        rig.robot._line.close()
        with Thymio(rig.address, clock=rig.lab.clock, timeout=5.0):
            assert rig.standing
            wait(rig, 0.1)
            assert rig.standing


@contextmanager
def answering(data):
    """Give the port of a server that answers any message."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve():
        client, _ = listener.accept()
        with client:
            while client.recv(4096):
                client.sendall(data)

    threading.Thread(target=serve, daemon=True).start()
    with listener:
        yield f"socket://127.0.0.1:{listener.getsockname()[1]}"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"0 robot neurosim-lines 1 a b*1234\n", "no Thymio answers on socket"),
        (aseba.encode(aseba.PRESENT, [5], source=3), "does not describe itself whole"),
    ],
)
def test_what_is_no_thymio_is_refused(data, says):
    with answering(data) as port, pytest.raises(RobotError, match=says):
        Thymio(port, timeout=0.05).connect()


def test_another_node_and_an_old_firmware_are_named(monkeypatch):
    with a_rig() as rig:
        with pytest.raises(RobotError, match="no Thymio of the number 7 answers"):
            Thymio(rig.address, node=7, timeout=0.05, clock=rig.lab.clock).connect()
        with open_robot("thymio", port=rig.address, node=NODE, clock=rig.lab.clock) as robot:
            assert robot.describe()["node"] == NODE
        old = tuple(f"old-{name}" for name in EVENTS)
        rig.firmware.reboot()
        monkeypatch.setattr("neurosim.lab.thymio.firmware.EVENTS", old)
        with pytest.raises(RobotError, match="is too old: update it"):
            Thymio(rig.address, timeout=1.0, clock=rig.lab.clock).connect()
