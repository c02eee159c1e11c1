"""The tracker on the benchmark's scenes: short, small clips, compared with their known poses."""

import math

import numpy as np
import pytest
from tracking_accuracy import Colours, OneTag, OpenCV, rate
from tracking_scenes import ARUCO, MARKERS, SCENARIOS, TAG_PLACE, Clip

from tracking.markers.tags import Tag
from tracking.poses import board_poses

SIZE = (640, 480)
BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}


def tracked(name, seconds, method=Colours, *carried, every=1, seed=1):
    clip = Clip(BY_NAME[name], SIZE, seed, seconds, *carried)
    estimate = method(clip.camera, *carried)
    frames = [frame for i, frame in enumerate(clip) if i % every == 0]
    return rate([(frame, estimate(frame.picture, frame.time)) for frame in frames])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["clean", "square", "lamp", "blur", "others", "tilted"])
def test_a_millimetre_and_a_third_of_a_degree(name):
    seen = tracked(name, 0.7)
    assert seen["tracked"] == 1
    assert seen["position_mm"] < 0.5
    assert seen["heading_deg"] < 0.15
    assert seen["false"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("tag", [ARUCO, Tag(number=7)], ids=str)
@pytest.mark.parametrize("name", ["clean", "blur", "tilted"])
def test_a_tag_to_a_fifth_of_a_millimetre_and_of_a_degree(name, tag):
    seen = tracked(name, 0.7, OneTag, tag, 0.06)
    assert seen["tracked"] == 1
    assert seen["position_mm"] < 0.2
    assert seen["heading_deg"] < 0.2
    assert seen["false"] == 0


@pytest.mark.slow
def test_colours_that_drift_from_purple_to_red_are_followed():
    seen = tracked("cast", 3.0)
    assert seen["tracked"] == 1
    assert seen["worst_mm"] < 1


@pytest.mark.slow
@pytest.mark.parametrize("what", [(Colours,), (OneTag, ARUCO, 0.06)], ids=["colours", "tag"])
def test_hands_and_cables_make_no_pose_and_the_robot_is_found_again(what):
    seen = tracked("covered", 5.2, *what, every=2)
    assert seen["false"] == 0
    assert seen["swapped"] == 0
    assert seen["worst_mm"] < 1
    assert seen["tracked"] > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("what", [(Colours,), (OneTag, ARUCO, 0.06)], ids=["colours", "tag"])
def test_out_of_the_picture_and_back(what):
    seen = tracked("leaves", 5.2, *what, every=2)
    assert seen["whole"] < seen["frames"]
    assert seen["false"] == 0
    assert seen["tracked"] > 0.9


@pytest.mark.slow
def test_the_truth_of_the_scenes_is_where_an_independent_detector_sees_it():
    seen = tracked("clean", 0.5, OpenCV, ARUCO, 0.1)
    assert seen["tracked"] == 1
    assert seen["position_mm"] < 1
    assert seen["heading_deg"] < 1.5
    assert TAG_PLACE[0] == pytest.approx((MARKERS["front"]["x"] + MARKERS["rear"]["x"]) / 2)


def test_rating_by_hand():
    clip = Clip(BY_NAME["clean"], (64, 48), 0, 0.1)
    frame = clip._frame(0)
    off = np.add(frame.pose, (0.003, 0.004, math.radians(2)))
    seen = rate([(frame, off), (frame, None)])
    assert seen["position_mm"] == pytest.approx(5)
    assert seen["heading_deg"] == pytest.approx(2)
    assert (seen["tracked"], seen["false"], seen["swapped"]) == (0.5, 0, 0)
    wrong = rate([(frame, np.add(frame.pose, (0.0, 0.0, math.pi)))])
    assert (wrong["false"], wrong["swapped"]) == (1, 1)


def test_markers_are_painted_where_the_camera_is_said_to_see_them():
    clip = Clip(BY_NAME["tilted"], SIZE, 2, 0.1)
    frame = clip._frame(0)
    front, rear = clip.marker_pixels(frame.pose)

    class Seen:
        pass

    seen = Seen()
    seen.front, seen.rear = front[None], rear[None]
    np.testing.assert_allclose(board_poses(seen, MARKERS, clip.camera)[0], frame.pose, atol=1e-5)
    for pixel, first in ((front, 2), (rear, 0)):
        u, v = np.round(pixel).astype(int)
        window = frame.picture[v - 6 : v + 7, u - 6 : u + 7].reshape(-1, 3).astype(int)
        assert window.mean(axis=0).argmax() == first
