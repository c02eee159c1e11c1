"""A laser scan of ROS as a ring of proximity sensors: the nearest object in each sector."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

SCAN = "sensor_msgs/msg/LaserScan"


class Sectors:
    """Divides scans into sectors of equal width: the first looks ahead, the others to its left.

    By sensor_msgs/LaserScan and REP 117, a range outside of the laser's own limits is ignored, and
    so is null, which rosbridge sends for infinity and NaN.

    Args:
        count: of the sectors.
        reach: distance from the laser from which on a reading is 0, m.
        turned: direction of the laser's own 0, rad to the left of the base's straight ahead.

    Attributes:
        readings: of the last scan, [S] from 0 (nothing within reach) to 1 (at the laser).
    """

    def __init__(self, count: int, reach: float, turned: float):
        self._reach, self._turned = reach, turned
        self.readings: NDArray[np.float64] = np.zeros(count)

    def take(self, message: dict[str, Any]) -> bool:
        """Take a scan; return whether it is valid."""
        try:
            first, step = float(message["angle_min"]), float(message["angle_increment"])
            low, high = _number(message["range_min"]), _number(message["range_max"])
            ranges = np.array([_number(each) for each in message["ranges"]], float)
        except (KeyError, TypeError, ValueError):
            return False
        if not (math.isfinite(first) and math.isfinite(step)):
            return False
        # A laser without a greatest range has null there.
        good = (ranges >= low) & (ranges <= (high if math.isfinite(high) else math.inf))
        good &= np.isfinite(ranges)
        count = len(self.readings)
        angles = first + step * np.arange(len(ranges)) + self._turned
        sectors = np.round(angles / (2 * math.pi / count)).astype(int) % count
        nearest = np.full(count, math.inf)
        np.minimum.at(nearest, sectors[good], ranges[good])
        self.readings = np.clip(1 - nearest / self._reach, 0.0, 1.0)
        return True


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
