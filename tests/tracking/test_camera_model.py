import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim.base.errors import FileError, UserError
from tracking.camera.camera_model import CameraModel


def looking_down(height=2.5, tilt=0.06, distortion=(-0.25, 0.08, 0.001, -0.0005, 0.01)):
    """A camera over the board's centre, x right and y up in the image, tilted a little."""
    cos, sin = np.cos(tilt), np.sin(tilt)
    rotation = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ np.diag([1.0, -1.0, -1.0])
    return CameraModel(
        (640, 480),
        [[520.0, 0, 322.0], [0, 521.0, 238.0], [0, 0, 1]],
        distortion,
        rotation,
        -rotation @ np.array([0.05, -0.1, height]),
    )


def undistorted_by_bisection(model, pixel):
    """Undistort one point by bisection, with the radial terms only."""
    k1, k2, _, _, k3 = model.distortion
    fx, fy = model.camera_matrix[0, 0], model.camera_matrix[1, 1]
    point = (np.asarray(pixel) - model.camera_matrix[:2, 2]) / (fx, fy)
    distorted, low, high = np.hypot(*point), 0.0, 2.0
    for _ in range(100):
        r = (low + high) / 2
        if r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) < distorted:
            low = r
        else:
            high = r
    return point * (low / distorted)


@given(st.floats(-1.38, 1.38), st.floats(-0.92, 0.92), st.floats(0.0, 0.3), st.floats(-0.12, 0.12))
def test_board_to_pixels_and_back(x, y, height, tilt):
    model = looking_down(tilt=tilt)
    pixels = model.to_pixels([[x, y, height]])
    np.testing.assert_allclose(model.to_board(pixels, height), [[x, y]], atol=1e-9)


def test_a_hand_worked_point():
    # Straight down from 2 m, f = 500 px: 0.4 m to the right is 100 px to the right, 0.2 m up the
    # board is 50 px up the image; at half the height distances look twice as large.
    model = CameraModel(
        (640, 480),
        [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]],
        np.zeros(5),
        np.diag([1.0, -1.0, -1.0]),
        [0.0, 0.0, 2.0],
    )
    np.testing.assert_allclose(model.to_pixels([[0.4, 0.2, 0.0]]), [[420, 190]])
    np.testing.assert_allclose(model.to_pixels([[0.4, 0.2, 1.0]]), [[520, 140]])
    np.testing.assert_allclose(model.to_board([[420, 190]]), [[0.4, 0.2]])
    np.testing.assert_allclose(model.to_board([[420, 190]], height=1.0), [[0.2, 0.1]])
    np.testing.assert_allclose(model.position, [0, 0, 2])


def test_undistortion_against_bisection():
    model = looking_down(distortion=(-0.25, 0.08, 0.0, 0.0, 0.01))
    for pixel in ((5.0, 7.0), (630.0, 20.0), (200.0, 470.0), (400.0, 240.0)):
        expected = undistorted_by_bisection(model, pixel)
        np.testing.assert_allclose(model.undistort([pixel])[0], expected, atol=1e-6 / 520)


def test_the_homography_is_the_plane_z_0():
    model = looking_down()
    pixels = np.array([[50.0, 60.0], [600.0, 100.0], [320.0, 400.0]])
    rays = np.column_stack([model.undistort(pixels), np.ones(3)]) @ model.homography.T
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], model.to_board(pixels), atol=1e-12)


def test_lost_points_stay_nan_and_none_stay_none():
    model = looking_down()
    points = model.to_board([[np.nan, np.nan], [300.0, 200.0]], 0.1)
    assert np.isnan(points[0]).all()
    assert np.isfinite(points[1]).all()
    assert model.to_board(np.empty((0, 2))).shape == (0, 2)
    assert model.to_pixels(np.empty((0, 3))).shape == (0, 2)


def test_file_round_trip(tmp_path):
    model = replace(looking_down(), rms_px=0.153, photographs=25, board_rms_m=0.0004)
    model.write(tmp_path / "calibration.json")
    again = CameraModel.read(tmp_path / "calibration.json")
    for name in ("camera_matrix", "distortion", "rotation", "translation", "homography"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name))
    assert (again.image_size, again.rms_px, again.photographs, again.board_rms_m) == (
        (640, 480),
        0.153,
        25,
        0.0004,
    )


def test_without_points_there_are_no_metres(tmp_path):
    model = replace(looking_down(), rotation=None, translation=None)
    model.write(tmp_path / "calibration.json")
    again = CameraModel.read(tmp_path / "calibration.json")
    assert not again.has_board
    assert again.homography is None
    with pytest.raises(UserError, match="at least 4 marked points"):
        again.to_board([[1.0, 2.0]])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("camera_matrix", [[1, 0], [0, 1]]),
        ("camera_matrix", [[0, 0, 1], [0, 5, 1], [0, 0, 1]]),
        ("distortion", [0, 0, 0, 0]),
        ("distortion", [0, 0, 0, 0, "much"]),
        ("rotation", [[1, 0, 0], [0, 2, 0], [0, 0, 1]]),
        ("rotation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
        ("translation", None),
        ("image_size", [640]),
        ("image_size", [640, 0]),
    ],
)
def test_a_wrong_field_is_named(tmp_path, field, value):
    path = tmp_path / "calibration.json"
    looking_down().write(path)
    document = json.loads(path.read_text())
    document[field] = value
    path.write_text(json.dumps(document))
    with pytest.raises(FileError, match=rf"field '{field}\b"):
        CameraModel.read(path)


def test_pixels_without_distortion():
    camera = looking_down()
    straight = replace(camera, distortion=np.zeros(5))
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (30, 3)) * (1, 1, 0)
    result = camera.straighten(camera.to_pixels(points))
    np.testing.assert_allclose(result, straight.to_pixels(points), atol=1e-6)
