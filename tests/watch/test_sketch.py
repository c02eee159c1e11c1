"""Clicks on the floor become a place: each part with numbers by hand."""

import math

import pytest

from neurosim.base.errors import UserError
from neurosim.base.perimeter import Board
from neurosim.base.place import Line, Place
from neurosim.watch.sketch import ANY_NUMBER, Sketch

BARE = Place(board=Board(2.0, 1.0, line_width=0.0))


def sketched(part, *points, width=0.02, place=BARE):
    sketch = Sketch(place)
    for point in points:
        says = sketch.click(part, point, width)
    if part in ANY_NUMBER:
        says = sketch.finish(width)
    assert says.startswith(f"the {part} is drawn")
    assert sketch.points == []
    return sketch.place


def test_each_part_by_hand():
    corners = ((-0.5, -0.4), (0.5, -0.4), (0.0, 0.4))
    assert sketched("outline", *corners).outline == corners
    assert sketched("wall", (0.1, 0.2), (0.3, 0.2)).walls == ((0.1, 0.2, 0.3, 0.2),)
    [(x, y, radius)] = sketched("cylinder", (0.1, 0.2), (0.13, 0.24)).obstacles
    assert (x, y, radius) == (0.1, 0.2, pytest.approx(0.05))
    # The third click sets the depth and the side of a box; any point on that edge is accepted.
    assert sketched("box", (0.0, 0.0), (0.2, 0.0), (0.7, -0.1)).walls == (
        (0.0, 0.0, 0.2, 0.0), (0.2, 0.0, 0.2, -0.1), (0.2, -0.1, 0.0, -0.1), (0.0, -0.1, 0.0, 0.0),
    )  # fmt: skip
    turned = sketched("box", (0.0, 0.0), (0.3, 0.4), (-0.08, 0.06)).walls
    assert turned[1:3] == ((0.3, 0.4, 0.22, 0.46), (0.22, 0.46, -0.08, 0.06))
    for part, is_closed in (("line", False), ("closed line", True)):
        [line] = sketched(part, *corners, width=0.03).lines
        assert line == Line(corners, 0.03, is_closed)
    assert sketched("light", (0.1, 0.2)).lights == ((0.1, 0.2),)
    assert sketched("start", (0.1, 0.2), (0.1, 0.5)).start == (0.1, 0.2, round(math.pi / 2, 4))
    # 8 cm from the nearer edge.
    assert sketched("perimeter", (0.92, 0.1)).board == Board(2.0, 1.0, 0.08, 0.02)
    assert sketched("perimeter", (0.3, -0.42)).board == Board(2.0, 1.0, 0.08, 0.02)


def test_a_place_grows_and_there_is_one_outline_and_one_start():
    place = BARE
    for y in (0.1, 0.2):
        place = sketched("wall", (0.0, y), (0.1, y), place=place)
        place = sketched("start", (-0.3, y), (0.0, y), place=place)
    assert len(place.walls) == 2
    assert place.start == (-0.3, 0.2, 0.0)


@pytest.mark.parametrize(
    ("part", "points", "message"),
    [
        ("outline", [(0, 0), (0.1, 0)], "an outline has at least 3 corners"),
        ("outline", [(0, 0), (0.2, 0.2), (0.2, 0), (0, 0.2)], "the outline crosses itself"),
        ("line", [(0, 0)], "an open line needs at least 2 points, found 1"),
        ("wall", [(0, 0), (0, 0)], "wall 0 has no length"),
        ("box", [(0, 0), (0, 0), (0, 1)], "two corners of the box are the same"),
        ("box", [(0, 0), (1, 0), (0.5, 0)], "the box has no depth"),
        ("cylinder", [(0, 0), (0, 0)], "no radius: click on its edge"),
        ("start", [(0, 0), (0, 0)], "a start needs a point straight ahead"),
        ("perimeter", [(1.02, 0)], "line is outside the board"),
    ],
)
def test_a_part_that_cannot_be_is_refused_and_the_place_stays(part, points, message):
    sketch = Sketch(BARE)

    def draw():
        for point in points:
            sketch.click(part, tuple(map(float, point)), 0.02)
        sketch.finish(0.02)

    with pytest.raises(UserError, match=message):
        draw()
    assert sketch.place == BARE
    # The earlier clicks are kept, to be undone or corrected.
    assert len(sketch.points) == (len(points) if part in ANY_NUMBER else len(points) - 1)


def test_undo_goes_back_click_by_click_and_then_part_by_part():
    sketch = Sketch(BARE)
    sketch.click("light", (0.1, 0.1), 0.02)
    sketch.click("wall", (0.0, 0.0), 0.02)
    with pytest.raises(UserError, match="finish the wall first"):
        sketch.click("light", (0.1, 0.2), 0.02)
    with pytest.raises(UserError, match="finished by a click on the other end"):
        sketch.finish(0.02)
    sketch.undo()
    assert (sketch.points, len(sketch.place.lights)) == ([], 1)
    sketch.undo()
    assert sketch.place == BARE
    with pytest.raises(UserError, match="nothing to undo"):
        sketch.undo()


def test_another_board_is_another_for_all_that_is_undone():
    sketch = Sketch(Place())
    sketch.click("light", (0.1, 0.1), 0.02)
    sketch.set_board(3.0, 2.0)
    assert sketch.place.board == Board(3.0, 2.0, line_width=0.0)
    sketch.undo()
    assert sketch.place == Place(board=Board(3.0, 2.0, line_width=0.0))
