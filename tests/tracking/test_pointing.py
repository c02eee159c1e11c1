import math

import numpy as np
import pytest
import tracking_scene as scene

from neurosim.base.errors import UserError
from tracking.markers.colours import angle_between, parse_colour
from tracking.markers.pointing import colour_at, distinguishable


@pytest.mark.parametrize(("which", "bgr"), [("front", scene.PINK), ("rear", scene.BLUE)])
@pytest.mark.parametrize("off", [(0, 0), (3, 2), (-5, 4)])
def test_a_click_on_or_near_a_fading_marker_gives_its_colour(which, bgr, off):
    image = scene.background()
    front, rear = scene.robot(image, np.array([300.0, 200.0]), 0.7)
    frame = scene.finish(image, np.random.default_rng(1))
    colour = colour_at(frame, (front if which == "front" else rear) + off)
    true = parse_colour(f"#{bgr[2]:02x}{bgr[1]:02x}{bgr[0]:02x}")
    assert abs(math.degrees(float(angle_between(colour.colour.hue, true.hue)))) < 6
    assert colour.places == 1
    assert colour.confidence > 0.7


def test_a_second_patch_of_the_colour_is_counted_and_makes_it_less_sure():
    image = scene.background()
    front, _ = scene.robot(image, np.array([300.0, 200.0]), 0.7)
    scene.paint_disc(image, np.array([500.0, 400.0]), 7, scene.PINK)
    colour = colour_at(scene.finish(image, np.random.default_rng(1)), front)
    assert colour.places == 2
    assert colour.confidence <= 0.7


def test_grey_is_no_colour():
    frame = scene.finish(scene.background(), np.random.default_rng(1))
    with pytest.raises(UserError, match="grey"):
        colour_at(frame, (100, 100))
    with pytest.raises(UserError, match="outside"):
        colour_at(frame, (700, 100))


def test_pink_and_blue_are_told_apart_and_two_pinks_are_not():
    pink, blue, red = (parse_colour(name) for name in ("pink", "blue", "red"))
    assert distinguishable(pink, blue)
    assert not distinguishable(pink, red)
