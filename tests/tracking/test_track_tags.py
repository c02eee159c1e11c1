"""Videos in which robots carry tags, as a user tracks them."""

import csv
import json

import cv2
import numpy as np
import pytest
import tracking_scene as scene
from click.testing import CliRunner

from neurosim.base.errors import UserError
from neurosim.cli.track import track as command
from tracking.camera.video import Video
from tracking.datasets.recordings import write_markers
from tracking.markers.tags import Tag
from tracking.track import track_video

SIZE = (320, 240)
FRAMES = 30


def place(number, frame):
    """Middle and heading of a robot: three on lanes of their own."""
    return np.array([60.0 + 5 * frame, 50.0 + 22 * number]), 0.13 + 0.02 * frame * number


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Tags 1, 3 and 6 drive side by side; 6 comes into view after two thirds of it."""
    path = tmp_path_factory.mktemp("video") / "three.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, SIZE)
    rng = np.random.default_rng(0)
    for frame in range(FRAMES):
        image = scene.background(SIZE)
        for number in (1, 3) if frame < 12 else (1, 3, 6):
            scene.paint_tag(image, Tag(number=number), *place(number, frame), 26.0)
        writer.write(scene.finish(image, rng))
    writer.release()
    return path


def run(*words):
    return CliRunner().invoke(command, [str(word) for word in words])


def rows_of(folder):
    with (folder / "poses.csv").open() as file:
        return [{k: float(v or "nan") for k, v in row.items()} for row in csv.DictReader(file)]


def check(folder, number, begin=0):
    rows = rows_of(folder)
    assert len(rows) == FRAMES
    assert all(np.isnan(row["u"]) for row in rows[:begin])
    for frame, row in enumerate(rows[begin:], start=begin):
        middle, heading = place(number, frame)
        assert (row["u"], row["v"]) == pytest.approx(tuple(middle), abs=0.15)
        assert row["theta"] == pytest.approx(heading, abs=0.01)
        assert row["doubtful"] == 0


def test_one_of_several(video, tmp_path):
    done = run(video, "--markers", "apriltag", "--tag", "3", "-o", tmp_path / "out",
               "--overlay", tmp_path / "seen.avi")  # fmt: skip
    assert done.exit_code == 0, done.exception
    check(tmp_path / "out", 3)
    assert "found in 100.0 %" in done.stdout
    assert "tag 3 of APRILTAG_36h11, others in view: 1" in done.stdout
    content = json.loads((tmp_path / "out" / "tracking.json").read_text())
    assert content["markers"] == {"tag": {"dictionary": "APRILTAG_36h11", "id": 3, "others": [1]}}
    with Video(tmp_path / "seen.avi") as overlay:
        assert sum(1 for _ in overlay) == FRAMES


def test_each_of_several_into_a_folder_of_its_own(video, tmp_path):
    done = run(video, "--markers", "apriltag", "--all-tags", "-o", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.exception
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["tag-1", "tag-3", "tag-6"]
    for number, begin in ((1, 0), (3, 0), (6, 12)):
        check(tmp_path / "out" / f"tag-{number}", number, begin)
    content = json.loads(done.stdout)["tags"]
    assert [each["markers"]["tag"]["id"] for each in content] == [1, 3, 6]


def test_a_file_names_the_tag_and_its_size_counts_only_in_metres(video, tmp_path):
    assert track_video(video, Tag(number=1))["in_view"] == 1.0
    ends = {"front": {"x": 0.013, "y": 0.0}, "rear": {"x": -0.013, "y": 0.0}, "height": 0.0}
    tag = {"dictionary": "APRILTAG_36h11", "id": 1}
    write_markers(tmp_path / "markers.json", {**ends, "tag": tag})
    done = run(video, "--markers", tmp_path / "markers.json", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.exception
    check(tmp_path / "out", 1)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--markers", "apriltag"], "tag 0 of APRILTAG_36h11 was not found in any frame; of its "
         "dictionary 1, 3, 6 are in view: name one with --tag"),
        (["--markers", "5X5_50", "--all-tags"], "no tag of 5X5_50 was found in any frame"),
        (["--all-tags", "--tag", "3"], "and no --tag"),
        (["--all-tags", "--markers", "pink,blue"], "give --markers apriltag or aruco"),
        (["--tag", "3", "--click", "5,5", "--click", "9,9"], "leave out --markers"),
        (["--tag", "587"], "no tag 587"),
    ],
)  # fmt: skip
def test_what_cannot_be_tracked_is_said_in_a_sentence(video, tmp_path, words, says):
    done = run(video, "-o", tmp_path / "out", *words)
    assert isinstance(done.exception, UserError)
    assert says in str(done.exception)
    assert not (tmp_path / "out").exists()
