import math

import numpy as np
import pytest
import tracking_scene as scene

from neurosim.base.errors import UserError
from tracking.camera_model import CameraModel
from tracking.colours import angle_between, parse_colour
from tracking.pointing import camera_over_board, colour_at, told_apart

CORNERS = np.array([(-1.38, 0.92), (1.38, 0.92), (1.38, -0.92), (-1.38, -0.92)])


def camera(tilt=0.0, focal_length=560.0, height=2.6):
    """Return a camera without distortion that looks down, tilted about its x axis."""
    cos, sin = math.cos(tilt), math.sin(tilt)
    rotation = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ np.diag([1.0, -1.0, -1.0])
    place = np.array([0.1, -0.05, height])
    matrix = [[focal_length, 0, 319.5], [0, focal_length, 239.5], [0, 0, 1]]
    return CameraModel((640, 480), matrix, np.zeros(5), rotation, -rotation @ place)


def clicked(model):
    return np.column_stack([model.to_pixels(np.column_stack([CORNERS, np.zeros(4)])), CORNERS])


@pytest.mark.parametrize(("which", "bgr"), [("front", scene.PINK), ("rear", scene.BLUE)])
@pytest.mark.parametrize("off", [(0, 0), (3, 2), (-5, 4)])
def test_a_click_on_or_near_a_fading_marker_gives_its_colour(which, bgr, off):
    image = scene.background()
    front, rear = scene.robot(image, np.array([300.0, 200.0]), 0.7)
    frame = scene.finish(image, np.random.default_rng(1))
    found = colour_at(frame, (front if which == "front" else rear) + off)
    true = parse_colour(f"#{bgr[2]:02x}{bgr[1]:02x}{bgr[0]:02x}")
    assert abs(math.degrees(float(angle_between(found.colour.hue, true.hue)))) < 6
    assert found.places == 1
    assert found.sure > 0.7


def test_a_second_patch_of_the_colour_is_counted_and_makes_it_less_sure():
    image = scene.background()
    front, _ = scene.robot(image, np.array([300.0, 200.0]), 0.7)
    scene.paint_disc(image, np.array([500.0, 400.0]), 7, scene.PINK)
    found = colour_at(scene.finish(image, np.random.default_rng(1)), front)
    assert found.places == 2
    assert found.sure <= 0.7


def test_grey_is_no_colour():
    frame = scene.finish(scene.background(), np.random.default_rng(1))
    with pytest.raises(UserError, match="grey"):
        colour_at(frame, (100, 100))
    with pytest.raises(UserError, match="outside"):
        colour_at(frame, (700, 100))


def test_pink_and_blue_are_told_apart_and_two_pinks_are_not():
    pink, blue, red = (parse_colour(name) for name in ("pink", "blue", "red"))
    assert told_apart(pink, blue)
    assert not told_apart(pink, red)


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_four_corners_and_the_height_give_the_camera(tilt):
    true = camera(tilt)
    found = camera_over_board((640, 480), clicked(true), height=2.6)
    assert found.camera_matrix[0, 0] == pytest.approx(560, rel=1e-3 if tilt else 1e-6)
    marks = np.array([[1.2, 0.8, 0.1], [-1.2, -0.3, 0.1], [0.0, 0.0, 0.1]])
    board = found.to_board(true.to_pixels(marks), 0.1)
    assert np.abs(board - marks[:, :2]).max() < 1e-3


def test_without_the_height_what_lies_on_the_board_is_right_all_the_same():
    true = camera()
    found = camera_over_board((640, 480), clicked(true))
    flat = np.array([[1.2, 0.8, 0.0], [-1.2, -0.3, 0.0]])
    assert np.abs(found.to_board(true.to_pixels(flat)) - flat[:, :2]).max() < 1e-4
    raised = flat + np.array([0, 0, 0.1])
    # 576 in place of 560: 3 % of the height's 10 cm at the edge, seen from 2.6 m.
    assert np.abs(found.to_board(true.to_pixels(raised), 0.1) - raised[:, :2]).max() < 2.5e-3


def test_a_lens_that_is_known_is_used():
    true = camera(0.1)
    lens = CameraModel((640, 480), true.camera_matrix, true.distortion)
    found = camera_over_board((640, 480), clicked(true), lens)
    assert np.allclose(found.position, true.position, atol=1e-4)
    with pytest.raises(UserError, match="320x240"):
        camera_over_board((320, 240), clicked(true), lens)


def test_a_height_that_cannot_be_is_refused():
    with pytest.raises(UserError, match="50 m above"):
        camera_over_board((640, 480), clicked(camera()), height=50.0)
