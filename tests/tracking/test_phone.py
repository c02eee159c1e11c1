"""A phone as the camera: a program on it sends Motion JPEG over HTTP, at its own rate."""

import http.server
import threading
import time

import cv2
import numpy as np
import pytest
import tracking_scene as scene
from patience import wait_until

from neurosim.base.errors import UserError
from tracking.camera.cameras import open_camera
from tracking.live import LiveTracker
from tracking.markers.tags import Tag

SIZE = (320, 240)
#: Size of a picture. Columns of this many pixels encode its number.
COLUMN = 4
NUMBERS = SIZE[0] // COLUMN


class Phone(http.server.ThreadingHTTPServer):
    """Sends pictures, 25 a second, late by up to 25 ms, as Wi-Fi delivers them."""

    daemon_threads = True

    def __init__(self, picture):
        super().__init__(("127.0.0.1", 0), _Sender)
        self.picture, self.sent, self.ends = picture, {}, threading.Event()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_address[1]}/video"

    def __enter__(self):
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *error):
        self.ends.set()
        self.shutdown()
        self.server_close()


class _Sender(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        rng, number = np.random.default_rng(0), 0
        while not self.server.ends.wait(0.015 + rng.uniform(0, 0.025)):
            data = cv2.imencode(".jpg", self.server.picture(number))[1].tobytes()
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}"
            try:
                self.server.sent[number] = time.monotonic()
                self.wfile.write(head.encode() + b"\r\n\r\n" + data + b"\r\n")
            except OSError:
                return
            number += 1

    def log_message(self, *_):
        pass


def numbered(number):
    picture = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    at = COLUMN * (number % NUMBERS)
    picture[:, at : at + COLUMN] = 255
    return picture


@pytest.mark.slow
def test_frames_before_the_start_do_not_come_late():
    with Phone(numbered) as phone:
        camera, frames = open_camera(phone.url, time.monotonic), []
        assert camera.size == SIZE
        before = len(phone.sent)
        wait_until(lambda: len(phone.sent) > before + 40, "pictures that nobody takes")
        skipped = len(phone.sent)
        assert not camera.stalled
        camera.start(lambda when, frame: frames.append((when, frame)))
        wait_until(lambda: len(frames) > 20, "pictures")
        camera.stop()
        assert not camera.failed
    first = int(frames[0][1].mean(axis=(0, 2)).argmax() // COLUMN)
    # One may have been on its way.
    assert (first - skipped) % NUMBERS in (NUMBERS - 2, NUMBERS - 1, 0, 1, 2)
    assert (np.diff([when for when, _ in frames]) > 0).all()
    assert "source" in camera.describe()


@pytest.mark.slow
def test_a_tag_is_followed_over_the_network():
    tag, seen = Tag(number=2), []

    def picture(number):
        image = scene.background(SIZE)
        scene.paint_tag(image, tag, np.array([60.0 + 2 * number, 120.0]), 0.4, 32.0)
        return scene.finish(image)

    with Phone(picture) as phone:
        camera = open_camera(phone.url, time.monotonic)
        live = LiveTracker(tag, None, time.monotonic, seen.append)
        camera.start(live.take)
        wait_until(lambda: len(seen) > 15, "pictures that were tracked")
        camera.stop()
        live.close()
    assert sum(one.sighting.in_view for one in seen) >= 15
    along = [one.sighting.front[0] for one in seen if one.sighting.in_view]
    assert (np.diff(along) > 0).all()


@pytest.mark.slow
def test_a_phone_that_leaves_has_failed_or_stalled():
    with Phone(numbered) as phone:
        camera, frames = open_camera(phone.url, time.monotonic), []
        camera.start(lambda when, frame: frames.append(when))
        wait_until(lambda: frames, "a picture")
    wait_until(lambda: camera.failed or camera.stalled, "the loss")
    camera.stop()


def test_nobody_sends():
    with pytest.raises(UserError, match="start the program that sends it, in the same network"):
        open_camera("http://127.0.0.1:9/video", time.monotonic)
