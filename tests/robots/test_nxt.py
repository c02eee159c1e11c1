"""The NXT driver through the real nxt-python, on virtual bricks and on other devices."""

import os
import select
import socket
import sys
import threading
from contextlib import suppress

import nxt.backend.usb
import pytest
import usb.core
from brick_body import Body, LabClock
from patience import PATIENCE, wait_until

from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.lab.nxt.serve import PtyServer, Radio, SocketServer
from neurosim.robots.base import Battery, Counters, Lamp, Robot, SelfStopping, Sensors
from neurosim.robots.nxt import link as nxt_link
from neurosim.robots.nxt.driver import NXT

needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals on Windows")

BRAKED = (7, 1, 0, 0x20)  # on, brake, regulated; speed regulation; no turn; running
SHORT = 0.3  # where no reply comes


class Rig:
    """A virtual brick being served, and how a driver reaches it."""

    def __init__(self, kind=SocketServer, **options):
        self.clock = LabClock()
        self.body = Body()
        brick = VirtualBrick(self.body, "Pippin")
        self.radio = Radio(brick, self.clock, jitter=0.0, patience=PATIENCE)
        self.server = kind(self.radio)
        self.options = {"clock": self.clock, "deadline": PATIENCE, **options}
        if kind is PtyServer:
            self.options["filename"] = self.server.path
        else:
            self.options["server_host"], self.options["server_port"] = self.server.address

    def robot(self, **options):
        return NXT(**{**self.options, **options})

    def motors(self):
        return [(output.power, output.mode) for output in self.body.outputs]


@pytest.fixture(params=[pytest.param(PtyServer, marks=needs_pty), SocketServer])
def rig(request):
    rig = Rig(request.param)
    yield rig
    rig.server.stop()


@pytest.fixture
def one():
    rig = Rig()
    yield rig
    rig.server.stop()


@pytest.fixture
def pty():
    if sys.platform == "win32":
        pytest.skip("no pseudo-terminals on Windows")
    rig = Rig(PtyServer)
    yield rig
    rig.server.stop()


def one_sentence(error):
    text = str(error.value)
    assert text
    assert "\n" not in text
    assert "Traceback" not in text
    return text


def test_drive_sets_both_motors_regulated_and_for_a_minute(rig):
    with rig.robot() as robot:
        assert isinstance(robot, Robot)
        assert isinstance(robot, Battery)
        assert isinstance(robot, Sensors)
        assert not isinstance(robot, Counters)
        robot.drive((40.4, -100))
        left, right = rig.body.outputs[1], rig.body.outputs[2]
        for output, power in ((left, 40), (right, -100)):
            assert output.power == power
            got = output.mode, output.regulation, output.turn_ratio, output.run_state
            assert got == BRAKED
            assert output.tacho_limit == 12 * abs(power) * 61
        robot.stop()
        assert [output.power for output in rig.body.outputs] == [0, 0, 0]
        assert rig.body.outputs[1].mode == 7


def test_drive_returns_when_the_lab_has_taken_it(one):
    with one.robot() as robot:
        for alone, took in ((False, 0.0425), (True, 0.0850)):
            robot.alone = alone
            before = one.clock.now()
            robot.drive((10, 20))
            # Two or four telegrams and a question are sent together; the answer takes another 20
            # ms, and so do a second question and its answer.
            assert one.clock.now() - before == pytest.approx(took, abs=1e-6)


def test_the_brick_is_kept_awake(one):
    heard = []
    plain = one.radio.deliver
    one.radio.deliver = lambda telegram: heard.append(telegram[1]) or plain(telegram)
    with one.robot() as robot:
        for _ in range(100):
            robot.drive((10, 20))
            one.clock.sleep_until(one.clock.now() + 1.0)
    assert heard.count(0x0D) == 3  # at the start, and two in 100 s


def test_mirrored_motors_and_other_ports(one):
    body = one.body
    with one.robot(left="C", right="a", lamp="B", invert=True) as robot:
        robot.drive((30, 50))
        assert [output.power for output in body.outputs] == [-50, 0, -30]
        robot.lamp(True)
        assert body.outputs[1].power == 100


@pytest.mark.parametrize("speed", [101, -100.5, float("nan"), float("inf")])
def test_impossible_speeds_are_refused_before_anything_is_sent(one, speed):
    with one.robot() as robot:
        sent = one.radio.telegrams
        with pytest.raises(UserError, match="right motor"):
            robot.drive((10, speed))
        assert one.radio.telegrams == sent


def test_sensors(rig):
    rig.body.raw = 460
    with rig.robot() as robot:
        assert rig.body.types[:2] == [(5, 0), (5, 0)]
        assert robot.read_sensors() == {"line_left": 563 / 1023, "line_right": 563 / 1023}
        assert robot.battery() == 7.9
    assert rig.body.types[:2] == [(6, 0), (6, 0)]
    with rig.robot(light_left="none", light_right=4) as robot:
        assert tuple(robot.read_sensors()) == robot.sensor_names == ("line_right",)
        assert rig.body.types[3] == (5, 0)


def test_sensors_that_are_slow_to_wake_are_waited_for_by_the_robots_clock(one):
    since = {}
    plain = one.body.input

    def sleepy(port):
        since.setdefault(port, one.clock.now())
        return (one.clock.now() - since[port] > 0.3, *plain(port)[1:])

    one.body.input = sleepy
    with one.robot() as robot:
        assert one.clock.now() > 0.6
        assert robot.read_sensors()["line_left"] == 563 / 1023
    one.body.input = lambda port: (False, *plain(port)[1:])
    with pytest.raises(RobotError, match="port 1"), one.robot():
        pass


def test_lamp_on_a_motor_port(rig):
    with rig.robot() as robot:
        robot.lamp(True)
        assert (rig.body.outputs[0].power, rig.body.outputs[0].mode) == (100, 1)
        robot.lamp(False)
        assert (rig.body.outputs[0].power, rig.body.outputs[0].mode) == (0, 0)
        robot.lamp(True)
    assert (rig.body.outputs[0].power, rig.body.outputs[0].mode) == (0, 0)


def test_lamp_of_the_colour_sensor(rig):
    with rig.robot(lamp="color:3") as robot:
        robot.lamp(True)
        assert rig.body.types[2] == (14, 0)
        robot.lamp(False)
        assert rig.body.types[2] == (17, 0)
        robot.lamp(True)
    assert rig.body.types[2] == (17, 0)
    assert rig.body.outputs[0].power == 0


def test_no_lamp(one):
    with one.robot() as robot:
        assert isinstance(robot, Lamp)
    with one.robot(lamp=None) as robot:
        assert not isinstance(robot, Lamp)


def test_description(one):
    with one.robot(lamp="color:4", light_left=None) as robot:
        about = robot.describe()
    assert about["kind"] == "nxt"
    assert (about["name"], about["firmware"], about["protocol"]) == ("Pippin", "1.31", "1.124")
    assert about["address"] == "02:16:53:00:00:01"
    assert about["virtual"] is True
    assert about["ports"] == {
        "left": "B",
        "right": "C",
        "lamp": "color:4",
        "light_left": None,
        "light_right": 2,
    }
    assert about["link"] == "nxt-server"
    assert NXT().describe()["link"] == "USB"
    assert NXT(filename="/dev/rfcomm0").describe()["link"] == "device file"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"left": "D"}, "left: 'D' is not a motor port"),
        ({"left": "C"}, "motor port C is used twice"),
        ({"lamp": "b"}, "motor port B is used twice"),
        ({"lamp": "color:1"}, "sensor port 1 is used twice"),
        ({"lamp": "color:5"}, "lamp: '5' is not a sensor port"),
        ({"lamp": "5"}, "lamp: '5' is neither"),
        ({"light_right": 0}, "light_right: 0 is not a sensor port"),
        ({"light_right": 1}, "sensor port 1 is used twice"),
    ],
)
def test_wrong_ports_are_named(options, words):
    with pytest.raises(UserError, match=words):
        NXT(**options)


def test_motors_stop_whatever_happens(rig):
    with pytest.raises(KeyboardInterrupt), rig.robot() as robot:
        robot.lamp(True)
        robot.drive((50, 50))
        raise KeyboardInterrupt
    assert rig.motors() == [(0, 0), (0, 7), (0, 7)]


def test_interrupted_while_waiting_for_a_reply_the_motors_still_stop(rig):
    with rig.robot() as robot:
        robot.drive((50, 50))
        guard = robot._brick._sock
        guard.send(b"\x00\x0b")  # the reply to this is never read
        assert robot.battery() == 7.9
        guard.send(b"\x01\x9b")
    assert rig.motors()[1:] == [(0, 7), (0, 7)]


def test_closed_and_connected_again(rig):
    robot = rig.robot()
    with pytest.raises(RobotError, match="not connected"):
        robot.drive((1, 1))
    robot.close()
    for _ in range(2):
        robot.connect()
        robot.connect()
        robot.drive((7, 7))
        robot.close()
        robot.close()
    assert rig.motors()[1:] == [(0, 7), (0, 7)]


def test_a_brick_that_falls_silent_is_lost_within_the_deadline(rig, monkeypatch):
    with rig.robot() as robot:
        robot.drive((50, 50))
        rig.radio.silent = True
        robot._brick._sock._deadline = SHORT
        with pytest.raises(LinkLost, match=r"stopped answering: no reply within 0\.3 s") as error:
            robot.drive((10, 10))
        where = rig.options.get("filename") or "127.0.0.1:"
        assert where in one_sentence(error)
        for read in ("_read_frame", "_read_packet"):
            monkeypatch.setattr(nxt_link.Guard, read, lambda _: pytest.fail("it is waited for"))
        with pytest.raises(LinkLost):
            robot.read_sensors()
        robot.close()


def test_a_line_that_closes_is_lost(rig):
    with rig.robot() as robot:
        robot.drive((50, 50))
        rig.server.hang_up()
        with pytest.raises(LinkLost, match="stopped answering: the line was closed"):
            for _ in range(3):
                robot.drive((10, 10))


@pytest.mark.parametrize(
    "reply",
    [
        b"\x02\x0b\x00",  # too short
        b"\x02\x55\x00\x01\x02",  # of another command
        b"\x07\x0b\x00\x01\x02",  # no reply
        b"\x02",
        b"\x02\x0b\x77\x01\x02",  # an unknown status
    ],
)
def test_replies_that_are_none_lose_the_link(rig, reply):
    with rig.robot() as robot:
        rig.radio.deliver = lambda telegram: reply
        with pytest.raises(LinkLost, match="not send LEGO's protocol") as error:
            robot.battery()
        one_sentence(error)


def test_what_the_brick_refuses_is_no_lost_link(one):
    with one.robot() as robot:
        one.radio.brick.hardware.set_output = lambda *settings: None
        with pytest.raises(RobotError, match="motor port B is at 0 % instead of 10 %") as error:
            robot.drive((10, 20))
        assert not isinstance(error.value, LinkLost)
        one.radio.deliver = lambda telegram: bytes([2, telegram[1], 0xFB]) + bytes(2)
        with pytest.raises(RobotError, match="insufficient memory"):
            robot.battery()


def refused(*, deadline=PATIENCE, **options):
    robot = NXT(deadline=deadline, **options)
    with pytest.raises(RobotError) as error:
        robot.connect()
    assert not isinstance(error.value, LinkLost)
    robot.close()
    return one_sentence(error)


@needs_pty
def test_files_that_are_no_brick(tmp_path):
    plain = tmp_path / "notes.txt"
    plain.write_text("not a brick")
    for path in (plain, "/dev/null"):
        text = refused(filename=path)
        assert str(path) in text
        assert "not a serial line" in text
    assert plain.read_text() == "not a brick"
    assert "no such file" in refused(filename=tmp_path / "rfcomm0")
    assert "folder" in refused(filename=tmp_path)
    secret = tmp_path / "secret"
    secret.touch(mode=0)
    if os.geteuid() != 0:
        assert "may not open" in refused(filename=secret)


@needs_pty
@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, "no reply within 0.3 s"),
        (lambda data: data, "own input"),
        (lambda data: b"login: ", "not send LEGO's protocol"),
        (lambda data: b"\x05\x00\x02\x9b", "no reply within 0.3 s"),
        (lambda data: b"\x03\x00\x02\x88\x00", "not send LEGO's protocol"),
    ],
)
def test_lines_that_are_no_brick(answer, words):
    import tty

    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)

    def other_end():
        try:
            while data := os.read(master, 100):
                if answer:
                    os.write(master, answer(data))
        except OSError:
            pass

    thread = threading.Thread(target=other_end, daemon=True)
    thread.start()
    try:
        silent = words.startswith("no reply")
        text = refused(filename=path, deadline=SHORT if silent else PATIENCE)
        assert words in text
        assert path in text
    finally:
        os.write(slave, b"x")
        os.close(slave)
        thread.join(PATIENCE)
        os.close(master)


@needs_pty
def test_a_line_that_never_opens(monkeypatch):
    opened = threading.Event()
    monkeypatch.setattr(nxt_link, "_connect", lambda sock: opened.wait(PATIENCE))
    monkeypatch.setattr(nxt_link, "OPEN_WITHIN", 0.1)
    assert "cannot open /dev/rfcomm0: nothing on that line" in refused(filename="/dev/rfcomm0")
    opened.set()


@needs_pty
def test_what_an_earlier_program_left_unread_is_not_taken_for_a_reply(pty):
    line = os.open(pty.server.path, os.O_RDWR | os.O_NOCTTY)
    os.write(line, b"\x02\x00\x00\x0b")
    assert select.select([line], [], [], PATIENCE)[0]
    os.close(line)
    with pty.robot() as robot:
        assert robot.describe()["name"] == "Pippin"


def listener(answer):
    server = socket.create_server(("127.0.0.1", 0))

    def run():
        client, _ = server.accept()
        with client:
            client.recv(10)
            if answer:
                client.sendall(answer)
            while client.recv(10):
                pass  # until the other end leaves

    threading.Thread(target=run, daemon=True).start()
    return server


def test_servers_that_are_no_brick():
    with listener(b"") as server:
        text = refused(server_port=server.getsockname()[1], deadline=SHORT)
        assert "no nxt-server reached at localhost" in text
        assert "no reply within" in text
    with listener(b"HTTP/1.1 400 Bad Request\r\n") as server:
        text = refused(server_host="127.0.0.1", server_port=server.getsockname()[1])
        assert "is not nxt-server" in text
    free = socket.create_server(("127.0.0.1", 0))
    port = free.getsockname()[1]
    free.close()
    assert "no nxt-server reached" in refused(server_port=port)
    with pytest.raises(UserError, match="server_port: expected a whole number from 1 to 65,535"):
        NXT(server_port=70000)


def test_one_way_only():
    assert "one way" in refused(filename="/dev/rfcomm0", server_port=2727)


def usb_find(outcome):
    def find(**filters):
        if isinstance(outcome, Exception):
            raise outcome
        return iter(outcome)

    return find


class Device:
    bus = address = 1

    def __init__(self, error=None):
        self.error = error
        self.brick, self.reply = None, None

    def reset(self):
        if self.error:
            raise self.error

    def set_configuration(self):
        pass

    def get_active_configuration(self):
        return {(0, 0): (self, self)}

    def write(self, data):
        if self.brick:
            self.reply = self.brick.handle(bytes(data))

    def read(self, count):
        if self.reply:
            return memoryview(self.reply)
        raise usb.core.USBTimeoutError("Operation timed out", errno=110)


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        ([], "no brick found on USB"),
        (usb.core.NoBackendError("No backend available"), "libusb"),
        ([Device(usb.core.USBError("Access denied", errno=13))], "udev"),
        ([Device(usb.core.USBError("Pipe error", errno=32))], "Pipe error"),
        ([Device()], "no NXT brick answers on USB: no reply"),
    ],
)
def test_usb_without_a_brick(monkeypatch, outcome, words):
    monkeypatch.setattr(nxt.backend.usb.usb.core, "find", usb_find(outcome))
    assert words in refused()


def test_usb_with_a_brick(monkeypatch):
    brick = VirtualBrick(Body(), "Sam")
    device = Device()
    device.brick = brick
    monkeypatch.setattr(nxt.backend.usb.usb.core, "find", usb_find([device]))
    with NXT(clock=LabClock()) as robot:
        robot.drive((20, 30))
        assert [output.power for output in brick.hardware.outputs] == [0, 20, 30]
        assert robot.describe()["name"] == "Sam"
    assert [output.power for output in brick.hardware.outputs] == [0, 0, 0]


def test_usb_without_pyusb(monkeypatch):
    monkeypatch.setitem(sys.modules, "nxt.backend.usb", None)
    assert "pyusb" in refused()


def test_no_serial_lines_on_windows(monkeypatch):
    monkeypatch.setitem(sys.modules, "nxt.backend.devfile", None)
    text = refused(filename="/dev/rfcomm0")
    assert "no device files" in text
    assert "USB" in text


# Faults of the line while the robot drives: the brick must receive a stop


def flipped(reply):
    return bytes([reply[0], reply[1] ^ 0x10, *reply[2:]])


FAULTS = {
    "a flipped bit": lambda count, reply: flipped(reply) if count == 0 else reply,
    "a lost reply": lambda count, reply: None if count == 0 else reply,
    "a muted way back": lambda count, reply: None,
    "half a reply": lambda count, reply: reply[:5] if count == 0 else reply,
    "an answer to nothing": lambda count, reply: b"\x02\x55\x00" if count == 0 else reply,
}


def faulty(rig, fault):
    """Deliver everything to the brick, and damage its answers from now on."""
    plain, count = rig.radio.deliver, 0

    def deliver(telegram):
        nonlocal count
        reply = plain(telegram)
        if reply is None:
            return None
        count += 1
        return fault(count - 1, reply)

    rig.radio.deliver = deliver
    # A command without a reply is carried out soon, with no question after it.
    rig.radio.patience = 0.01


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
@pytest.mark.parametrize("then", ["drive", "read", "leave"])
def test_after_one_bad_reply_the_motors_stop(rig, fault, then):
    with suppress(RobotError), rig.robot(lamp=None) as robot:
        robot.drive((50, -50))
        robot._brick._sock._deadline = SHORT
        faulty(rig, fault)
        if then == "drive":
            robot.drive((60, 60))
        elif then == "read":
            robot.read_sensors()
    wait_until(lambda: not any(output.power for output in rig.body.outputs), "a stop")


def test_a_stop_that_is_interrupted_is_sent_all_the_same(rig):
    with rig.robot(lamp=None) as robot:
        robot.drive((50, 50))
        rig.radio.patience = 0.01

        def interrupted(*_):
            raise KeyboardInterrupt

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(robot, "_set_motor", interrupted)
            with pytest.raises(KeyboardInterrupt):
                robot.stop()
        wait_until(lambda: not any(output.power for output in rig.body.outputs), "a stop")


def test_a_command_that_lasts_ends_by_itself(rig):
    with rig.robot() as robot:
        assert isinstance(robot, SelfStopping)
        robot.drive_for((40, -100), 2.0)
        # 12 degrees a second for each percent, for 2 s and one more.
        limits = [output.tacho_limit for output in rig.body.outputs]
        assert limits == [0, 12 * 40 * 3, 12 * 100 * 3]
        assert [output.power for output in rig.body.outputs] == [0, 40, -100]
        robot.drive_for((0, 10), 0.1)
        assert [output.tacho_limit for output in rig.body.outputs] == [0, 0, 132]
    assert [output.tacho_limit for output in rig.body.outputs] == [0, 0, 0]


def test_a_limit_counts_from_where_the_motor_is(one):
    """The firmware adds a limit to where the last one would have ended.

    This does not hold where the motor ran without a limit in between (LEGO's d_output.c).
    """
    heard = []
    plain = one.body.set_output
    one.body.set_output = lambda port, power, *rest: (
        heard.append((port, power, rest[-1])) or plain(port, power, *rest)
    )
    with one.robot() as robot:
        heard.clear()
        robot.drive_for((50, -50), 1.0)
        # At 1 %, and without regulation, no motor turns.
        assert heard == [(1, 1, 0), (2, 1, 0), (1, 50, 1200), (2, -50, 1200)]


def test_motors_that_an_earlier_program_left_running_are_stopped(rig):
    rig.body.set_output(1, 70, 7, 1, 0, 0x20, 0)
    with rig.robot():
        assert [output.power for output in rig.body.outputs] == [0, 0, 0]
