"""The programs in firmware/, as processes behind pseudo-terminals, held to the protocol."""

import itertools
import os
import shutil
import subprocess
import tty
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from boards import FIRMWARE, micropython

from neurosim.robots.lines.driver import Lines
from neurosim.testing import check_lines

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="this system has no pseudo-terminals"),
]

HERE = Path(__file__).parent
SKETCH = FIRMWARE / "arduino" / "neurosim_lines" / "neurosim_lines.ino"
#: Debian's arduino-core-avr: the library that programs of an Arduino Uno use.
CORE = Path("/usr/share/arduino/hardware/arduino/avr")


@contextmanager
def on_a_terminal(*words):
    master, slave = os.openpty()
    tty.setraw(slave)
    process = subprocess.Popen([str(word) for word in words], stdin=master, stdout=master)
    try:
        yield os.ttyname(slave)
    finally:
        process.terminate()
        process.wait()
        os.close(master)
        os.close(slave)


@pytest.fixture(scope="module")
def arduino(tmp_path_factory):
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    program = tmp_path_factory.mktemp("arduino") / "program"
    host = HERE / "host"
    subprocess.run(
        [compiler, "-std=c++11", "-Wall", "-Wextra", "-Werror", "-I", host, "-x", "c++",
         "-include", "Arduino.h", SKETCH, host / "host.cpp", "-o", program],
        check=True,
    )  # fmt: skip
    return program


def test_arduino(arduino):
    with on_a_terminal(arduino) as port:
        greeting = check_lines(port)
    assert [one.name for one in greeting.counters] == ["left", "right"]
    assert greeting.lamp
    assert not greeting.virtual


NAMES, REAL = ("main_pico", "main_microbit", "main_pybricks"), (True, False)


@pytest.fixture(scope="module")
def checked():
    """Check all programs at once: most of a check is waiting."""

    def check(name, real):
        with on_a_terminal(*micropython(name, real)) as port:
            return check_lines(port)

    cases = [*itertools.product(NAMES, REAL)]
    with ThreadPoolExecutor(len(cases)) as pool:
        yield {case: pool.submit(check, *case) for case in cases}


@pytest.mark.parametrize("real", REAL, ids=["micropython", "python"])
@pytest.mark.parametrize("name", NAMES)
def test_micropython(checked, name, real):
    greeting = checked[name, real].result()
    assert len(greeting.sensors) == (0 if name == "main_pybricks" else 2)
    assert len(greeting.counters) == (0 if name == "main_microbit" else 2)
    assert greeting.battery is (name == "main_pybricks")


def test_the_driver_drives_the_arduino(arduino):
    with on_a_terminal(arduino) as port, Lines(port) as robot:
        robot.set_counts(0, 0)
        robot.drive_for((50, -50), 0.3)
        robot.clock.sleep_until(robot.clock.now() + 1.0)
        left, right = robot.read_counts()
        assert left == -right
        # 200 pulses a second, for 0.3 s and what the driver adds.
        assert 60 <= left <= 200
        assert robot.read_sensors() == {"line_left": 500 / 1023, "line_right": 510 / 1023}


@pytest.mark.skipif(
    shutil.which("avr-g++") is None or not CORE.exists(),
    reason="there is no compiler for an Arduino Uno (Debian: gcc-avr, avr-libc, arduino-core-avr)",
)
def test_the_sketch_compiles_for_an_arduino_uno(tmp_path):
    board = ["-mmcu=atmega328p", "-DF_CPU=16000000L", "-DARDUINO=10819"]
    folders = ["-I", CORE / "cores" / "arduino", "-I", CORE / "variants" / "standard"]
    subprocess.run(
        ["avr-g++", "-std=gnu++11", "-Os", "-Wall", "-Werror", *board, *folders, "-x", "c++",
         "-include", "Arduino.h", "-c", SKETCH, "-o", tmp_path / "sketch.o"],
        check=True,
    )  # fmt: skip
    sizes = subprocess.run(
        ["avr-size", tmp_path / "sketch.o"], check=True, capture_output=True, text=True
    ).stdout.splitlines()[1].split()  # fmt: skip
    program, data, zero = map(int, sizes[:3])
    assert program < 16_000  # of 32 KB
    assert data + zero < 1000  # of 2 KB
