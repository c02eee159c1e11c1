import math

import numpy as np
import pytest
import tracking_scene as scene

from tracking.colours import chroma_plane, parse_colour
from tracking.markers import Look
from tracking.palette import find_colours, found_colour, together
from tracking.white import Cast, cast_of

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
    found = found_colour(NAMES[0], Look(np.array([alpha, beta]) / chroma, chroma, luma), 0.0)
    assert found.rgb == "#c82878"
    assert found.sure == 1
    assert found_colour(NAMES[0], Look(np.array([1.0, 0.0]), 30.0, 90.0), 1.0).sure == 0.25


def test_this_cameras_pink_and_blue():
    front, rear = find_colours([picture(seed) for seed in range(3)], NAMES)
    for found, paint in ((front, scene.PINK), (rear, scene.BLUE)):
        alpha, beta = chroma_plane(np.array(paint, np.float32))
        assert found.colour.hue == pytest.approx(math.atan2(beta, alpha), abs=0.08)
        assert found.sure > 0.8


def test_less_sure_among_others_and_where_it_is_seldom_seen():
    alone = find_colours([picture(1)], NAMES)
    among = find_colours([picture(1, lone=True)], NAMES)
    seldom = find_colours([picture(1), picture(2, robot=False)], NAMES)
    for which in (0, 1):
        assert among[which].sure < 0.7 * alone[which].sure
        assert seldom[which].sure == pytest.approx(0.5 * alone[which].sure)
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
