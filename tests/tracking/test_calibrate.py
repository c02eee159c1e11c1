import functools
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from neurosim.base.errors import FileError, UserError
from neurosim.cli.calibrate import calibrate as command
from tracking.camera.board import locate
from tracking.camera.calibrate import (
    _lens_numbers,
    _resampled,
    _spread,
    _uncertainty,
    calibrate,
    from_corners,
)
from tracking.camera.camera_model import CameraModel
from tracking.camera.lens import fit, fit_robustly
from tracking.camera.targets import Charuco, Chessboard, View

TRUTH = CameraModel(
    (640, 480),
    [[520.0, 0, 322.0], [0, 521.0, 238.0], [0, 0, 1]],
    [-0.2, 0.05, 0.0005, -0.0005, 0.0],
    np.diag([1.0, -1.0, -1.0]) @ cv2.Rodrigues(np.array([0.05, -0.03, 0.02]))[0],
    [0.03, -0.02, 2.6],
)
CORNERS = np.array([[-1.3, -0.8], [1.3, -0.8], [1.3, 0.8], [-1.3, 0.8]])


def points_of(model, board):
    board = np.asarray(board, float)
    pixels = model.to_pixels(np.column_stack([board, np.zeros(len(board))]))
    return np.column_stack([pixels, board])


@functools.cache
def chessboard_view(turn, shift, squares=(8, 6), side=40):
    """A flat chessboard of 7 x 5 inner corners, turned and moved before the lens of TRUTH."""
    flat = np.full((squares[1] * side + 2 * side, squares[0] * side + 2 * side), 255, np.uint8)
    for row in range(squares[1]):
        for column in range(squares[0]):
            if (row + column) % 2:
                flat[side * (row + 1) : side * (row + 2), side * (column + 1) :][:, :side] = 20
    v, u = np.mgrid[:480, :640].astype(float)
    rays = TRUTH.undistort(np.column_stack([u.ravel(), v.ravel()]))
    rotation = cv2.Rodrigues(np.array(turn, float))[0]
    plane = np.column_stack([rotation[:, 0], rotation[:, 1], np.array(shift, float)])
    places = np.column_stack([rays, np.ones(len(rays))]) @ np.linalg.inv(plane).T
    places = (places[:, :2] / places[:, 2:] / 0.03 * side).astype(np.float32)
    offset = np.array([flat.shape[1] / 2, flat.shape[0] / 2], np.float32)
    around = (places + offset - 0.5).reshape(480, 640, 2)
    return cv2.GaussianBlur(
        cv2.remap(flat, around[..., 0], around[..., 1], cv2.INTER_LINEAR, borderValue=128),
        (0, 0),
        0.8,
    )


VIEWS = [
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.5)),
    ((0.5, 0.0, 0.1), (0.05, 0.02, 0.55)),
    ((-0.5, 0.1, 0.0), (-0.08, -0.03, 0.5)),
    ((0.0, 0.5, 0.3), (0.08, -0.05, 0.5)),
    ((0.1, -0.5, -0.2), (-0.06, 0.05, 0.5)),
    ((0.4, 0.3, 0.1), (0.19, 0.13, 0.5)),
    ((-0.4, 0.3, 0.1), (0.18, -0.13, 0.5)),
    ((-0.3, -0.4, 0.1), (-0.18, -0.13, 0.5)),
    ((0.3, -0.4, 0.1), (-0.19, 0.13, 0.5)),
]


def write_views(folder):
    for i, (turn, shift) in enumerate(VIEWS):
        cv2.imwrite(str(folder / f"{i}.png"), chessboard_view(turn, shift))


@pytest.mark.slow
def test_real_photographs(shared_data):
    model = calibrate(shared_data / "chessboard", pattern=(9, 6), square=0.025)
    assert model.image_size == (640, 512)
    assert model.photographs == 25
    fx, fy = model.camera_matrix[0, 0], model.camera_matrix[1, 1]
    assert (fx, fy) == pytest.approx((518.6, 518.9), abs=0.2)
    assert tuple(model.camera_matrix[:2, 2]) == pytest.approx((315.6, 249.3), abs=0.2)
    assert model.rms_px == pytest.approx(0.153, abs=0.002)
    assert not model.has_board


@pytest.mark.slow
def test_a_rendered_lens_is_recovered_with_its_pose(tmp_path):
    write_views(tmp_path)
    points = points_of(TRUTH, [*CORNERS, (0.0, 0.8), (0.0, -0.8)])
    model = calibrate(tmp_path, pattern=(7, 5), square=0.03, points=points)
    assert model.rms_px < 0.15
    assert model.camera_matrix[0, 0] == pytest.approx(520, rel=0.01)
    assert model.camera_matrix[1, 2] == pytest.approx(238, abs=4)
    board = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 2))
    pixels = TRUTH.to_pixels(np.column_stack([board, np.full(50, 0.1)]))
    misses = model.to_board(pixels, 0.1) - board
    assert np.abs(misses).max() < 0.005
    stated = model.uncertainty
    assert 0.1 < stated["fx"] < 20
    assert 0.0003 < stated["board_m"] < 0.01
    model.write(tmp_path / "calibration.json")
    model_bytes = (tmp_path / "calibration.json").read_bytes()
    assert CameraModel.read(tmp_path / "calibration.json").uncertainty == stated
    for number in range(4):  # to the last digit, by however many threads
        again = calibrate(tmp_path, pattern=(7, 5), square=0.03, points=points)
        again.write(tmp_path / f"{number}.json")
        assert (tmp_path / f"{number}.json").read_bytes() == model_bytes


@pytest.mark.slow
def test_a_video_does_as_well(tmp_path):
    path = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (640, 480))
    for turn, shift in VIEWS:
        writer.write(cv2.cvtColor(chessboard_view(turn, shift), cv2.COLOR_GRAY2BGR))
    writer.release()
    model = calibrate(path, pattern=(7, 5), square=0.03)
    assert model.photographs == len(VIEWS)
    assert model.camera_matrix[0, 0] == pytest.approx(520, rel=0.02)


def test_views_that_differ_most_are_kept():
    same = [np.full((4, 2), 100.0) + 0.1 * i for i in range(6)]
    other = [np.full((4, 2), 300.0), np.full((4, 2), 500.0)]
    kept = _spread([View(corners, corners) for corners in [*same, *other]], 3)
    assert [view.pixels[0, 0] for view in kept] == [100.0, 300.0, 500.0]


@pytest.mark.parametrize("count", [4, 9])
def test_exact_points_give_the_exact_pose(count):
    board = np.vstack([CORNERS, np.random.default_rng(1).uniform(-0.8, 0.8, (count - 4, 2))])
    bare = replace(TRUTH, rotation=None, translation=None)
    model = locate(bare, points_of(TRUTH, board))
    np.testing.assert_allclose(model.rotation, TRUTH.rotation, atol=1e-6)
    np.testing.assert_allclose(model.translation, TRUTH.translation, atol=1e-6)
    assert model.board_rms_m < 1e-6


def test_points_from_a_file(tmp_path):
    path = tmp_path / "points.csv"
    rows = points_of(TRUTH, CORNERS)
    path.write_text("name,u,v,x,y\n" + "".join(f"p,{u},{v},{x},{y}\n" for u, v, x, y in rows))
    model = locate(TRUTH, path)
    np.testing.assert_allclose(model.position, TRUTH.position, atol=1e-6)
    path.write_text("u,v,x,y\n1,2,3,left\n")
    with pytest.raises(FileError, match=r"line 2, field 'y'"):
        locate(TRUTH, path)
    path.write_text("u,v,x\n1,2,3\n")
    with pytest.raises(FileError, match="column is missing"):
        locate(TRUTH, path)


@pytest.mark.parametrize(
    ("board", "says"),
    [
        (CORNERS[:3], "at least 4"),
        ([(0, 0), (0.5, 0), (1, 0), (-1, 0), (0.2, 0)], "one line"),
        ([(0, 0), (0.5, 0), (1, 0), (0.3, 0.8)], "one line"),
    ],
)
def test_points_that_fix_no_pose(board, says):
    with pytest.raises(UserError, match=says):
        locate(TRUTH, points_of(TRUTH, board))


def test_mirrored_points():
    rows = points_of(TRUTH, CORNERS)
    rows[:, 3] *= -1
    with pytest.raises(UserError, match="mirrored"):
        locate(TRUTH, rows)


def test_points_that_are_no_numbers():
    with pytest.raises(UserError, match="four numbers"):
        locate(TRUTH, [[1.0, 2.0, 3.0]] * 4)


@pytest.mark.slow
def test_photographs_that_will_not_do(tmp_path):
    with pytest.raises(UserError, match="no photographs in this folder"):
        calibrate(tmp_path)
    write_views(tmp_path)
    with pytest.raises(UserError, match=rf"9 x 6 inner corners was found in 0 of {len(VIEWS)}"):
        calibrate(tmp_path, pattern=(9, 6))
    with pytest.raises(UserError, match="in 2 of 2 pictures; at least 3"):
        calibrate([tmp_path / "0.png", tmp_path / "1.png"], pattern=(7, 5))
    with pytest.raises(UserError, match="no such file; expected a photograph"):
        calibrate([tmp_path / "absent.png"], pattern=(7, 5))
    (tmp_path / "9.png").write_bytes(b"not a picture")
    with pytest.raises(UserError, match="not a photograph"):
        calibrate(tmp_path, pattern=(7, 5))
    cv2.imwrite(str(tmp_path / "9.png"), np.zeros((240, 320), np.uint8))
    with pytest.raises(UserError, match=r"320 x 240 pixels .* 640 x 480"):
        calibrate(tmp_path, pattern=(7, 5))
    with pytest.raises(UserError, match=r"pattern\[0\]: expected a whole number from 2"):
        calibrate(tmp_path, pattern=(1, 5))
    with pytest.raises(UserError, match=r"square: .* found nan"):
        calibrate(tmp_path, pattern=(7, 5), square=np.nan)


@pytest.mark.slow
def test_the_stated_uncertainty_covers_random_halves(shared_data):
    target = Chessboard((9, 6), 0.025)
    pictures = sorted((shared_data / "chessboard").glob("*.jpg"))
    views = [target.find(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE)) for p in pictures]
    model = fit(views, (640, 512))
    stated = _uncertainty(model, *_resampled(views, (640, 512)), None)
    rng = np.random.default_rng(1)
    result = [
        _lens_numbers(fit([views[i] for i in half], (640, 512)))
        for _ in range(60)
        for half in np.array_split(rng.permutation(len(views)), 2)
    ]
    off = (np.array(result) - _lens_numbers(model))[:, :4]
    claimed = np.array([stated[name] for name in ("fx", "fy", "cx", "cy")])
    ratios = claimed / np.sqrt((off**2).mean(0))
    # Leaving out one view after the other gives 0.88 of the scatter; 120 halves give it to 7 %.
    assert 0.95 < ratios.mean() < 1.15
    assert ratios.min() > 0.85
    assert (np.abs(off) < 2 * claimed).mean() > 0.9


@pytest.fixture(scope="module")
def real_views(shared_data):
    target = Chessboard((9, 6), 0.025)
    pictures = sorted((shared_data / "chessboard").glob("*.jpg"))
    return [target.find(cv2.imread(str(p), 0))._replace(name=p.name) for p in pictures]


@pytest.mark.parametrize("count", [25, 8, 4, 3])
def test_corners_in_wrong_places_are_found_and_left_out(real_views, count):
    views = [view._replace(pixels=view.pixels.copy()) for view in real_views[-count:]]
    right = fit(views, (640, 512))
    wrong = []
    for view, corner, off in ((views[0], 12, (5.0, 3.0)), (views[1], 53, (-4.0, 4.0))):
        view.pixels[corner] += off
        wrong.append((view.name, *(round(float(place), 1) for place in view.pixels[corner])))
    model, kept = fit_robustly(views, (640, 512))
    assert {(each["photograph"], each["u"], each["v"]) for each in model.left_out} == set(wrong)
    assert [len(view.pixels) for view in kept] == [53, 53] + [54] * (count - 2)
    assert model.rms_px < 1.02 * right.rms_px < 0.7 * fit(views, (640, 512)).rms_px
    assert model.camera_matrix[0, 0] == pytest.approx(right.camera_matrix[0, 0], abs=0.6)


def test_a_chessboard_that_is_bent_is_left_out_as_a_whole(real_views):
    right = fit(real_views[:3] + real_views[4:], (640, 512))
    bent = real_views[3]
    along = bent.board[:, 0] - bent.board[:, 0].mean()
    aside = np.column_stack([0 * along, 1.5 * (along / along.std()) ** 2])
    views = [*real_views]
    views[3] = bent._replace(pixels=bent.pixels + aside)
    model, kept = fit_robustly(views, (640, 512))
    assert [each["photograph"] for each in model.left_out] == [bent.name]
    assert "u" not in model.left_out[0]
    assert len(kept) == model.photographs == 24
    np.testing.assert_array_equal(model.camera_matrix, right.camera_matrix)


def test_a_photograph_that_fits_no_other(real_views):
    views = real_views[:6]
    views[5] = views[5]._replace(pixels=np.roll(views[5].pixels, 9, axis=0))
    assert [each["photograph"] for each in fit_robustly(views, (640, 512))[0].left_out] == [
        views[5].name
    ]
    with pytest.raises(
        UserError, match=r"fewer than 3 photographs fit together|do not fix the lens"
    ):
        fit_robustly(views[3:], (640, 512))


def test_photographs_that_are_right_are_all_kept(real_views):
    for chosen in (real_views, real_views[:6], real_views[10:13]):
        model, kept = fit_robustly(chosen, (640, 512))
        assert model.left_out == ()
        assert len(kept) == len(chosen)


def test_what_is_left_out_is_said_and_three_photographs_are_too_few(shared_data, tmp_path):
    pictures = sorted((shared_data / "chessboard").glob("*.jpg"))[:3]
    image = cv2.imread(str(pictures[0]))
    corners = Chessboard((9, 6), 0.025).find(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)).pixels
    # A dark smear from a corner to a point next to it, where the corner then seems to be.
    u, v = corners[22]
    cv2.line(image, (round(u) - 4, round(v) - 4), (round(u) + 3, round(v) + 3), (0, 0, 0), 5)
    cv2.imwrite(str(tmp_path / "smeared.png"), image)
    words = [str(tmp_path / "smeared.png"), *map(str, pictures[1:]), "-o", str(tmp_path / "c.json")]
    done = CliRunner().invoke(command, words)
    assert done.exit_code == 0, done.exception
    first, second = done.stderr.splitlines()
    assert "smeared.png: the corner at " in first
    assert "px off and left out" in first
    assert "3 photographs are too few" in second
    assert "standard deviations" not in done.stdout
    content = json.loads((tmp_path / "c.json").read_text())["left_out"]
    assert len(content) == 1
    assert np.hypot(content[0]["u"] - u, content[0]["v"] - v) < 6


def test_a_charuco_board_of_which_parts_are_seen(tmp_path):
    target = Charuco((7, 5), 0.03, 0.022)
    flat = target.board.generateImage((960, 720), marginSize=0)
    v, u = np.mgrid[:480, :640].astype(float)
    rays = np.column_stack(
        [TRUTH.undistort(np.column_stack([u.ravel(), v.ravel()])), np.ones(u.size)]
    )
    for i, (turn, shift) in enumerate(VIEWS):
        rotation = cv2.Rodrigues(np.array(turn, float))[0]
        # Nearer than the chessboard was, so that some of it is outside of the picture.
        at = np.array([shift[0] * 1.2, shift[1] * 1.2, 0.42]) - rotation @ [0.12, 0.09, 0.0]
        places = rays @ np.linalg.inv(np.column_stack([rotation[:, :2], at])).T
        places = (places[:, :2] / places[:, 2:] * 4000 - 0.5).astype(np.float32)
        view = cv2.remap(
            flat, *np.moveaxis(places.reshape(480, 640, 2), -1, 0), cv2.INTER_AREA, borderValue=200
        )
        cv2.imwrite(str(tmp_path / f"{i}.png"), cv2.GaussianBlur(view, (0, 0), 0.8))
    model = calibrate(tmp_path, (7, 5), 0.03, marker=0.022)
    assert model.photographs >= 7
    assert model.rms_px < 0.3
    assert model.camera_matrix[0, 0] == pytest.approx(520, rel=0.01)
    with pytest.raises(UserError, match="ChArUco board of 9 x 6"):
        calibrate(tmp_path, (9, 6), 0.03, marker=0.022, dictionary="6X6_100")
    with pytest.raises(UserError, match="no ArUco dictionary"):
        calibrate(tmp_path, (9, 6), 0.03, marker=0.022, dictionary="9X9")
    with pytest.raises(UserError, match="does not fit"):
        calibrate(tmp_path, (9, 6), 0.03, marker=0.04)


def test_a_place_that_is_not_there(tmp_path):
    with pytest.raises(UserError, match="no such photographs"):
        calibrate(tmp_path / "nope")


def test_four_corners_need_the_size_of_the_board(tmp_path):
    cv2.imwrite(str(tmp_path / "board.png"), np.zeros((480, 640), np.uint8))
    corners = ["--corners", "50,50", "600,50", "600,400", "50,400"]
    words = [str(tmp_path / "board.png"), *corners, "-o", str(tmp_path / "c.json")]
    done = CliRunner().invoke(command, words)
    assert isinstance(done.exception, UserError)
    assert "--corners needs the size of the board" in str(done.exception)
    assert not (tmp_path / "c.json").exists()
    done = CliRunner().invoke(command, [*words, "--board", "2.0x1.3"])
    assert done.exit_code == 0, done.exception
    # A calibration is not lost by a second one.
    first = (tmp_path / "c.json").read_bytes()
    done = CliRunner().invoke(command, [*words, "--board", "4.0x2.6"])
    assert "c.json exists; name another calibration, or add --overwrite" in str(done.exception)
    assert (tmp_path / "c.json").read_bytes() == first
    done = CliRunner().invoke(command, [*words, "--board", "4.0x2.6", "--overwrite"])
    assert done.exit_code == 0, done.exception
    assert (tmp_path / "c.json").read_bytes() != first


def test_four_corners_and_nothing_else(tmp_path):
    picture = tmp_path / "board.png"
    cv2.imwrite(str(picture), np.zeros((480, 640), np.uint8))
    board = CORNERS[[3, 2, 1, 0]] * 0.9  # top left, clockwise
    flat = np.column_stack([board, np.zeros(4)])
    corners = TRUTH.to_pixels(flat)
    model = from_corners(picture, corners, (2.34, 1.44))
    np.testing.assert_allclose(model.to_board(corners), board, atol=0.003)
    places = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))
    seen = TRUTH.to_pixels(np.column_stack([places, np.full(50, 0.1)]))
    misses = np.sqrt(((model.to_board(seen, 0.1) - places) ** 2).sum(-1).mean())
    assert misses < 2 * model.uncertainty["board_m"] < 0.2
    with pytest.raises(UserError, match="clockwise"):
        from_corners(picture, corners[[0, 2, 1, 3]], (2.34, 1.44))
    with pytest.raises(UserError, match="clockwise"):
        from_corners(picture, corners[::-1], (2.34, 1.44))
    with pytest.raises(UserError, match="outside"):
        from_corners(picture, corners + 400, (2.34, 1.44))
    with pytest.raises(UserError, match=r"clockwise|one line"):
        from_corners(picture, [(0, 0), (10, 10), (20, 20), (30, 30)], (2.34, 1.44))
