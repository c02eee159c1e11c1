"""A camera that freezes while a robot is driven: no frames come, or always the same one."""

import http.server
import os
import re
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import cv2
import numpy as np
import pytest
from patience import PATIENCE, wait_until

from neurosim.base.commands import TWO_WHEELS
from neurosim.lab import VirtualKheperaRig, VirtualRig
from neurosim.lab.nxt.world import Pacer
from neurosim.recording.agreement import Agreement, Pictures
from neurosim.recording.commands import Command, FixedCommands, RandomCommands
from neurosim.recording.perimeter import Reckoning
from neurosim.recording.record import RecordSettings, Rig, record
from neurosim.recording.session import SeenToStand
from neurosim.robots.nxt.driver import NXT
from tracking.camera.cameras import Camera, OpenCVCamera
from tracking.datasets.recordings import Recording

SIZE, FPS = (320, 240), 30.0


class Stream(http.server.BaseHTTPRequestHandler):
    """Sends motion JPEG for as long as it runs; then it holds the line and sends nothing."""

    runs = threading.Event()
    ends = threading.Event()

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        rng = np.random.default_rng(0)
        try:
            while not self.ends.is_set():
                if self.runs.is_set():
                    picture = rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
                    data = cv2.imencode(".jpg", picture)[1].tobytes()
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}"
                    self.wfile.write(head.encode() + b"\r\n\r\n" + data + b"\r\n")
                time.sleep(1 / FPS)
        except OSError:
            pass

    def log_message(self, *_):
        pass


@pytest.fixture
def stream():
    Stream.runs.set()
    Stream.ends.clear()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Stream) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/x.mjpg"
        Stream.ends.set()
        server.shutdown()


@pytest.mark.slow
def test_a_camera_that_freezes_has_stalled_and_can_be_left(stream):
    camera, frames = OpenCVCamera(stream, time.monotonic), []
    camera.start(lambda time, frame: frames.append(time))
    wait_until(lambda: len(frames) > 10, "frames")
    assert not camera.failed
    Stream.runs.clear()
    wait_until(lambda: camera.stalled, "the stall")
    camera.stop()  # while OpenCV still waits for a frame
    assert not camera.stalled
    count = len(frames)
    Stream.runs.set()
    camera._thread.join(PATIENCE)
    assert not camera._thread.is_alive()
    assert not camera._capture.isOpened()
    assert len(frames) == count


@contextmanager
def recorded(folder, robot, stream):
    words = ["record", "r", "--robot", "khepera", "--port", robot, "--camera", stream]
    words += ["--commands", "100", "--durations", "3..3", "--stopped", "0", "--max-speed", "20"]
    child = subprocess.Popen(
        [sys.executable, "-X", "faulthandler", "-m", "neurosim", *words],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="no pseudo-terminals")
def test_a_camera_that_freezes_stops_the_robot_in_the_middle_of_a_command(tmp_path, stream):
    with (
        VirtualKheperaRig(0, device="pty", real_time=True) as rig,
        Pacer(rig.lab),
        recorded(tmp_path, rig.address, stream) as child,
    ):
        wait_until(lambda: rig.lab.body._inputs[:2].any() or child.poll() is not None, "a command")
        assert child.poll() is None
        Stream.runs.clear()
        wait_until(lambda: not rig.lab.body._inputs[:2].any(), "the robot's stop")
        _, stderr = child.communicate(timeout=PATIENCE)
    assert child.returncode == 1, stderr
    assert re.search(r"the camera delivered no frame for 0\.5 s or more, and the robot was", stderr)
    assert "continue with --resume" in stderr
    assert "Fatal" not in stderr
    recording = Recording(tmp_path / "r")
    assert recording.meta["complete"] is False
    motor = [line.kind for line in recording.commands().itertuples() if line.is_motor]
    assert motor[-1] == "cut"
    assert motor.count("command") <= 3


# The same picture again and again


class Still(Camera):
    """The lab's camera, whose picture no longer changes from some time of the lab on."""

    waits = True

    def __init__(self, rig, since, noise=0.0):
        self._rig, self._since, self._noise = rig, since, noise
        self._rng = np.random.default_rng(0)
        self.size, self.fps = rig.camera.size, rig.camera.fps
        self.describe, self.stop = rig.camera.describe, rig.camera.stop

    def start(self, deliver):
        kept = None

        def take(time, frame):
            nonlocal kept
            if self._rig.lab.time >= self._since:
                if kept is None:
                    kept = frame.copy()
                noise = self._noise * self._rng.standard_normal(kept.shape)
                frame = np.clip(kept + noise, 0, 255).astype(np.uint8)
            deliver(time, frame)

        self._rig.camera.start(take)


#: Wheels that only slip.
HELD = {"slip_mean": 1.0, "slip_field": 0.0, "slip_draw": 0.0}


def filmed(folder, source, count, *, since=np.inf, noise=0.0, fps=30.0, sensors=False, held=False,
           calibrated=True, seed=2):  # fmt: skip
    """Record in the lab; check that the motors stand afterwards."""
    changes = HELD if held else None
    with VirtualRig(seed, camera_size=SIZE, fps=fps, changes=changes) as rig:
        camera, calibration = Still(rig, since, noise), None
        if calibrated:
            calibration, optics = folder / "calibration.json", rig.camera.optics
            optics.calibration.write(calibration)
        robot = rig.robot
        if not sensors:
            robot = NXT(
                clock=rig.lab.clock, light_left=None, light_right=None, deadline=60.0,
                **rig.address,
            )  # fmt: skip
        settings = RecordSettings(count)
        try:
            record(
                folder / "r", Rig(robot, camera, lab=rig.describe()), source, settings,
                calibration=calibration, say=lambda text: None,
            )  # fmt: skip
        finally:
            outputs = [rig.lab.body.output(port) for port in (1, 2)]
            assert [output.power for output in outputs] == [0, 0]


def stopped_after(folder, begun):
    """Return how long after some time of the lab the session stopped the robot, s."""
    last = [line for line in Recording(folder / "r").commands().itertuples() if line.is_motor][-1]
    assert last.kind == "cut"
    return last.time - begun


ON = FixedCommands([Command((50, 40), 3.0), Command((-40, 40), 3.0), Command((40, 50), 3.0)])


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 3.0])
@pytest.mark.parametrize("fps", [30.0, 2.2])
def test_pictures_that_stay_the_same_stop_a_robot_that_drives(tmp_path, fps, noise):
    with pytest.raises(SeenToStand, match="commanded to move and is seen to stand") as error:
        filmed(tmp_path, ON, 3, since=7.0, noise=noise, fps=fps)
    assert "continue with --resume" in str(error.value)
    recording = Recording(tmp_path / "r")
    assert recording.meta["complete"] is False
    # The first picture that no longer changes comes up to a frame later.
    assert 0 < stopped_after(tmp_path, 7.0) < 1.0 + 1 / fps


@pytest.mark.parametrize("sensors", [False, True])
@pytest.mark.parametrize("fps", [30.0, 2.2])
def test_a_robot_that_is_held_is_stopped(tmp_path, fps, sensors):
    with pytest.raises(SeenToStand):
        filmed(tmp_path, ON, 3, fps=fps, held=True, sensors=sensors)
    sent = next(line for line in Recording(tmp_path / "r").commands().itertuples() if line.is_motor)
    assert stopped_after(tmp_path, sent.time) < (1.3 if sensors else 1.05)


@pytest.mark.slow
def test_a_robot_that_is_commanded_to_stand_may_stand(tmp_path):
    stand = FixedCommands([Command((0, 0), 3.0), Command((8, 10), 2.0), Command((0, 0), 2.0)])
    filmed(tmp_path, stand, 3, since=0.0, noise=3.0, held=True)
    kinds = [line.kind for line in Recording(tmp_path / "r").commands().itertuples()]
    assert "cut" not in kinds


@pytest.mark.slow
@pytest.mark.parametrize("fps", [30.0, 2.2])
def test_a_robot_that_drives_is_not_taken_for_one_that_stands(tmp_path, fps):
    filmed(tmp_path, RandomCommands(seed=4), 12, fps=fps, seed=9)


def test_without_a_calibration_pictures_that_are_the_same_bytes_stop_the_robot(tmp_path):
    with pytest.raises(SeenToStand):
        filmed(tmp_path, ON, 3, since=7.0, sensors=True, calibrated=False)
    assert 0 < stopped_after(tmp_path, 7.0) < 1.3


def drive(commands, delay, gain, fps, noise=0.0, slowest=None):
    """Return when a robot with a delay and a gain is judged to stand; None if it is not.

    Args:
        commands: left and right (percent) and seconds.
        delay: of all observations, s.
        gain: of the speeds.
        fps: observations a second.
        noise: of the observations, m and rad.
        slowest: setting of the agreement.
    """
    takes = TWO_WHEELS.measured(full=0.5, track=0.13)
    result = Agreement(0.5, takes.arm)
    if slowest is not None:
        result.slowest = slowest
    truth = Reckoning()
    rng, begin, pose, time = np.random.default_rng(0), 10.0, np.zeros(3), 8.0
    starts = begin + np.cumsum([0.0, *[seconds for _, _, seconds in commands]])
    for start, (left, right, _) in zip(starts[:-1], commands, strict=True):
        truth.sent(start, gain * takes.twist((left, right)))
    waiting = list(zip(starts[:-1], commands, strict=True))
    while time < starts[-1]:
        time += 1 / fps
        while waiting and waiting[0][0] <= time:
            start, (left, right, _) = waiting.pop(0)
            result.sent(start, takes.twist((left, right)))
        pose = truth.predict(pose, time - 1 / fps - delay, time - delay)[0]
        result.seen(time, pose + noise * rng.standard_normal(3))
        if result.broken():
            return time - begin
    return None


JERKS = [(60, 60, 0.5), (-60, -60, 0.5), (30, -30, 0.6), (0, 0, 0.5), (0, 40, 0.5)]


@pytest.mark.parametrize("gain", [0.4, 1.0, 1.3])
@pytest.mark.parametrize("delay", [0.0, 0.15, 0.3])
@pytest.mark.parametrize("fps", [2.2, 9.0, 30.0])
def test_late_or_slow_is_not_standing(fps, delay, gain):
    assert drive(JERKS, delay, gain, fps, noise=1e-3) is None
    assert drive([(100, -100, 4.0)], delay, gain, fps, noise=1e-3) is None
    assert drive([(20, 20, 4.0)], delay, gain, fps, noise=1e-3) is None


def test_a_slow_camera_is_waited_for_where_light_sensors_guard_the_robot():
    assert drive([(50, 50, 3.0)], 0.55, 1.0, 30.0) is not None
    assert drive([(50, 50, 3.0)], 0.55, 1.0, 30.0, slowest=0.6) is None


@pytest.mark.parametrize("speeds", [(50, 50), (25, -25), (100, -100), (0, 60), (-20, -20)])
def test_standing_is_found_within_a_second_or_little_more(speeds):
    at = drive([(*speeds, 5.0)], 0.1, 0.0, 2.2, noise=1e-3)
    slow = max(map(abs, speeds)) < 25
    assert at < (1.3 if slow else 1.1)
    assert drive([(8, 10, 5.0)], 0.1, 0.0, 2.2) is None  # in the dead band


def test_pictures_differ_or_do_not():
    pictures, frame = Pictures(), np.zeros((4, 4, 3), np.uint8)
    assert pictures.last is None
    pictures.take(1.0, frame)
    frame[0, 0, 0] = 1  # the camera's own memory
    pictures.take(2.0, frame)
    pictures.take(3.0, frame)
    (time, place), first = pictures.last, np.array([1.0, 0.0, 0.0])
    assert time == 3.0
    assert np.array_equal(place - first, [1.0, 0.0, 0.0])
