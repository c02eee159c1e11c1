"""An e-puck2 and a Khepera IV in software, each on a pseudo-terminal, driven and checked."""

import os

import numpy as np
import pytest
from patience import PATIENCE, wait_until
from serial_robots import EPuck2, Khepera4, on_a_line

from neurosim.base.errors import RobotError
from neurosim.lab.cable import address_of
from neurosim.robots.base import Battery, Counters, Lamp, Proximity, SelfStopping
from neurosim.robots.check import check
from neurosim.robots.khepera.driver import Khepera

pytestmark = pytest.mark.skipif(os.name != "posix", reason="this system has no pseudo-terminals")

BOTH = pytest.mark.parametrize(("kind", "dialect"), [(EPuck2, "epuck2"), (Khepera4, "khepera4")])
#: An e-puck2 is reached by Bluetooth or by TCP.
ENDS = pytest.mark.parametrize("device", ["pty", "socket"])


def driver(robot, cable, dialect, **options):
    options = {"timeout": PATIENCE, **options}
    return Khepera(address_of(cable), dialect=dialect, clock=robot.clock, **options)


def wait(robot, seconds):
    robot.clock.sleep_until(robot.clock.now() + seconds)


@ENDS
@BOTH
def test_it_is_driven_and_read(kind, dialect, device):
    with on_a_line(kind, device) as (fake, cable), driver(fake, cable, dialect) as robot:
        can = [isinstance(robot, each) for each in (Proximity, Counters, Lamp, Battery)]
        assert can == [True] * 4
        # Nothing would stop it: its program keeps a speed until the next command.
        assert not isinstance(robot, SelfStopping)
        robot.drive((100, -50))
        full = robot.full_speed
        assert fake.speeds == (full, -full // 2)
        wait(robot, 10.0)
        assert fake.speeds == (full, -full // 2)
        robot.stop()
        assert fake.speeds == (0, 0)
        left, right = np.array(robot.read_counts()) / robot.pulses_per_metre
        assert left == pytest.approx(10 * full * robot.speed_unit, rel=0.01)
        assert right == pytest.approx(-left / 2, rel=0.01)
        robot.lamp(True)
        assert fake.lamp is True
        robot.lamp(False)
        assert fake.lamp is False
        robot.drive((10, 10))
    assert fake.speeds == (0, 0)


@ENDS
def test_the_sensors_of_an_e_puck2(device):
    with on_a_line(EPuck2, device) as (fake, cable), driver(fake, cable, "epuck2") as robot:
        assert robot.describe()["version"] == "Version 2.0 January 2018 GCtronic"
        np.testing.assert_array_equal(robot.read_proximity(), fake.proximity)
        # The last one looks ahead, a little to the left.
        assert robot.activations()[7] == 1.0
        assert np.degrees(robot.angles[7]) == pytest.approx(17)
        assert robot.scan == 0.010
        assert robot.battery() == pytest.approx(3.898, abs=0.001)
        # 1000 steps are a turn of a wheel of 41 mm.
        assert robot.pulses_per_metre == pytest.approx(7763.7, abs=0.1)


def test_the_sensors_of_a_khepera_iv():
    with on_a_line(Khepera4) as (fake, cable), driver(fake, cable, "khepera4") as robot:
        assert robot.describe()["version"] == "B,1"
        np.testing.assert_array_equal(robot.read_proximity(), range(100, 900, 100))
        assert robot.angles[3] == 0.0
        assert robot.battery() == pytest.approx(7.427)
        assert robot.speed_unit * robot.full_speed == pytest.approx(0.1017, abs=1e-4)


@BOTH
def test_counters_that_no_command_sets_are_set_by_the_driver(kind, dialect):
    with on_a_line(kind) as (fake, cable), driver(fake, cable, dialect) as robot:
        robot.drive((100, 100))
        wait(robot, 1.0)
        robot.stop()
        assert robot.read_counts()[0] > 0
        for wanted in ((0, 0), (-1000, 5)):
            robot.set_counts(*wanted)
            assert robot.read_counts() == wanted
        fake.heard.clear()
        robot.read_counts()
        assert fake.heard == [robot.dialect.read_counts]


def test_an_e_puck2_that_restarts_counts_on_and_drives_on():
    with on_a_line(EPuck2) as (fake, cable), driver(fake, cable, "epuck2") as robot:
        robot.set_counts(500, -500)
        robot.drive((50, 50))
        fake.start()
        cable.say(fake.banner)
        wait_until(lambda: robot._line._serial.in_waiting >= len(fake.banner), "its first lines")
        counts = robot.read_counts()
        assert robot.reboots == 1
        assert fake.speeds == (500, 500)
        assert counts[0] >= 500
        assert counts[0] - counts[1] == 1000


@BOTH
def test_a_refused_command_is_told(kind, dialect):
    with on_a_line(kind) as (fake, cable), driver(fake, cable, dialect) as robot:
        with pytest.raises(RobotError, match=r"does not carry out 'Y'"):
            robot._ask("Y", 0)
        assert fake.heard[-3:] == ["Y"] * 3


def test_an_e_puck_is_not_taken_for_an_e_puck2():
    with on_a_line(EPuck2) as (fake, cable):
        with pytest.raises(
            RobotError, match=r"is not an e-puck \('Version 2.*give the dialect epuck2"
        ):
            driver(fake, cable, "epuck").connect()
        answer = fake.answer
        fake.answer = lambda line: answer(line).replace("Version 2.0", "Version 1.1.3")
        with pytest.raises(RobotError, match=r"is not an e-puck2 .*give the dialect epuck$"):
            driver(fake, cable, "epuck2").connect()


@BOTH
def test_check_robot_finds_that_nothing_stops_it(kind, dialect):
    with on_a_line(kind) as (fake, cable), driver(fake, cable, dialect) as robot:
        by_name = {one.what: one for one in check(robot)}
    assert {what for what, one in by_name.items() if one.verdict == "wrong"} == {"self-stopping"}
    assert by_name["battery"].verdict == "good"
    assert by_name["command left"].measured["speed_m_s"] == pytest.approx(
        0.3 * robot.full_speed * robot.speed_unit, rel=0.05
    )
    assert fake.speeds == (0, 0)
