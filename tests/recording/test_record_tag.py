"""A robot of the lab that carries a printed tag: tracked live, and tracked again from its video."""

import shutil

import numpy as np
import pytest
import tracking_scene as scene
from click.testing import CliRunner

from neurosim.base.errors import UserError
from neurosim.base.files import number, read_csv
from neurosim.cli.track import track as command
from neurosim.lab import read_truth
from neurosim.lab.khepera.camera import SCALE
from neurosim.recording.commands import Command, FixedCommands
from neurosim.recording.markers import marker_settings
from neurosim.recording.record import RecordSettings, record
from neurosim.trials.rig import Setup, open_rig
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import Recording, write_markers
from tracking.markers.sought import sought, tracker_of
from tracking.markers.tags import KINDS, Tag
from tracking.poses import marker_geometry, marker_poses, too_small
from tracking.track import track_video

DRIVES = FixedCommands([Command((40, 60), 0.7), Command((60, 30), 0.7), Command((-50, -50), 0.5)])


def recorded(folder, another=None):
    """Record tag 5 with ``another`` robot in view; return the recording and the messages."""
    markers, messages = marker_settings("apriltag", "virtual", 5), []
    with open_rig("virtual", {}, Setup(markers=markers)) as rig:
        if another is not None:
            start = rig.camera.start
            rig.camera.start = lambda take: start(
                lambda time, frame: take(time, another(time, frame.copy()))
            )
        optics = rig.camera.optics
        optics.calibration.write(folder / "calibration.json")
        made = record(
            folder / "r", rig, DRIVES, RecordSettings(3, markers=markers),
            calibration=folder / "calibration.json", say=messages.append,
        )  # fmt: skip
    return made, messages


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    made, messages = recorded(tmp_path_factory.mktemp("tag"))
    assert messages == []
    return made


def misses(recording):
    poses, truth = recording.poses(), read_truth(recording.path)
    assert (poses.quality > 0.5).all()
    return poses.pose - truth.pose_at(poses.time)


@pytest.mark.slow
def test_its_poses_are_where_it_was(kept):
    off = misses(kept)
    # The clock is known to two milliseconds, in which it drives a millimetre.
    assert np.sqrt((off[:, :2] ** 2).mean()) < 2e-3
    assert np.degrees(np.sqrt((off[:, 2] ** 2).mean())) < 0.6
    assert kept.meta["markers"]["tag"] == {"dictionary": "APRILTAG_36h11", "id": 5}
    (session,) = kept.tracked_sessions()
    assert session["markers"]["tag"]["id"] == 5
    # The flashes of the lamp next to it were seen.
    assert session["clock"]["flashes"]
    assert session["clock"]["residual"] < 0.012


@pytest.mark.slow
def test_of_several_robots_the_right_one_is_followed(kept, tmp_path):
    """Another one with a tag of its own drives to and fro across the picture, close by."""

    def at(time):
        return np.array([320.0 + 200.0 * np.sin(1.5 * time), 190.0]), 0.4 * time

    def another(time, frame):
        scene.paint_tag(frame, Tag(number=9), *at(time), 22.0)
        return frame

    made, messages = recorded(tmp_path, another)
    assert messages == ["other tags are in view, and ignored: 9"]
    off = misses(made)
    assert np.sqrt((off[:, :2] ** 2).mean()) < 2e-3
    assert np.degrees(np.sqrt((off[:, 2] ** 2).mean())) < 0.6
    # The same video shows the path of the other robot, too.
    (video,) = made.meta["videos"]
    track_video(made.path / video, Tag(number=9), out=tmp_path / "other")
    rows = read_csv(tmp_path / "other" / "poses.csv", dict.fromkeys("uv", number))
    assert rows["v"].to_numpy() == pytest.approx(190.0, abs=1.0)
    assert np.ptp(rows["u"]) > 150.0


@pytest.mark.slow
def test_the_video_says_the_same_once_more(kept, tmp_path):
    shutil.copytree(kept.path, tmp_path / "again")
    done = CliRunner().invoke(command, [str(tmp_path / "again")])
    assert done.exit_code == 0, done.exception
    assert "tag 5 of APRILTAG_36h11" in done.stdout
    live, again = kept.poses().pose, Recording(tmp_path / "again").poses().pose
    assert np.abs(live - again)[:, :2].max() < 1e-3


@pytest.mark.slow
def test_another_tag_is_not_there(kept, tmp_path):
    shutil.copytree(kept.path, tmp_path / "again")
    done = CliRunner().invoke(command, [str(tmp_path / "again"), "--tag", "6"])
    assert isinstance(done.exception, UserError)
    assert "tag 6 of APRILTAG_36h11 was not found in any frame" in str(done.exception)
    assert "of its dictionary 5 are in view: name one with --tag" in str(done.exception)


@pytest.mark.parametrize("robot", ["virtual", "virtual-khepera"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_lab_shows_the_tag_where_the_markers_say_it_is(robot, kind):
    markers = marker_settings(kind, robot, 2)
    with open_rig(robot, {}, Setup(markers=markers)) as rig:
        scale = SCALE if robot == "virtual-khepera" else 1.0
        optics, pose = rig.camera.optics, np.array([0.4, -0.3, 0.8])
        model = CameraModel(
            rig.camera.size, optics.matrix, optics.distortion, optics.rotation,
            scale * optics.translation,
        )  # fmt: skip
        frame = rig.camera.render(pose)
    tracker = tracker_of(sought(markers), marker_geometry(markers, model))
    seen = tracker.update(frame, 0.0)
    (result,) = marker_poses(seen.front[None], seen.rear[None], markers, model)
    np.testing.assert_allclose(result[:2], scale * pose[:2], atol=4e-4 * scale)
    assert result[2] == pytest.approx(pose[2], abs=0.005)


def test_a_tag_of_the_lab_lies_on_the_robot(tmp_path):
    away = {"front": {"x": 0.1, "y": 0.0}, "rear": {"x": 0.0, "y": 0.0}, "height": 0.1}
    write_markers(tmp_path / "m.json", {**away, "tag": {"dictionary": "4X4_50", "id": 0}})
    markers = marker_settings(str(tmp_path / "m.json"), "virtual")
    with (
        pytest.raises(
            UserError, match="a tag of 100 mm at this position does not fit on the virtual"
        ),
        open_rig("virtual", {}, Setup(markers=markers)),
    ):
        pass


@pytest.mark.parametrize(("size", "width"), [((640, 480), None), ((320, 240), "1.1 pixels")])
def test_a_tag_that_is_too_small_in_the_picture(size, width):
    tag, colours = marker_settings("apriltag", "virtual"), marker_settings(None, "virtual")
    with open_rig("virtual", {}, Setup(size=size)) as rig:
        optics = rig.camera.optics
        seen_by = optics.calibration
    assert too_small(colours, seen_by) is None
    message = too_small(tag, seen_by)
    assert message is None if width is None else f"a cell of the tag is {width} wide" in message


@pytest.mark.slow
def test_a_tag_that_is_too_small_in_a_video(kept, tmp_path, monkeypatch):
    folder = tmp_path / "r"
    shutil.copytree(kept.path, folder)
    done = CliRunner().invoke(command, [str(folder)], catch_exceptions=False)
    assert "a cell of the tag" not in done.stderr
    monkeypatch.setattr("tracking.poses.SMALLEST_CELL", 9.0)  # pixels, more than in this camera
    done = CliRunner().invoke(command, [str(folder)], catch_exceptions=False)
    assert (done.exit_code, done.stderr.count("session 1: a cell of the tag is ")) == (0, 1)
