"""The whole virtual Khepera: through the driver, through others' clients, and with faults."""

import json
import math
import os
import signal

import numpy as np
import pytest
import serial
from patience import PATIENCE, wait_until
from processes import finished, neurosim, started

from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.base.place import Place
from neurosim.lab import KheperaParams, Pacer, VirtualKheperaRig
from neurosim.lab.khepera.params import RADIUS
from neurosim.robots.khepera.driver import Khepera

DEVICES = ["socket", *(["pty"] if os.name == "posix" else [])]


def drive(rig, robot, steps=60):
    """Drive around by the sensors' readings; return the distance."""
    distance = []
    begin = robot.clock.now()
    robot.drive((60, 50))
    activations = robot.activations()
    for step in range(1, steps + 1):
        robot.clock.sleep_until(begin + 0.1 * step)
        left, right = 60 - 120 * activations[2:5].max(), 60 - 60 * activations[:2].max()
        robot.drive((left, right))
        activations = robot.activations()
        distance.append([*rig.lab.pose, *activations])
    return np.array(distance)


def driven(seed=1, noise=3, **options):
    with VirtualKheperaRig(seed, noise_seed=noise, **options) as rig, rig.robot as robot:
        return drive(rig, robot)


def test_the_same_numbers_give_the_same_drive_over_any_line():
    first = driven(device=DEVICES[-1])
    np.testing.assert_array_equal(first, driven(device=DEVICES[-1]))
    np.testing.assert_array_equal(first, driven(device="socket"))
    assert np.abs(first - driven(noise=4)).max() > 1e-6
    assert np.abs(first - driven(seed=2)).max() > 1e-3


@pytest.mark.parametrize("device", DEVICES)
def test_the_driver_drives_and_reads_it(device):
    arena = Place(walls=((0.105, -1.0, 0.105, 1.0),))
    with (
        VirtualKheperaRig(
            0, place=arena, start=(0.0, 0.0, 0.0), device=device, params=KheperaParams.ideal()
        ) as rig,
        rig.robot as robot,
    ):
        robot.set_counts(0, 0)
        begin = rig.lab.pose[0]
        robot.drive((100, 100))
        robot.clock.sleep_until(robot.clock.now() + 0.5)
        robot.stop()
        robot.clock.sleep_until(robot.clock.now() + 0.5)
        left, right = robot.read_counts()
        assert left == right
        assert left / robot.pulses_per_metre == pytest.approx(rig.lab.pose[0] - begin, abs=2e-4)
        rig.lab.place(0.1 - RADIUS - 0.02, 0.0, 0.0)
        ahead = robot.read_proximity()
        rig.lab.place(0.1 - RADIUS - 0.02, 0.0, math.pi)
        behind = robot.read_proximity()
        assert ahead[2] > 500 > behind[2]
        assert behind[6] > 500 > ahead[6]
        # The wall to its right: it looks along +y.
        rig.lab.place(0.1 - RADIUS - 0.015, 0.0, math.pi / 2)
        assert robot.read_proximity()[5] > 500 > robot.read_proximity()[0]
        np.testing.assert_array_equal(robot.read_ambient(), 480)


def test_the_line_takes_its_time():
    times = {}
    for baud in (9600, 38400):
        with VirtualKheperaRig(0, baud=baud) as rig, rig.robot as robot:
            robot.stop()
            begin = rig.lab.time
            robot.stop()
            times[baud] = rig.lab.time - begin
    # "D,0,0" and CR, then "d" and CR LF: 9 bytes of 11 bits.
    assert times[9600] == pytest.approx(9 * 11 / 9600)
    assert times[38400] == pytest.approx(9 * 11 / 38400)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.slow
def test_a_client_to_the_manuals_letter(device):
    with VirtualKheperaRig(0, device=device, real_time=True) as rig, Pacer(rig.lab):
        for _ in range(2):  # The second comes after the first has gone.
            with serial.serial_for_url(
                rig.address, baudrate=9600, bytesize=8, parity="N", stopbits=2, timeout=PATIENCE
            ) as port:
                port.write(b"B\r")
                assert port.readline() == b"b,5.02,5.02-virtual\r\n"
                port.write(b"D,5,-5\n")
                assert port.readline() == b"d\r\n"
                port.write(b"G,0,0\r\n")
                assert port.readline() == b"g\r\n"

                def turned():
                    port.write(b"H\n")
                    name, left, right = port.readline().strip().split(b",")
                    assert name == b"h"
                    return int(left) > 20 and int(right) < -20

                wait_until(turned, "the wheels' turn")
                port.write(b"D,0,0\nE\n")
                assert port.readline() == b"d\r\n"
                assert port.readline().startswith(b"e,")
                port.write(b"N\n")
                values = port.readline().strip().split(b",")
                assert (values[0], len(values)) == (b"n", 9)
                assert all(0 <= int(value) <= 1023 for value in values[1:])
                port.write(b"X\nD,1\n")
                assert port.readline() == b"z,Command not found\r\n"
                assert port.readline() == b"z,Protocol error\r\n"
                port.write(b"restart\n")
                assert b"ROM of minirobot KHEPERA" in port.readline() + port.readline()
                port.readline()


@pytest.mark.parametrize("device", DEVICES)
def test_a_reboot_is_survived(device):
    with VirtualKheperaRig(1, device=device) as rig, rig.robot as robot:
        robot.set_speeds(3, 3)
        robot.set_counts(1000, 1000)
        rig.reboot()
        wait_until(lambda: robot._line._serial.in_waiting, "the banner")
        robot.read_proximity()
        robot.clock.sleep_until(robot.clock.now() + 1.0)
        assert robot.reboots == 1
        assert rig.firmware.feed(b"K\r").startswith(b"k,")
        assert min(robot.read_counts()) > 1200


def test_a_robot_switched_off_is_lost():
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        rig.switch_off()
        robot._timeout = 0.05
        with pytest.raises(LinkLost, match="stopped answering"):
            robot.read_proximity()


def test_a_line_taken_down_is_lost():
    with VirtualKheperaRig(1) as rig:
        robot = rig.robot
        robot.connect()
        rig.close()
        robot._timeout = 0.05
        with pytest.raises(RobotError):
            robot.read_proximity()
        robot.close()


def test_no_room_at_the_start():
    with pytest.raises(UserError, match="obstacle"):
        VirtualKheperaRig(0, start=(0.0, 0.0, 0.0))


@pytest.mark.slow
def test_from_the_command_line(tmp_path):
    arena = tmp_path / "arena.json"
    Place.rectangle(1.0, 1.0).write(arena)
    process = started(
        "lab", "khepera", "--place", arena, "--socket", "--seconds", PATIENCE, "--start", 10, 0, 90,
        "--json",
    )  # fmt: skip
    try:
        text = "".join(process.stdout.readline() for _ in range(4))
        content = json.loads(text)
        assert content["baud"] == 9600
        with Khepera(content["port"], timeout=PATIENCE) as robot:
            robot.set_speeds(5, 5)
            wait_until(lambda: robot.read_counts()[0] > 100, "its drive")
            robot.stop()
            assert max(robot.read_proximity()) < 60
    finally:
        process.send_signal(signal.SIGTERM)
        finished(process)


@pytest.mark.slow
def test_a_start_outside_the_arena(tmp_path):
    done = neurosim(
        "lab", "khepera", "--start", 50, 0, 0, "--seconds", 1, cwd=tmp_path, check=False
    )
    assert done.returncode == 1
    assert "outside the outline" in done.stderr
    assert "Traceback" not in done.stderr
