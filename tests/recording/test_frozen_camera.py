"""A camera that freezes while a robot is driven: a stream over HTTP, and a robot in real time."""

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

from neurosim.lab import VirtualKheperaRig
from neurosim.lab.nxt.world import Pacer
from tracking.camera.cameras import OpenCVCamera
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
        _, said = child.communicate(timeout=PATIENCE)
    assert child.returncode == 1, said
    assert re.search(r"the camera delivered no frame for 0\.5 s or more, and the robot was", said)
    assert "go on with --resume" in said
    assert "Fatal" not in said
    recording = Recording(tmp_path / "r")
    assert recording.meta["complete"] is False
    motor = [line.kind for line in recording.commands().itertuples() if line.is_motor]
    assert motor[-1] == "cut"
    assert motor.count("command") <= 3
