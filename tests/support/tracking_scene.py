"""Rendered frames for the tracker's tests: a robot of two discs on black, seen from above."""

from __future__ import annotations

import cv2
import numpy as np

PINK = (160, 70, 235)  # BGR
BLUE = (225, 105, 40)
SIZE = (640, 480)
BOARD = 140.0
BLACK = 18.0
OVERSAMPLE = 4


def background(size=SIZE, level=BOARD):
    """A light board whose light falls off towards one corner."""
    v, u = np.mgrid[: size[1], : size[0]]
    light = level * (1.0 - 0.2 * u / size[0] - 0.1 * v / size[1])
    return np.repeat(light[..., None], 3, axis=-1)


def paint_disc(image, centre, radius, colour, *, fade=True, gain=1.0):
    """Paint a disc that fades linearly to white at its centre, antialiased."""
    _paint(image, centre, radius + 2, lambda du, dv: _disc(du, dv, radius, colour, fade, gain))


def paint_rectangle(image, centre, half, angle, colour):
    """Paint a rectangle; ``angle`` turns counter-clockwise as seen."""
    cos, sin = np.cos(angle), np.sin(angle)

    def cover(du, dv):
        along, across = cos * du - sin * dv, sin * du + cos * dv
        inside = (np.abs(along) <= half[0]) & (np.abs(across) <= half[1])
        return inside, np.asarray(colour, float)

    _paint(image, centre, float(np.hypot(*half)) + 2, cover)


def paint_tag(image, tag, middle, heading, side, *, white=235.0):
    """Paint a tag with a cell of white around it; return the middles of its front and rear edge.

    ``heading`` of its upper edge, in radians, counter-clockwise as seen; ``side`` of its black
    square in pixels.
    """
    cells = np.pad(tag.cells, 1, constant_values=True)
    cos, sin = np.cos(heading), np.sin(heading)

    def cover(du, dv):
        up, right = cos * du - sin * dv, sin * du + cos * dv
        row, column = (
            np.floor(direction * len(tag.cells) / side + len(cells) / 2).astype(int)
            for direction in (-up, right)
        )
        inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < len(cells))
        light = cells[np.clip(row, 0, len(cells) - 1), np.clip(column, 0, len(cells) - 1)]
        return inside, np.where(light, white, BLACK)[..., None] * np.ones(3)

    _paint(image, middle, side, cover)
    ahead = side / 2 * np.array([cos, -sin])
    return middle + ahead, middle - ahead


def _disc(du, dv, radius, colour, fade, gain):
    distance = np.hypot(du, dv)
    fraction = np.clip(distance / radius, 0, 1)[..., None] if fade else 1.0
    return distance <= radius, gain * (
        fraction * np.asarray(colour, float) + (1 - fraction) * 255.0
    )


def _paint(image, centre, reach, cover):
    height, width = image.shape[:2]
    left, right = max(0, int(centre[0] - reach)), min(width, int(centre[0] + reach) + 2)
    top, bottom = max(0, int(centre[1] - reach)), min(height, int(centre[1] + reach) + 2)
    if left >= right or top >= bottom:
        return
    n = OVERSAMPLE
    fine = (np.arange(n) + 0.5) / n - 0.5
    u = (np.arange(left, right)[:, None] + fine).ravel() - centre[0]
    v = (np.arange(top, bottom)[:, None] + fine).ravel() - centre[1]
    inside, colour = cover(*np.meshgrid(u, v))
    patch = inside[..., None] * np.broadcast_to(colour, (*inside.shape, 3))
    rows, columns = bottom - top, right - left
    patch = patch.reshape(rows, n, columns, n, 3).mean((1, 3))
    fraction = inside.reshape(rows, n, columns, n).mean((1, 3))[..., None]
    image[top:bottom, left:right] = image[top:bottom, left:right] * (1 - fraction) + patch


def robot(
    image,
    middle,
    heading,
    *,
    separation=34.0,
    radius=6.4,
    lamp=0.0,
    fade=True,
    front=PINK,
    rear=BLUE,
    body=(44, 14),
):
    """Paint a robot; return the pixels of its front and rear marker.

    ``heading`` in radians, counter-clockwise as seen; ``middle`` is half way between the
    markers, where the lamp is; ``lamp`` its brightness in 0..1.
    """
    ahead = np.array([np.cos(heading), -np.sin(heading)])
    centres = middle + ahead * separation / 2, middle - ahead * separation / 2
    paint_rectangle(image, middle, (body[0] / 2 + 2, body[1] / 2 + 2), heading, (BLACK,) * 3)
    for centre, colour in zip(centres, (front, rear), strict=True):
        if colour is not None:
            paint_disc(image, centre, radius, colour, fade=fade)
    if lamp > 0:
        _glow(image, middle, lamp)
    return centres


def _glow(image, centre, lamp):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    square = (u - centre[0]) ** 2 + (v - centre[1]) ** 2
    image += (
        lamp * (400.0 * np.exp(-square / (2 * 1.6**2)) + 25.0 * np.exp(-square / 50.0))[..., None]
    )


def webcam_noise(frame, sd, rng):
    """Add noise of ``sd`` grey levels to luma and, at half resolution, to both colour channels."""
    picture = cv2.cvtColor(frame, cv2.COLOR_BGR2YCrCb).astype(np.float32)
    height, width = frame.shape[:2]
    picture[..., 0] += rng.normal(0.0, sd, (height, width))
    for channel in (1, 2):
        coarse = rng.normal(0.0, sd, ((height + 1) // 2, (width + 1) // 2)).astype(np.float32)
        picture[..., channel] += cv2.resize(coarse, (width, height))
    return cv2.cvtColor(np.clip(np.round(picture), 0, 255).astype(np.uint8), cv2.COLOR_YCrCb2BGR)


def finish(image, rng=None, *, noise=2.0, blur=0.6, jpeg=None):
    """Apply the camera's effects: blur, noise, eight bits, perhaps compression."""
    image = cv2.GaussianBlur(np.clip(image, 0, 255), (0, 0), blur) if blur else image
    if rng is not None:
        image = image + rng.normal(0.0, noise, image.shape)
    frame = np.clip(np.round(image), 0, 255).astype(np.uint8)
    if jpeg:
        frame = cv2.imdecode(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, jpeg])[1], 1)
    return frame
