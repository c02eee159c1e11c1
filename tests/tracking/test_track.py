import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tracking_scene as scene
from click.testing import CliRunner

from neurosim.base.errors import FileError, UserError
from neurosim.base.files import number, read_csv
from neurosim.cli.track import track as command_line
from tracking.camera.camera_model import CameraModel
from tracking.camera.video import Video
from tracking.datasets.recordings import DEFAULT_MARKERS, Recording, write_markers
from tracking.poses import board_poses, marker_geometry, unwrap
from tracking.track import track, track_video

SIZE, FPS, HEIGHT = (320, 240), 30.0, 0.10
CAMERA = CameraModel(
    SIZE,
    [[280.0, 0, 161.0], [0, 280.0, 118.0], [0, 0, 1]],
    [-0.15, 0.03, 0.0, 0.0, 0.0],
    np.diag([1.0, -1.0, -1.0]) @ cv2.Rodrigues(np.array([0.04, -0.02, 0.01]))[0],
    [0.02, -0.01, 1.6],
)
#: The robot's clock is this much behind the camera's.
OFFSET = -7.25
LAMP = ((0.6, 1.108), (1.516, 1.824))
FRAMES = 150


def pose_at(time):
    """Still until 2.5 s, then in a circle of 0.2 m radius, faster than 90 degrees a second."""
    turned = 1.8 * max(0.0, time - 2.5)
    return np.array([0.2 * np.sin(turned), -0.1 - 0.2 * np.cos(turned), turned])


def frame_at(time, rng, background):
    x, y, theta = pose_at(time)
    cos, sin = np.cos(theta), np.sin(theta)
    ends = [(x + cos * a, y + sin * a, HEIGHT) for a in (0.07, -0.09)]
    front, rear = CAMERA.to_pixels(ends)
    axis = front - rear
    image = background.copy()
    fraction = np.mean(
        [
            any(on <= t < off for on, off in LAMP)
            for t in time + np.linspace(0, 1, 50) / FPS - 0.5 / FPS
        ]
    )
    scene.robot(
        image,
        (front + rear) / 2,
        np.arctan2(-axis[1], axis[0]),
        separation=float(np.hypot(*axis)),
        radius=0.03 * float(np.hypot(*axis)) / 0.16,
        body=(44, 18),
        lamp=fraction,
    )
    return scene.finish(image, rng)


def write_video(path, frames, fourcc="MJPG"):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), FPS, SIZE)
    for frame in frames:
        writer.write(frame)
    writer.release()


@pytest.fixture(scope="module")
def frames():
    rng, background = np.random.default_rng(0), scene.background(SIZE)
    return [frame_at(i / FPS, rng, background) for i in range(FRAMES)]


@pytest.fixture
def recording(tmp_path, frames):
    """Two sessions: one that was killed before its first command, and a whole one."""
    made = Recording.create(tmp_path / "rec", {"robot": {"kind": "none"}})
    CAMERA.write(made.path / "calibration.json")
    made.begin_session(video="video-001.mkv")
    session = made.begin_session(video="video-002.mkv")
    write_video(made.path / "video-002.mkv", frames)
    with made.frame_log() as log:
        for i in range(FRAMES):
            log.append(session, i, i / FPS - OFFSET)
    with made.command_log() as log:
        log.append(1, None, "lamp-on", 0.5, None, None, None)
        for on, off in LAMP:
            log.append(session, None, "lamp-on", on, None, None, None)
            log.append(session, None, "lamp-off", off, None, None, None)
        log.append(session, 1, "command", 2.5, 20, 40, 2.5)
        log.append(session, None, "stop", 5.0, 0, 0, None)
    return made


def test_a_recording_becomes_poses(recording, tmp_path):
    summary = track(recording.path, overlay=tmp_path / "overlay.mp4")
    poses = Recording(recording.path).poses()
    assert (poses.quality > 0.3).all()
    assert set(poses.session) == {2}
    truth = np.array([pose_at(i / FPS) for i in range(FRAMES)])
    assert np.abs(poses.time - np.arange(FRAMES) / FPS).max() < 0.005
    # 6 mm a pixel: a tenth of a pixel on each marker.
    assert np.abs(poses.pose[:, :2] - truth[:, :2]).max() < 0.002
    assert np.abs(poses.pose[:, 2] - truth[:, 2]).max() < 0.015
    assert truth[-1, 2] > np.pi
    assert summary["in_view"] == 1.0
    document = json.loads((recording.path / "tracking.json").read_text())
    assert document["format"] == "neurosim-tracking"
    assert document["sessions"][0] == {"session": 1, "left_out": "no command was sent"}
    assert document["sessions"][1]["clock"]["offset"] == pytest.approx(OFFSET, abs=0.005)
    assert document["sessions"][1]["clock"]["flashes"][0] == pytest.approx(0.6 - OFFSET, abs=0.005)
    with Video(tmp_path / "overlay-002.mp4") as overlay:
        sampled = [frame for _, _, frame in overlay]
    assert len(sampled) == FRAMES


def test_a_session_that_was_killed_before_its_first_frame_is_left_out(recording):
    path = recording.path / "commands.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], "1,0,command,3.0,20,20,1.0", *lines[2:], ""]))
    (recording.path / "video-001.mkv").touch()
    track(recording.path)
    assert set(recording.poses().session) == {2}
    (left_out, _) = json.loads((recording.path / "tracking.json").read_text())["sessions"]
    assert left_out == {"session": 1, "left_out": "nothing was filmed"}
    (recording.path / "video-001.mkv").unlink()
    with pytest.raises(UserError, match=r"video-001.mkv: no such video"):
        track(recording.path)


def test_a_video_cut_in_the_middle_is_read_as_far_as_it_goes(recording):
    path = recording.path / "video-002.mkv"
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    track(recording.path)
    poses = recording.poses()
    assert 80 < len(poses.frame) < 110
    assert np.abs(poses.time - poses.frame / FPS).max() < 0.005


def test_without_frame_times_those_of_the_video_do(recording):
    (recording.path / "frames.csv").unlink()
    track(recording.path)
    poses = recording.poses()
    assert np.abs(poses.time - poses.frame / FPS).max() < 0.005


def test_a_video_from_elsewhere_is_joined(recording, tmp_path):
    (recording.path / "video-002.mkv").rename(tmp_path / "phone.mkv")
    (recording.path / "frames.csv").unlink()
    recording.meta["videos"][1] = None
    recording.save_meta()
    with pytest.raises(UserError, match="session 2 has no video"):
        track(recording.path)
    summary = track(recording.path, videos=[tmp_path / "phone.mkv"])
    assert summary["sessions"][1]["video"] == "phone.mkv"
    with pytest.raises(UserError, match="2 videos are named"):
        track(recording.path, videos=[tmp_path / "phone.mkv"] * 2)


def spoil_video(recording):
    (recording.path / "video-002.mkv").write_bytes(b"")


def remove_video(recording):
    (recording.path / "video-002.mkv").unlink()


def remove_calibration(recording):
    (recording.path / "calibration.json").unlink()


def other_size(recording):
    CameraModel(
        (640, 480), CAMERA.camera_matrix, CAMERA.distortion, CAMERA.rotation, CAMERA.translation
    ).write(recording.path / "calibration.json")


def no_board(recording):
    CameraModel(SIZE, CAMERA.camera_matrix, CAMERA.distortion).write(
        recording.path / "calibration.json"
    )


def empty_scene(recording):
    rng, background = np.random.default_rng(1), scene.background(SIZE)
    write_video(recording.path / "video-002.mkv", [scene.finish(background, rng) for _ in range(5)])


def no_flash(recording):
    path = recording.path / "commands.csv"
    path.write_text("".join(x for x in path.open() if "lamp" not in x))


def flash_not_filmed(recording):
    path = recording.path / "commands.csv"
    text = path.read_text()
    for (on, off), (late, later) in zip(LAMP, ((2.6, 3.9), (4.1, 4.15)), strict=True):
        text = text.replace(f"lamp-on,{on!r}", f"lamp-on,{late}")
        text = text.replace(f"lamp-off,{off!r}", f"lamp-off,{later}")
    lines = sorted(text.splitlines()[2:], key=lambda row: float(row.split(",")[3]))
    path.write_text("\n".join([*text.splitlines()[:2], *lines]) + "\n")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (spoil_video, "video-002.mkv: cannot be opened as a video"),
        (remove_video, "video-002.mkv: no such video"),
        (remove_calibration, "has no calibration.json"),
        (other_size, r"320 x 240 pixels, the calibration was made at 640 x 480"),
        (no_board, "has no points on the board"),
        (empty_scene, "nothing pink and nothing blue was found in any frame"),
        (no_flash, "video-002.mkv: the clock cannot be found from the motion: 2 commands"),
        (flash_not_filmed, "video-002.mkv: no flash found"),
    ],
)
def test_what_is_wrong_is_said_and_nothing_written(recording, spoil, says):
    spoil(recording)
    with pytest.raises(UserError, match=says):
        track(recording.path)
    assert not (recording.path / "poses.csv").exists()
    assert not (recording.path / "tracking.json").exists()


def test_other_colours_than_the_recording_says(recording):
    with pytest.raises(UserError, match="nothing green was found"):
        track(recording.path, colours=("green", "blue"))
    with pytest.raises(UserError, match="both markers are blue"):
        track(recording.path, colours=("blue", "blue"))


def test_bare_video_in_pixels(frames, tmp_path):
    write_video(tmp_path / "bare.avi", frames[70:])
    summary = track_video(tmp_path / "bare.avi", ("pink", "blue"), tmp_path / "out")
    assert summary["units"] == {"u": "pixel", "v": "pixel", "theta": "rad", "time": "s"}
    names = ("frame", "time", "u", "v", "theta", "quality", "front_u", "rear_v")
    table = read_csv(tmp_path / "out" / "poses.csv", dict.fromkeys(names, number))
    x, y, theta = np.transpose([pose_at(i / FPS) for i in range(70, FRAMES)])
    middle = np.stack([x - 0.01 * np.cos(theta), y - 0.01 * np.sin(theta)], axis=-1)
    pixels = CAMERA.to_pixels(np.column_stack([middle, np.full(len(x), HEIGHT)]))
    np.testing.assert_allclose(np.transpose([table["u"], table["v"]]), pixels, atol=0.2)
    # The camera is turned and tilted by a few hundredths of a radian.
    np.testing.assert_allclose(table["theta"], theta, atol=0.1)
    assert table["time"].iloc[30] == pytest.approx(1.0, abs=1e-3)
    document = json.loads((tmp_path / "out" / "tracking.json").read_text())
    assert document["markers"]["front"]["colour"] == "pink"
    with pytest.raises(UserError, match="not empty"):
        track_video(tmp_path / "bare.avi", ("pink", "blue"), tmp_path / "out")


def test_bare_video_in_metres(frames, tmp_path):
    write_video(tmp_path / "bare.avi", frames[120:])
    poses = track_video(tmp_path / "bare.avi", ("pink", "blue"), calibration=CAMERA, height=HEIGHT)[
        "poses"
    ]
    x, y, theta = np.transpose([pose_at(i / FPS) for i in range(120, FRAMES)])
    np.testing.assert_allclose(poses["x"], x - 0.01 * np.cos(theta), atol=0.002)
    np.testing.assert_allclose(poses["y"], y - 0.01 * np.sin(theta), atol=0.002)


def test_a_lens_alone_gives_pixels_without_its_distortion(frames, tmp_path):
    path = tmp_path / "bare.avi"
    write_video(path, frames[120:])
    lens = replace(CAMERA, rotation=None, translation=None, distortion=[-1.5, 0, 0, 0, 0])
    summary = track_video(path, ("pink", "blue"), calibration=lens)
    assert summary["units"]["u"] == "pixel"
    poses = summary["poses"]
    ends = [np.transpose([poses[f"{end}_u"], poses[f"{end}_v"]]) for end in ("front", "rear")]
    middle = np.mean([lens.straighten(end) for end in ends], axis=0)
    result = np.transpose([poses["u"], poses["v"]])
    np.testing.assert_allclose(result, middle, atol=1e-3)
    assert np.abs(result - np.mean(ends, axis=0)).max() > 0.5
    with pytest.raises(UserError, match="a height over the board needs"):
        track_video(path, ("pink", "blue"), calibration=lens, height=HEIGHT)
    with pytest.raises(UserError, match="a height over the board needs"):
        track_video(path, ("pink", "blue"), height=HEIGHT)


def test_markers_as_watch_saves_them(recording, frames, tmp_path):
    path, saved = tmp_path / "bare.avi", tmp_path / "markers.json"
    write_video(path, frames[120:])
    write_markers(saved, {**DEFAULT_MARKERS, "height": HEIGHT})
    CAMERA.write(tmp_path / "calibration.json")
    words = [str(path), "--markers", str(saved), "-o"]
    done = CliRunner().invoke(command_line, [*words, str(tmp_path / "pixels")])
    assert done.exit_code == 0, done.exception
    calibrated = [str(tmp_path / "m"), "--calibration", str(tmp_path / "calibration.json")]
    done = CliRunner().invoke(command_line, words + calibrated)
    assert done.exit_code == 0, done.exception
    table = read_csv(tmp_path / "m" / "poses.csv", {"x": number, "theta": number})
    x, _, theta = np.transpose([pose_at(i / FPS) for i in range(120, FRAMES)])
    # Their height is known from the file.
    np.testing.assert_allclose(table["x"], x - 0.01 * np.cos(theta), atol=0.002)
    # With other positions of the markers on the robot, a recording has other poses.
    shifted = {which: {**DEFAULT_MARKERS[which]} for which in ("front", "rear")}
    shifted["lamp"] = {**DEFAULT_MARKERS["lamp"]}
    for marker in shifted.values():
        marker["x"] += 0.05
    write_markers(saved, {**DEFAULT_MARKERS, **shifted})
    track(recording.path)
    own = recording.poses().pose
    done = CliRunner().invoke(command_line, [str(recording.path), "--markers", str(saved)])
    assert done.exit_code == 0, done.exception
    other = recording.poses().pose
    np.testing.assert_allclose(np.hypot(*(other - own)[:, :2].T), 0.05, atol=1e-4)


@pytest.mark.parametrize(
    "words", [["--sync", "motion"], ["--video", "b.avi"], ["--height", "0.1"]], ids=lambda w: w[0]
)
def test_options_that_do_nothing_for_a_video_file_are_refused(frames, tmp_path, words):
    write_video(tmp_path / "bare.avi", frames[:3])
    arguments = [str(tmp_path / "bare.avi"), "-o", str(tmp_path / "out"), *words]
    done = CliRunner().invoke(command_line, arguments)
    assert isinstance(done.exception, UserError)
    assert words[0].strip("-") in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_a_height_is_no_option_of_a_recording(recording):
    done = CliRunner().invoke(command_line, [str(recording.path), "--height", "0.1"])
    assert isinstance(done.exception, UserError)
    assert "--height is for video files" in str(done.exception)


@pytest.mark.slow
def test_footage_as_a_user_would(shared_data, tmp_path):
    summary = track_video(
        shared_data / "footage" / "marker-pushed.avi",
        ("green", "blue"),
        tmp_path / "out",
        overlay=tmp_path / "seen.mkv",
    )
    assert summary["frames"] == 121
    assert summary["in_view"] == 1.0
    with Video(tmp_path / "seen.mkv") as overlay:
        assert sum(1 for _ in overlay) == 121


def test_colours_taken_from_a_click_on_each_marker(shared_data, tmp_path):
    video = shared_data / "footage" / "field-static.mp4"
    arguments = [str(video), "-o", str(tmp_path / "out"), "--json"]
    clicks = ["--click", "422,178", "--click", "437,177"]
    done = CliRunner().invoke(command_line, arguments + clicks)
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    assert content["in_view"] == 1
    assert content["markers"]["front"]["confidence"] > 0.5
    poses = read_csv(tmp_path / "out" / "poses.csv", {"u": number, "v": number})
    assert np.std([poses["u"], poses["v"]], axis=1).max() < 0.1
    assert abs(np.mean(poses["u"]) - 428) < 2


@pytest.mark.parametrize(
    "clicks",
    [
        ("204,106", "226,381"),  # the blue of one plate and the pink of another
        ("218,364", "469,52"),
        ("204,106", "100,222"),
        ("214,118", "112,232"),
    ],
)
def test_clicks_on_two_robots_take_no_third_pair(shared_data, tmp_path, clicks):
    video = shared_data / "footage" / "marker-pushed.avi"
    front, rear = clicks
    done = CliRunner().invoke(
        command_line, [str(video), "-o", str(tmp_path / "out"), "--click", front, "--click", rear]
    )
    assert isinstance(done.exception, UserError)
    assert "at the clicks" in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_a_recording_of_a_pair_in_doubt_has_no_poses_unless_they_are_wanted(recording, frames):
    still = [frames[70]] * 20 + list(frames[:60]) + [frames[70]] * (FRAMES - 80)
    write_video(recording.path / "video-002.mkv", still)
    done = CliRunner().invoke(command_line, [str(recording.path)])
    assert isinstance(done.exception, UserError)
    assert "the pair never moves" in str(done.exception)
    assert not (recording.path / "poses.csv").exists()
    done = CliRunner().invoke(command_line, [str(recording.path), "--doubtful"])
    assert done.exit_code == 0, done.exception
    assert "the pair never moves" in done.stderr
    poses = recording.poses()
    assert poses.doubtful.tolist() == (poses.quality > 0).tolist()
    assert poses.doubtful.any()


@pytest.mark.slow
def test_names_alone_find_this_cameras_colours_and_wrong_names_are_doubted(shared_data, tmp_path):
    def report_of(colours, video="marker-pushed.avi", *more):
        out = tmp_path / f"{colours}-{video}"
        path = str(shared_data / "footage" / video)
        done = CliRunner().invoke(command_line, [path, "--colours", colours, "-o", str(out), *more])
        markers = None
        if done.exit_code == 0:
            markers = json.loads((out / "tracking.json").read_text())["markers"]
            assert all(seen["rgb"] in done.stdout for seen in markers.values())
        return markers, done

    right, done = report_of("green,blue")
    assert min(seen["confidence"] for seen in right.values()) > 0.9
    assert done.stderr.count("not sure") == 0
    # A ball and another robot's square, a pair that stands still, and markers that belong to no
    # robot.
    for colours, video in (
        ("orange,red", "marker-pushed.avi"),
        ("pink,blue", "marker-pushed.avi"),
        ("green,orange", "field-static.mp4"),
    ):
        refused, done = report_of(colours, video)
        assert refused is None
        assert isinstance(done.exception, UserError)
        assert "may not be the robot's markers" in str(done.exception)
        assert "--click U,V" in str(done.exception)
        assert not (tmp_path / f"{colours}-{video}").exists()
        wrong, done = report_of(colours, video, "--doubtful")
        assert max(seen["confidence"] for seen in wrong.values()) <= 0.5
        assert "may not be the robot's markers" in done.stderr
        assert "--click U,V" in done.stderr
    nothing, done = report_of("green,orange")
    assert nothing is None
    assert isinstance(done.exception, UserError)
    assert not (tmp_path / "green,orange-marker-pushed.avi").exists()


def test_a_video_that_begins_without_the_robot(frames, tmp_path):
    empty = np.full_like(frames[0], 140)
    write_video(tmp_path / "late.avi", [empty] * 40 + list(frames[70:150]))
    summary = track_video(tmp_path / "late.avi", ("pink", "blue"))
    assert summary["in_view"] == pytest.approx(80 / 120, abs=0.04)
    assert min(seen["confidence"] for seen in summary["markers"].values()) > 0.9


@pytest.mark.parametrize(
    ("clicks", "says"),
    [
        (["--click", "422,178"], "give it twice"),
        (["--click", "5,5", "--click", "9,9"], "only grey"),
        (["--click", "9000,5", "--click", "9,9"], "outside of the picture"),
        (["--click", "5,5", "--click", "9,9", "--colours", "red,blue"], "leave out --markers"),
    ],
)
def test_clicks_that_will_not_do(tmp_path, frames, clicks, says):
    write_video(tmp_path / "bare.avi", frames[:3])
    done = CliRunner().invoke(
        command_line, [str(tmp_path / "bare.avi"), "-o", str(tmp_path / "out"), *clicks]
    )
    assert done.exit_code == 1
    assert says in str(done.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("click", ["x,y", "9,nan", "422"])
def test_a_click_is_two_numbers(tmp_path, frames, click):
    write_video(tmp_path / "bare.avi", frames[:3])
    words = [str(tmp_path / "bare.avi"), "-o", str(tmp_path / "out"), "--click", click]
    done = CliRunner().invoke(command_line, words)
    assert done.exit_code == 2
    assert f"'{click}'" in done.stderr
    assert not (tmp_path / "out").exists()


def test_bare_video_that_will_not_do(tmp_path, frames):
    with pytest.raises(FileError, match="no such video"):
        track_video(tmp_path / "absent.avi", ("pink", "blue"), tmp_path / "out")
    write_video(tmp_path / "none.avi", [])
    with pytest.raises(FileError, match=r"none\.avi"):
        track_video(tmp_path / "none.avi", ("pink", "blue"), tmp_path / "out")
    write_video(tmp_path / "bare.avi", frames[:3])
    with pytest.raises(UserError, match="name the overlay video"):
        track_video(tmp_path / "bare.avi", ("pink", "blue"), overlay=tmp_path / "seen.txt")
    before = (tmp_path / "bare.avi").read_bytes()
    with pytest.raises(UserError, match="is the video itself"):
        track_video(tmp_path / "bare.avi", ("pink", "blue"), overlay=tmp_path / "bare.avi")
    write_video(tmp_path / "other.avi", frames[:3])
    with pytest.raises(UserError, match="exists already; name another file"):
        track_video(tmp_path / "other.avi", ("pink", "blue"), overlay=tmp_path / "bare.avi")
    assert (tmp_path / "bare.avi").read_bytes() == before
    with pytest.raises(UserError, match="not a number"):
        track_video(tmp_path / "bare.avi", ("pink", "blue"), height=math.nan)
    done = CliRunner().invoke(
        command_line, [str(tmp_path / "absent.mp4"), "-o", str(tmp_path / "out")]
    )
    assert "no recording or video file" in str(done.exception)
    assert not (tmp_path / "out").exists()
    assert {path.name for path in Path(tmp_path).iterdir()} == {"bare.avi", "none.avi", "other.avi"}


def test_the_rigid_fit_by_hand():
    markers = {
        "front": {"colour": "pink", "x": 0.07, "y": 0.02},
        "rear": {"colour": "blue", "x": -0.09, "y": 0.02},
        "height": 0.0,
        "lamp": {"x": -0.01, "y": 0.06},
    }
    # Facing along +y, axle at (0.5, 0.3): left of the robot is -x.
    ends = np.array([[0.48, 0.37, 0.0], [0.48, 0.21, 0.0]])
    front, rear = CAMERA.to_pixels(ends)[:, None]

    class Seen:
        pass

    Seen.front, Seen.rear = front, rear
    np.testing.assert_allclose(
        board_poses(Seen, markers, CAMERA), [[0.5, 0.3, np.pi / 2]], atol=1e-9
    )
    geometry = marker_geometry(markers, CAMERA)
    assert geometry.separation == pytest.approx(0.16)
    assert geometry.lamp == pytest.approx((0.5, 0.25))


def test_unwrap_across_gaps():
    np.testing.assert_allclose(
        unwrap([3.0, -3.0, np.nan, -2.5]), [3.0, 2 * np.pi - 3, np.nan, 2 * np.pi - 2.5]
    )


def test_a_video_left_early_is_closed(frames, tmp_path):
    write_video(tmp_path / "bare.avi", frames)
    with Video(tmp_path / "bare.avi", times=np.arange(100) / 10) as video:
        assert video.size == SIZE
        for index, time, _ in video:
            assert time == index / 10
            if index == 3:
                break
    with Video(tmp_path / "bare.avi", times=np.arange(100) / 10) as video:
        assert sum(1 for _ in video) == 100
