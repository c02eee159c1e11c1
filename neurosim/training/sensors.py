"""Sensors learned from readings: each sensor's position on the robot, and its map of the board.

A reading is assumed to depend on the sensor's position on the board. For each sensor the training
finds its mounting on the robot, the delay of its reading after the scan began, and a map of the
board. The map m is the smooth one nearest to the readings y, with linear interpolation W between
its points,

.. math:: \\min_m |y - W m|^2 + \\lambda |(\\kappa^2 + L) m|^2

which is a Gaussian random field of Matern covariance (Lindgren, Rue, Lindstrom 2011, J. R. Stat.
Soc. B 73): L is the Laplacian of the grid, kappa its cell over a length. Mounting, time and lambda
have the least error in cross-validation, which leaves out readings of whole spans of time in turn.
Sensors share a map if that predicts the left-out readings better than a map for each. A sensor
whose readings do not depend on its position gets a flat map and large noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.base.errors import UserError
from neurosim.base.progress import Progress
from neurosim.networks.control import NOT_READINGS
from neurosim.simulators.motion.sensors import Sensors
from tracking.datasets.readings import PLACE, sensors_of

#: Distance between a map's points, and that of the coarser map for the search of the mounting, m.
CELL, COARSE = 0.01, 0.02
#: Correlation length of the map, m; far from all readings its value is their median.
LENGTH = 0.05
#: Candidates for the smoothness of maps; cross-validation chooses.
SMOOTHNESS = (0.01, 0.03, 0.1, 0.3, 1.0, 10.0)
#: Range of the search for a sensor around the middle of the axle, and its step, m.
REACH, STEP = 0.16, 0.02
#: Largest delay of a sensor's reading after the scan began, s.
LATEST = 0.25
#: Seconds of readings that are left out together, and number of parts.
SPAN, PARTS = 8.0, 4
#: Largest number of a map's points, and smallest number of readings for a sensor.
MOST_POINTS, FEWEST = 4_000_000, 50
#: Standard deviation of readings, which are from 0 to 1, below which a sensor saw nothing.
NOTHING = 0.002
#: Steps at which the search of the mounting ends: m, m, s.
_FINEST = np.array([0.0005, 0.0005, 0.004])
#: During the search of the mounting: smoothness, number of left-out parts, and accuracy.
_SEARCHED, _ROUGH = 0.1, (2, 1e-7)
_BY_CHANCE = 1.4826  # standard deviation over median absolute deviation, of normal numbers


@dataclass(frozen=True)
class _Rows:
    """Readings of some sensors.

    Attributes:
        place: [N, 6] in the columns of :data:`tracking.datasets.readings.PLACE`.
        part: [N] part of each in the cross-validation.
        values: [N, S].
    """

    place: NDArray[np.float64]
    part: NDArray[np.int64]
    values: NDArray[np.float64]

    def looked_at(self, mount: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a sensor's positions [N, 2] from its mounting: ahead, aside (m), after (s)."""
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
        """Return the map's points [N, 4] around positions [N, 2], and their weights [N, 4]."""
        ny, nx = self.shape
        across, up = ((places - self.origin) / self.cell).T
        across, up = across.clip(0, nx - 1), up.clip(0, ny - 1)
        i, j = across.astype(int).clip(max=nx - 2), up.astype(int).clip(max=ny - 2)
        a, b = across - i, up - j
        first = j * nx + i
        points = np.stack([first, first + 1, first + nx, first + nx + 1], axis=1)
        return points, np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)


class _Maps:
    """Maps of readings, and their errors on left-out readings.

    Args:
        rows: the readings.
        cell: distance between the maps' points, m.
        parts: number of the :data:`PARTS` that are left out in turn.
        exact: accuracy of the maps; a computation begins with the previous map.
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
        """Return the map [NY, NX] of a group of sensors from the kept rows [N].

        ``part`` is the left-out part, -1 for none.
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
        """Return the errors of a group's readings [N, G] against maps of the other parts."""
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
        """Return the sum of squared errors of a group's left-out readings."""
        return float((self.left_out(mounts, smooth, group) ** 2).sum())


def learn_sensors(
    readings: pd.DataFrame, held_out: float = 0.2, *, progress: bool = True
) -> tuple[Sensors, dict[str, Any]]:
    """Learn sensors from the readings of a dataset.

    Mounting, smoothness and noise are learned from the earlier readings, and tested on the last
    ones. Then the maps are computed from all readings, because they know only where the robot
    drove.

    Args:
        readings: the table of :mod:`tracking.datasets.readings`.
        held_out: the fraction of the readings, last in time, for the test.
        progress: show progress on stderr.

    Returns:
        The sensors, and their description for simulator.json: the mounting (m), the delay (s), the
        noise, and the root mean square of the readings' errors, relative to their standard
        deviation.

    Raises:
        UserError: if there are too few readings, or a sensor has the name of another input.
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
        mounts, flat = np.zeros((len(names), 3)), rows.values.std(0) < NOTHING
        for s in range(len(names)):
            mounts[s] = 0.0 if flat[s] else _mounting(rows, s)
            bar.advance()
        groups = _grouped(_Maps(rows, COARSE, *_ROUGH), mounts, np.flatnonzero(~flat))
        groups += [[s] for s in np.flatnonzero(flat)]
        rough, fitted, final = _Maps(rows, CELL, *_ROUGH), _Maps(rows, CELL), _Maps(every, CELL)
        noise, tried, maps = np.zeros((len(names), 2)), np.zeros(len(names)), []
        for group in groups:
            sees = not flat[group].any()
            mounts = _refine(rough, mounts, group) if sees else mounts
            tries = (*SMOOTHNESS, np.inf) if sees else (np.inf,)
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
            "flat": bool(flat[s]),
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
    # If the clock starts again, a new span of time begins.
    begins = np.concatenate([[True], (np.diff(time) < 0) | (whose[1:] != whose[:-1])])
    run = np.cumsum(begins) - 1
    part = (time // SPAN).astype(np.int64) + run
    return _Rows(
        readings[list(PLACE)].to_numpy(np.float64),
        part % PARTS,
        readings[list(sensors_of(readings))].to_numpy(np.float64),
    )


def _mounting(rows: _Rows, sensor: int) -> NDArray[np.float64]:
    """Return the approximate mounting and delay of a sensor, [3] m, m, s."""
    rows = replace(rows, values=rows.values[:, [sensor]])
    coarse = _Maps(rows, COARSE, *_ROUGH)
    offsets = np.arange(-REACH, REACH + STEP / 2, STEP)
    tries = [
        (ahead, aside) for ahead in offsets for aside in offsets if np.hypot(ahead, aside) <= REACH
    ]
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
    """Return mountings [S, 3] of a group with the least error near given ones, by a pattern search.

    A step that reduces the error is repeated; if none does, steps are halved.
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


def _grouped(
    maps: _Maps, mounts: NDArray[np.float64], sensors: NDArray[np.int64]
) -> list[list[int]]:
    """Return the groups of sensors that share a map: each joins a group that predicts it better."""
    groups: list[list[int]] = []
    errors: list[float] = []
    for s in sensors.tolist():
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
    """Return the standard deviations [G, 2] of a group's readings and of their positions.

    They use medians, because errors of the map at sparse readings are not noise.
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
    """Return the root mean square error [G] on later readings; 0 if there are none."""
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


@njit(fastmath={"contract", "nsz"})
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


@njit(fastmath={"contract", "nsz"})
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


@njit(fastmath={"contract", "nsz"})
def _conjugate_gradients(points, weights, values, kappa, smooth, exact, x):
    """Change the map x to the least-squares one (Hestenes and Stiefel 1952)."""
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
