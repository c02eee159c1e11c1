"""The driver against scripted bytes: answers of a robot, of a broken one, and of another device."""

import errno
import math
import os
import threading
from contextlib import contextmanager

import numpy as np
import pytest
import serial
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from patience import PATIENCE, wait_until

from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.robots import Battery, Counters, Lamp, Robot, open_robot, serial_line
from neurosim.robots.base import LightSensors, Proximity, read_sensors, sensors_read_with
from neurosim.robots.khepera import driver as driver_module
from neurosim.robots.khepera.driver import Khepera, _numbers
from neurosim.robots.serial_line import SerialLine

pytestmark = pytest.mark.skipif(os.name != "posix", reason="this system has no pseudo-terminals")

WELL = {
    b"B": b"b,5.02,5.02\r\n",
    b"D": b"d\r\n",
    b"G": b"g\r\n",
    b"H": b"h,120,-7\r\n",
    b"L": b"l\r\n",
    b"N": b"n,0,1,2,3,4,5,6,1023\r\n",
    b"O": b"o,500,501,502,503,504,505,506,507\r\n",
}
BANNER = b"\r\nROM of minirobot KHEPERA, version 3\r\n"


SHORT = 0.3  # where no answer comes


class Scripted:
    """Answers commands on a pseudo-terminal; answers in ``script`` replace those of WELL."""

    def __init__(self, master):
        self.master, self.heard, self.script, self.table = master, [], [], WELL
        self.sent = self.taken = 0

    def pace(self, driver):
        """Have a driver give up soon where the script has no whole answer, and only there."""
        write = driver._line.write

        def paced(data):
            wait_until(lambda: self.taken == self.sent, "the command before")
            answer = self.script[0] if self.script else self.table.get(data[:1], b"")
            driver._timeout = PATIENCE if answer.endswith(b"\n") else SHORT
            self.sent += 1
            write(data)

        driver._line.write = paced

    def run(self):
        buffer = b""
        while True:
            try:
                data = os.read(self.master, 256)
            except OSError:
                return
            if not data or data == b"\x04":
                return
            buffer += data
            while b"\r" in buffer:
                command, _, buffer = buffer.partition(b"\r")
                if command:
                    self.heard.append(command.decode())
                    answer = self.script.pop(0) if self.script else None
                    # Before the answer, after which the test may begin to count again.
                    self.taken += 1
                    os.write(
                        self.master, self.table.get(command[:1], b"") if answer is None else answer
                    )

    def say(self, data, driver):
        """Send something unasked; return when it waits at the driver's end."""
        os.write(self.master, data)
        wait_until(lambda: driver._line._serial.in_waiting >= len(data), "what was said")


@contextmanager
def scripted():
    import tty

    master, slave = os.openpty()
    tty.setraw(slave)
    robot = Scripted(master)
    thread = threading.Thread(target=robot.run, daemon=True)
    thread.start()
    try:
        yield robot, os.ttyname(slave)
    finally:
        os.write(slave, b"\x04")
        thread.join(PATIENCE)
        os.close(slave)
        os.close(master)


@pytest.fixture
def line():
    with scripted() as result:
        yield result


@pytest.fixture
def robot(line):
    script, path = line
    with Khepera(path, timeout=PATIENCE) as driver:
        script.heard.clear()
        script.taken = 0
        script.pace(driver)
        yield driver


def test_it_is_a_robot_and_says_which(line):
    script, path = line
    driver = open_robot("khepera", port=path, timeout=PATIENCE)
    assert isinstance(driver, Robot)
    assert [isinstance(driver, kind) for kind in (Lamp, Proximity, Counters)] == [True] * 3
    assert not isinstance(driver, Battery)
    about = driver.describe()
    assert about["kind"] == "khepera"
    assert (about["version"], about["baud"], about["dialect"]) == ("5.02,5.02", 9600, "khepera")
    driver.close()
    assert script.heard == ["B", "D,0,0", "D,0,0"]


def test_every_command(line, robot):
    script, _ = line
    robot.drive((100, -54))
    robot.set_speeds(3, 127)
    np.testing.assert_array_equal(robot.read_proximity(), [0, 1, 2, 3, 4, 5, 6, 1023])
    np.testing.assert_array_equal(robot.read_ambient(), np.arange(500, 508))
    assert robot.read_counts() == (120, -7)
    robot.set_counts(5, -5)
    robot.lamp(True)
    robot.stop()
    assert script.heard == ["D,10,-5", "D,3,127", "N", "O", "H", "G,5,-5", "L,0,1", "D,0,0"]
    assert robot.read_sensors()["sensor_7"] == 1.0
    assert robot.read_sensors()["sensor_1"] == pytest.approx(1 / 1023)
    assert tuple(robot.read_sensors()) == robot.sensor_names


def test_light_is_measured_only_where_it_is_wanted(line, robot):
    script, _ = line
    assert isinstance(robot, LightSensors)
    assert robot.lights() == pytest.approx(1 - np.arange(500, 508) / 512)
    light = tuple(f"light_{index}" for index in range(8))
    assert sensors_read_with(robot) == (*robot.sensor_names, *light)
    for wanted, names, asked in (
        (("light_2",), light, ["O"]),
        (("sensor_0", "sensor_3"), robot.sensor_names, ["N"]),
        (("sensor_0", "light_7"), (*robot.sensor_names, *light), ["N", "O"]),
        (("line_left",), (), []),
    ):
        script.heard.clear()
        assert sensors_read_with(robot, wanted) == names
        assert tuple(read_sensors(robot, wanted)) == names
        assert script.heard == asked
    assert read_sensors(robot, ("light_2",))["light_2"] == pytest.approx(1 - 502 / 512)


@pytest.mark.parametrize(("left", "right"), [(101, 0), (0, -100.5), (math.nan, 0), (0, math.inf)])
def test_no_such_speed(robot, left, right):
    with pytest.raises(UserError, match="is not a speed"):
        robot.drive((left, right))


def test_no_such_speed_of_its_own(robot):
    with pytest.raises(UserError, match=r"left wheel: 128.*up to 127"):
        robot.set_speeds(128, 0)
    with pytest.raises(UserError, match=r"right wheel: 1.5"):
        robot.set_speeds(0, 1.5)


@pytest.mark.parametrize(
    "bad",
    [
        b"n,0,1,2,3\r\n",
        b"n,0,1,2,3,4,5,6,x\r\n",
        b"z,Command not found\r\n",
        b"n,0,1,2",
        b"",
    ],
)
def test_half_answers_and_errors_are_asked_again(line, robot, bad):
    script, _ = line
    script.script = [bad]
    np.testing.assert_array_equal(robot.read_proximity(), [0, 1, 2, 3, 4, 5, 6, 1023])
    assert script.heard == ["N", "N"]


def test_garbage_before_an_answer_is_passed_over(line, robot):
    script, _ = line
    script.script = [b"\xff\xfe\x00?\r\n,,\r\nh,1,2\r\nn,0,1,2,3,4,5,6,1023\r\n"]
    np.testing.assert_array_equal(robot.read_proximity(), [0, 1, 2, 3, 4, 5, 6, 1023])
    assert script.heard == ["N"]


def test_a_late_answer_is_not_taken_for_the_next(line, robot):
    script, _ = line
    script.say(b"h,1,1\r\n", robot)
    assert robot.read_counts() == (120, -7)


def test_a_robot_that_reboots_is_set_to_what_it_was(line, robot):
    script, _ = line
    robot.set_speeds(7, 8)
    robot.read_counts()
    script.heard.clear()
    script.say(BANNER, robot)
    robot.read_proximity()
    assert script.heard == ["G,120,-7", "D,7,8", "N"]
    assert robot.reboots == 1
    assert robot.describe()["reboots"] == 1


def test_a_reboot_in_the_middle_of_an_answer(line, robot):
    script, _ = line
    robot.set_speeds(7, 8)
    script.heard.clear()
    script.script = [b"n,0,1" + BANNER]
    np.testing.assert_array_equal(robot.read_proximity(), [0, 1, 2, 3, 4, 5, 6, 1023])
    assert script.heard in (["N", "D,7,8", "N"], ["N", "N", "D,7,8", "N"], ["N", "N"])
    robot.read_proximity()
    assert "D,7,8" in script.heard
    assert robot.reboots == 1


@pytest.mark.slow
def test_silence_is_a_lost_link(line, robot):
    script, path = line
    script.table = {}
    with pytest.raises(LinkLost, match=rf"{path} stopped answering.*'N' within 0.3 s, 3 times"):
        robot.read_proximity()
    # A robot that does not answer may still have received the command.
    wait_until(lambda: script.heard[3:] == ["D,0,0"] * 4, "a stop, four times")
    assert script.heard[:3] == ["N", "N", "N"]
    with pytest.raises(LinkLost, match="stopped answering"):
        robot.read_proximity()


def test_a_command_refused_each_time_is_told(line, robot):
    script, _ = line
    script.script = [b"z,Command not found\r\n"] * 3
    with pytest.raises(RobotError, match=r"does not carry out 'O'.*z,Command not found"):
        robot.read_ambient()


def test_nothing_answers(line):
    script, path = line
    script.table = {}
    with pytest.raises(RobotError, match=rf"nothing answers on {path} at 9600 baud"):
        Khepera(path, timeout=0.05).connect()


def test_something_else_answers(line, monkeypatch):
    script, path = line
    script.table = {b"B": b"\x80\x91gibberish\r\n"}
    write = SerialLine.write

    def heard(self, data):
        write(self, data)
        if data.strip():
            wait_until(lambda: self._serial.in_waiting, "its answer")

    monkeypatch.setattr(SerialLine, "write", heard)
    with pytest.raises(RobotError, match=r"does not answer as a Khepera.*gibberish.*the speed"):
        Khepera(path, timeout=0.05).connect()


def test_a_terminal_is_no_robot():
    with pytest.raises(RobotError, match="sends back its own input"):
        Khepera("loop://", timeout=0.05).connect()


def test_a_port_in_use(line):
    _, path = line
    with (
        serial.serial_for_url(path, exclusive=True),
        pytest.raises(RobotError, match=rf"cannot open the serial port {path}: it is busy"),
    ):
        Khepera(path).connect()


@pytest.mark.parametrize(
    ("port", "why"),
    [
        ("/dev/no-such-port", "there is no such port"),
        ("COM333", "there is no such port"),
        ("nonsense://x", "nonsense"),
        ("socket://127.0.0.1:1", "nothing listens there"),
    ],
)
def test_ports_that_do_not_open(port, why):
    with pytest.raises(RobotError, match=rf"cannot open the serial port .*{why}"):
        Khepera(port, timeout=0.1).connect()


def test_a_file_is_no_port(tmp_path):
    path = tmp_path / "file"
    path.write_text("x")
    with pytest.raises(RobotError, match="cannot open the serial port"):
        Khepera(str(path)).connect()


def test_no_right_to_a_port(monkeypatch):
    def refuse(*_, **__):
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(RobotError, match=r"you may not open it.*dialout"):
        Khepera("/dev/ttyUSB0").connect()


def test_the_line_goes_away():
    with scripted() as (script, path):
        driver = Khepera(path, timeout=PATIENCE)
        driver.connect()
        script.table = {}
        driver._line._serial.close()
        with pytest.raises(LinkLost, match=f"the line {path} is gone"):
            driver.read_proximity()
        driver.close()


def test_a_spy_on_the_line_which_overwrites_a_file_is_refused(line, tmp_path):
    _, path = line
    (tmp_path / "log").write_text("mine")
    with pytest.raises(RobotError, match="overwrites a file"):
        Khepera(f"spy://{path}?file={tmp_path / 'log'}", timeout=PATIENCE).connect()
    assert (tmp_path / "log").read_text() == "mine"


def test_the_khepera_iii_has_other_letters_prefixes_and_sensors(line):
    script, path = line
    answer = b"n," + b",".join(b"%d" % (100 * i) for i in range(11)) + b",4711\r\n"
    script.table = {b"B": b"b,3,0\r\n", b"D": b"d\r\n", b"N": answer, b"I": b"i\r\n"}
    script.table |= {b"R": b"r,l10,-20\r\n"}
    with Khepera(path, dialect="khepera3", timeout=PATIENCE) as driver:
        script.heard.clear()
        driver.drive((100, -100))
        driver.set_counts(0, 5)
        assert driver.read_counts() == (10, -20)
        # Its answer begins behind to the left; ours ends there.
        np.testing.assert_array_equal(
            driver.read_proximity(), [100, 200, 300, 400, 500, 600, 700, 0]
        )
        assert script.heard == ["D,l14400,l-14400", "I,l0,l5", "R", "N"]
        assert not isinstance(driver, Lamp)


def test_the_e_puck_has_other_letters_and_its_own_order(line):
    script, path = line
    script.table = {
        b"V": b"v,Version 1.1.3 September 2006\r\n",
        b"D": b"d\r\n",
        b"N": b"n,4095,-3,0,0,0,0,0,0\r\n",
        b"Q": b"q,77,-77\r\n",
        b"P": b"p\r\n",
        b"B": b"b\r\n",
    }
    with Khepera(path, dialect="epuck", timeout=PATIENCE) as driver:
        script.heard.clear()
        assert driver.describe()["version"] == "Version 1.1.3 September 2006"
        driver.drive((50, 100))
        driver.lamp(True)
        driver.set_counts(1, 2)
        assert driver.read_counts() == (77, -77)
        assert driver.read_sensors()["sensor_0"] == 1.0
        assert driver.read_sensors()["sensor_1"] == 0.0
        # Sensor 0 looks to the right.
        assert driver.angles[0] < 0
        assert script.heard[:4] == ["D,500,1000", "B,1", "P,1,2", "Q"]


def test_an_e_puck_of_a_later_version_is_one(line):
    script, path = line
    script.table = {b"V": b"v,Version 2.0.0 January 2008\r\n", b"D": b"d\r\n"}
    with Khepera(path, dialect="epuck", timeout=PATIENCE) as driver:
        assert driver.describe()["version"] == "Version 2.0.0 January 2008"


def test_an_e_puck_that_reboots(line):
    script, path = line
    script.table = {b"V": b"v,x\r\n", b"D": b"d\r\n", b"N": b"n,0,0,0,0,0,0,0,0\r\n"}
    with Khepera(path, dialect="epuck", timeout=PATIENCE) as driver:
        driver.set_speeds(100, 200)
        script.heard.clear()
        banner = b"\f\aWELCOME to the SerCom protocol on e-Puck\r\nthe EPFL education robot\r\n"
        script.say(banner, driver)
        driver.read_proximity()
        assert script.heard == ["D,100,200", "N"]


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (
            {"dialect": "roomba"},
            "'roomba' is not known; there are khepera, khepera3, khepera4, epuck, epuck2",
        ),
        ({"full_speed": 0}, "full_speed: expected"),
        ({"full_speed": 128}, "use 1 to 127"),
        ({"baud": -1}, "baud: expected a whole number from 300"),
    ],
)
def test_options_that_make_no_sense(options, why):
    with pytest.raises(UserError, match=why):
        Khepera("/dev/ttyUSB0", **options)


class Noisy:
    """A port in memory: garbage and an answer to the first command, the answer to the next.

    It is the clock, too: time goes by where there is nothing to read.
    """

    def __init__(self, garbage, answer):
        self.answers, self.waiting = [garbage + answer, answer, answer], b""
        self.time = 0.0

    def monotonic(self):
        return self.time

    @property
    def in_waiting(self):
        return len(self.waiting)

    def read(self, count):
        result, self.waiting = self.waiting[:count], self.waiting[count:]
        self.time += 0.0 if result else 0.1
        return result

    def write(self, data):
        if data.startswith(b"H"):
            self.waiting += self.answers.pop(0)

    def close(self):
        pass


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=700))
def test_whatever_comes_before_an_answer(garbage):
    assume(b"h,12" not in garbage and b"ROM of" not in garbage)
    port = Noisy(garbage.replace(b"h", b"").replace(b"z", b""), b"h,12,-3\r\n")
    driver = Khepera("memory", timeout=1.0)
    driver._line._serial = port
    with pytest.MonkeyPatch.context() as patch:
        for module in (driver_module, serial_line):
            patch.setattr(module, "time", port)
        assert driver.read_counts() == (12, -3)


def test_a_flood_is_no_answer():
    class Flood(Noisy):
        in_waiting = 100

        def read(self, count):
            return b"flood\r\n" * 20

    driver = Khepera("memory", timeout=0.05)
    driver._line._serial = Flood(b"", b"")
    with pytest.raises(LinkLost, match="stopped answering"):
        driver.read_counts()


def test_the_manuals_pulses_make_a_slower_unit():
    assert Khepera("x").speed_unit == pytest.approx(0.010)
    assert Khepera("x", pulses_per_metre=12_500).speed_unit == pytest.approx(0.008)


@given(st.text(max_size=40))
def test_any_line_is_an_answer_or_none(text):
    values = _numbers(text, "n")
    assert values is None or all(isinstance(value, int) for value in values)


@given(st.lists(st.integers(-(2**31), 2**31 - 1)))
def test_numbers_are_read_as_they_were_written(values):
    assert _numbers(",".join(["h", *map(str, values)]), "h") == values
