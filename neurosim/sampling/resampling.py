"""From a robot's turns to samples at even distances and angles, and to the sizes of its wheels.

The robot finds the counts of a full turn from its sensors, whose readings repeat after it. A turn
on the spot gives the effective distance between the wheels; a turn around one wheel gives the size
of the other. So the robot measures unequal wheels, which counters alone do not show.

Two wheels are never equal, so a robot that turns on the spot moves around a point next to its
middle; its pose is integrated from its counters. The counters do not show slip, but the sensors do:
their readings in the same direction differ after the turn back.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.sampling.settings import Sampler, SampleSettings
from neurosim.sampling.turns import PIVOTS, TURNS, Turns
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import WALL, radius_of

#: Standard deviations: of the wheels' slip in a turn there and back, m, and of averaged readings.
_SLIP, _READING = 0.0005, 0.01
#: Smallest mean reading above its median from which a sensor's direction is computed.
_FAINT = 0.02
#: Range around an angle over which readings are averaged, rad.
_NEAR = math.radians(2.0)

#: Range of the search for a full turn around the nominal one, as a fraction of it.
_REACH = 0.1

_TURN = 2.0 * math.pi
_Array = NDArray[np.float64]


def full_turn(turns: Turns) -> float:
    """Return the counts of a wheel in a full turn, after which the sensors' readings repeat.

    The median over objects and repeats of the period with the least mean squared difference, at the
    smallest distance, where readings are strongest.

    Raises:
        UserError: if no turn is complete, or the readings do not repeat near the counters' full
            turn.
    """
    repeats = [
        _period(rows)
        for (name, _, distance), rows in turns.items()
        if distance == 0 and name not in PIVOTS and len(rows) > 9
    ]
    if not repeats:
        raise UserError("no full turn was sampled at the smallest distance: continue with --resume")
    return float(np.median(repeats))


def wheel_sizes(turns: Turns) -> tuple[float, float]:
    """Return the sizes of the left and the right wheel over their mean.

    They are equal if the robot did not turn around a wheel.
    """
    if any((name, 1, 0) not in turns for name in PIVOTS):
        return 1.0, 1.0
    # The larger wheel needs fewer counts.
    right, left = (1.0 / _period(turns[name, 1, 0]) for name in PIVOTS)
    return 2.0 * left / (left + right), 2.0 * right / (left + right)


def _period(rows: _Array) -> float:
    """Return the counts after which the readings repeat, in a turn and back."""
    turned = _turned(rows)
    halves = _halves(np.abs(turned - turned[0]), rows[:, 4:])
    return float(np.mean([_repeats(*half) for half in halves]))


def _repeats(turned: _Array, readings: _Array) -> float:
    """Return the number of counts [N] after which readings [N, S] repeat.

    Raises:
        UserError: if the best is at the edge of the searched range, so that the true one is beyond
            it.
    """
    turned = turned - turned[0]
    periods = turned[-1] / TURNS * np.linspace(1.0 - _REACH, 1.0 + _REACH, 401)
    errors = []
    for period in periods:
        late = turned >= period
        again = np.stack([np.interp(turned[late] - period, turned, r) for r in readings.T], axis=1)
        errors.append(((readings[late] - again) ** 2).mean())
    best = int(np.argmin(errors))
    if best in (0, len(periods) - 1):
        raise UserError(
            "the readings do not repeat after a full turn of the counters: the pulses per metre "
            "or the robot's size is wrong (a Khepera has 10,000 here, 12,000 or 12,500 in its "
            "manuals); give --pulses-per-metre and sample into a new folder"
        )
    return float(periods[best])


def _turned(rows: _Array, sizes: tuple[float, float] = (1.0, 1.0)) -> _Array:
    """Return the robot's turn to the left since it was placed, in counts [N]."""
    return (sizes[1] * rows[:, 1] - sizes[0] * rows[:, 0]) / 2


def _halves(turned: _Array, columns: _Array) -> list[tuple[_Array, _Array]]:
    """Return the turn there and the turn back, if any, both as turns to the left."""
    top = int(turned.argmax())
    there = turned[: top + 1], columns[: top + 1]
    back = turned[top:][::-1], columns[top:][::-1]
    return [there, back] if len(back[0]) > len(there[0]) // 2 else [there]


def write_samples(
    out: Path,
    settings: SampleSettings,
    turns: Turns,
    robot: Sampler,
    pulses: float,
    sizes: tuple[float, float],
) -> list[Path]:
    """Write the samples of all objects and repeats, interpolated between readings.

    The robot's start angle differs between objects, but its sensors' directions do not: the samples
    are turned to agree with their mean.

    Args:
        out: folder.
        settings: the distances and angles.
        turns: the sampled turns.
        robot: the robot that sampled.
        pulses: counts of a wheel in a full turn.
        sizes: sizes of the left and the right wheel over their mean.
    """
    keys = [(name, repeat) for name in settings.kinds for repeat in range(1, settings.repeats + 1)]
    seen = [_Seen(settings, turns, robot, pulses, sizes, *key) for key in keys]
    facing = [_between(seen[0].directions, one.directions) for one in seen]
    facing = np.nan_to_num(facing)
    paths = []
    for (name, repeat), one, off in zip(keys, seen, facing - facing.mean(), strict=True):
        path = out / (f"{name}.sample" if repeat == 1 else f"{name}-{repeat}.sample")
        if not path.exists():
            Samples(one.samples(off), settings.first, settings.step_at(name)).write(path)
        paths.append(path)
    return paths


class _Seen:
    """The readings near an object at all distances.

    Attributes:
        directions: [S] see :func:`_directions`, at the smallest distance.
    """

    def __init__(
        self,
        settings: SampleSettings,
        turns: Turns,
        robot: Sampler,
        pulses: float,
        sizes: tuple[float, float],
        name: str,
        repeat: int,
    ):
        self._settings, self._away = settings, settings.away(name)
        #: For every distance and half: angles [N], distances and readings [N, 1 + S], fraction [N].
        self._halves: list[list[tuple[_Array, _Array, _Array]]] = []
        off = 0.0
        for k in range(settings.distances):
            rows = turns[name, repeat, k]
            turned = _turned(rows, sizes)
            ahead, aside = _places(rows, sizes, pulses / robot.pulses_per_metre / math.pi, robot)
            if name == WALL:
                distance, bearing = -ahead, np.zeros(len(rows))
            else:
                touching = robot.geometry.radius + radius_of(name)
                to = touching - ahead
                distance = np.hypot(to, aside) - touching
                bearing = np.arctan2(-aside, to)
            progress = np.abs(np.diff(turned, prepend=turned[0])).cumsum()
            columns = np.column_stack(
                [bearing, distance, progress / max(progress[-1], 1.0), rows[:, 4:]]
            )
            halves = [
                (_TURN * angle / pulses - each[:, 0], np.delete(each, (0, 2), axis=1), each[:, 2])
                for angle, each in _halves(turned, columns)
            ]
            looking = [_directions(angle, each[:, 1:]) for angle, each, _ in halves]
            if k == 0:
                self.directions = np.mean(looking, axis=0)
            offs = [_between(self.directions, one) for one in looking]
            # Beyond the sensors' range the robot's angle is unknown.
            offs = [off if math.isnan(offset) else offset for offset in offs]
            off = offs[-1]
            self._halves.append(
                [(half[0] - one, *half[1:]) for half, one in zip(halves, offs, strict=True)]
            )
        self._slipped()

    def _slipped(self) -> None:
        """Add the wheels' slip to the distances, from the readings after the turn back."""
        count = self._settings.angles
        both = [[_even(angle, each, count) for angle, each, _ in halves] for halves in self._halves]
        mean = np.array([np.mean(halves, axis=0) for halves in both])
        slopes = np.gradient(mean[..., 1:], self._away, axis=0)
        # A direction that is seen late in the turn there is seen early in the turn back.
        apart = (1.0 - np.arange(count) / count / TURNS)[:, None]
        before = 0.0
        for k, halves in enumerate(self._halves):
            slipped = 0.0
            if len(halves) == 2:
                expected, change = slopes[k] * apart, (both[k][1] - both[k][0])[:, 1:]
                variance = (_READING / _SLIP) ** 2
                slipped = float((expected * change).sum() / ((expected**2).sum() + variance))
            for _, each, progress in halves:
                each[:, 0] += before + slipped * progress
            before += slipped

    def samples(self, off: float) -> _Array:
        """Return readings [D, A, S] at the settings' distances and angles, turned back by ``off``.

        Those near an angle are averaged; between distances they are interpolated.
        """
        count = self._settings.angles
        mean = []
        for halves in self._halves:
            angle = np.concatenate([angle for angle, _, _ in halves]) - off
            mean.append(_even(angle, np.concatenate([each for _, each, _ in halves]), count))
        averaged = np.array(mean)
        samples = np.empty((*averaged.shape[:2], averaged.shape[2] - 1))
        for a in range(count):
            order = np.argsort(averaged[:, a, 0])
            for s in range(samples.shape[2]):
                samples[:, a, s] = np.interp(
                    self._away, averaged[order, a, 0], averaged[order, a, 1 + s]
                )
        # A straight line through readings near the end of their range may leave the range.
        return samples.clip(0.0, 1.0)


def _places(
    rows: _Array, sizes: tuple[float, float], wheel_base: float, robot: Sampler
) -> tuple[_Array, _Array]:
    """Return the robot's positions in a turn, ahead and to the left of its start, [N] m."""
    left, right = (np.diff(rows[:, w]) * sizes[w] / robot.pulses_per_metre for w in range(2))
    turns = (right - left) / wheel_base
    first = 2.0 * _turned(rows[:1], sizes)[0] / robot.pulses_per_metre / wheel_base
    heading = first + np.cumsum(turns) - turns / 2.0
    forward = (left + right) / 2.0
    along = [np.cumsum(forward * part) for part in (np.cos(heading), np.sin(heading))]
    ahead, aside = (rows[0, 2 + axis] + np.append(0.0, along[axis]) for axis in range(2))
    return ahead, aside


def _even(angle: _Array, columns: _Array, count: int) -> _Array:
    """Return columns [N, C] at even angles of a full turn, [count, C]: straight lines through them.

    The weight of a row falls linearly to zero at a distance of 2 degrees, or at the next angle if
    it is nearer, or at the next row if it is farther.
    """
    grid = _TURN * np.arange(count) / count
    place = np.sort(angle % _TURN)
    gap = np.diff(np.append(place, place[0] + _TURN)).max()
    off = se2.wrapped(angle - grid[:, None])
    width = max(min(_TURN / count, _NEAR), gap)
    weight = np.maximum(1.0 - np.abs(off) / width, 0.0) + 1e-12 * (np.abs(off) <= width)
    total, first, second = ((weight * off**n).sum(axis=1, keepdims=True) for n in range(3))
    middle = first / total
    spread = second / total - middle**2
    mean = weight @ columns / total
    slope = ((weight * off) @ columns / total - middle * mean) / (spread + 1e-6 * width**2)
    return mean - slope * middle


def _directions(angle: _Array, readings: _Array) -> NDArray[np.complex128]:
    """Return every sensor's [S] angle of the largest reading in the turn, and that reading."""
    even = _even(angle, readings, 180)
    above = np.maximum(even - np.median(even, axis=0), 0.0)
    return (above * np.exp(1j * _TURN * np.arange(180) / 180)[:, None]).mean(axis=0)


def _between(first: NDArray[np.complex128], seen: NDArray[np.complex128]) -> float:
    """Return the robot's angle relative to the first half, rad; NaN if no sensor sees enough.

    A sensor's readings are symmetric about an object straight ahead of it. So the middle of the
    readings, over all sensors, changes only if wheels slip.
    """
    clear = (np.abs(seen) > _FAINT) & (np.abs(first) > _FAINT)
    if clear.sum() < 2:
        return math.nan
    return float(np.angle(seen[clear] * first[clear].conj()).mean())
