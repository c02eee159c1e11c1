"""The roof camera's pictures: where things are in them, how long they were exposed, when."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from neurosim.lab.camera import scene
from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.nxt.params import BOARD, CameraParams, LabParams
from neurosim.lab.nxt.world import Lab

ON, RUNNING = 1, 0x20
POSES = [(0.0, 0.0, 0.0), (1.2, 0.75, 0.8), (-1.22, -0.7, -2.0), (0.313, -0.5, 3.0)]


@pytest.fixture(scope="module")
def camera():
    return RoofCamera(CameraParams(), seed=1)


def in_view(camera, pose, offset):
    """Return the pixel of a point of the robot at marker height."""
    x, y, theta = pose
    cos, sin = np.cos(theta), np.sin(theta)
    point = [x + cos * offset[0] - sin * offset[1], y + sin * offset[0] + cos * offset[1]]
    return camera.project(np.array([[*point, scene.MARKER_HEIGHT]]))[0]


def around(frame, centre, radius):
    """Return pixel coordinates [N, 2] and colours [N, 3] within a radius of a pixel."""
    v, u = np.indices(frame.shape[:2])
    near = np.hypot(u - centre[0], v - centre[1]) <= radius
    return np.column_stack([u[near], v[near]]), frame[near].astype(float)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("marker", [scene.FRONT_MARKER, scene.REAR_MARKER], ids=["pink", "blue"])
def test_marker_is_painted_where_it_projects(camera, pose, marker):
    frame = camera.render(np.array(pose), noise=False)
    centre = in_view(camera, pose, marker)
    pixels, colours = around(frame, centre, 7.2)
    weights = (colours.sum(1) - 66.0).clip(0)  # pixels brighter than the black backing
    result = (weights[:, None] * pixels).sum(0) / weights.sum()
    assert np.hypot(*(result - centre)) < 0.1


def test_markers_have_their_colours_and_fade_to_white(camera):
    pose = POSES[0]
    frame = camera.render(np.array(pose), noise=False)
    u, v = in_view(camera, pose, (scene.FRONT_MARKER[0] + 0.022, 0)).round().astype(int)
    blue, green, red = frame[v, u].astype(int)
    assert red > blue + 20 > green + 40
    u, v = in_view(camera, pose, (scene.REAR_MARKER[0] - 0.022, 0)).round().astype(int)
    blue, green, red = frame[v, u].astype(int)
    assert blue > green + 40 > red
    for marker in (scene.FRONT_MARKER, scene.REAR_MARKER):
        u, v = in_view(camera, pose, marker).round().astype(int)
        assert np.ptp(frame[v, u].astype(int)) < 45
        assert frame[v, u].min() > 150


def test_projection_is_opencvs(camera):
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, -1.0, 0.0], [1.5, 1.0, 0.2], (50, 3))
    optics = camera.optics
    turn, _ = cv2.Rodrigues(optics.rotation)
    expected, _ = cv2.projectPoints(
        points, turn, optics.translation, optics.matrix, optics.distortion
    )
    assert camera.project(points) == pytest.approx(expected.reshape(-1, 2), abs=1e-6)


@pytest.mark.parametrize("height", [0.0, 0.1])
def test_lines_of_sight_lead_back_to_their_pixels(camera, height):
    plane = camera.optics.plane_map(height)
    pixels = np.array([[0, 0], [639, 0], [320, 240], [5, 479], [639, 479], [100, 300]])
    points = np.column_stack([plane[pixels[:, 1], pixels[:, 0]], np.full(len(pixels), height)])
    assert camera.project(points) == pytest.approx(pixels, abs=1e-5)


def test_the_lens_bends_the_picture_and_the_camera_is_tilted(camera):
    straight = replace(CameraParams(), distortion=(0.0,) * 5)
    corner = np.array([[1.38, 0.92, 0.0]])
    bent = camera.project(corner) - RoofCamera(straight, 1).project(corner)
    assert 5 < np.hypot(*bent[0]) < 40
    assert np.degrees(np.arccos(-camera.optics.rotation[2, 2])) > 2.0


@pytest.mark.slow
@pytest.mark.parametrize("size", [(640, 480), (1280, 720)])
def test_the_robot_is_in_view_all_over_the_board(size):
    optics = RoofCamera(CameraParams(size=size), 1).optics
    x, y = np.meshgrid(np.linspace(-1.38, 1.38, 9), np.linspace(-0.92, 0.92, 9))
    pixels = optics.project(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.1)]))
    assert (pixels > 8).all()
    assert (pixels < np.array(size) - 9).all()


def test_board_lines_and_floor_have_their_brightness(camera):
    frame = camera.render(None, noise=False).astype(int).mean(2)

    def grey(x, y):
        u, v = camera.project(np.array([[x, y, 0.0]]))[0].round().astype(int)
        return frame[v, u]

    line = BOARD.width / 2 - BOARD.line_inset
    assert grey(0.3, line) < 90 < 150 < grey(0.3, line - 0.05)
    assert grey(0.3, -line) < 90 < 150 < grey(0.3, -line + 0.05)
    assert grey(0.3, BOARD.width / 2 + 0.05) < 110
    assert all(grey(*mark) < 130 for mark in scene.MARKS)
    assert grey(1.0, 0.3) > grey(-1.0, 0.3) + 10  # this side is nearer to the window


def glow(frame, camera, pose):
    """Return the light around the lamp, on the black body, less the body's own."""
    centre = in_view(camera, pose, scene.LAMP)
    ring, colours = around(frame, centre, 6.0)
    beyond = np.hypot(*(ring - centre).T) > 3.5
    return colours[beyond].mean() - 20.0


@pytest.mark.slow
def test_lamp_is_as_bright_as_its_share_of_the_exposure(camera):
    pose = POSES[1]
    dark, half, full = (
        glow(camera.render(np.array(pose), lamp, noise=False), camera, pose) for lamp in (0, 0.5, 1)
    )
    assert full - dark > 15
    assert (half - dark) / (full - dark) == pytest.approx(0.5, abs=0.05)
    u, v = in_view(camera, pose, scene.LAMP).round().astype(int)
    assert camera.render(np.array(pose), 1.0, noise=False)[v, u].min() > 200
    assert camera.render(np.array(pose), 0.0, noise=False)[v, u].max() < 150


def test_lamp_switched_on_within_an_exposure_shows_partly():
    params = CameraParams(noise=0.0, clock_jitter=0.0)
    lab = Lab(1, params=LabParams.ideal(), camera=params)
    frames = []
    lab.camera.start(lambda time, frame: frames.append(frame))
    period = 1 / params.fps / (1 + params.clock_drift)
    lab.advance_to(2 * period + 0.25 * params.exposure)
    lab.body.set_output(0, 100, ON, 0, 0, RUNNING, 0)
    lab.advance_to(4 * period)
    pose = lab.body.pose
    levels = np.array([glow(frame, lab.camera, pose) for frame in frames])
    assert levels[0] == levels[1]
    fraction = (levels[2] - levels[0]) / (levels[3] - levels[0])
    assert fraction == pytest.approx(0.75, abs=0.06)


@pytest.mark.parametrize("length", [4.0, 9.0])
def test_blur_is_as_long_as_the_way_during_the_exposure(camera, length):
    middle = camera.project(np.array([[0.0, 0.0, 0.1], [0.01, 0.0, 0.1]]))
    metres = length * 0.01 / np.hypot(*(middle[1] - middle[0]))
    poses = np.zeros((5, 3))
    poses[:, 0] = metres * (np.linspace(0, 1, 5) - 0.5)

    def spread(picture):
        pixels, colours = around(picture, in_view(camera, (0, 0, 0), scene.REAR_MARKER), 14)
        weights = (colours[:, 0] - colours[:, 2]).clip(0)  # blue less red: nothing else there
        weights[weights < 10] = 0
        return np.average(
            (pixels[:, 0] - np.average(pixels[:, 0], weights=weights)) ** 2, weights=weights
        )

    moved = spread(camera.render(poses, noise=False)) - spread(camera.render(poses[2], noise=False))
    assert np.sqrt(12 * moved) == pytest.approx(length, rel=0.12)


def test_a_robot_off_the_picture_leaves_the_board_empty(camera):
    empty = camera.render(None, noise=False)
    assert np.array_equal(camera.render(np.array([2.1, 1.6, 0.0]), noise=False), empty)
    camera.render(np.array([1.55, 1.1, 0.5]))  # cut by the picture's corner


@pytest.mark.slow
def test_noise_has_its_deviation_on_board_and_robot():
    camera = RoofCamera(CameraParams(noise=3.0), 2)
    pose = np.array([0.0, 0.0, 0.3])
    clean = camera.render(pose, noise=False).astype(float)
    noise = np.stack([camera.render(pose) - clean for _ in range(12)])
    assert noise.std() == pytest.approx(3.0, rel=0.05)
    _, body = around(noise[0], in_view(camera, pose, scene.LAMP), 12)
    assert body.std() == pytest.approx(3.0, rel=0.15)
    assert abs(body.mean()) < 0.6
    assert not np.array_equal(noise[0], noise[1])


def test_frames_come_at_the_cameras_own_pace_and_time():
    params = CameraParams(size=(160, 120), fps=25.0, clock_offset=40.0, clock_drift=1e-3)
    lab = Lab(3, camera=params)
    times, shapes = [], set()
    lab.advance_to(0.5)
    lab.camera.start(lambda time, frame: (times.append(time), shapes.add(frame.shape)))
    lab.advance_to(2.5)
    lab.camera.stop()
    lab.advance_to(3.0)
    assert shapes == {(120, 160, 3)}
    assert len(times) == 50  # the 51st exposure, begun after 50 periods, is not over
    assert times[0] == pytest.approx(40.0 + 1.001 * (0.5 + params.exposure / 2), abs=1e-3)
    gaps = np.diff(times)
    assert gaps == pytest.approx(0.04, abs=1.2e-3)
    assert gaps.std() > 1e-5


def test_frames_may_get_lost():
    for dropped, expected in ((1.0, 0), (0.5, 15)):
        lab = Lab(3, camera=CameraParams(size=(160, 120), dropped=dropped))
        times = []
        lab.camera.start(lambda time, frame, times=times: times.append(time))
        lab.advance_to(1.0)
        assert len(times) == pytest.approx(expected, abs=9)


def test_a_running_camera_is_not_started_again():
    lab = Lab(3, camera=CameraParams(size=(160, 120)))
    lab.camera.start(lambda time, frame: None)
    with pytest.raises(RuntimeError, match="runs already"):
        lab.camera.start(lambda time, frame: None)


def test_a_frame_is_the_receivers_to_keep(camera):
    first = camera.render(None)
    kept = first.copy()
    camera.render(np.zeros(3))[:] = 0
    assert np.array_equal(first, kept)
    assert camera.render(None).min() > 0


def test_it_says_what_it_is(camera):
    assert camera.describe()["size"] == [640, 480]
    assert "matrix" not in camera.describe()
