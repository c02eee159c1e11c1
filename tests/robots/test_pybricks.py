"""A Pybricks hub by Bluetooth: the port, against a hub in software behind the real bleak."""

import json
import os
import sys
import time

import pytest
from boards import micropython
from click.testing import CliRunner
from patience import wait_until

from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.cli.main import cli
from neurosim.robots.lines import driver as lines_driver
from neurosim.robots.lines.driver import Lines
from neurosim.testing import check_lines

pytest.importorskip("bleak")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="the hub's program is fed through a pipe"),
]
if os.name == "posix":
    from bleak.exc import (
        BleakBluetoothNotAvailableError,
        BleakBluetoothNotAvailableReason,
        BleakDBusError,
    )
    from pybricks_hub import Hub, Scanner, in_reach

PORT = "pybricks://Pybricks Hub"


@pytest.fixture
def reach(monkeypatch):
    """Return a function that makes a hub within reach."""
    made = []

    def make(program=None, **options):
        if program is None:
            program = micropython("main_pybricks", False)
        made.append(Hub(program, **options))
        in_reach(monkeypatch, *made)
        return made[-1]

    yield make
    for hub in made:
        hub.switch_off()


def test_the_program_keeps_to_the_protocol_over_bluetooth(reach):
    hub = reach(micropython("main_pybricks", True))
    greeting = check_lines(PORT)
    assert greeting.name == "two-wheels"
    assert [one.name for one in greeting.counters] == ["left", "right"]
    assert greeting.battery
    # Its stdin was full at times; the bytes that did not fit were sent again.
    assert hub.refused > 0
    assert hub.process is not None


def test_check_robot_tries_it(reach):
    reach(longest=247, room=512)
    done = CliRunner().invoke(
        cli, ["check-robot", "--robot", "lines", "--port", PORT, "--timeout", "5", "--json"]
    )
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["robot"]["port"] == PORT
    by_name = {one["what"]: one for one in result["findings"]}
    assert by_name["self-stopping"]["verdict"] == "good"
    assert by_name["command left"]["measured"]["speed_m_s"] == pytest.approx(0.117, rel=0.1)
    assert by_name["battery"]["measured"]["battery_v"] == pytest.approx(7.9)


@pytest.mark.parametrize("name", ["Pybricks Hub", "A8:e2:c1:00:00:02", ""])
def test_it_is_found_by_name_or_address_and_its_program_is_started(reach, name):
    if name:
        other = reach(name="another", address="A8:E2:C1:00:00:01")
    hub = reach(address="A8:E2:C1:00:00:02")
    for _ in range(2):
        with Lines(f"pybricks://{name}", timeout=5) as robot:
            assert robot.greeting.name == "two-wheels"
            process = hub.process
            assert process is not None
        # The program continues, and is not started a second time.
        assert hub.client is None
        assert hub.process is process
    assert not name or other.process is None
    assert hub.refused == 0


def test_a_robot_that_goes_out_of_reach_stops_by_itself(reach):
    hub = reach()
    with Lines(PORT, timeout=5) as robot:
        robot.drive_for((50, 50), 0.3)
        begin = robot.read_counts()
        hub.leave()
        with pytest.raises(LinkLost, match="the line pybricks://Pybricks Hub is gone: the hub has"):
            for _ in range(1000):
                robot.read_counts()
    time.sleep(0.7)
    with Lines(PORT, timeout=5) as robot:
        counts = robot.read_counts()
        assert counts[0] > begin[0]
        time.sleep(0.2)
        assert robot.read_counts() == counts


def test_a_program_that_ends_while_the_robot_drives(reach):
    hub = reach()
    with Lines(PORT, timeout=5) as robot:
        robot.drive((10, 10))
        hub.process.kill()
        with pytest.raises(LinkLost, match="is gone: the hub's program has ended"):
            for _ in range(1000):
                robot.read_counts()


def test_a_hub_that_tells_its_status_late_is_known_to_run_its_program(reach, monkeypatch):
    hub = reach()
    hub.start()
    monkeypatch.setattr("neurosim.robots.pybricks.TELL", 0.05)
    say, refused = hub.say_status, []
    monkeypatch.setattr(hub, "say_status", lambda: None)
    command = hub.command

    def commanded(data):
        error = command(data)
        if data[0] == 1:
            refused.append(error)
            say()
        return error

    monkeypatch.setattr(hub, "command", commanded)
    with Lines(PORT, timeout=5) as robot:
        assert robot.greeting.battery
    assert refused == [0x81]


@pytest.mark.parametrize(
    ("port", "options", "says"),
    [
        ("pybricks://Other", {}, "no Pybricks hub 'Other' is found by Bluetooth: switch it on"),
        (PORT, {"version": "1.2.0"}, "hub 'Pybricks Hub' has firmware that is too old"),
        (PORT, {"program": []}, "hub 'Pybricks Hub' has no program: download"),
        (PORT, {"program": [sys.executable, "-c", "import time; time.sleep(900)"]},
         "the line pybricks://Pybricks Hub is gone: its program reads nothing: download"),
        (PORT, {"program": [sys.executable, "-c", "while True: input()"]},
         "nothing answers on pybricks://Pybricks Hub: is the robot on, its program running"),
        (PORT, {"program": [sys.executable, "-uc", "while True: input(); print('ready')"]},
         "pybricks://Pybricks Hub does not speak neurosim's lines"),
    ],
)  # fmt: skip
def test_what_is_no_robot_is_said_in_one_sentence(reach, monkeypatch, port, options, says):
    monkeypatch.setattr("neurosim.robots.pybricks.FIND", 0.1)
    monkeypatch.setattr("neurosim.robots.pybricks.FULL", 0.2 if "reads nothing" in says else 900)
    monkeypatch.setattr(lines_driver, "BOOT", 0.5)
    hub = reach(**options)
    with pytest.raises(RobotError) as error:
        Lines(port, timeout=1.0).connect()
    assert says in str(error.value)
    wait_until(lambda: hub.client is None, "the end of the connection")


def test_a_program_that_ends_at_once_is_said(reach, monkeypatch):
    hub = reach()
    monkeypatch.setattr("neurosim.robots.pybricks.START", 0.2)
    monkeypatch.setattr(hub, "start", lambda: 0)
    with pytest.raises(RobotError, match=r"the program of the Pybricks hub .* does not run"):
        Lines(PORT).connect()


@pytest.mark.parametrize("why", ["off", "no service", "no bus"])
def test_a_computer_without_bluetooth(reach, monkeypatch, why):
    reach()
    reason = BleakBluetoothNotAvailableReason.POWERED_OFF
    raised, says = {
        "off": (BleakBluetoothNotAvailableError("No powered Bluetooth adapters found.", reason),
                "No powered Bluetooth adapters found."),
        "no service": (BleakDBusError("org.freedesktop.DBus.Error.ServiceUnknown",
                                      ["The name org.bluez was not provided"]),
                       "The name org.bluez was not provided"),
        "no bus": (FileNotFoundError(2, "No such file or directory"), "No such file or directory"),
    }[why]  # fmt: skip

    async def start(self):
        raise raised

    monkeypatch.setattr(Scanner, "start", start)
    with pytest.raises(RobotError) as error:
        Lines(PORT).connect()
    assert f"Bluetooth cannot be used on this computer ({says}): plug in" in str(error.value)


def test_without_bleak(monkeypatch):
    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(UserError, match=r"needs the package bleak: pip install 'neurosim\["):
        Lines(PORT).connect()
