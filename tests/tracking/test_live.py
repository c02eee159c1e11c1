import threading

import numpy as np
import pytest
import tracking_scene as scene
from patience import PATIENCE, wait_until

from neurosim.base.errors import UserError
from tracking.camera.cameras import Film, OpenCVCamera, VideoSink
from tracking.camera.video import Video
from tracking.live import WAITING, LiveTracker
from tracking.markers.colours import parse_colour
from tracking.markers.tracker import Tracker

COLOURS = parse_colour("pink"), parse_colour("blue")


def frames(count):
    rng = np.random.default_rng(5)
    for number in range(count):
        image = scene.background()
        scene.robot(image, np.array([200.0 + 3 * number, 200.0]), 0.05 * number)
        yield number / 30, scene.finish(image, rng)


def test_a_camera_that_waits_is_tracked_frame_by_frame():
    seen = []
    live = LiveTracker(COLOURS, None, lambda: 7.5, seen.append, waits=True)
    slow = Tracker(*COLOURS)
    for number, (when, frame) in enumerate(frames(6)):
        live.take(when, frame)
        expected = slow.update(frame, when)
        assert seen[-1].index == number
        assert (seen[-1].time, seen[-1].arrived) == (when, 7.5)
        assert seen[-1].frame is frame
        assert np.array_equal(seen[-1].sighting.front, expected.front)
        assert seen[-1].sighting.quality == expected.quality > 0
    live.close()
    assert live.passed_over == 0


def test_tracking_begins_anew_where_a_video_begins_again():
    seen = []
    live = LiveTracker(COLOURS, None, lambda: 0.0, seen.append, waits=True)
    film = list(frames(20))
    for when, frame in film + film[5:10]:  # back by 15 frames at the seam: 45 pixels, 0.7 rad
        live.take(when, frame)
    live.close()
    assert all(each.sighting.in_view for each in seen)
    tracker = Tracker(*COLOURS)
    again = [tracker.update(frame, when) for when, frame in film[5:10]]
    assert [each.sighting.quality for each in seen[20:]] == [each.quality for each in again]


def test_a_slow_tracker_passes_frames_over_and_never_makes_the_camera_wait():
    seen, go, busy = [], threading.Event(), threading.Event()

    def slow(what):
        busy.set()
        assert go.wait(PATIENCE)
        seen.append(what.index)

    live = LiveTracker(COLOURS, None, lambda: 0.0, slow)
    film = list(frames(10))
    live.take(*film[0])
    assert busy.wait(PATIENCE)
    for when, frame in film[1:]:
        live.take(when, frame)  # returns although nothing is tracked
    go.set()
    live.close()
    # The frame whose tracking had begun, and the newest.
    assert seen == [0, *range(10 - WAITING, 10)]
    assert live.passed_over == 9 - WAITING


def test_what_goes_wrong_while_tracking_is_raised_at_the_end():
    def wrong(what):
        raise ValueError("wrong")

    live = LiveTracker(COLOURS, None, lambda: 0.0, wrong)
    live.take(*next(frames(1)))
    with pytest.raises(ValueError, match="wrong"):
        live.close()
    assert live.failed


class FullDisk:
    def append(self, *values):
        raise OSError("No space left on device")


def test_a_video_that_could_not_be_written_is_told_of_at_the_end(tmp_path):
    sink = VideoSink(tmp_path / "video.avi", FullDisk(), 1, scene.SIZE, 30.0)
    sink.write(*next(frames(1)))
    wait_until(lambda: sink._error, "the full disk")
    with pytest.raises(UserError, match="No space left"):
        sink.close()


def test_a_camera_stops_where_its_frames_cannot_be_taken(tmp_path):
    class Log:
        def append(self, *values):
            pass

    sink = VideoSink(tmp_path / "video.avi", Log(), 1, scene.SIZE, 30.0)
    for when, frame in frames(5):
        sink.write(when, frame)
    assert sink.close() == 5
    taken = []

    def refuse(when, frame):
        taken.append(when)
        raise UserError("the disk is full")

    camera = OpenCVCamera(str(tmp_path / "video.avi"), lambda: 0.0)
    camera.start(refuse)
    wait_until(lambda: camera.failed, "the end of the camera")
    camera.stop()
    assert taken == [0.0]


@pytest.mark.slow
def test_a_film_keeps_the_time_of_a_camera_that_does_not_keep_its_rate(tmp_path):
    rng = np.random.default_rng(0)
    # 20 frames a second, uneven, and half a second without any.
    times = 5.0 + np.cumsum(0.05 + rng.uniform(-0.01, 0.01, 80))
    times[40:] += 0.5
    film = Film(tmp_path / "film.avi", scene.SIZE)
    for number, when in enumerate(times):
        frame = np.zeros((scene.SIZE[1], scene.SIZE[0], 3), np.uint8)
        frame[:, 8 * number : 8 * number + 8] = 255  # which one it is
        film.take(when, frame)
    count = film.close()
    with Video(tmp_path / "film.avi") as video:
        shown = [(when, int(frame.mean(axis=(0, 2)).argmax() // 8)) for _, when, frame in video]
    assert len(shown) == count
    for when, number in shown:
        # The newest frame, to half of the time between two.
        newest = np.searchsorted(times - times[0], when + 1e-6) - 1
        assert newest <= number + 1
        assert times[number] - times[0] < when + 0.03
    assert shown[-1][0] == pytest.approx(times[-1] - times[0], abs=0.1)
    with pytest.raises(UserError, match="exists already"):
        Film(tmp_path / "film.avi", scene.SIZE)
    with pytest.raises(UserError, match=r"name an \.avi"):
        Film(tmp_path / "film.mp4", scene.SIZE)
    assert Film(tmp_path / "nothing.avi", scene.SIZE).close() == 0
    assert not (tmp_path / "nothing.avi").exists()
