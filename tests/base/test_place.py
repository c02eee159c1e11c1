"""Places are written and read; impossible ones are errors; distances by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from neurosim.base.errors import FileError, UserError
from neurosim.base.perimeter import Board
from neurosim.base.place import NAMED, Line, Place, paper_arena

ALL = Place(
    paper_arena().outline,
    ((-0.2, -0.1, -0.1, 0.1),),
    ((0.1, 0.02, 0.03),),
    (Line(((0, 0), (0.1, 0), (0.1, 0.1)), 0.02), Line(((0, 0), (0.2, 0.1)), closed=False)),
    ((0.25, 0.15),),
    Board(0.6, 0.35, line_inset=0.03, line_width=0.01),
    (0.2, 0.1, 1.0),
)


def test_round_trip(tmp_path):
    ALL.write(tmp_path / "place.json")
    assert Place.read(tmp_path / "place.json") == ALL == Place.of(ALL.to_json())
    assert Place.of(tmp_path / "place.json") == ALL
    assert ALL.surfaces.shape == (4 + 4, 4)  # a wall inside is a board of four sides
    assert ALL.bounds == (-0.3, -0.175, 0.3, 0.175)
    Place().write(tmp_path / "nothing.json")
    assert json.loads((tmp_path / "nothing.json").read_text()) == {
        "format": "neurosim-place", "version": 1,
    }  # fmt: skip
    assert Place.read(tmp_path / "nothing.json") == Place()
    for name in NAMED:
        assert Place.of(Place.of(name).to_json()) == Place.of(name)


def test_a_board_without_a_line_has_none(tmp_path):
    path = tmp_path / "place.json"
    about = {"format": "neurosim-place", "version": 1, "board": {"length": 2, "width": 1}}
    path.write_text(json.dumps(about))
    assert Place.read(path).board == Board(2, 1, line_width=0.0)
    assert Place.read(path).bounds == (-1.0, -0.5, 1.0, 0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"outline": [[0, 0], [1, 1]]}, "an outline has at least 3 corners"),
        ({"outline": [[0, 0], [1, 0], [1, 1], [0, 0]]}, "corners 3 and 0 of the outline are the s"),
        ({"outline": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "crosses itself: .* corners 0 and 2"),
        ({"outline": [[0, 0, 1, 0]]}, r"field 'outline\[0\]': expected a list of 2 numbers"),
        ({"obstacles": [[0.5, 0, 0.02]]}, "obstacle 0 stands outside"),
        ({"obstacles": [[0.29, 0, 0.02]]}, "obstacle 0 overlaps a wall"),
        ({"obstacles": [[0, 0, 0.02], [0.03, 0, 0.02]]}, "obstacle 1 overlaps obstacle 0"),
        ({"obstacles": [[0, 0, -0.02]]}, r"obstacles\[0\]\[2\]': expected a number from 0\.0001"),
        ({"obstacles": [[0, 0]]}, r"field 'obstacles\[0\]': expected a list of 3 numbers"),
        ({"obstacles": [[0, 0, float("1e300")]]}, r"obstacles\[0\]\[2\]': .* found 1e"),
        ({"walls": 3}, "field 'walls': expected a list, found 3"),
        ({"walls": [[0.5, 0, 0.6, 0]]}, "wall 0 stands outside"),
        ({"walls": [[0.1, 0, 0.1, 0]]}, "wall 0 has no length"),
        ({"lines": [{"points": [[0, 0], [1, 1]]}]}, "a closed line needs at least 3 points, found"),
        ({"lines": [{"points": [[0, 0]], "closed": False}]}, "an open line needs at least 2"),
        ({"lines": [{"points": [[0, 0], [1, 1]], "width": -1}]}, r"lines\[0\]\.width"),
        ({"lights": [[0, 0, 0]]}, r"lights\[0\]"),
        ({"board": {"length": 2}}, r"board\.width': is missing"),
        ({"start": [0.31, 0, 0]}, "cannot start at x 31.0 cm.*outside the outline"),
        ({"walls": [[0.1, -0.1, 0.1, 0.1]], "start": [0.103, 0, 0]}, "stand in a wall"),
        ({"version": 7}, "version"),
        ({"wals": []}, "there is no 'wals'; expected outline, walls, obstacles"),
        ({"lines": [{"point": []}]}, "missing"),
        ({"format": "neurosim-arena"}, "expected 'neurosim-place', found 'neurosim-arena'"),
    ],
)
def test_what_is_wrong_is_named(change, message, tmp_path):
    path = tmp_path / "place.json"
    Place.rectangle(0.6, 0.35).write(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(FileError, match=message):
        Place.read(path)


def test_clearance_and_starts():
    arena = paper_arena()
    assert arena.clearance([0.06, 0.0]) == pytest.approx(0.06 - 0.0275)
    assert arena.clearance([0.29, 0.0]) == pytest.approx(0.01)
    assert arena.clearance([0.31, 0.0]) == -math.inf
    assert Place().clearance([5.0, 0.0]) == math.inf
    # In the middle of a wall of 1 cm the distance to its surface is 0.5 cm.
    assert ALL.clearance([-0.15, 0.0]) == pytest.approx(-0.005)
    with pytest.raises(UserError, match=r"x 0\.0 cm, y 0\.0 cm: it would stand in a wall or an"):
        arena.check_start((0, 0, 0), 0.0275)
    with pytest.raises(UserError, match="outside the outline"):
        arena.check_start((0.5, 0, 0), 0.0275)
    poses = arena.free_poses(200, 0.0275, np.random.default_rng(0))
    assert poses.shape == (200, 3)
    assert arena.clearance(poses[:, :2]).min() > 0.0275
    on_board = Place.of("board").free_poses(200, 0.1, np.random.default_rng(0))
    assert np.abs(on_board[:, :2]).max(axis=0) == pytest.approx([1.38, 0.92], rel=0.05)
    with pytest.raises(UserError, match="no room"):
        Place.rectangle(0.05, 0.05).free_poses(1, 0.0275, np.random.default_rng(0))
    with pytest.raises(UserError, match="neither an outline nor a board"):
        Place.of("ellipse").free_poses(1, 0.0275, np.random.default_rng(0))


def test_inside_a_polygon_with_a_bay():
    place = Place(((0, 0), (2, 0), (2, 2), (1, 1), (0, 2)))
    inside = place.inside([[1, 0.5], [1, 1.5], [0.2, 1.5], [3, 1]])
    assert inside.tolist() == [True, False, True, False]
    assert len(place.screens) == 5  # not convex: walls may hide others
    assert len(paper_arena().screens) == 0


def test_what_is_free_is_on_the_left_of_a_surface():
    """This holds for both orders of an outline's corners, and on all sides of a wall inside."""
    square = paper_arena().outline
    wall = ((-0.2, -0.1, -0.1, 0.1),)
    for outline in (square, square[::-1]):
        place = Place(outline, wall)
        starts, ends = place.surfaces[:, :2], place.surfaces[:, 2:]
        along = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
        left = (starts + ends) / 2 + 0.002 * np.stack([-along[:, 1], along[:, 0]], 1)
        assert place.clearance(left) == pytest.approx(0.002)
        assert place.screens.tolist() == [list(wall[0])]
    # One centimetre thick, as long as its middle.
    lengths = np.linalg.norm(ends - starts, axis=1)[4:]
    assert lengths == pytest.approx([math.hypot(0.1, 0.2), 0.01] * 2)


def test_an_open_line_leads_there_and_back():
    bent = Line(((0, 0), (1, 0), (1, 2)), closed=False)
    assert bent.loop.length == pytest.approx(6.0)
    away, _ = bent.loop.nearest([[0.5, 0.3], [0.4, 1.0], [-0.3, 0.4]])
    assert away == pytest.approx([0.3, 0.6, 0.5])  # there is no side from its end to its beginning
    straight = Line(((0, 0), (1, 0)), closed=False)
    assert straight.loop.nearest([[2.0, 0.0], [0.5, 0.2]])[0] == pytest.approx([1.0, 0.2])
    assert straight.shapes() == [{"polygon": [[0, 0], [1, 0]], "width": 0.04}]


def test_a_picture_shows_every_part():
    shapes = ALL.shapes()
    corners = [len(shape.get("polygon", [])) for shape in shapes]
    # The board and its perimeter line, the outline, both lines, the wall, obstacle and light.
    assert corners == [4, 2, 2, 2, 2, 4, 2, 2, 2, 2, 4, 0, 0]
    assert shapes[1]["polygon"] == [[-0.27, pytest.approx(-0.145)], [0.27, pytest.approx(-0.145)]]
    assert [shape["width"] for shape in shapes[6:10]] == [0.02, 0.02, 0.02, 0.04]
    bare = replace(ALL, board=Board(0.6, 0.35, line_width=0.0)).shapes()
    assert len(bare) == len(shapes) - 4
