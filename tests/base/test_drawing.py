"""Drawings become places: numbers by hand, transforms, layers, and drawings that are errors."""

import math
import re

import pytest

from neurosim.base.drawing import read_drawing
from neurosim.base.errors import FileError
from neurosim.base.perimeter import Board
from neurosim.base.place import Place

INKSCAPE = 'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape"'


def place_of(tmp_path, inside, size='width="100" height="100"'):
    path = tmp_path / "drawing.svg"
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {INKSCAPE} {size}>{inside}</svg>')
    place, place_of.notes = read_drawing(path)
    return place


#: 100 units are half a metre.
SCALE = '<line id="scale-50cm" x1="0" y1="0" x2="60" y2="80"/>'


def test_every_part_by_hand(tmp_path):
    """The board's middle is at (200, 150); a unit is 5 mm; y points down."""
    place = place_of(
        tmp_path,
        SCALE
        + '<rect id="board" x="0" y="0" width="400" height="300"/>'
        + '<rect id="perimeter" x="20" y="20" width="360" height="260" stroke-width="4"/>'
        + '<polygon id="outline" points="100,50 300,50 300,250 100,250"/>'
        + '<g id="walls"><polyline points="150,100 150,150 200,150"/></g>'
        + '<circle class="obstacle" cx="250" cy="100" r="10"/>'
        + '<g id="lines"><path d="M 120,200 H 180 V 240" style="stroke-width: 2px"/></g>'
        + '<circle id="light-1" cx="200" cy="60" r="3"/>'
        + '<circle id="light-2" cx="210" cy="60" r="3"/>'
        + '<line id="start" x1="200" y1="200" x2="200" y2="180"/>'
        + '<text id="caption" x="3" y="3">a caption</text>',
    )
    assert place.board == Board(2.0, 1.5, line_inset=0.1, line_width=0.02)
    assert place.outline == ((-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5))
    assert place.walls == ((-0.25, 0.25, -0.25, 0.0), (-0.25, 0.0, 0.0, 0.0))
    assert place.obstacles == ((0.25, 0.25, 0.05),)
    assert [line.points for line in place.lines] == [((-0.4, -0.25), (-0.1, -0.25), (-0.1, -0.45))]
    assert (place.lines[0].width, place.lines[0].closed) == (0.01, False)
    assert place.lights == ((0.0, 0.45), (0.05, 0.45))
    assert place.start == (0.0, -0.25, pytest.approx(math.pi / 2))
    assert not place_of.notes
    place.write(tmp_path / "place.json")
    assert Place.read(tmp_path / "place.json") == place


def test_additions_are_named(tmp_path):
    """An open outline is closed, unless its ends meet; a line without a width has the usual one."""
    place = place_of(
        tmp_path,
        SCALE
        + '<path id="outline" d="M 0,0 H 200 V 200 H 0"/>'
        + '<path id="line-1" d="M 20,20 H 180"/>'
        + '<path id="line-2" d="M 40,40 H 80 V 80 L 40,40" stroke-width="2"/>'
        + '<polyline id="obstacle" points="100,100 120,100 120,120"/>',
    )
    assert place_of.notes == [
        "outline (outline) is open: its last point is joined to its first",
        "line-1 (line) has no stroke width: 4 cm is used",
        "obstacle (obstacle) is open: its last point is joined to its first",
    ]
    assert [(line.closed, line.width) for line in place.lines] == [(False, 0.04), (True, 0.01)]
    assert (len(place.outline), len(place.walls)) == (4, 3)


def test_layers_transforms_and_pages_of_a_known_size(tmp_path):
    """As Inkscape writes it: millimetres, labels of layers, transforms within each other."""
    place = place_of(
        tmp_path,
        '<g id="layer1" inkscape:label="Outline"><rect x="10" y="10" width="100" height="60"/></g>'
        '<g inkscape:label="Walls 2" transform="translate(60 40)"><g transform="rotate(90)">'
        '<path id="path12" transform="scale(2)" d="m 0,0 5,0"/></g></g>'
        '<g inkscape:label="Lines" transform="matrix(0 2 -2 0 60 40)" stroke-width="1">'
        '<ellipse cx="0" cy="0" rx="5" ry="10"/></g>'
        '<g inkscape:label="obstacles" style="display:none"><circle cx="20" cy="20" r="5"/></g>'
        '<defs><circle id="obstacle-9" cx="20" cy="20" r="5"/></defs>',
        'width="120mm" height="80mm" viewBox="0 0 120 80"',
    )
    assert place.outline == ((-0.05, 0.03), (0.05, 0.03), (0.05, -0.03), (-0.05, -0.03))
    assert place.walls == ((0.0, 0.0, 0.0, -0.01),)
    line = place.lines[0]
    assert (line.closed, line.width) == (True, 0.002)
    # Turned by a quarter: 20 mm to each side along x, 10 mm along y.
    points = [abs(x) for x, _ in line.points], [abs(y) for _, y in line.points]
    assert (max(points[0]), max(points[1])) == pytest.approx((0.02, 0.01), abs=1e-6)
    a, b = 0.02, 0.01  # Ramanujan's first formula
    around = math.pi * (3 * (a + b) - math.sqrt((3 * a + b) * (a + 3 * b)))
    assert line.loop.length == pytest.approx(around, rel=2e-3)
    assert place.obstacles == ()


def test_circles_of_any_element_and_other_obstacles(tmp_path):
    place = place_of(
        tmp_path,
        SCALE + '<g id="obstacles"><path d="M -10,0 a 10 10 0 1 0 20 0 a 10 10 0 1 0 -20 0 z"/>'
        '<rect x="50" y="50" width="20" height="10"/>'
        '<ellipse cx="100" cy="0" rx="20" ry="10"/></g>'
        '<rect id="outline" x="-150" y="-150" width="300" height="300"/>',
    )
    assert place.obstacles == ((0.0, 0.0, 0.05),)
    assert place.walls[:4] == (
        (0.25, -0.25, 0.35, -0.25),
        (0.35, -0.25, 0.35, -0.3),
        (0.35, -0.3, 0.25, -0.3),
        (0.25, -0.3, 0.25, -0.25),
    )
    assert len(place.walls) > 4 + 30  # an ellipse, not a circle


def test_a_round_rectangle_is_a_line_of_its_length(tmp_path):
    rect = '<rect id="line" x="0" y="0" width="280" height="160" rx="60"/>'
    line = place_of(tmp_path, SCALE + rect).lines[0]
    wanted = Place.with_line("rectangle", 1.4, 0.8, 0.3).lines[0]
    assert line.loop.length == pytest.approx(wanted.loop.length, rel=1e-3)
    away, _ = wanted.loop.nearest(line.points)
    assert away.max() < 1e-3
    assert line.width == wanted.width  # its width is not given


OUTLINE = '<rect id="outline" width="100" height="100"/>'


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        ("", "no element is named as a part of a place"),
        (SCALE + '<rect id="floor" width="5" height="5"/>', "no element is named"),
        (OUTLINE, "has no size: add a line of a known length and name it"),
        (OUTLINE + SCALE + SCALE, "several scales"),
        (OUTLINE + '<line id="scale-1m" x1="3" x2="3"/>', "scale-1m has no length"),
        (SCALE + OUTLINE + OUTLINE, "several elements named outline"),
        (SCALE + '<path id="walls" d="M 0,0 L x"/>', "the path of walls cannot be read: M 0,0 L x"),
        (SCALE + '<rect id="outline" width="50%" height="9"/>', "width of outline is not a length"),
        (
            SCALE + '<g id="walls" transform="turn(3)"><path d="M0 0h9"/></g>',
            r"turn\(3\) cannot be",
        ),
        (SCALE + '<g id="walls" transform="scale(x)"><path d="M0 0h9"/></g>', r"scale\(x\) cannot"),
        (SCALE + '<g id="walls"><use href="#a"/></g>', "<use> is a copy of another element"),
        (SCALE + '<rect id="perimeter" width="50" height="9"/>', "needs a board around it"),
        (SCALE + '<circle id="board" r="50"/>', r"board \(board\) is not an upright rectangle"),
        (
            SCALE + '<rect id="board" width="90" height="60"/>'
            '<rect id="perimeter" x="9" y="3" width="72" height="54"/>',
            "must have the same distance from all edges",
        ),
        (SCALE + OUTLINE + '<circle id="obstacle" cx="900" r="9"/>', "obstacle 0 stands outside"),
    ],
)
def test_what_is_no_drawing_of_a_place_is_refused(inside, words, tmp_path):
    with pytest.raises(FileError, match=words) as caught:
        place_of(tmp_path, inside)
    assert str(caught.value).startswith(str(tmp_path / "drawing.svg"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no drawing", "is not XML"),
        ("<html></html>", "expected a drawing in SVG, found <html>"),
        ('<!DOCTYPE svg [<!ENTITY a "b">]><svg>&a;</svg>', "defines entities of its own"),
        ("<svg>" + 17 * 2**20 * " " + "</svg>", "16"),
    ],
)
def test_files_that_are_no_drawings(text, words, tmp_path):
    path = tmp_path / "drawing.svg"
    path.write_text(text)
    with pytest.raises(FileError, match=re.compile(words)):
        read_drawing(path)


@pytest.mark.parametrize(
    ("box", "inside", "words"),
    [
        ("0 0 e 1", '<circle id="obstacle" r="9"/>', "viewBox is not four numbers"),
        ("0 0 100 100", '<circle id="obstacle" r="0.1"/>', "obstacle .* is smaller than 1 mm"),
        ("0 0 0 0", '<circle id="obstacle" r="9"/>', "viewBox is not four numbers"),
        ("0 0 100 100", '<circle id="obstacle" r="-9"/>', "radius that is not above 0"),
        ("0 0 100 100", '<text id="wall-1">wall</text>', "wall-1 .wall. is a <text>: draw a shape"),
        ("0 0 100 100", '<path id="scale-abc" d="M0 0h9"/>', "not a length such as scale-50cm"),
        ("0 0 100 100", "<g>" * 3000 + '<circle id="wall" r="9"/>' + "</g>" * 3000, "too deeply"),
    ],
)
def test_sizes_that_cannot_be_are_refused(box, inside, words, tmp_path):
    with pytest.raises(FileError, match=words):
        place_of(tmp_path, inside, f'width="100mm" viewBox="{box}"')


def test_small_circles_stay_round(tmp_path):
    """Steps of a curve may be shorter than the distance below which two points count as one."""
    size = 'width="100cm" height="80cm" viewBox="0 0 1000 800"'
    place = place_of(tmp_path, '<circle id="obstacle" cx="100" cy="100" r="8"/>', size)
    assert place.obstacles[0][2] == pytest.approx(0.008, abs=2e-4)


def test_a_page_is_shown_as_large_as_fits_into_width_and_height(tmp_path):
    size = 'width="100cm" height="40cm" viewBox="0 0 1000 800"'
    place = place_of(tmp_path, '<rect id="board" width="800" height="600"/>', size)
    assert (place.board.length, place.board.width) == (0.4, 0.3)
