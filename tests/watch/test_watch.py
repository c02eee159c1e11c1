"""The command itself: how it begins and how it ends."""

import json
import os
import signal
import sys
from contextlib import contextmanager
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
import tracking_scene as scene
from patience import PATIENCE, wait_until
from processes import started

from neurosim.base.errors import UserError
from neurosim.cli.main import main
from tracking.camera.cameras import OpenCVCamera, VideoCamera
from tracking.camera.video import Video
from tracking.markers.tags import Tag


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "robot.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, scene.SIZE)
    for turn in np.linspace(0, 1, 12):
        image = scene.background()
        scene.robot(image, np.array([300.0, 200.0]), turn)
        writer.write(scene.finish(image))
    writer.release()
    return path


@pytest.fixture
def two_tags(tmp_path):
    path = tmp_path / "tags.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, scene.SIZE)
    for number in range(12):
        image = scene.background()
        for tag, x in ((3, 200.0 + number), (8, 400.0)):
            scene.paint_tag(image, Tag(number=tag), np.array([x, 200.0]), 0.3, 40.0)
        writer.write(scene.finish(image))
    writer.release()
    return path


@contextmanager
def watching(*words, cwd):
    child = started("watch", "--json", *words, cwd=cwd)
    try:
        message = ""
        while not message.rstrip().endswith("}"):
            line = child.stdout.readline()
            assert line, child.stderr.read()
            message += line
        yield child, json.loads(message)["url"]
    finally:
        child.kill()
        child.communicate()


def state_of(url, after=0):
    with urlopen(f"{url}picture?after={after}", timeout=PATIENCE) as reply:
        return json.loads(reply.headers["Neurosim-State"])


@pytest.mark.slow
def test_of_several_tags_one_is_shown_and_the_others_are_named(two_tags, tmp_path):
    words = ["--camera", two_tags.name, "--markers", "apriltag", "--tag", "8"]
    with watching(*words, cwd=tmp_path) as (_, url):
        states = [state_of(url)]
        wait_until(lambda: states.append(state_of(url)) or states[-1]["others"], "a picture")
        state = states[-1]
        assert state["tag"] == "tag 8 of APRILTAG_36h11"
        assert state["others"] == [3]
        assert (np.array(state["front"]) + state["rear"]) / 2 == pytest.approx([400, 200], abs=1)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise there")
def test_a_video_is_watched_over_and_over_until_ctrl_c(video, tmp_path):
    with watching("--camera", video.name, cwd=tmp_path) as (child, url):
        states = [state_of(url)]

        def newer():
            states.append(state_of(url, states[-1]["number"]))
            return states[-1]

        for _ in range(2):
            wait_until(lambda: newer()["time"] < states[-2]["time"], "the video's beginning")
            wait_until(lambda: newer()["in_view"], "the robot")
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=PATIENCE) == 0
        assert child.stderr.read() == ""
    assert [path.name for path in tmp_path.iterdir()] == [video.name]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent otherwise there")
def test_the_labs_camera_shows_a_robot_that_drives_and_films_it(tmp_path):
    words = ["--camera", "lab", "--camera-size", "320x240", "--film", "film.avi"]
    with watching(*words, cwd=tmp_path) as (child, url):
        state = {"number": 0}

        def front():
            state.update(state_of(url, state["number"]))
            return state["in_view"] and state["front"]

        first = wait_until(front, "a robot in the picture")
        assert state["label"] == "virtual lab"
        wait_until(lambda: np.hypot(*np.subtract(front() or first, first)) >= 5, "its drive")
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=PATIENCE) == 0
        stderr = child.stderr.read()
    with Video(tmp_path / "film.avi") as film:
        assert film.size == (320, 240)
        frames = sum(1 for _ in film)
    assert stderr == f"film.avi: {frames} frames. Next: neurosim track film.avi -o POSES\n"


@pytest.mark.slow
def test_a_camera_that_stops_is_told_on_the_page_and_in_the_terminal(video, monkeypatch, capsys):
    # OpenCV opens a video as it opens a camera; at its end the camera is gone.
    monkeypatch.setattr(
        "tracking.camera.cameras.VideoCamera", lambda path: OpenCVCamera(path, lambda: 0.0)
    )
    ended = []
    monkeypatch.setattr("neurosim.watch.Viewer.end", lambda self, why: ended.append(why))
    monkeypatch.setattr(sys, "argv", ["neurosim", "watch", "--camera", str(video)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 1
    message = capsys.readouterr().err
    assert message == f"neurosim: {ended[0]}\n"
    assert "stopped delivering" in message


def refused(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["neurosim", "watch", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        main()
    out, message = capsys.readouterr()
    assert stop.value.code == 1
    assert out == ""
    assert message.startswith("neurosim: ")
    assert message.count("\n") == 1
    return message


def test_what_cannot_be_watched(video, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert "'97'" in refused(monkeypatch, capsys, "--camera", 97).replace("97", "'97'", 1)
    assert "nowhere.mp4" in refused(monkeypatch, capsys, "--camera", "nowhere.mp4")
    (tmp_path / "words.mp4").write_text("no video")
    assert "words.mp4" in refused(monkeypatch, capsys, "--camera", "words.mp4")
    assert "mauve" in refused(monkeypatch, capsys, "--camera", video, "--markers", "mauve,blue")
    assert "is a video file" in refused(monkeypatch, capsys, "--camera", video, "--film", "a.avi")
    (tmp_path / "c.json").write_text("{}")
    assert "c.json" in refused(monkeypatch, capsys, "--camera", video, "--calibration", "c.json")
    (tmp_path / "m.json").write_text('{"format": "neurosim-markers", "version": 1, "front": {}}')
    assert "m.json" in refused(monkeypatch, capsys, "--camera", video, "--markers", "m.json")
    assert "ends in .json" in refused(monkeypatch, capsys, "--camera", video, "--place", "arena")
    assert "c.json" in refused(monkeypatch, capsys, "--camera", video, "--place", "c.json")


def test_a_port_that_is_taken(video, tmp_path, monkeypatch, capsys):
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert str(port) in refused(monkeypatch, capsys, "--camera", video, "--port", port)


def test_a_video_that_goes_away_is_a_camera_that_failed(video):
    camera = VideoCamera(video)
    seen = []

    def take(time_, frame):
        seen.append(time_)
        if video.exists():
            video.unlink()

    camera.start(take)
    wait_until(lambda: camera.failed, "the end of the video")
    camera.stop()
    assert len(seen) == 12
    assert np.all(np.diff(seen) > 0)


def test_a_video_that_begins_again_has_its_own_times_again(video):
    camera = VideoCamera(video)
    seen = []
    camera.start(lambda time_, frame: seen.append(time_))
    wait_until(lambda: len(seen) >= 30, "the third beginning")
    camera.stop()
    assert not camera.failed
    assert seen[12:24] == seen[:12] == sorted(seen[:12])


def test_what_is_no_video_is_no_camera(tmp_path):
    with pytest.raises(UserError, match="no such video"):
        VideoCamera(tmp_path / "absent.avi")
