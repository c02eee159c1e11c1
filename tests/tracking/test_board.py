"""The camera over the board, calibrated from four corners alone."""

import math

import numpy as np
import pytest

from neurosim.base.errors import UserError
from tracking.camera.board import camera_over_board, corner_points
from tracking.camera.camera_model import CameraModel

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


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_four_corners_and_the_height_give_the_camera(tilt):
    true = camera(tilt)
    model = camera_over_board((640, 480), clicked(true), height=2.6)
    assert model.camera_matrix[0, 0] == pytest.approx(560, rel=1e-3 if tilt else 1e-6)
    marks = np.array([[1.2, 0.8, 0.1], [-1.2, -0.3, 0.1], [0.0, 0.0, 0.1]])
    board = model.to_board(true.to_pixels(marks), 0.1)
    assert np.abs(board - marks[:, :2]).max() < 1e-3


def test_without_the_height_what_lies_on_the_board_is_right_all_the_same():
    true = camera()
    model = camera_over_board((640, 480), clicked(true))
    flat = np.array([[1.2, 0.8, 0.0], [-1.2, -0.3, 0.0]])
    assert np.abs(model.to_board(true.to_pixels(flat)) - flat[:, :2]).max() < 1e-4
    raised = flat + np.array([0, 0, 0.1])
    # 576 in place of 560: 3 % of the height's 10 cm at the edge, seen from 2.6 m.
    assert np.abs(model.to_board(true.to_pixels(raised), 0.1) - raised[:, :2]).max() < 2.5e-3


def test_a_lens_that_is_known_is_used():
    true = camera(0.1)
    lens = CameraModel((640, 480), true.camera_matrix, true.distortion)
    model = camera_over_board((640, 480), clicked(true), lens)
    assert np.allclose(model.position, true.position, atol=1e-4)
    with pytest.raises(UserError, match="320x240"):
        camera_over_board((320, 240), clicked(true), lens)


def test_a_height_that_cannot_be_is_refused():
    with pytest.raises(UserError, match="height of 50 m"):
        camera_over_board((640, 480), clicked(camera()), height=50.0)


@pytest.mark.parametrize("height", [None, 2.6])
@pytest.mark.slow
def test_what_is_stated_covers_usual_lenses(height):
    """Lenses and heights of common cameras; corners clicked to half a pixel."""
    rng = np.random.default_rng(6)
    turn = camera(0.05).rotation
    board = CORNERS[:, :2] * 0.8
    ratios = []
    for _ in range(30):
        focal = 576 * rng.normal(1, 0.15)
        middle = (319.5, 239.5) + 0.02 * 640 * rng.normal(size=2)
        matrix = [[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]]
        place = [0.1, -0.05, 2.6 * focal / 576]
        true = CameraModel(
            (640, 480), matrix, [rng.normal(0, 0.2), 0, 0, 0, 0], turn, -turn @ place
        )
        pixels = true.to_pixels(np.column_stack([board, np.zeros(4)]))
        pixels += rng.normal(0, 0.3, (4, 2))
        known = None if height is None else place[2] * rng.normal(1, 0.02)
        model = camera_over_board((640, 480), np.column_stack([pixels, board]), height=known)
        spots = rng.uniform(-1, 1, (40, 2)) * board.max(axis=0)
        seen = true.to_pixels(np.column_stack([spots, np.full(40, 0.1)]))
        miss = np.sqrt(((model.to_board(seen, 0.1) - spots) ** 2).sum(-1).mean())
        ratios.append(miss / model.uncertainty["board_m"])
    assert np.mean(np.array(ratios) < 2) >= 0.85
    # The statement is not too wide either.
    assert np.sqrt(np.mean(np.square(ratios))) > 0.5


@pytest.mark.parametrize("order", [[0, 2, 1, 3], [3, 2, 1, 0]])
def test_corners_in_another_order(order):
    pixels = camera().to_pixels(np.column_stack([CORNERS, np.zeros(4)]))
    assert np.allclose(corner_points((640, 480), pixels, (2.76, 1.84))[:, 2:], CORNERS)
    with pytest.raises(UserError, match="clockwise"):
        corner_points((640, 480), pixels[order], (2.76, 1.84))
