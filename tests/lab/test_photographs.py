"""Photographs of the virtual roof camera are good enough to calibrate it with."""

import cv2
import numpy as np
import pytest

from neurosim.base.errors import UserError
from neurosim.base.files import number, read_csv
from neurosim.lab.camera import scene
from neurosim.lab.camera.optics import Optics
from neurosim.lab.camera.photographs import CORNERS, SQUARE, render_photographs
from neurosim.lab.nxt.params import CameraParams


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return render_photographs(tmp_path_factory.mktemp("lab") / "photos", CameraParams(), 7, 9)


def test_opencv_calibrates_close_to_the_truth(photographs):
    grid = np.zeros((CORNERS[0] * CORNERS[1], 3), np.float32)
    grid[:, :2] = np.mgrid[: CORNERS[0], : CORNERS[1]].T.reshape(-1, 2) * SQUARE
    corners = []
    for path in photographs.chessboards:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        result, points = cv2.findChessboardCorners(grey, CORNERS)
        assert result, path.name
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
        corners.append(cv2.cornerSubPix(grey, points, (5, 5), (-1, -1), stop))
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(
        [grid] * len(corners), corners, (640, 480), None, None
    )
    truth = Optics(CameraParams())
    assert rms < 0.15
    assert matrix[[0, 1], [0, 1]] == pytest.approx(truth.matrix[[0, 1], [0, 1]], rel=0.005)
    assert matrix[:2, 2] == pytest.approx(truth.matrix[:2, 2], abs=2.0)
    assert distortion.ravel()[0] == pytest.approx(truth.distortion[0], abs=0.02)


def test_points_are_clicked_on_the_crosses(photographs):
    table = read_csv(photographs.points, dict.fromkeys("uvxy", number))
    marks = np.column_stack([table["x"], table["y"]])
    assert marks == pytest.approx(np.array(scene.MARKS))
    clicks = np.column_stack([table["u"], table["v"]])
    truth = Optics(CameraParams()).project(np.column_stack([marks, np.zeros(len(marks))]))
    errors = np.hypot(*(clicks - truth).T)
    assert 0.01 < errors.mean() < 1.0
    grey = cv2.imread(str(photographs.board), cv2.IMREAD_GRAYSCALE)
    for u, v in truth.round().astype(int):
        patch = grey[v - 12 : v + 13, u - 12 : u + 13].astype(int)
        assert patch[12, 12] < np.median(patch) - 30


def test_same_seed_same_photographs(photographs, tmp_path):
    again = render_photographs(tmp_path / "photos", CameraParams(), 7, 2)
    for first, second in zip(photographs.chessboards[:2], again.chessboards, strict=True):
        assert first.read_bytes() == second.read_bytes()


def test_refuses_a_full_folder_and_no_photographs(photographs, tmp_path):
    with pytest.raises(UserError, match="not empty"):
        render_photographs(photographs.board.parent, CameraParams(), 7, 1)
    with pytest.raises(UserError, match="at least 1"):
        render_photographs(tmp_path / "none", CameraParams(), 7, 0)
