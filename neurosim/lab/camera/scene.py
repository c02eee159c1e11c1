"""The scene under the roof camera: floor, board and robot, painted pixel by pixel.

Colours are blue, green, red grey levels in full light. All visible parts of the robot are painted
in the plane of its markers. A pixel is the mean of 2 x 2 samples (3 x 3 for the ground),
each with edges blurred over its own breadth, so that centres are exact to hundredths of a pixel. If
a robot moves during the exposure, every pose uses two of the four samples, on one diagonal of the
pixel, and the next pose the other two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from neurosim.base.closed_line import distance_to
from neurosim.base.compiled import njit
from neurosim.base.errors import UserError
from neurosim.base.perimeter import Board
from neurosim.base.place import THICKNESS, Place
from neurosim.lab.nxt.params import BOARD
from tracking.markers.sought import sought
from tracking.markers.tags import QUIET

#: Markers and lamp in the robot frame (m).
FRONT_MARKER = (0.07, 0.0)
REAR_MARKER = (-0.09, 0.0)
LAMP = (-0.01, 0.0)
MARKER_DIAMETER = 0.06
MARKER_HEIGHT = 0.10
LAMP_RADIUS = 0.010

#: Distance of the reference crosses on the board from its edges, m.
_MARK_INSET, _MARK_ARM, _MARK_HALF_WIDTH = 0.05, 0.03, 0.004

_BOARD_COLOUR = (208.0, 214.0, 212.0)
LINE_COLOUR = (52.0, 50.0, 48.0)
SOLID_COLOUR = (150.0, 156.0, 160.0)
_FLOOR_COLOUR = (92.0, 100.0, 106.0)
_PINK = (150.0, 60.0, 232.0)
_BLUE = (205.0, 85.0, 25.0)
_WHITE = (238.0, 240.0, 240.0)
_LAMP_GLASS = (120.0, 135.0, 140.0)
_LAMP_LIT = (215.0, 250.0, 285.0)
_GLOW, _GLOW_RADIUS = 70.0, 0.018
_DOT_RADIUS = 0.003
_WHEEL_COLOUR = (118.0, 118.0, 116.0)
_SENSOR_COLOUR = (40.0, 38.0, 38.0)
_BODY_COLOUR = (20.0, 20.0, 21.0)
#: Argument of :func:`paint_robot` for a robot with two coloured markers.
NO_TAG = np.zeros((0, 0)), np.array([0.0, 0.0, 1.0, 0.0, 1.0])
_TAG_BLACK = (30.0, 30.0, 31.0)
#: Boxes in the robot frame: x from and to, y from and to (m). The right wheel mirrors the left.
_WHEEL = (-0.028, 0.028, 0.052, 0.079)
_SENSOR_ARM = (0.045, 0.075, -0.102, 0.102)
_BODY = (-0.128, 0.108, -0.052, 0.052)
_ROBOT = (-0.13, 0.11, -0.105, 0.105)  # with all that stands out from the body
#: Largest distance of the robot's parts and its lamp's glow from its pose (m).
REACH = 0.14
_GRAIN = 0.02


#: Compiles the loops over pixels; the order of sums may change, which no pixel shows.
_painted = njit(error_model="numpy", fastmath=True)


def marks_of(board: Board) -> np.ndarray:
    """Return the marks' positions, [8, 2] (m): near the board's corners and its edges' middles."""
    x, y = board.length / 2 - _MARK_INSET, board.width / 2 - _MARK_INSET
    return np.array([(a, b) for b in (-y, 0.0, y) for a in (-x, 0.0, x) if (a, b) != (0.0, 0.0)])


#: Marks of the usual board.
MARKS = tuple(map(tuple, marks_of(BOARD).tolist()))


def grain(rng: np.random.Generator, room: float) -> np.ndarray:
    """Return the board's and floor's texture: relative brightness at every 2 cm, [NY, NX]."""
    nx = math.ceil((BOARD.length + 2 * room) / _GRAIN) + 2
    ny = math.ceil((BOARD.width + 2 * room) / _GRAIN) + 2
    fine = rng.standard_normal((ny, nx))
    coarse = cv2.resize(
        rng.standard_normal((ny // 8, nx // 8)), (nx, ny), interpolation=cv2.INTER_CUBIC
    )
    return 1.0 + 0.012 * fine + 0.018 * coarse


@_painted
def _edge(depth, breadth):
    """Return the part of a sample of this breadth that is inside an edge at this depth."""
    return min(max(0.5 + depth / breadth, 0.0), 1.0)


@_painted
def _box(x, y, box, breadth):
    along = _edge(min(x - box[0], box[1] - x), breadth)
    return along * _edge(min(y - box[2], box[3] - y), breadth) if along > 0.0 else 0.0


def paint_ground(plane, texture, gradient, vignetting, board=BOARD):
    """Paint the empty board and the floor around it.

    Args:
        plane: board coordinates of every pixel's centre at height 0, [H, W, 2] (m).
        texture: relative brightness, as :func:`grain` returns it, its middle at the origin.
        gradient: loss of light from the middle of the board to its end at -x, and gain to +x.
        vignetting: loss of light from the picture's middle to its corners.
        board: the board.

    Returns:
        The picture, float32 [H, W, 3], and its light, float32 [H, W].
    """
    half = 0.5 * board.length, 0.5 * board.width
    line = board.line_inset, board.line_width
    return _paint_ground(plane, texture, gradient, vignetting, half, line, marks_of(board))


@_painted
def _paint_ground(plane, texture, gradient, vignetting, half, perimeter, marks):
    height, width = plane.shape[:2]
    rows, columns = texture.shape
    picture = np.zeros((height, width, 3), np.float32)
    light = np.empty((height, width), np.float32)
    half_x, half_y = half
    for v in range(height):
        for u in range(width):
            u0, v0 = min(max(u, 1), width - 2), min(max(v, 1), height - 2)
            ux = 0.5 * (plane[v, u0 + 1, 0] - plane[v, u0 - 1, 0])
            uy = 0.5 * (plane[v, u0 + 1, 1] - plane[v, u0 - 1, 1])
            vx = 0.5 * (plane[v0 + 1, u, 0] - plane[v0 - 1, u, 0])
            vy = 0.5 * (plane[v0 + 1, u, 1] - plane[v0 - 1, u, 1])
            breadth = math.hypot(ux, uy) / 3.0
            dark = 0.0
            inside = 0.0
            grey = 0.0
            for b in range(-1, 2):
                for a in range(-1, 2):
                    x = plane[v, u, 0] + (a * ux + b * vx) / 3.0
                    y = plane[v, u, 1] + (a * uy + b * vy) / 3.0
                    depth = min(half_x - abs(x), half_y - abs(y))
                    board = _edge(depth, breadth)
                    line = 0.0
                    if perimeter[1] > 0.0:
                        from_line = abs(depth - perimeter[0])
                        line = _edge(0.5 * perimeter[1] - from_line, breadth)
                    for i in range(marks.shape[0]):
                        mx, my = abs(x - marks[i, 0]), abs(y - marks[i, 1])
                        if mx < 2.0 * _MARK_ARM and my < 2.0 * _MARK_ARM:
                            long, wide = max(mx, my), min(mx, my)
                            cross = _edge(_MARK_ARM - long, breadth)
                            cross *= _edge(_MARK_HALF_WIDTH - wide, breadth)
                            line = max(line, cross)
                    column = min(max(int(x / _GRAIN + columns / 2), 0), columns - 1)
                    row = min(max(int(y / _GRAIN + rows / 2), 0), rows - 1)
                    inside += board / 9.0
                    dark += board * line / 9.0
                    grey += texture[row, column] / 9.0
            across, down = 2.0 * u / width - 1.0, 2.0 * v / height - 1.0
            lit = 1.0 - 0.5 * vignetting * (across * across + down * down)
            lit *= 1.0 + gradient * min(max(plane[v, u, 0] / half_x, -1.3), 1.3)
            light[v, u] = lit
            for c in range(3):
                colour = _FLOOR_COLOUR[c] * (1.0 - inside) + _BOARD_COLOUR[c] * (inside - dark)
                picture[v, u, c] = lit * (grey * colour + LINE_COLOUR[c] * dark)
    return picture, light


@_painted
def print_line(picture, light, plane, points, line_width, ink):
    """Print a closed line on the ground of :func:`paint_ground`, in place.

    Args:
        picture: float32 [H, W, 3], changed.
        light: of the picture, float32 [H, W].
        plane: board coordinates of every pixel's centre at height 0, [H, W, 2] (m).
        points: of the line, [N, 2] (m).
        line_width: m.
        ink: its colour in full light.
    """
    height, width = plane.shape[:2]
    for v in range(height):
        for u in range(width):
            u0 = min(max(u, 1), width - 2)
            breadth = 0.5 * math.hypot(
                plane[v, u0 + 1, 0] - plane[v, u0 - 1, 0], plane[v, u0 + 1, 1] - plane[v, u0 - 1, 1]
            )
            away = distance_to(points, plane[v, u, 0], plane[v, u, 1])
            fraction = _edge(0.5 * line_width - away, breadth)
            for c in range(3):
                picture[v, u, c] += fraction * (light[v, u] * ink[c] - picture[v, u, c])


def paint_place(picture, light, plane, place: Place) -> None:
    """Paint the lines, walls and obstacles of a place on the ground, in place; all are flat.

    Args:
        picture, light, plane: as in :func:`print_line`.
        place: the place.
    """
    for line in place.lines:
        print_line(picture, light, plane, line.loop.points, line.width, LINE_COLOUR)
    for x1, y1, x2, y2 in place.walls:
        there_and_back = np.array([(x1, y1), ((x1 + x2) / 2, (y1 + y2) / 2), (x2, y2)])
        print_line(picture, light, plane, there_and_back, THICKNESS, SOLID_COLOUR)
    if place.outline:
        print_line(picture, light, plane, np.array(place.outline), THICKNESS, SOLID_COLOUR)
    for x, y, radius in place.obstacles:
        spot = np.array([(x, y), (x + 1e-6, y), (x, y + 1e-6)])
        print_line(picture, light, plane, spot, 2 * radius, SOLID_COLOUR)


def plate_of(markers: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the tag of a robot in the form for :func:`paint_robot`.

    Args:
        markers: in the form of recording.json, with a ``tag``.

    Returns:
        Its cells with the white around them, [N, N], 0 black, 1 white; and its plate: the centre
        (m, robot frame), cosine and sine of the angle of its upper edge, and its side (m).

    Raises:
        UserError: if it does not fit on the robot.
    """
    tag = sought(markers)
    ends = np.array([[markers[which][axis] for axis in "xy"] for which in ("front", "rear")], float)
    ahead, (x, y) = ends[0] - ends[1], ends.mean(axis=0)
    cells = np.pad(tag.cells, round(QUIET), constant_values=True).astype(float)
    side = float(np.hypot(*ahead))
    plate = side * len(cells) / len(tag.cells)
    cos, sin = ahead / side
    reach = 0.5 * plate * (abs(cos) + abs(sin))
    # It may be wider than the body, like the wheels and the sensors.
    along = _BODY[0] <= x - reach and x + reach <= _BODY[1]
    inside = along and abs(y) + reach <= _SENSOR_ARM[3]
    if not inside:
        raise UserError(
            f"a tag of {1000 * side:.0f} mm at this position does not fit on the virtual robot; "
            "keep the positions that neurosim watch saved in markers.json"
        )
    return cells, np.array([x, y, cos, sin, plate])


@_painted
def paint_robot(
    frame, ground, light, plane, window, poses, weights, lamp, noise, shift, cells, plate
):
    """Paint the robot into a picture of the empty board, blurred over its poses.

    Args:
        frame: uint8 [H, W, 3], changed in place.
        ground: the empty board without noise, float32 [H, W, 3].
        light: float32 [H, W].
        plane: board coordinates of every pixel's centre at marker height, [H, W, 2] (m).
        window: u from and to, v from and to: nothing of the robot is outside.
        poses: [K, 3] (m, m, rad).
        weights: fraction of the exposure at each pose, [K], of sum 1.
        lamp: the lamp's mean brightness over the exposure, 0..1.
        noise: sensor noise, float32 [N, N, 3], repeated over the picture.
        shift: rows and columns by which the noise is shifted.
        cells, plate: of the tag that it carries, as :func:`plate_of` returns them, or NO_TAG.
    """
    height, width = plane.shape[:2]
    size = noise.shape[0]
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    still, plain = len(poses) == 1, lamp == 0.0 and len(cells) == 0
    for v in range(window[2], window[3]):
        v0 = min(max(v, 1), height - 2)
        for u in range(window[0], window[1]):
            u0 = min(max(u, 1), width - 2)
            ux = 0.5 * (plane[v, u0 + 1, 0] - plane[v, u0 - 1, 0])
            uy = 0.5 * (plane[v, u0 + 1, 1] - plane[v, u0 - 1, 1])
            vx = 0.5 * (plane[v0 + 1, u, 0] - plane[v0 - 1, u, 0])
            vy = 0.5 * (plane[v0 + 1, u, 1] - plane[v0 - 1, u, 1])
            breadth = 0.5 * math.sqrt(ux * ux + uy * uy)
            under = (float(ground[v, u, 0]), float(ground[v, u, 1]), float(ground[v, u, 2]))
            lit = float(light[v, u])
            blue = green = red = 0.0
            touched = False
            for k in range(poses.shape[0]):
                px, py = plane[v, u, 0] - poses[k, 0], plane[v, u, 1] - poses[k, 1]
                x, y = cos[k] * px + sin[k] * py, cos[k] * py - sin[k] * px
                if lamp == 0.0 and not _within(x, y, _ROBOT, 2.0 * breadth):
                    blue += weights[k] * under[0]
                    green += weights[k] * under[1]
                    red += weights[k] * under[2]
                    continue
                touched = True
                if plain and _is_ground(x, y, 2.0 * breadth):
                    blue += weights[k] * under[0]
                    green += weights[k] * under[1]
                    red += weights[k] * under[2]
                    continue
                if plain and _is_bare(x, y, 2.0 * breadth):
                    blue += weights[k] * lit * _BODY_COLOUR[0]
                    green += weights[k] * lit * _BODY_COLOUR[1]
                    red += weights[k] * lit * _BODY_COLOUR[2]
                    continue
                # The pixel's sides in the robot frame, a quarter of each.
                ax, ay = 0.25 * (cos[k] * ux + sin[k] * uy), 0.25 * (cos[k] * uy - sin[k] * ux)
                bx, by = 0.25 * (cos[k] * vx + sin[k] * vy), 0.25 * (cos[k] * vy - sin[k] * vx)
                fraction = 0.25 * weights[k] if still else 0.5 * weights[k]
                for sample in range(4 if still else 2):
                    along = 1.0 if sample % 2 == 0 else -1.0
                    down = along if (sample // 2 + k) % 2 == 0 else -along
                    to_x, to_y = along * ax + down * bx, along * ay + down * by
                    seen = _robot_colour(
                        x + to_x, y + to_y, breadth, under, lit, lamp, cells, plate
                    )
                    blue += fraction * seen[0]
                    green += fraction * seen[1]
                    red += fraction * seen[2]
            if touched:
                i, j = (v + shift[0]) % size, (u + shift[1]) % size
                frame[v, u, 0] = int(min(max(blue + noise[i, j, 0] + 0.5, 0.0), 255.0))
                frame[v, u, 1] = int(min(max(green + noise[i, j, 1] + 0.5, 0.0), 255.0))
                frame[v, u, 2] = int(min(max(red + noise[i, j, 2] + 0.5, 0.0), 255.0))


@_painted
def _within(x, y, box, margin):
    return box[0] - margin < x < box[1] + margin and box[2] - margin < y < box[3] + margin


@_painted
def _is_ground(x, y, margin):
    """Return whether there is only ground around a point of the robot frame."""
    at_side = _within(x, abs(y), _WHEEL, margin) or _within(x, y, _SENSOR_ARM, margin)
    return not (at_side or _within(x, y, _BODY, margin))


@_painted
def _is_bare(x, y, margin):
    """Return whether there is only the body around a point: no edge, marker or lamp."""
    front = (x - FRONT_MARKER[0]) ** 2 + (y - FRONT_MARKER[1]) ** 2
    rear = (x - REAR_MARKER[0]) ** 2 + (y - REAR_MARKER[1]) ** 2
    lamp = (x - LAMP[0]) ** 2 + (y - LAMP[1]) ** 2
    apart = min(front, rear) > (0.5 * MARKER_DIAMETER + margin) ** 2
    return apart and lamp > (LAMP_RADIUS + margin) ** 2 and _within(x, y, _BODY, -margin)


@_painted
def _blend(under, over, fraction):
    """Return the colour of a sample of which a fraction is covered."""
    return (
        under[0] + fraction * (over[0] - under[0]),
        under[1] + fraction * (over[1] - under[1]),
        under[2] + fraction * (over[2] - under[2]),
    )


@_painted
def _lit(colour, light):
    return light * colour[0], light * colour[1], light * colour[2]


@_painted
def _on_tag(x, y, breadth, cells, plate):
    """Return the white fraction of a sample, and the fraction that the plate covers."""
    count = cells.shape[0]
    px, py = x - plate[0], y - plate[1]
    up, left = plate[2] * px + plate[3] * py, plate[2] * py - plate[3] * px
    half = 0.5 * plate[4]
    cover = _edge(half - abs(up), breadth) * _edge(half - abs(left), breadth)
    if cover <= 0.0:
        return 0.0, 0.0
    # In cells; a sample's breadth of them counts by the area.
    row, column = (half - up) * count / plate[4], (half - left) * count / plate[4]
    reach = 0.5 * breadth * count / plate[4]
    white = whole = 0.0
    for i in range(max(int(row - reach), 0), min(int(row + reach), count - 1) + 1):
        tall = min(row + reach, i + 1.0) - max(row - reach, float(i))
        for j in range(max(int(column - reach), 0), min(int(column + reach), count - 1) + 1):
            wide = min(column + reach, j + 1.0) - max(column - reach, float(j))
            area = max(tall, 0.0) * max(wide, 0.0)
            whole += area
            white += area * cells[i, j]
    return white / max(whole, 1e-12), cover


@_painted
def _robot_colour(x, y, breadth, under, light, lamp, cells, plate):
    """Return the colour at a point of the robot frame, over the ground's colour there."""
    colour = under
    body = _box(x, y, _BODY, breadth)
    if body < 1.0:
        fraction = _box(x, abs(y), _WHEEL, breadth)
        if fraction > 0.0:
            colour = _blend(colour, _lit(_WHEEL_COLOUR, light), fraction)
        fraction = _box(x, y, _SENSOR_ARM, breadth)
        if fraction > 0.0:
            colour = _blend(colour, _lit(_SENSOR_COLOUR, light), fraction)
    if body > 0.0:
        colour = _blend(colour, _lit(_BODY_COLOUR, light), body)
    if cells.shape[0] > 0:
        white, cover = _on_tag(x, y, breadth, cells, plate)
        colour = _blend(colour, _lit(_blend(_TAG_BLACK, _WHITE, white), light), cover)
    elif body > 0.0:
        front = x > LAMP[0]
        marker = FRONT_MARKER if front else REAR_MARKER
        rim = _PINK if front else _BLUE
        r2 = (x - marker[0]) ** 2 + (y - marker[1]) ** 2
        radius = 0.5 * MARKER_DIAMETER
        if r2 < (radius + 0.5 * breadth) ** 2:
            r = math.sqrt(r2)
            fraction = _edge(radius - r, breadth)
            fade = min(max((radius - r) / (radius - _DOT_RADIUS), 0.0), 1.0)
            colour = _blend(colour, _lit(_blend(rim, _WHITE, fade), light), fraction)
    r2 = (x - LAMP[0]) ** 2 + (y - LAMP[1]) ** 2
    if r2 < (LAMP_RADIUS + 0.5 * breadth) ** 2:
        fraction = _edge(LAMP_RADIUS - math.sqrt(r2), breadth)
        glass = _blend(_lit(_LAMP_GLASS, light), _LAMP_LIT, lamp)
        colour = _blend(colour, glass, fraction)
    if lamp > 0.0:
        glow = lamp * _GLOW * math.exp(-0.5 * r2 / _GLOW_RADIUS**2)
        colour = (colour[0] + glow, colour[1] + glow, colour[2] + glow)
    return colour
