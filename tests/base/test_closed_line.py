"""Closed lines: lengths by hand, the nearest point by brute force, poses on the line."""

import math

import numpy as np
import pytest

from neurosim.base.closed_line import ClosedLine, distance_to
from neurosim.base.errors import UserError

SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]


def test_lengths():
    assert ClosedLine(SQUARE).length == 4.0
    assert ClosedLine([*SQUARE, (0.0, 0.0)]).length == 4.0  # the first point again
    rounded = ClosedLine.of("rectangle", 1.4, 0.8, 0.3)
    assert rounded.length == pytest.approx(2 * 0.8 + 2 * 0.2 + 2 * math.pi * 0.3, rel=1e-4)
    assert ClosedLine.of("rectangle", 1.4, 0.8).length == pytest.approx(4.4)
    assert ClosedLine.of("ellipse", 1.0, 1.0).length == pytest.approx(math.pi, rel=1e-3)
    assert np.abs(rounded.points).max(axis=0) == pytest.approx([0.7, 0.4])


def test_nearest_by_hand():
    line = ClosedLine(SQUARE)
    away, along = line.nearest([[0.25, -0.1], [1.2, 0.5], [0.5, 0.9], [-0.3, -0.4], [0.1, 0.6]])
    assert away == pytest.approx([0.1, 0.2, 0.1, 0.5, 0.1])
    assert along == pytest.approx([0.25, 1.5, 2.5, 0.0, 3.4])


def test_nearest_is_that_of_many_points():
    line, rng = ClosedLine.of("ellipse", 1.2, 0.7), np.random.default_rng(0)
    places = rng.uniform(-1, 1, (5, 8, 2))
    away, along = line.nearest(places)
    every = line.poses(np.linspace(0, line.length, 20_000))[:, :2]
    wanted = np.linalg.norm(places[..., None, :] - every, axis=-1).min(-1)
    assert away.shape == along.shape == (5, 8)
    np.testing.assert_allclose(away, wanted, atol=1e-6)
    there = line.poses(along)[..., :2]
    np.testing.assert_allclose(np.linalg.norm(places - there, axis=-1), away, atol=1e-9)
    one = [distance_to(line.points, *place) for place in places[0]]
    np.testing.assert_allclose(one, away[0], atol=1e-12)


def test_poses_face_along_the_line_or_against_it():
    line = ClosedLine(SQUARE)
    poses = line.poses([0.5, 1.5, 2.5, 3.5, 4.5], [False, False, False, False, True])
    np.testing.assert_allclose(poses[:, :2], [[0.5, 0], [1, 0.5], [0.5, 1], [0, 0.5], [0.5, 0]])
    turn = np.pi / 2
    wanted = [0, turn, 2 * turn, -turn, 2 * turn]
    np.testing.assert_allclose(np.cos(poses[:, 2] - wanted), 1.0)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: ClosedLine([(0, 0), (1, 0)]), "at least three points"),
        (lambda: ClosedLine([(0, 0), (1, 0), (np.nan, 1)]), "finite"),
        (lambda: ClosedLine([(0, 0), (0, 0), (1, 1)]), "different"),
        (lambda: ClosedLine.of("circle", 1, 1), "rectangle, ellipse"),
        (lambda: ClosedLine.of("ellipse", 0, 1), "0 m by 1 m"),
        (lambda: ClosedLine.of("rectangle", 1, 0.5, 0.3), "corners of 0.3 m"),
    ],
)
def test_what_is_no_line_is_refused(made, words):
    with pytest.raises(UserError, match=words):
        made()
