"""Sensors learned from readings: where each is mounted, and what it reads where on the board.

A reading is taken to follow from the place of the board that the sensor is over. Of each sensor
are found its mounting on the robot, how long after the look began it is read, and a map of the
board. The map m is the smooth one nearest to the readings y, W being linear interpolation between
its points,

.. math:: \\min_m |y - W m|^2 + \\lambda |(\\kappa^2 + L) m|^2

which is a Gaussian random field of Matern covariance (Lindgren, Rue, Lindstrom 2011, J. R. Stat.
Soc. B 73): L is the Laplacian of the grid, kappa its cell over a length. Mounting, time and lambda
are those of the least error in cross-validation: readings of whole spans of time are left out in
turn. Sensors fraction a map where that predicts the readings left out better than a map for each.
A sensor whose readings do not follow from the place gets a map that is flat, and wide noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from numba import njit
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.progress import Progress
from neurosim.networks.control import NOT_READINGS
from neurosim.simulators.motion.sensors import Sensors
from tracking.datasets.readings import PLACE, sensors_of

#: Distance between a map's points, and where the mounting is searched on a coarser one, m.
CELL, COARSE = 0.01, 0.02
#: Length over which the map forgets, m; the value of a place far from all readings is their median.
LENGTH = 0.05
#: How smooth maps may be; cross-validation chooses.
SMOOTHNESS = (0.01, 0.03, 0.1, 0.3, 1.0, 10.0)
#: Sensors are searched within this distance of the middle of the axle, on a grid of such steps, m.
REACH, STEP = 0.16, 0.02
#: They are read at most so long after the look began, s.
LATEST = 0.25
#: Readings of so many seconds are left out together, in so many parts.
SPAN, PARTS = 8.0, 4
#: No map has more points, and no sensor can be learned from fewer readings.
MOST_POINTS, FEWEST = 4_000_000, 50
#: The search of the mounting ends at such steps: m, m, s.
_FINEST = np.array([0.0005, 0.0005, 0.004])
#: While the mounting is searched: the smoothness, and how many parts are left out, how exactly.
_SEARCHED, _ROUGH = 0.1, (2, 1e-7)
_BY_CHANCE = 1.4826  # standard deviation over median absolute deviation, of normal numbers


@dataclass(frozen=True)
class _Rows:
    """Readings of some sensors.

    Attributes:
        place: [N, 6] as :data:`tracking.datasets.readings.PLACE`.
        part: [N] to which part of the cross-validation each belongs.
        values: [N, S].
    """

    place: NDArray[np.float64]
    part: NDArray[np.int64]
    values: NDArray[np.float64]

    def looked_at(self, mount: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places [N, 2] that a sensor looks at: ahead, aside (m), after (s)."""
        pose = self.place[:, :3] + mount[2] * self.place[:, 3:]
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x = pose[:, 0] + cos * mount[0] - sin * mount[1]
        return np.stack([x, pose[:, 1] + sin * mount[0] + cos * mount[1]], axis=1)

    def take(self, rows: NDArray) -> _Rows:
        return _Rows(self.place[rows], self.part[rows], self.values[rows])


@dataclass(frozen=True)
class _Grid:
    """Points of maps: [NY, NX], ``cell`` apart from ``origin`` on, m."""

    origin: NDArray[np.float64]
    cell: float
    shape: tuple[int, int]

    @classmethod
    def around(cls, rows: _Rows, cell: float) -> _Grid:
        low, high = rows.place[:, :2].min(0) - REACH, rows.place[:, :2].max(0) + REACH
        nx, ny = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
        if nx * ny > MOST_POINTS:
            raise UserError(
                f"the readings are spread over {high[0] - low[0]:.0f} m by {high[1] - low[1]:.0f} "
                "m, more than the largest map of a board: are the poses right? --no-sensors "
                "leaves the sensors out"
            )
        return cls(low, cell, (ny, nx))

    def weights(self, places: NDArray) -> tuple[NDArray, NDArray]:
        """Return the points [N, 4] around places [N, 2], and their weights [N, 4]."""
        ny, nx = self.shape
        across, up = ((places - self.origin) / self.cell).T
        across, up = across.clip(0, nx - 1), up.clip(0, ny - 1)
        i, j = across.astype(int).clip(max=nx - 2), up.astype(int).clip(max=ny - 2)
        a, b = across - i, up - j
        first = j * nx + i
        points = np.stack([first, first + 1, first + nx, first + nx + 1], axis=1)
        return points, np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)


class _Maps:
    """Maps of readings, and how well they predict readings that were left out.

    Args:
        rows: the readings.
        cell: distance between the maps' points, m.
        parts: how many of the :data:`PARTS` are left out in turn.
        exact: how exactly the maps are found; a map that was found before is begun from.
    """

    def __init__(self, rows: _Rows, cell: float, parts: int = PARTS, exact: float = 1e-8):
        self.rows = rows
        self.grid = _Grid.around(rows, cell)
        self.base = np.median(rows.values, axis=0)
        self._parts, self._exact = parts, exact
        self._known: dict[tuple[int, ...], NDArray[np.float64]] = {}

    def fit(
        self,
        mounts: NDArray,
        smooth: float,
        group: Sequence[int],
        kept: NDArray,
        part: int = -1,
    ) -> NDArray[np.float64]:
        """Return the map [NY, NX] of a group of sensors, of the rows that are kept [N].

        ``part`` is the one that is left out, -1 for none.
        """
        base = self._base(group)
        parts = [self.grid.weights(self.rows.looked_at(mounts[s])[kept]) for s in group]
        points, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
        off = np.concatenate([self.rows.values[kept, s] - base for s in group])
        if not np.isfinite(smooth):
            return np.full(self.grid.shape, base)
        field = self._known.setdefault((*group, part), np.zeros(self.grid.shape))
        kappa = (self.grid.cell / LENGTH) ** 2
        _conjugate_gradients(points, weights, off, kappa, smooth, self._exact, field)
        return field + base

    def _base(self, group: Sequence[int]) -> float:
        return float(np.mean(self.base[list(group)]))

    def left_out(self, mounts: NDArray, smooth: float, group: Sequence[int]) -> NDArray[np.float64]:
        """Return how far a group's readings [N, G] are from maps of the other parts' readings."""
        off = np.zeros((len(self.rows.part), len(group)))
        for part in range(self._parts):
            tested = self.rows.part == part
            if not tested.any() or tested.all():
                continue
            field = self.fit(mounts, smooth, group, ~tested, part).ravel()
            for place, s in enumerate(group):
                at = self.grid.weights(self.rows.looked_at(mounts[s])[tested])
                predicted = (field[at[0]] * at[1]).sum(1)
                off[tested, place] = self.rows.values[tested, s] - predicted
        return off

    def error(self, mounts: NDArray, smooth: float, group: Sequence[int]) -> float:
        """Return the sum of squares of a group's readings that were left out."""
        return float((self.left_out(mounts, smooth, group) ** 2).sum())


def learn_sensors(
    readings: pd.DataFrame, held_out: float = 0.2, *, progress: bool = True
) -> tuple[Sensors, dict[str, Any]]:
    """Learn sensors from the readings of a dataset.

    Mounting, smoothness and noise are found on the earlier readings, and tried on the last ones;
    the maps are then of all: what was not driven over is not known.

    Args:
        readings: the table of :mod:`tracking.datasets.readings`.
        held_out: the fraction of the readings, last in time, on which the result is tried.
        progress: show progress on stderr.

    Returns:
        The sensors, and what simulator.json says of them: for each its mounting (m), when it is
        read (s), its noise, and the root mean square of its readings' errors, relative to their
        standard deviation.

    Raises:
        UserError: if there are too few readings, or one's name is that of something else.
    """
    names = sensors_of(readings)
    for name in names:
        if name in NOT_READINGS:
            raise UserError(
                f"a sensor cannot be called {name}: controllers use this name for another input"
            )
    every = _rows_of(readings)
    earlier = int(len(readings) * (1 - held_out))
    rows, later = every.take(np.arange(earlier)), every.take(np.arange(earlier, len(readings)))
    if len(rows.part) < FEWEST or len(np.unique(rows.part)) < PARTS:
        raise UserError(
            f"{len(readings)} readings are too few to learn sensors from, which takes {FEWEST} "
            f"over {PARTS * SPAN / (1 - held_out):.0f} s: record longer, or train with --no-sensors"
        )
    with Progress("sensors", 2 * len(names), "steps") if progress else _Quiet() as bar:
        mounts = np.zeros((len(names), 3))
        for s in range(len(names)):
            mounts[s] = _mounting(rows, s)
            bar.advance()
        groups = _grouped(_Maps(rows, COARSE, *_ROUGH), mounts)
        rough, fitted, final = _Maps(rows, CELL, *_ROUGH), _Maps(rows, CELL), _Maps(every, CELL)
        noise, tried, maps = np.zeros((len(names), 2)), np.zeros(len(names)), []
        for group in groups:
            mounts = _refine(rough, mounts, group)
            tries = (*SMOOTHNESS, np.inf)
            smooth = min(tries, key=lambda each: fitted.error(mounts, each, group))
            noise[group] = _noise(fitted, mounts, smooth, group)
            tried[group] = _tried(fitted, mounts, smooth, group, later)
            maps.append(final.fit(mounts, smooth, group, np.ones(len(every.part), bool)))
            for _ in group:
                bar.advance()
    place = [next(k for k, group in enumerate(groups) if s in group) for s in range(len(names))]
    sensors = Sensors(
        names,
        torch.from_numpy(mounts[:, :2].copy()),
        torch.tensor(place),
        torch.from_numpy(noise),
        torch.from_numpy(np.clip(np.stack(maps), 0.0, 1.0)),
        torch.from_numpy(final.grid.origin),
        CELL,
    )
    about = [
        {
            "name": name,
            "ahead": round(float(mounts[s, 0]), 5),
            "aside": round(float(mounts[s, 1]), 5),
            "after": round(float(mounts[s, 2]), 4),
            "map": place[s],
            "noise": round(float(noise[s, 0]), 5),
            "place_noise": round(float(noise[s, 1]), 5),
            "rms_error": round(float(tried[s]), 5),
            "rms": round(float(later.values[:, s].std()), 5) if len(later.part) else 0.0,
        }
        for s, name in enumerate(names)
    ]
    return sensors, {"rows": len(every.part), "held_out": len(later.part), "sensors": about}


def _rows_of(readings: pd.DataFrame) -> _Rows:
    time = readings["time"].to_numpy(np.float64)
    whose = readings["recording"].to_numpy()
    # A span of time is a part of its own where the clock starts anew.
    begins = np.concatenate([[True], (np.diff(time) < 0) | (whose[1:] != whose[:-1])])
    run = np.cumsum(begins) - 1
    part = (time // SPAN).astype(np.int64) + run
    return _Rows(
        readings[list(PLACE)].to_numpy(np.float64),
        part % PARTS,
        readings[list(sensors_of(readings))].to_numpy(np.float64),
    )


def _mounting(rows: _Rows, sensor: int) -> NDArray[np.float64]:
    """Return about where a sensor is mounted and when it is read, [3] m, m, s."""
    rows = replace(rows, values=rows.values[:, [sensor]])
    coarse = _Maps(rows, COARSE, *_ROUGH)
    offsets = np.arange(-REACH, REACH + STEP / 2, STEP)
    tries = [
        (ahead, aside) for ahead in offsets for aside in offsets if np.hypot(ahead, aside) <= REACH
    ]
    # Readings that do not differ say nothing of where they are from.
    if rows.values.std() < 1e-6:
        return np.zeros(3)
    best = min(
        (np.array([ahead, aside, 0.04]) for ahead, aside in tries),
        key=lambda mount: coarse.error(mount[None], _SEARCHED, [0]),
    )
    return _refine(coarse, best[None], [0], finest=8 * _FINEST)[0]


def _refine(
    maps: _Maps,
    mounts: NDArray[np.float64],
    group: Sequence[int],
    finest: NDArray[np.float64] = _FINEST,
) -> NDArray[np.float64]:
    """Return mountings [S, 3] of a group at the least error near others: a pattern search.

    A step that made the error less is gone on with; where none does, steps are halved.
    """
    best, least = mounts.copy(), maps.error(mounts, _SEARCHED, group)
    steps = np.array([STEP / 4, STEP / 4, 0.02])
    while (steps > finest).any():
        better = False
        for s in group:
            for axis in range(3):
                for sign in (1.0, -1.0):
                    tried = best.copy()
                    tried[s, axis] += sign * steps[axis]
                    if axis == 2 and not 0.0 <= tried[s, 2] <= LATEST:
                        continue
                    error = maps.error(tried, _SEARCHED, group)
                    if error < least:
                        best, least, better = tried, error, True
                        break
        if not better:
            steps = steps / 2
    return best


def _grouped(maps: _Maps, mounts: NDArray[np.float64]) -> list[list[int]]:
    """Return which sensors fraction a map: each joins those with whom it is predicted better."""
    groups: list[list[int]] = []
    errors: list[float] = []
    for s in range(len(mounts)):
        alone = maps.error(mounts, _SEARCHED, [s])
        joined = [maps.error(mounts, _SEARCHED, [*group, s]) for group in groups]
        gains = [before + alone - after for before, after in zip(errors, joined, strict=True)]
        best = int(np.argmax(gains)) if gains else 0
        if gains and gains[best] > 0:
            groups[best].append(s)
            errors[best] = joined[best]
        else:
            groups.append([s])
            errors.append(alone)
    return groups


def _noise(
    maps: _Maps, mounts: NDArray, smooth: float, group: Sequence[int]
) -> NDArray[np.float64]:
    """Return the standard deviations [G, 2] of a group's readings and of their places.

    By medians: where readings were sparse the map is wrong, and that is no noise.
    """
    off = np.abs(maps.left_out(mounts, smooth, group))
    noise = np.zeros((len(group), 2))
    field = maps.fit(mounts, smooth, group, np.ones(len(off), bool))
    along_y, along_x = np.gradient(field, maps.grid.cell)
    steep = np.hypot(along_x, along_y).ravel()
    for place, s in enumerate(group):
        at = maps.grid.weights(maps.rows.looked_at(mounts[s]))
        slope = (steep[at[0]] * at[1]).sum(1)
        level = slope <= np.median(slope)
        own = noise[place, 0] = _BY_CHANCE * np.median(off[level, place])
        sloping = slope * CELL / 2 > 2 * own
        if sloping.sum() >= 20:
            beyond = _BY_CHANCE * np.median(off[sloping, place] / slope[sloping])
            noise[place, 1] = np.sqrt(max(beyond**2 - (own / np.median(slope[sloping])) ** 2, 0.0))
    return noise


def _tried(
    maps: _Maps, mounts: NDArray, smooth: float, group: Sequence[int], later: _Rows
) -> NDArray[np.float64]:
    """Return the root mean square error [G] on later readings; 0 where there are none."""
    field = maps.fit(mounts, smooth, group, np.ones(len(maps.rows.part), bool)).ravel()
    error = np.zeros(len(group))
    for place, s in enumerate(group):
        if len(later.part):
            points, weights = maps.grid.weights(later.looked_at(mounts[s]))
            off = later.values[:, s] - (field[points] * weights).sum(1)
            error[place] = np.sqrt(np.mean(off**2))
    return error


class _Quiet:
    def __enter__(self) -> _Quiet:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def advance(self) -> None:
        """Show nothing."""


@njit(cache=True, fastmath={"contract", "nsz"})
def _rough(m, kappa, out):
    """Write (kappa + L) m."""
    ny, nx = m.shape
    for j in range(ny):
        for i in range(nx):
            total = kappa * m[j, i]
            if j > 0:
                total += m[j, i] - m[j - 1, i]
            if j < ny - 1:
                total += m[j, i] - m[j + 1, i]
            if i > 0:
                total += m[j, i] - m[j, i - 1]
            if i < nx - 1:
                total += m[j, i] - m[j, i + 1]
            out[j, i] = total


@njit(cache=True, fastmath={"contract", "nsz"})
def _normal(points, weights, kappa, smooth, m, inner, out):
    """Write (W'W + smooth (kappa + L)^2) m."""
    _rough(m, kappa, inner)
    _rough(inner, kappa, out)
    out *= smooth
    flat, into = m.ravel(), out.ravel()
    for row in range(len(points)):
        total = 0.0
        for c in range(4):
            total += weights[row, c] * flat[points[row, c]]
        for c in range(4):
            into[points[row, c]] += weights[row, c] * total


@njit(cache=True, fastmath={"contract", "nsz"})
def _conjugate_gradients(points, weights, values, kappa, smooth, exact, x):
    """Change the map x to the one of least squares (Hestenes and Stiefel 1952)."""
    residual = np.zeros_like(x)
    into = residual.ravel()
    for row in range(len(points)):
        for c in range(4):
            into[points[row, c]] += weights[row, c] * values[row]
    whole = (residual * residual).sum()
    inner, image = np.empty_like(x), np.empty_like(x)
    _normal(points, weights, kappa, smooth, x, inner, image)
    residual -= image
    direction = residual.copy()
    square = (residual * residual).sum()
    for _ in range(2000):
        if square <= exact * whole:
            break
        _normal(points, weights, kappa, smooth, direction, inner, image)
        step = square / (direction * image).sum()
        x += step * direction
        residual -= step * image
        after = (residual * residual).sum()
        direction = residual + after / square * direction
        square = after
