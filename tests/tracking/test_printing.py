"""The page to print, seen as a camera would see it."""

import io
import math
import re

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from neurosim.base.errors import UserError
from neurosim.cli._common import COLOUR_NAMES
from neurosim.cli.print_page import print_page as command
from tracking.camera.targets import Chessboard
from tracking.markers.colours import NAMED, parse_colour
from tracking.markers.markers import Picture
from tracking.printing import PAPER, PageSettings, draw_page, write_page

PER_MM = 4


def picture_of(settings):
    data = io.BytesIO()
    draw_page(settings).savefig(data, format="png", dpi=25.4 * PER_MM)
    return cv2.imdecode(np.frombuffer(data.getvalue(), np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        PageSettings(),
        PageSettings("green,orange", 0.012, 0.022, (7, 5), "Letter"),
        PageSettings("yellow,#2040c0", 0.040, plain=True),
    ],
    ids=["default", "small", "plain"],
)
def test_what_is_on_the_page_has_its_true_size(settings):
    image = picture_of(settings)
    size = [round(1000 * PER_MM * side) for side in PAPER[settings.paper]]
    assert image.shape[1::-1] == pytest.approx(tuple(size), abs=1)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    corners = Chessboard(settings.pattern, settings.square).find(grey).pixels
    grid = corners.reshape(settings.pattern[1], settings.pattern[0], 2)
    for axis in (0, 1):
        steps = np.linalg.norm(np.diff(grid, axis=axis), axis=-1)
        np.testing.assert_allclose(steps, 1000 * PER_MM * settings.square, atol=0.5)
    places = []
    # A marker is a small part of a picture.
    around = cv2.copyMakeBorder(image, 600, 600, 600, 600, cv2.BORDER_REPLICATE)
    for name in settings.markers.split(","):
        (disc, *others) = Picture(around, factor=1).blobs(parse_colour(name))
        assert not others
        across = 2 * disc.radius / PER_MM / 1000
        # The white in the middle is not of the colour.
        assert (0.97 if settings.plain else 0.7) < across / settings.diameter < 1.03
        places.append(disc.centre)
    assert places[0][0] < places[1][0]
    backing = 8 / 6 * 1000 * settings.diameter * PER_MM
    assert math.dist(*places) > backing


@pytest.mark.parametrize(
    "settings",
    [PageSettings("apriltag"), PageSettings("aruco", tag=3, side=0.050, paper="Letter")],
    ids=["apriltag", "aruco"],
)
def test_a_tag_on_the_page_has_its_true_size_and_its_front_up(settings):
    grey = cv2.cvtColor(picture_of(settings), cv2.COLOR_BGR2GRAY)
    detector = cv2.aruco.ArucoDetector(settings.printed_tag.words)
    corners, numbers, _ = detector.detectMarkers(grey)
    assert numbers.ravel().tolist() == [settings.tag]
    left_ahead, right_ahead, right_behind, left_behind = corners[0].reshape(4, 2)
    side = 1000 * PER_MM * settings.side
    np.testing.assert_allclose(right_ahead - left_ahead, (side, 0), atol=2)
    np.testing.assert_allclose(left_behind - left_ahead, (0, side), atol=2)
    np.testing.assert_allclose(right_behind - right_ahead, (0, side), atol=2)
    # The white border belongs to the marker, and nothing else is printed on it.
    low = np.floor(left_ahead - side / len(settings.printed_tag.cells) + 2).astype(int)
    high = np.ceil(right_behind + side / len(settings.printed_tag.cells) - 2).astype(int)
    plate = grey[low[1] : high[1], low[0] : high[0]].copy()
    inner = np.floor(left_ahead - low - 2).astype(int)
    plate[inner[1] : -inner[1], inner[0] : -inner[0]] = 255
    assert plate.min() > 250


@pytest.mark.slow
def test_the_page_is_written_once_and_always_the_same(tmp_path):
    for name in ("a.svg", "b.svg", "a.pdf", "b.pdf"):
        done = CliRunner().invoke(command, [str(tmp_path / name), "--diameter", "50"])
        assert done.exit_code == 0, done.exception
        assert "two markers of 50 mm" in done.stdout
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
    points = [
        float(x)
        for x in re.search(
            rb"MediaBox \[ 0 0 (\S+) (\S+) ", (tmp_path / "a.pdf").read_bytes()
        ).groups()
    ]
    assert points == pytest.approx([210 / 25.4 * 72, 297 / 25.4 * 72], abs=0.01)
    with pytest.raises(UserError, match="exists already"):
        write_page(tmp_path / "a.svg")
    with pytest.raises(UserError, match=r"written as \.pdf or \.svg"):
        write_page(tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"square": 0.025}, "largest squares that do are of 19 mm"),
        ({"diameter": 0.09}, "largest that do are of 68 mm"),
        ({"diameter": 0.0005}, "diameter: expected a number from 0.002"),
        ({"diameter": math.nan}, "diameter: .* found nan"),
        ({"markers": "pink,magenta"}, "too much alike"),
        ({"markers": "pink,mauve"}, "'mauve' is not known"),
        ({"markers": "apriltag", "side": 0.2}, "a tag of 200 mm does not fit on A4.* 152 mm"),
        ({"markers": "aruco", "tag": 50}, "no tag 50: its tags are 0 to 49"),
        ({"markers": "pink"}, "'pink': expected two different colours"),
        ({"pattern": (1, 5)}, r"pattern\[0\]: expected a whole number from 2"),
    ],
)
def test_pages_that_cannot_be(settings, says):
    with pytest.raises(UserError, match=says):
        PageSettings(**settings)


def test_what_is_said_to_fit_fits():
    PageSettings(square=0.019)
    PageSettings(diameter=0.068, square=0.017)


def test_the_help_names_every_colour():
    names = COLOUR_NAMES.replace(" or ", ", ").split(", ")
    assert names[: len(NAMED)] == list(NAMED)
