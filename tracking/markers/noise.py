"""A camera's noise: its strength in colour, and the smoothing of strong noise."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.markers.colours import chroma_plane

#: Noise of the chroma (standard deviation, of 255) up to which nothing is smoothed.
QUIET = 8.0
#: Smoothing of a whole picture with more noise: sd of a Gaussian, px.
_SMOOTHING = 1.5
#: Number of times that a patch is smoothed with the weights 1 2 1.
_PASSES = 2
#: Pixels at this distance have independent noise: cameras have colour at half resolution.
_APART = 4
#: Pixels between two measured places.
_STEP = 3


def noise_of(image: NDArray) -> float:
    """Return the standard deviation of the noise of the chroma, of 255.

    By the median of second differences of pixels that share no noise: most of a picture is flat.

    Args:
        image: BGR [H, W, 3] uint8.
    """
    if image.shape[1] <= 2 * _APART:
        return 0.0
    rows = image[::_STEP]
    left, middle, right = (
        chroma_plane(np.ascontiguousarray(part))
        for part in (
            rows[:, : -2 * _APART : _STEP],
            rows[:, _APART:-_APART:_STEP],
            rows[:, 2 * _APART :: _STEP],
        )
    )
    # Of a normal distribution the median of the absolute value is 0.6745 standard deviations.
    return float(np.median(np.abs(2 * middle - left - right))) / (0.6745 * math.sqrt(6))


def smooth(image: NDArray) -> NDArray:
    """Return a picture, BGR [H, W, 3] uint8, smoothed if it is noisy."""
    if noise_of(image) <= QUIET:
        return image
    return cv2.GaussianBlur(image, (0, 0), _SMOOTHING)


def passes_for(image: NDArray) -> int:
    """Return how many times patches of a picture are to be smoothed."""
    return 0 if noise_of(image) <= QUIET else _PASSES
