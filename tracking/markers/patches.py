"""Compiled loops over the pixels around one marker, which measure it.

Colour gives a marker's place, its size and whether it is covered; light gives its exact centre: see
:mod:`tracking.markers.markers`. Places are (u, v) and, within a patch, from its corner.
"""

from __future__ import annotations

import math

import numpy as np

from neurosim.base.compiled import njit
from neurosim.base.kernels import kernel, smallest

#: Chroma across the marker's hue that is tolerated, as a fraction of that along it: 34 degrees.
ACROSS = 1.5
#: The centre of light is computed until it moves by less (px), or this many times.
SETTLED, ROUNDS = 0.002, 12
#: In a smaller marker (px) no white dot can be seen: video has colour at half resolution.
DOT_RADIUS = 4.0
#: Light counts from this fraction of the marker's own on, for what is left of the backing; where
#: there is no white dot edges are sharper, and what a camera's sharpening makes of them matters.
DEAD, PLAIN_DEAD = 0.15, 0.25
#: As many times the marker's ratio of light to chroma are its own, with a white dot and without.
FULL, PLAIN_FULL = 2.0, 3.5
#: Next to a brighter neighbour: pixels above this multiple of a marker's mean are not of it.
GLARE = 1.2
_ROOT = math.sqrt(0.75)


@njit(nogil=True)
def read_patch(frame, u, v, reach, blue_gain, red_gain, passes):
    """Return chroma plane [2, H, W] and luma [H, W] around a place, and where they begin.

    The chroma plane is smoothed ``passes`` times, luma never: it says where the centre is.
    """
    height, width = frame.shape[:2]
    reach = math.ceil(reach)
    middle_u, middle_v = round(u), round(v)
    left, right = max(0, middle_u - reach), min(width, middle_u + reach + 1)
    top, bottom = max(0, middle_v - reach), min(height, middle_v + reach + 1)
    rows, columns = max(bottom - top, 0), max(right - left, 0)
    plane = np.empty((2, rows, columns), np.float32)
    luma = np.empty((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            blue = int(frame[top + i, left + j, 0])
            green = int(frame[top + i, left + j, 1])
            red = int(frame[top + i, left + j, 2])
            b, r = blue_gain * blue, red_gain * red
            plane[0, i, j] = r - 0.5 * (green + b)
            plane[1, i, j] = _ROOT * (green - b)
            # As OpenCV does it, whole grey levels.
            luma[i, j] = (1868 * blue + 9617 * green + 4899 * red + 8192) >> 14
    for _ in range(passes if plane.size else 0):
        for channel in plane:
            _smooth_down(channel)
            _smooth_down(channel.T)
    return plane, luma, left, top


@kernel()
def _smooth_down(channel):
    """Weigh each pixel [H, W] with those above and below it, 1 2 1, in place."""
    for j in range(channel.shape[1]):
        before = channel[0, j]
        for i in range(channel.shape[0]):
            own, after = channel[i, j], channel[min(i + 1, channel.shape[0] - 1), j]
            channel[i, j] = 0.25 * (before + after) + 0.5 * own
            before = own


@njit(nogil=True)
def mean_luma(frame, u, v, radius):
    """Return the mean luma within a radius of a place, NaN where none of it is in the picture."""
    height, width = frame.shape[:2]
    total, count = 0, 0
    for i in range(max(0, math.floor(v - radius)), min(height, math.ceil(v + radius) + 1)):
        for j in range(max(0, math.floor(u - radius)), min(width, math.ceil(u + radius) + 1)):
            if (j - u) ** 2 + (i - v) ** 2 <= radius**2:
                blue, green, red = int(frame[i, j, 0]), int(frame[i, j, 1]), int(frame[i, j, 2])
                total += (1868 * blue + 9617 * green + 4899 * red + 8192) >> 14
                count += 1
    return total / count if count else math.nan


@kernel()
def _member(alpha, beta, p, q, chroma):
    """See :meth:`tracking.markers.markers.Look.membership`."""
    along, across = p * alpha + q * beta, p * beta - q * alpha
    return min(max(((along - ACROSS * abs(across)) / chroma - 0.25) / 0.35, 0.0), 1.0)


@kernel()
def _disc(i, j, u, v, radius):
    """Return 1 within a radius, 0 without, soft over one pixel."""
    return min(max(radius + 0.5 - math.sqrt((j - u) ** 2 + (i - v) ** 2), 0.0), 1.0)


@kernel()
def _span(middle, radius, size):
    """Return the first pixel, and that after the last, in which a disc may be other than 0."""
    return max(0, math.floor(middle - radius)), min(size, math.ceil(middle + radius) + 1)


@kernel()
def _centroid(member, u, v, radius):
    total = across = down = 0.0
    top, bottom = _span(v, radius, member.shape[0])
    left, right = _span(u, radius, member.shape[1])
    for i in range(top, bottom):
        for j in range(left, right):
            weight = member[i, j]
            if weight > 0.0:
                weight *= _disc(i, j, u, v, radius)
                total += weight
                across += weight * j
                down += weight * i
    if total <= 0.0:
        return u, v, 0.0
    return across / total, down / total, total


@njit(nogil=True)
def _densest(member, u, v, radius, margin):
    """Return the place with most of the colour, near (u, v) preferred; and its amount."""
    rows, columns = member.shape
    half = max(0, int(0.8 * radius))
    side = 2 * half + 1
    sums = np.zeros((rows + 1, columns + 1))
    for i in range(rows):
        line = 0.0
        for j in range(columns):
            line += member[i, j]
            sums[i + 1, j + 1] = sums[i, j + 1] + line
    best, best_i, best_j = -1.0, 0, 0
    falloff = -0.5 / (margin + radius) ** 2
    for i in range(rows):
        top, bottom = max(0, i - half), min(rows, i + half + 1)
        for j in range(columns):
            left, right = max(0, j - half), min(columns, j + half + 1)
            inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
            if inside <= best * side * side:
                continue
            inside *= math.exp(falloff * ((j - u) ** 2 + (i - v) ** 2)) / (side * side)
            if inside > best:
                best, best_i, best_j = inside, i, j
    return best_j, best_i, best


@njit(nogil=True)
def darkest(luma):
    """Return the tenth percentile of luma: the marker's background."""
    counts = np.zeros(256, np.int64)
    for i in range(luma.shape[0]):
        for j in range(luma.shape[1]):
            counts[int(luma[i, j])] += 1
    place, seen = luma.size // 10, 0
    for level in range(256):
        seen += counts[level]
        if seen > place:
            return float(level)
    return 255.0


@njit(nogil=True)
def _length(member, u, v, radius):
    """Return half the length of an evenly coloured bar as long as the colour around (u, v)."""
    total = uu = uv = vv = 0.0
    top, bottom = _span(v, radius, member.shape[0])
    left, right = _span(u, radius, member.shape[1])
    for i in range(top, bottom):
        for j in range(left, right):
            weight = member[i, j]
            if weight > 0.0:
                weight *= _disc(i, j, u, v, radius)
                total += weight
                uu += weight * (j - u) ** 2
                uv += weight * (j - u) * (i - v)
                vv += weight * (i - v) ** 2
    mean, half = 0.5 * (uu + vv), 0.5 * (uu - vv)
    return math.sqrt(3.0 * (mean + math.sqrt(half**2 + uv**2)) / total)


@kernel()
def _plain(plane, u, v, radius, p, q, chroma):
    """Return whether a marker is coloured in its middle as well, without a white dot."""
    total = along = 0.0
    top, bottom = _span(v, 0.35 * radius, plane.shape[1])
    left, right = _span(u, 0.35 * radius, plane.shape[2])
    for i in range(top, bottom):
        for j in range(left, right):
            weight = _disc(i, j, u, v, 0.35 * radius)
            total += weight
            along += weight * (p * plane[0, i, j] + q * plane[1, i, j])
    return along > 0.6 * chroma * total


@kernel()
def _foreign(plane, member, u, v, chroma):
    """Return whether (u, v) is of another colour: neither the marker's own, nor white or grey."""
    i, j = round(v), round(u)
    if not (0 <= i < member.shape[0] and 0 <= j < member.shape[1]):
        return False
    coloured = math.hypot(plane[0, i, j], plane[1, i, j]) > 0.5 * chroma
    return coloured and member[i, j] == 0.0


@njit(nogil=True)
def _without_glare(member, luma, u, v, radius, backing):
    """Return both levelled, without pixels much brighter than the colour at (u, v)."""
    total = light = 0.0
    for i in range(luma.shape[0]):
        for j in range(luma.shape[1]):
            weight = member[i, j] * _disc(i, j, u, v, radius)
            total += weight
            light += weight * (luma[i, j] - backing)
    light = max(light / max(total, 1.0), 1.0)
    member, luma = member.copy(), luma.copy()
    for i in range(luma.shape[0]):
        for j in range(luma.shape[1]):
            above = (luma[i, j] - backing) / light
            if above > 1.0:
                own = min(max(GLARE + 1.0 - above, 0.0), 1.0)
                member[i, j] *= own
                luma[i, j] = backing + own * light
    return member, luma


@kernel()
def _brightest(plane, luma, u, v, radius, reach, full, dead, p, q, chroma, light, backing):
    """Return the centroid of the marker's light within reach of itself, and its sum."""
    dark = backing + dead * light
    explained = full * light / chroma
    for _ in range(ROUNDS):
        total = across = down = 0.0
        top, bottom = _span(v, reach, luma.shape[0])
        left, right = _span(u, reach, luma.shape[1])
        for i in range(top, bottom):
            for j in range(left, right):
                weight = luma[i, j] - dark
                if weight <= 0.0:
                    continue
                window = _disc(i, j, u, v, reach)
                if window == 0.0:
                    continue
                # Mixing with black at the rim leaves the ratio of chroma to light as it is; a grey
                # board or another colour has less of this chroma. Some times the ratio of the rim,
                # so that the fade and bleached edges count in full. Outside the white dot only
                # such light counts: the backing may be narrow, and the board beyond it is bright.
                alpha, beta = plane[0, i, j], plane[1, i, j]
                own = p * alpha + q * beta - 0.7 * abs(p * beta - q * alpha)
                rim = min(weight, max(own, 0.0) * explained)
                weight = window * (rim + (weight - rim) * _disc(i, j, u, v, 0.55 * radius))
                total += weight
                across += weight * j
                down += weight * i
        if total <= 0.0:
            return u, v, 0.0
        moved = max(abs(across / total - u), abs(down / total - v))
        u, v = across / total, down / total
        if moved < SETTLED:
            break
    return u, v, total


@njit(nogil=True)
def measure_marker(frame, u, v, radius, margin, p, q, chroma, light, blue_gain, red_gain, passes):
    """See :func:`tracking.markers.markers.measure`.

    Returns whether there is one, its u and v, those of its light alone, its area, and its look as
    it is now.
    """
    none = (False, u, v, u, v, 0.0, p, q, chroma, light)
    plane, luma, left, top = read_patch(
        frame, u, v, radius + margin + 3.0, blue_gain, red_gain, passes
    )
    rows, columns = luma.shape
    if rows < 3 or columns < 3:
        return none
    member = np.empty((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            member[i, j] = _member(plane[0, i, j], plane[1, i, j], p, q, chroma)
    column, row, density = _densest(member, u - left, v - top, radius, margin)
    if density < 0.15:
        return none
    around = 1.4 * radius + 1.0
    cu, cv, area = _centroid(member, float(column), float(row), around)
    cu, cv, area = _centroid(member, cu, cv, around)
    if area <= 0.0:
        return none
    backing = darkest(luma)
    # A marker with a white dot is round. Another may be a bar, which is longer than the disc of its
    # area and has no one brightest place along it, or a square, whose corners stand out.
    reach, full, dead = radius, FULL, DEAD
    if radius > DOT_RADIUS and _plain(plane, cu, cv, radius, p, q, chroma):
        reach = max(1.25 * radius, 1.1 * _length(member, cu, cv, around))
        full, dead = PLAIN_FULL, PLAIN_DEAD
    bu, bv, total = _brightest(
        plane, luma, cu, cv, radius, reach + 1.0, full, dead, p, q, chroma, light, backing
    )
    near = 0.5 + 0.15 * radius
    if math.hypot(bu - cu, bv - cv) >= near and _foreign(plane, member, bu, bv, chroma):
        member, luma = _without_glare(member, luma, cu, cv, radius, backing)
        cu, cv, area = _centroid(member, cu, cv, around)
        bu, bv, total = _brightest(
            plane, luma, cu, cv, radius, reach + 1.0, full, dead, p, q, chroma, light, backing
        )
    if total <= 0.0 or area <= 0.0:
        return none
    # Something bright next to the marker pulls at its light, something of its colour at both.
    ou, ov = bu, bv
    if math.hypot(bu - cu, bv - cv) < near:
        cu, cv = bu, bv
    p, q, chroma, light = read_look(plane, luma, cu, cv, radius, p, q, chroma, light, backing)
    return True, left + cu, top + cv, left + ou, top + ov, area, p, q, chroma, light


@njit(nogil=True)
def read_look(plane, luma, u, v, radius, p, q, chroma, light, backing):
    """Measure a marker's look in a patch, from a rough look: direction, chroma, light."""
    total = alpha = beta = lit = 0.0
    coloured = np.empty((luma.size, 2), np.float32)
    along = np.empty(luma.size, np.float32)
    count = 0
    top, bottom = _span(v, radius, luma.shape[0])
    left, right = _span(u, radius, luma.shape[1])
    for i in range(top, bottom):
        for j in range(left, right):
            window = _disc(i, j, u, v, radius)
            if window == 0.0:
                continue
            weight = window * _member(plane[0, i, j], plane[1, i, j], p, q, chroma)
            total += weight
            alpha += weight * plane[0, i, j]
            beta += weight * plane[1, i, j]
            lit += weight * luma[i, j]
            if weight > 0.5:
                coloured[count, 0], coloured[count, 1] = plane[0, i, j], plane[1, i, j]
                count += 1
    if total < 1.0 or count < 3:
        return p, q, chroma, light
    length = max(math.hypot(alpha, beta), 1e-6)
    p, q = alpha / length, beta / length
    for n in range(count):
        along[n] = p * coloured[n, 0] + q * coloured[n, 1]
    chroma = max(float(smallest(along, count, count * 3 // 4)), 1.0)
    return p, q, chroma, max(lit / total - backing, 1.0)
