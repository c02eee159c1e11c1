"""A robot whose program is killed, stopped or suspended while it drives: processes and signals."""

import os
import signal
import subprocess
import time
from contextlib import contextmanager

import pytest
from patience import PATIENCE, wait_until
from processes import finished, process, started

from neurosim.lab import (
    VirtualKheperaRig,
    VirtualLinesRig,
    VirtualRig,
    VirtualRosRig,
    VirtualThymioRig,
)
from neurosim.lab.nxt.world import Pacer
from tracking.datasets.recordings import Recording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="no pseudo-terminals, and other signals"),
]

#: Seconds of the lab after which a robot that still drives counts as never stopped.
FOR_EVER = 60.0
#: Straight on for 1 s, again and again.
WORDS = ["record", "r", "--camera", "none", "--commands", "100", "--at-line", "ignore"]
WORDS += ["--straight", "1", "--stopped", "0", "--durations", "1..1", "--max-speed", "20"]


@contextmanager
def recording(folder, *robot):
    child = started(*WORDS, *robot, cwd=folder, stdout=subprocess.DEVNULL, session=True)
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


@contextmanager
def nxt():
    with VirtualRig(0, camera=False, device="pty", real_time=True) as rig, Pacer(rig.lab):
        outputs = [rig.lab.body.output(port) for port in (1, 2)]
        yield (
            rig,
            ["--robot", "nxt", "--filename", rig.address["filename"]],
            lambda: any(each.power and each.run_state for each in outputs),
        )


@contextmanager
def khepera():
    with VirtualKheperaRig(0, device="pty", real_time=True) as rig, Pacer(rig.lab):
        yield (
            rig,
            ["--robot", "khepera", "--port", rig.address],
            lambda: any(rig.lab.body._inputs[:2]),
        )


@contextmanager
def lines():
    with VirtualLinesRig(0, camera=False, device="pty", real_time=True) as rig, Pacer(rig.lab):
        yield rig, ["--robot", "lines", "--port", rig.address], lambda: not rig.standing


@contextmanager
def thymio():
    with VirtualThymioRig(0, camera=False, device="pty", real_time=True) as rig, Pacer(rig.lab):
        yield rig, ["--robot", "thymio", "--port", rig.address], lambda: not rig.standing


@contextmanager
def ros():
    with VirtualRosRig(0, camera=False, real_time=True) as rig, Pacer(rig.lab):
        robot = ["--robot", "ros", "--url", rig.address, "--stops-after", "0.5"]
        yield rig, robot, lambda: not rig.standing


def stops(rig, drives):
    """Return whether the robot stops within those seconds."""
    begun = rig.lab.time
    wait_until(lambda: not drives() or rig.lab.time > begun + FOR_EVER, "the robot's stop")
    return not drives()


ASKED = ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"]


@pytest.mark.parametrize("name", ASKED)
@pytest.mark.parametrize("lab", [nxt, khepera, lines, thymio, ros])
def test_what_asks_a_recording_to_end_stops_the_motors_first(tmp_path, lab, name):
    number = getattr(signal, name)
    with lab() as (rig, robot, drives), recording(tmp_path, *robot) as child:
        wait_until(lambda: drives() or child.poll() is not None, "the first command")
        assert child.poll() is None
        child.send_signal(number)
        assert stops(rig, drives)
        _, stderr = child.communicate(timeout=PATIENCE)
    assert child.returncode == 128 + number
    assert stderr.count("\n") <= 3
    assert "interrupted" in stderr
    assert "Traceback" not in stderr
    assert Recording(tmp_path / "r").commands()["kind"].iloc[-1] == "command"


@pytest.mark.parametrize("name", ["SIGKILL", "SIGSTOP", "SIGSEGV", "SIGABRT"])
@pytest.mark.parametrize("lab", [nxt, lines, thymio, ros])
def test_a_robot_stops_by_itself_when_its_program_no_longer_runs(tmp_path, lab, name):
    with lab() as (rig, robot, drives), recording(tmp_path, *robot) as child:
        wait_until(lambda: drives() or child.poll() is not None, "the first command")
        assert child.poll() is None
        child.send_signal(getattr(signal, name))
        assert stops(rig, drives)


def test_a_program_that_was_suspended_by_force_and_goes_on_drives_again(tmp_path):
    with nxt() as (rig, robot, drives), recording(tmp_path, *robot) as child:
        wait_until(drives, "the first command")
        child.send_signal(signal.SIGSTOP)
        assert stops(rig, drives)
        child.send_signal(signal.SIGCONT)
        wait_until(drives, "the next command")
        child.send_signal(signal.SIGINT)
        assert stops(rig, drives)


def test_the_next_program_stops_what_an_earlier_one_left_running():
    with nxt() as (rig, robot, drives):
        driving = (
            "import os, signal\n"
            "from neurosim.robots.nxt.driver import NXT\n"
            f"robot = NXT(filename={robot[-1]!r})\n"
            "robot.connect(); robot.drive((20, 20)); os.kill(os.getpid(), signal.SIGKILL)"
        )
        finished(process(driving))
        time.sleep(0.2)
        assert drives()  # drive() lasts until the next command
        waiting = (
            "from neurosim.robots.nxt.driver import NXT\n"
            f"robot = NXT(filename={robot[-1]!r}); robot.connect(); input()"
        )
        child = process(waiting, stdin=subprocess.PIPE)
        assert stops(rig, drives)
        child.stdin.write("\n")
        child.stdin.close()
        child.communicate(timeout=PATIENCE)
