import math

import numpy as np
import pytest
import tracking_scene as scene

from tracking.markers.colours import chroma_plane, parse_colour
from tracking.markers.markers import Look
from tracking.markers.palette import (
    APART,
    CONFIDENT,
    GREY,
    OTHER_HUE,
    RIVAL,
    STILL,
    describe_markers,
    least_confident,
    seen_colour,
    together,
    unless_still,
    warning,
)
from tracking.markers.tracker import Tracker
from tracking.markers.white import Cast, cast_of
from tracking.sightings import find_colours

SIZE = (320, 240)
NAMES = (parse_colour("pink"), parse_colour("blue"))


def picture(seed, *, lone=False, cast=(1.0, 1.0), robot=True):
    image = scene.background(SIZE)
    if robot:
        scene.robot(image, (130.0, 120.0), 0.4 * seed, body=(48, 18))
    if lone:
        scene.robot(image, (250.0, 60.0), 1.0 * seed, body=(48, 18))
    image *= (cast[0], 1.0, cast[1])
    return scene.finish(image, np.random.default_rng(seed))


def test_rgb_has_the_hue_chroma_and_luma_of_the_look():
    bgr = np.array([120.0, 40.0, 200.0], np.float32)
    alpha, beta = chroma_plane(bgr)
    chroma = math.hypot(alpha, beta)
    luma = float(bgr @ [0.114, 0.587, 0.299])
    colour = seen_colour(NAMES[0], Look(np.array([alpha, beta]) / chroma, chroma, luma), 0.0)
    assert colour.rgb == "#c82878"
    assert colour.confidence == pytest.approx(1, abs=1e-4)


def test_this_cameras_pink_and_blue():
    front, rear = find_colours([picture(seed) for seed in range(3)], NAMES)
    for each_result, paint in ((front, scene.PINK), (rear, scene.BLUE)):
        alpha, beta = chroma_plane(np.array(paint, np.float32))
        assert each_result.colour.hue == pytest.approx(math.atan2(beta, alpha), abs=0.08)
        assert each_result.confidence > 0.8


def test_less_sure_among_others_and_where_it_is_seldom_seen():
    alone = find_colours([picture(1)], NAMES)
    among = find_colours([picture(1, lone=True)], NAMES)
    seldom = find_colours([picture(1), picture(2, robot=False)], NAMES)
    for which in (0, 1):
        assert among[which].confidence < 0.7 * alone[which].confidence
        assert seldom[which].confidence == pytest.approx(0.5 * alone[which].confidence)
    assert find_colours([picture(2, robot=False)], NAMES) is None
    assert together([None]) is None


def test_a_cast_is_guessed_and_followed():
    before, after = picture(0), picture(1, cast=(0.8, 1.1))
    assert cast_of(before) == pytest.approx((1.0, 1.0), abs=0.02)
    assert cast_of(after) == pytest.approx((1 / 0.8, 1 / 1.1), abs=0.02)
    cast = Cast(before)
    assert cast.update(after) == pytest.approx((1 / 0.8, 1 / 1.1), abs=0.02)
    assert cast.update(np.zeros_like(after)) == cast.white
    assert cast_of(np.zeros_like(after)) == (1.0, 1.0)


def survey_of(pictures, colours=NAMES, start=None):
    tracker = Tracker(*colours, None, start)
    for i, frame in enumerate(pictures):
        tracker.update(frame, i / 30)
    return tracker.seen_colours


def test_a_survey_finds_what_came_into_view_later_and_fits_as_well():
    alone, among = picture(1), picture(1, lone=True)
    before = survey_of([alone])
    after = survey_of([alone] * 70 + [among] * 60)  # looked at: 1, 64 and 128
    assert min(colour.confidence for colour in before) > 0.8
    assert max(colour.confidence for colour in after) < 0.85 * min(
        colour.confidence for colour in before
    )
    assert {colour.reason for colour in after} == {RIVAL}
    pointed = survey_of([among], start=np.array([[145.0, 114.0], [115.0, 126.0]]))
    assert min(colour.confidence for colour in pointed) > 0.8


def test_a_pair_far_apart_for_its_size_is_doubted():
    image = scene.background(SIZE)
    for u, colour in ((60.0, scene.PINK), (128.0, scene.BLUE)):
        scene.paint_disc(image, (u, 100.0), 11.0, (18, 18, 18), fade=False)
        scene.paint_disc(image, (u, 100.0), 8.0, colour, fade=False)
    front, rear = survey_of([scene.finish(image, np.random.default_rng(0))])
    assert max(front.confidence, rear.confidence) < CONFIDENT
    assert front.as_dict()["reason"] == APART
    sentence = warning({"front": front.as_dict(), "rear": rear.as_dict()})
    assert f"front pink and rear blue: {APART}" in sentence


def test_marginal_names_and_greys_are_doubted_by_hand():
    def look(degrees, chroma):
        angle = math.radians(degrees)
        return Look(np.array([math.cos(angle), math.sin(angle)]), chroma, 90.0)

    hue, tolerance = (math.degrees(part) for part in (NAMES[0].hue, NAMES[0].tolerance))
    edge = seen_colour(NAMES[0], look(hue + tolerance, 90.0), 0.0)
    assert (edge.confidence, edge.reason) == (pytest.approx(math.exp(-0.5)), OTHER_HUE)
    grey = seen_colour(NAMES[0], look(hue, 30.0), 0.25)
    assert (grey.confidence, grey.reason) == (pytest.approx(0.5 * 0.8), GREY)
    assert warning({"front": seen_colour(NAMES[0], look(hue, 90.0), 0.0).as_dict()}) is None


def test_a_pair_that_never_moves_is_doubted():
    founds = find_colours([picture(1)], NAMES)
    front = np.array([[100.0, 100.0], [np.nan, np.nan], [100.2, 100.0]])
    still = unless_still(founds, front, front - (30.0, 0.0))
    assert {(colour.confidence, colour.reason) for colour in still} == {(0.5, STILL)}
    # It turned about its front.
    turned = unless_still(founds, front, np.array([[70.0, 100.0], [np.nan] * 2, [100.0, 130.0]]))
    assert turned == tuple(founds)


def test_the_session_that_is_least_sure_is_told():
    def markers(sure):
        return {which: {"colour": "red", "rgb": "#ff0000", "confidence": sure} for which in "ab"}

    sessions = [{"markers": markers(0.9)}, {"left_out": "no"}, {"markers": markers(0.4)}]
    assert describe_markers(least_confident(sessions)).startswith(
        "a red is #ff0000 here (confidence: 40 %), b "
    )
    assert describe_markers(least_confident([])) == ""
