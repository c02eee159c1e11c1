import math

import cv2
import numpy as np
import pytest
import tracking_scene as scene
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base.errors import UserError
from tracking.markers.colours import NAMED, angle_between, chroma_plane, parse_colour
from tracking.markers.markers import Picture, learn, measure


def one_marker(centre, radius=6.4, colour=scene.PINK, fade=True, jpeg=None, seed=0, noise=2.0):
    image = scene.background((120, 90))
    scene.paint_rectangle(image, centre, (radius + 3, radius + 3), 0.3, (scene.BLACK,) * 3)
    scene.paint_disc(image, centre, radius, colour, fade=fade)
    return scene.finish(image, np.random.default_rng(seed), noise=noise, jpeg=jpeg)


def find(frame, name, radius=6.4):
    blob = Picture(frame).blobs(parse_colour(name))[0]
    return measure(frame, blob.centre, radius, learn(frame, blob), 3.0)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.integers(0, 999), st.booleans())
def test_the_centre_to_a_tenth_of_a_pixel(du, dv, seed, fade):
    centre = np.array([60.0 + du, 45.0 + dv])
    for colour, name in ((scene.PINK, "pink"), (scene.BLUE, "blue")):
        blobs = find(one_marker(centre, colour=colour, fade=fade, seed=seed), name)
        assert math.dist(blobs.centre, centre) < 0.1


@pytest.mark.parametrize("name", ["pink", "blue"])
def test_no_bias_and_little_noise_through_jpeg(name):
    rng = np.random.default_rng(5)
    misses = []
    for seed in range(40):
        centre = np.array([60.0, 45.0]) + rng.uniform(-0.5, 0.5, 2)
        colour = scene.PINK if name == "pink" else scene.BLUE
        blobs = find(one_marker(centre, colour=colour, jpeg=90, seed=seed), name)
        misses.append(blobs.centre - centre)
    assert np.abs(np.mean(misses, axis=0)).max() < 0.02
    assert np.std(misses, axis=0).max() < 0.05


def test_a_bright_board_close_to_the_rim_pulls_little():
    centre = np.array([60.3, 45.4])
    image = scene.background((120, 90))
    # Black reaches 2 px beyond the rim on one side, far on the other.
    scene.paint_rectangle(image, (centre[0] + 20, centre[1]), (28.4, 20), 0.0, (scene.BLACK,) * 3)
    scene.paint_disc(image, centre, 6.4, scene.PINK)
    blobs = find(scene.finish(image, np.random.default_rng(0)), "pink")
    assert math.dist(blobs.centre, centre) < 0.15


def test_a_square_and_its_area():
    image = scene.background((120, 90), level=30.0)
    scene.paint_rectangle(image, (60.25, 44.5), (6.0, 6.0), 0.4, (60, 170, 60))
    blobs = find(scene.finish(image, np.random.default_rng(0)), "green", radius=6.8)
    assert math.dist(blobs.centre, (60.25, 44.5)) < 0.05
    assert blobs.area == pytest.approx(144, rel=0.15)


def test_nothing_there_is_none():
    frame = one_marker((60.0, 45.0))
    look = learn(frame, Picture(frame).blobs(parse_colour("pink"))[0])
    empty = scene.finish(scene.background((120, 90)), np.random.default_rng(1))
    assert measure(empty, np.array([60.0, 45.0]), 6.4, look, 3.0) is None
    assert measure(frame, np.array([-80.0, 45.0]), 6.4, look, 3.0) is None


def test_blobs_of_a_reduced_frame_stand_where_they_are():
    frame = cv2.resize(one_marker((60.0, 45.0)), (1920, 1440), interpolation=cv2.INTER_CUBIC)
    picture = Picture(frame)
    assert picture.factor == 3
    blob = picture.blobs(parse_colour("pink"))[0]
    # Sixteen times as large, pixel edges on pixel edges.
    assert math.dist(blob.centre, (16 * 60.5 - 0.5, 16 * 45.5 - 0.5)) < 4


def test_blobs_pass_over_greys_specks_and_large_areas():
    image = scene.background((120, 90))
    image[:30] = scene.PINK
    image[60, 60] = scene.PINK
    frame = scene.finish(image, np.random.default_rng(0), blur=0)
    assert Picture(frame).blobs(parse_colour("pink")) == []


@pytest.mark.parametrize("name", sorted(NAMED))
def test_named_colours_mean_themselves(name):
    colour = parse_colour(f" {name.upper()} ")
    alpha, beta = chroma_plane(np.array(colour.bgr, np.float32))
    assert abs(angle_between(math.atan2(beta, alpha), colour.hue)) < math.radians(1.5)


@given(st.integers(0, 359), st.integers(40, 100), st.integers(40, 100))
def test_hue_agrees_with_hsv(hue, saturation, value):
    pixel = np.float32([[[hue, saturation / 100, value / 100]]])
    blue, green, red = np.round(255 * cv2.cvtColor(pixel, cv2.COLOR_HSV2BGR)[0, 0]).astype(int)
    for text in (f"#{red:02x}{green:02x}{blue:02x}", f"hsv:{hue},{saturation},{value}"):
        assert abs(angle_between(parse_colour(text).hue, math.radians(hue))) < math.radians(3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("mauve", "is not known; name one of red, orange"),
        ("#808080", "is a grey"),
        ("#12345", "is not known"),
        ("hsv:10,5,50", "is a grey"),
        ("hsv:400,50,50", "expected hsv:0-360"),
    ],
)
def test_colours_that_cannot_be(text, says):
    with pytest.raises(UserError, match=says):
        parse_colour(text)
