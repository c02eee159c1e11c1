import pytest

from neurosim.base.errors import FileError, UserError
from neurosim.base.files import write_json
from neurosim.recording.markers import marker_settings
from tracking.datasets.recordings import (
    DEFAULT_MARKERS,
    DEFAULT_TAG,
    KHEPERA_TAG,
    MARKERS_FORMAT,
    VERSION,
    read_markers,
    write_markers,
)

FIRST = {"dictionary": "APRILTAG_36h11", "id": 0}


@pytest.mark.parametrize(
    ("markers", "tag", "means"),
    [
        ("apriltag", None, FIRST),
        ("apriltag", 3, {**FIRST, "id": 3}),
        (None, 3, {**FIRST, "id": 3}),
        ("aruco", None, {"dictionary": "4X4_50", "id": 0}),
        ("apriltag_25H9", 34, {"dictionary": "APRILTAG_25h9", "id": 34}),
    ],
)
def test_a_tag_is_named_by_its_kind_and_number(markers, tag, means):
    assert marker_settings(markers, tag=tag) == {**DEFAULT_TAG, "tag": means}


def test_a_tag_on_a_khepera_is_smaller():
    assert marker_settings("apriltag", "virtual-khepera") == {**KHEPERA_TAG, "tag": FIRST}


def test_without_a_word_they_are_colours():
    assert marker_settings() == DEFAULT_MARKERS
    assert marker_settings("green,blue")["front"] == {**DEFAULT_MARKERS["front"], "colour": "green"}


def test_what_a_recording_says_stays_unless_it_is_named(tmp_path):
    placed = {"front": {"x": 0.03, "y": 0.01}, "rear": {"x": -0.03, "y": 0.01}, "height": 0.2}
    tagged = {**placed, "tag": {"dictionary": "4X4_50", "id": 4}}
    assert marker_settings(recorded=tagged) == tagged
    assert marker_settings(tag=5, recorded=tagged) == {
        **placed, "tag": {"dictionary": "4X4_50", "id": 5}
    }  # fmt: skip
    assert marker_settings("apriltag", recorded=tagged) == {**placed, "tag": FIRST}
    assert marker_settings("pink,blue", recorded=tagged) == DEFAULT_MARKERS
    coloured = {
        **placed,
        "front": {**placed["front"], "colour": "red"},
        "rear": {**placed["rear"], "colour": "cyan"},
    }
    assert marker_settings(recorded=coloured) == coloured
    assert marker_settings("red,blue", recorded=coloured)["rear"] == {
        **placed["rear"], "colour": "blue"
    }  # fmt: skip
    assert marker_settings(tag=2, recorded=coloured)["tag"]["id"] == 2


def test_a_file_says_where_the_tag_is(tmp_path):
    path = tmp_path / "markers.json"
    wanted = {**DEFAULT_TAG, "tag": {"dictionary": "5X5_100", "id": 9}}
    write_markers(path, wanted)
    assert read_markers(path) == wanted
    assert marker_settings(str(path)) == wanted
    assert marker_settings(str(path), tag=10)["tag"]["id"] == 10


@pytest.mark.parametrize(
    ("markers", "tag", "says"),
    [
        ("pink", None, "'pink': expected two different colours.* or a kind of tag"),
        ("pink,blue", 3, "--tag is the number of a tag, but the robot's markers are colours"),
        ("aruco", 50, "no tag 50: its tags are 0 to 49"),
    ],
)
def test_what_does_not_go_together(markers, tag, says):
    with pytest.raises(UserError, match=says):
        marker_settings(markers, tag=tag)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"tag": {"dictionary": "QR", "id": 0}}, "no dictionary of tags 'QR'"),
        ({"tag": {"dictionary": "4X4_50", "id": -1}}, r"tag\.id"),
        ({"front": {"x": 0, "y": 0}}, r"front\.colour.*name a colour, or a tag"),
    ],
)
def test_files_of_markers_that_are_not_one(tmp_path, changes, says):
    path = tmp_path / "markers.json"
    write_json(path, MARKERS_FORMAT, VERSION, {**DEFAULT_MARKERS, **changes})
    with pytest.raises((FileError, UserError), match=says):
        marker_settings(str(path))
