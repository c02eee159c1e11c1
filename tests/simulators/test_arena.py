"""Arenas survive the disk; what cannot stand is refused."""

import json
import math

import numpy as np
import pytest

from neurosim.base.errors import FileError, UserError
from neurosim.simulators.tables.arena import Arena, paper_arena


def test_round_trip(tmp_path):
    arena = Arena(
        paper_arena().outline, ((0.1, 0.02, 0.03),), ((-0.2, -0.1, -0.1, 0.1),), (0.2, 0.1, 1.0)
    )
    arena.write(tmp_path / "arena.json")
    assert Arena.read(tmp_path / "arena.json") == arena
    assert arena.walls.shape == (4 + 4, 4)  # an inner wall is a board of four sides
    assert arena.bounds == (-0.3, -0.175, 0.3, 0.175)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"outline": [[0, 0, 1, 0], [1, 0, 1, 1]]}, "do not close: an outline has at least 3"),
        (
            {"outline": [[0, 0, 1, 0], [1, 0, 1, 1], [1, 1, 0, 0.5]]},
            "do not close: wall 2 of the outline ends 50.0 cm from where wall 0 begins",
        ),
        ({"obstacles": [[0.5, 0, 0.02]]}, "obstacle 0 stands outside"),
        ({"obstacles": [[0.29, 0, 0.02]]}, "obstacle 0 overlaps a wall"),
        ({"obstacles": [[0, 0, 0.02], [0.03, 0, 0.02]]}, "obstacle 1 overlaps obstacle 0"),
        ({"obstacles": [[0, 0, -0.02]]}, "obstacle 0 has a radius of -0.02 m"),
        ({"obstacles": [[0, 0]]}, r"field 'obstacles\[0\]': expected a list of 3 numbers"),
        (
            {"obstacles": [[0, 0, float("1e300")]]},
            r"obstacles\[0\]\[2\]': .* found 1e",
        ),
        ({"inner": 3}, "field 'inner': expected a list, found 3"),
        ({"inner": [[0.5, 0, 0.6, 0]]}, "inner wall 0 stands outside"),
        ({"inner": [[0.1, 0, 0.1, 0]]}, "wall 4 has no length"),
        ({"version": 7}, "version"),
    ],
)
def test_what_is_wrong_is_named(change, message, tmp_path):
    path = tmp_path / "arena.json"
    Arena.rectangle(0.6, 0.35).write(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(FileError, match=message):
        Arena.read(path)


def test_clearance_and_starts():
    arena = paper_arena()
    assert arena.clearance([0.06, 0.0]) == pytest.approx(0.06 - 0.0275)
    assert arena.clearance([0.29, 0.0]) == pytest.approx(0.01)
    assert arena.clearance([0.31, 0.0]) == -math.inf
    with pytest.raises(UserError, match=r"x 0\.0 cm, y 0\.0 cm: it would stand in a wall or an"):
        arena.check_start((0, 0, 0), 0.0275)
    with pytest.raises(UserError, match="outside the arena"):
        arena.check_start((0.5, 0, 0), 0.0275)
    poses = arena.free_poses(200, 0.0275, np.random.default_rng(0))
    assert poses.shape == (200, 3)
    assert arena.clearance(poses[:, :2]).min() > 0.0275
    with pytest.raises(UserError, match="no room"):
        Arena.rectangle(0.05, 0.05).free_poses(1, 0.0275, np.random.default_rng(0))


def test_inside_a_polygon_with_a_bay():
    corners = [(0, 0), (2, 0), (2, 2), (1, 1), (0, 2)]
    walls = tuple((*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True))
    arena = Arena(walls)
    assert arena.inside([[1, 0.5], [1, 1.5], [0.2, 1.5], [3, 1]]).tolist() == [
        True,
        False,
        True,
        False,
    ]
    assert len(arena.screens) == 5  # not convex: walls may hide others
    assert len(paper_arena().screens) == 0


def test_what_is_free_is_on_the_left_of_a_surface():
    """Whichever way round an outline is given, and on all sides of a board."""
    square = paper_arena().outline
    turned = tuple((*wall[2:], *wall[:2]) for wall in reversed(square))
    board = ((-0.2, -0.1, -0.1, 0.1),)
    for outline in (square, turned):
        arena = Arena(outline, (), board)
        starts, ends = arena.walls[:, :2], arena.walls[:, 2:]
        along = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
        left = (starts + ends) / 2 + 0.002 * np.stack([-along[:, 1], along[:, 0]], 1)
        assert arena.clearance(left) == pytest.approx(0.002)
        assert arena.screens.tolist() == [list(board[0])]
    # One centimetre thick, as long as its middle.
    lengths = np.linalg.norm(ends - starts, axis=1)[4:]
    assert lengths == pytest.approx([math.hypot(0.1, 0.2), 0.01] * 2)
