"""A robot turns in front of an object, at growing distances, and reads its sensors all the while.

How many counts a full turn is, it finds from its sensors: after one they say the same again; so
the distance between the wheels, as the floor has it, is measured too. It turns as far back after
every turn, so that neither cable nor errors wind up.

Two wheels are never equal, so a robot that turns on the spot goes round a point beside its middle
and the mean of its counters grows without bringing it anywhere. Its counters are therefore
integrated to where it is; samples are taken to the distances and directions asked for from those
at which readings were made.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files, se2
from neurosim.base.errors import RobotError, UserError
from neurosim.base.progress import Progress
from neurosim.robots import Khepera
from neurosim.sampling.settings import SampleSettings
from neurosim.simulators.samples import Samples

#: How far it turns, in nominal full turns: enough to see the beginning of the turn again.
TURNS = 7 / 6
#: Wheel speeds when turning to sample or ending a motion, and on the way back, m/s.
SLOW, FAST = 0.008, 0.032
#: The last of a fast motion is slow, m of a wheel's way.
BRAKE = 0.004
#: A robot whose counters stand for so long while it should move is stuck, s.
STUCK = 3.0
#: Radius of the round obstacle (the paper's is 5.5 cm across), m.
OBSTACLE = 0.0275
#: A sensor whose mean reading above its median is less says nothing of directions.
_FAINT = 0.02

_COLUMNS = (
    "object", "repeat", "distance", "turn", "whole", "time", "seconds", "left", "right",
    "ahead", "aside", *(f"sensor_{index}" for index in range(8)),
)  # fmt: skip
_PLACES = ("ahead", "aside", *_COLUMNS[11:])

#: Turns by object, repeat and number of the distance; see :func:`read_turns`.
Turns = dict[tuple[str, int, int], NDArray[np.float64]]


def sample_object(
    out: Path,
    robot: Khepera,
    settings: SampleSettings,
    name: str,
    repeat: int,
    place: Callable[[str], None],
    bar: Progress | None,
) -> None:
    """Turn at every distance from an object at which that was not done yet."""
    path = out / "sensors.csv"
    done = read_turns(out) if path.exists() else {}
    left_to_do = [d for d in range(settings.distances) if (name, repeat, d) not in done]
    if bar is not None:
        bar.advance(settings.distances - len(left_to_do))
    if not left_to_do:
        return
    place(name)
    whereabouts = _Whereabouts(robot)
    last = 0
    if path.exists():
        numbers = files.read_csv(path, {"turn": files.integer}, drop_torn_line=True)["turn"]
        last = max(numbers, default=0)
    with files.LineLog(path, _COLUMNS) as log:
        for turn, distance in enumerate(left_to_do, last + 1):
            away = settings.first + distance * settings.step
            whereabouts.go(-1, -1, partial(_further, whereabouts, away))
            _turn(robot, whereabouts, log, (name, repeat, distance, turn))
            # Fast for one full turn exactly: what that shifts the robot by, it takes back.
            full = 2.0 * math.pi * robot.geometry.wheel_base / 2.0
            whereabouts.go(1, -1, partial(_turned, whereabouts), fast=(BRAKE, BRAKE + full))
            if bar is not None:
                bar.advance(note=f"{name}, {1000 * away:g} mm")


def read_turns(folder: str | Path) -> Turns:
    """Read what was sampled: (object, repeat, distance) -> rows [N, 3 + S].

    Columns: how far the robot had turned, in counts of a wheel (half the difference of both);
    where it was, ahead and to the left of where it had been put (m); activations. Turns that did
    not come to their end are left out; of a turn that was made again the last counts.
    """
    parsers: dict[str, Any] = {"object": str, "whole": files.flag}
    parsers |= dict.fromkeys(("repeat", "distance", "turn"), files.integer)
    parsers |= dict.fromkeys(("left", "right", *_PLACES), files.number)
    table = files.read_csv(Path(folder) / "sensors.csv", parsers, drop_torn_line=True)
    turned = (np.array(table["right"]) - np.array(table["left"])) / 2
    rows = np.column_stack([turned, *(table[name] for name in _PLACES)])
    number, found = np.array(table["turn"], int), {}
    for turn in np.unique(number):
        places = np.flatnonzero(number == turn)
        last = places[-1]
        if table["whole"][last]:
            key = (table["object"][last], table["repeat"][last], table["distance"][last])
            found[key] = rows[places]
    return found


def reading_times(folder: str | Path) -> NDArray[np.float64]:
    """Return how long every reading of the sensors took, s."""
    path = Path(folder) / "sensors.csv"
    return np.array(files.read_csv(path, {"seconds": files.number}, drop_torn_line=True)["seconds"])


def full_turn(turns: Turns) -> float:
    """Return the counts of a wheel in a full turn, from where the sensors say the same again.

    The median over objects and repeats of the period with the least mean squared difference, at
    the smallest distance, where sensors say most.
    """
    found = [
        _period(rows) for (_, _, distance), rows in turns.items() if distance == 0 and len(rows) > 9
    ]
    if not found:
        raise UserError("no turn at the smallest distance was sampled to its end")
    return float(np.median(found))


def _period(rows: NDArray[np.float64]) -> float:
    turned, readings = rows[:, 0], rows[:, 3:]
    nominal = turned[-1] / TURNS
    periods = nominal * np.linspace(0.9, 1.1, 401)
    errors = []
    for period in periods:
        late = turned >= period
        again = np.stack([np.interp(turned[late] - period, turned, r) for r in readings.T], axis=1)
        errors.append(((readings[late] - again) ** 2).mean())
    return float(periods[int(np.argmin(errors))])


def write_samples(
    out: Path,
    settings: SampleSettings,
    turns: Turns,
    pulses: float,
    name: str,
    repeat: int,
    radius: float,
) -> Path:
    """Write an object's samples at even distances and angles, interpolated between readings.

    Args:
        out: folder.
        settings: the distances and angles.
        turns: what was sampled.
        pulses: counts of a wheel in a full turn.
        name: of the object.
        repeat: which.
        radius: of the robot, m.
    """
    grid = 2.0 * math.pi * np.arange(settings.angles) / settings.angles
    away = settings.first + settings.step * np.arange(settings.distances)
    distances = np.empty((settings.distances, settings.angles))
    found = np.empty((settings.distances, settings.angles, 8))
    fixed: NDArray[np.complex128] | None = None
    drifted = 0.0
    for k in range(settings.distances):
        rows = turns[name, repeat, k]
        ahead, aside = rows[:, 1], rows[:, 2]
        if name == "wall":
            distance, bearing = -ahead, 0.0
        else:
            to = radius + OBSTACLE - ahead
            distance, bearing = np.hypot(to, aside) - radius - OBSTACLE, np.arctan2(-aside, to)
        angle = 2.0 * math.pi * rows[:, 0] / pulses - bearing
        seen = _directions(angle, rows[:, 3:])
        fixed = seen if fixed is None else fixed
        drifted = _drift(fixed, seen, drifted)
        angle = angle - drifted
        # Where the turn began later or ended earlier than the grid, by what a full turn says.
        angle, columns = _wrapped(angle, np.column_stack([distance, rows[:, 3:]]))
        columns = np.stack([np.interp(grid, angle, column) for column in columns.T], axis=1)
        distances[k], found[k] = columns[:, 0], columns[:, 1:]
    for a in range(settings.angles):
        order = np.argsort(distances[:, a])
        for s in range(8):
            found[:, a, s] = np.interp(away, distances[order, a], found[order, a, s])
    path = out / (f"{name}.sample" if repeat == 1 else f"{name}-{repeat}.sample")
    if not path.exists():
        Samples(found, settings.first, settings.step).write(path)
    return path


def _wrapped(
    angle: NDArray[np.float64], columns: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return one full turn of readings, with the first again after the last and vice versa."""
    turn = 2.0 * math.pi
    once = angle < angle[0] + turn
    angle, columns = angle[once] % turn, columns[once]
    order = np.argsort(angle)
    angle, columns = angle[order], columns[order]
    angle = np.concatenate([angle[-1:] - turn, angle, angle[:1] + turn])
    return angle, np.concatenate([columns[-1:], columns, columns[:1]])


def _directions(
    angle: NDArray[np.float64], readings: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return for every sensor [S] at which angle of the turn it sees most, and how much."""
    angle, readings = _wrapped(angle, readings)
    even = np.linspace(0.0, 2.0 * math.pi, 360, endpoint=False)
    at = np.stack([np.interp(even, angle, column) for column in readings.T], axis=1)
    above = np.maximum(at - np.median(at, axis=0), 0.0)
    return (above * np.exp(1j * even)[:, None]).mean(axis=0)


def _drift(first: NDArray[np.complex128], seen: NDArray[np.complex128], before: float) -> float:
    """Return by how much the robot was turned since the first distance, rad.

    At every distance a sensor sees an object straight before it alike on both sides, so that the
    middle of what it sees stays where it is, over all sensors, unless wheels slipped.
    """
    clear = (np.abs(seen) > _FAINT) & (np.abs(first) > _FAINT)
    if clear.sum() < 2:
        return before
    return float(np.angle(seen[clear] * first[clear].conj()).mean())


class _Whereabouts:
    """Where the robot is by its counters, from where it was put down.

    Attributes:
        pose: [3] (m, m, rad).
        counts: of both wheels.
    """

    def __init__(self, robot: Khepera):
        self._robot = robot
        robot.set_counts(0, 0)
        self.pose, self.counts = np.zeros(3), (0, 0)
        self._since = robot.clock.now()

    @property
    def turned(self) -> float:
        """To the left, in counts of a wheel."""
        return (self.counts[1] - self.counts[0]) / 2

    def read(self) -> None:
        """Read the counters.

        Raises:
            RobotError: if they stand for too long.
        """
        robot, now = self._robot, self._robot.clock.now()
        counts = robot.read_counts()
        if counts != self.counts:
            ways = [
                (b - a) / robot.pulses_per_metre for a, b in zip(self.counts, counts, strict=True)
            ]
            turn = (ways[1] - ways[0]) / robot.geometry.wheel_base
            self.pose = se2.compose(self.pose, se2.exp([sum(ways) / 2, 0.0, turn]))
            self.counts, self._since = counts, now
        elif now - self._since > STUCK:
            robot.stop()
            raise RobotError(
                "the robot's wheels do not turn: is it held, or its battery empty? Put it right "
                "and go on with --resume"
            )

    def go(
        self,
        left: int,
        right: int,
        to_go: Callable[[], float],
        fast: tuple[float, float] = (BRAKE, math.inf),
    ) -> None:
        """Drive until nothing is to go and stop; fast while between two numbers (m) are."""
        pace, self._since = 0, self._robot.clock.now()
        self.read()
        while (rest := to_go()) > 0:
            wanted = pace_of(self._robot, FAST if fast[0] < rest < fast[1] else SLOW)
            if wanted != pace:
                pace = wanted
                self._robot.set_speeds(left * pace, right * pace)
            self.read()
        self._robot.stop()


def _turned(whereabouts: _Whereabouts) -> float:
    return whereabouts.turned / whereabouts._robot.pulses_per_metre


def _further(whereabouts: _Whereabouts, away: float) -> float:
    return whereabouts.pose[0] + away


def _turn(
    robot: Khepera, whereabouts: _Whereabouts, log: files.LineLog, what: tuple[Any, ...]
) -> None:
    """Turn to the left by more than a full turn and write down what the sensors say."""
    way = TURNS * math.pi * robot.geometry.wheel_base * robot.pulses_per_metre
    pace = pace_of(robot, SLOW)
    whereabouts.read()
    robot.set_speeds(-pace, pace)
    whole = False
    while not whole:
        # The sensors are scanned right behind the counters.
        whereabouts.read()
        begin = robot.clock.now()
        readings = robot.activations()
        now = robot.clock.now()
        whole = whereabouts.turned >= way
        ahead, aside, _ = map(float, whereabouts.pose)
        log.append(*what, whole, now, now - begin, *whereabouts.counts, ahead, aside, *readings)
    robot.stop()


def pace_of(robot: Khepera, speed: float) -> int:
    """Return the whole speed of the robot's that is nearest to ``speed`` (m/s), 1 or more."""
    return max(round(speed / robot.speed_unit), 1)
