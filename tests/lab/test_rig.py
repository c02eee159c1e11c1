"""The whole virtual robot: the interface over a socket, in real time, and with faults."""

import os
import subprocess
import sys

import numpy as np
import pytest
from patience import PATIENCE, wait_until
from processes import finished, process

from neurosim.lab import Pacer, VirtualRig
from neurosim.lab.nxt import world
from neurosim.recording.commands import RandomCommands
from neurosim.recording.record import RecordSettings, Rig, record


def recorded(folder, **options):
    with VirtualRig(1, noise_seed=3, camera=False, **options) as rig:
        record(folder, Rig(rig.robot), RandomCommands(seed=3), RecordSettings(12))
        return rig.lab.body.pose.copy()


def test_a_socket_does_what_a_device_file_does(tmp_path):
    np.testing.assert_array_equal(
        recorded(tmp_path / "pty"), recorded(tmp_path / "socket", device="socket")
    )
    assert (tmp_path / "pty" / "commands.csv").read_bytes() == (
        tmp_path / "socket" / "commands.csv"
    ).read_bytes()


def test_other_noise_leads_elsewhere(tmp_path):
    with VirtualRig(1, noise_seed=4, camera=False) as rig:
        record(tmp_path / "r", Rig(rig.robot), RandomCommands(seed=3), RecordSettings(12))
        assert np.abs(rig.lab.body.pose - recorded(tmp_path / "same"))[:2].max() > 1e-3


@pytest.mark.parametrize("device", ["pty", "socket"])
def test_nxt_test_passes_in_real_time(device):
    with VirtualRig(0, camera=False, device=device, real_time=True) as rig, Pacer(rig.lab):
        if device == "pty":
            where = ["--backend", "devfile", "--filename", rig.address["filename"]]
        else:
            where = ["--backend", "socket", "--server-host", "127.0.0.1"]
            where += ["--server-port", str(rig.address["server_port"])]
        done = subprocess.run(
            [sys.executable, "-m", "nxt.command.test", *where],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
        assert done.returncode == 0, done.stderr
        assert "NXT brick name: lab-0" in done.stdout
        assert rig.alive


class Wall:
    """A wall clock that is set by hand."""

    def __init__(self):
        self.time, self.looks = 100.0, 0

    def perf_counter(self):
        self.looks += 1
        return self.time


def test_in_real_time_a_second_is_a_second(monkeypatch):
    wall = Wall()
    monkeypatch.setattr(world, "time", wall)
    with VirtualRig(0, camera=False, real_time=True) as rig, Pacer(rig.lab):
        began = rig.lab.clock.now()
        wait_until(lambda: wall.looks > 1, "the pacer")
        assert rig.lab.clock.now() == began
        wall.time += 1.0
        rig.lab.clock.sleep_until(began + 1.0)  # in steps of the pacer
        looks = wall.looks
        wait_until(lambda: wall.looks > looks + 2, "the pacer")
        assert rig.lab.clock.now() == pytest.approx(began + 1.0)


def test_what_breaks_inside_the_lab_is_told_and_not_a_lost_link(tmp_path):
    class DiskFull(OSError):
        pass

    rig = VirtualRig(0, fps=10)

    def on_frame(when, frame):
        raise DiskFull(28, "No space left on device")

    def drive():
        with rig, rig.robot as robot:
            rig.camera.start(on_frame)
            for _ in range(20):
                robot.drive((10, 10))

    with pytest.raises(DiskFull):
        drive()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no controlling terminals")
@pytest.mark.slow
def test_a_line_that_closes_does_not_hang_up_a_notebook(tmp_path):
    """A session leader without a terminal, such as a notebook's kernel, survives."""
    program = (
        "from neurosim.lab import VirtualRig\n"
        "with VirtualRig(0, camera=False) as rig, rig.robot as robot:\n"
        "    robot.drive((10, 10))\n"
        "print('alive')\n"
    )
    done = finished(process(program, session=True))
    assert (done.returncode, done.stdout) == (0, "alive\n"), done.stderr
