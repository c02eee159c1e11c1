"""A robot turns in front of an object, at growing distances, and reads its sensors continuously.

After every turn it turns back, so that neither the cable winds up nor errors add up, and reads
meanwhile, too. Last it turns around each wheel in front of the wall, which gives the wheels' sizes.
:mod:`.resampling` evaluates the readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files
from neurosim.base.errors import RobotError
from neurosim.base.progress import Progress
from neurosim.robots.odometry import Odometry
from neurosim.sampling.settings import Sampler, SampleSettings
from neurosim.simulators.tables.sensor_table import LIGHT

#: Length of a turn, in nominal full turns: enough to see the beginning of the turn again.
TURNS = 7 / 6
#: Speed of the wheels, as a fraction of full speed.
SLOW = 0.08
#: Time after which a robot whose counters stand although it should move is stuck, s.
STUCK = 3.0
#: Smallest distance between wall and rim when the robot turns around one wheel, m.
PIVOT_MARGIN = 0.01
#: Names in ``sensors.csv`` for turns around a wheel, and the directions of both wheels then: the
#: wall is near when the turn begins again.
PIVOTS = {"around-left": (0, 1), "around-right": (1, 0)}

#: Columns of ``sensors.csv`` before those of the sensors; the last ones are in a turn's rows.
_COLUMNS = (
    "object", "repeat", "distance", "turn", "whole", "time", "seconds",
    "left", "right", "ahead", "aside",
)  # fmt: skip
_ROW = _COLUMNS[7:]

#: Turns by object, repeat and number of the distance; see :func:`read_turns`.
Turns = dict[tuple[str, int, int], NDArray[np.float64]]


def sample_object(
    out: Path,
    robot: Sampler,
    settings: SampleSettings,
    name: str,
    repeat: int,
    place: Callable[[str], None],
    bar: Progress | None,
) -> None:
    """Turn at every distance from an object that is still missing.

    At the first wall, also turn around each wheel.
    """
    path = out / "sensors.csv"
    done = read_turns(out) if path.exists() else {}
    left_to_do = [d for d in range(settings.distances) if (name, repeat, d) not in done]
    pivots = PIVOTS if (name, repeat) == ("wall", 1) else {}
    pivots = {name: signs for name, signs in pivots.items() if (name, 1, 0) not in done}
    if bar is not None:
        bar.advance(settings.distances - len(left_to_do))
    if not left_to_do and not pivots:
        return
    place(name)
    whereabouts = _Whereabouts(robot)
    last = 0
    if path.exists():
        numbers = files.read_csv(path, {"turn": files.integer}, drop_torn_line=True)["turn"]
        last = int(numbers.max()) if len(numbers) else 0
    with files.LineLog(path, (*_COLUMNS, *_sensors(len(robot.angles)))) as log:
        for turn, distance in enumerate(left_to_do, last + 1):
            away = float(settings.away(name)[distance])
            whereabouts.go(-1, -1, partial(_further, whereabouts, away))
            _turn(robot, whereabouts, log, (name, repeat, distance, turn))
            if bar is not None:
                bar.advance(note=f"{name}, {1000 * away:g} mm")
        away = robot.geometry.wheel_base / 2.0 + PIVOT_MARGIN
        for turn, (pivot, signs) in enumerate(pivots.items(), last + len(left_to_do) + 1):
            whereabouts.go(-1, -1, partial(_further, whereabouts, away))
            _turn(robot, whereabouts, log, (pivot, 1, 0, turn), signs)


def read_turns(folder: str | Path) -> Turns:
    """Read the sampled turns: (object or pivot, repeat, distance) -> rows [N, 4 + S].

    Columns: counts of both wheels; the robot's position, ahead and to the left of its start (m);
        activations. Incomplete turns are left out; of a repeated turn the last one counts.
    """
    parsers: dict[str, Any] = {"object": str, "whole": files.flag}
    parsers |= dict.fromkeys(("repeat", "distance", "turn"), files.integer)
    path = Path(folder) / "sensors.csv"
    header = files.read_text(path, "a CSV file in UTF-8").partition("\n")[0]
    row = [*_ROW, *_sensors(header.count("sensor_"))]
    parsers |= dict.fromkeys(row, files.number)
    table = files.read_csv(path, parsers, drop_torn_line=True)
    turns = {}
    for _, turn in table.groupby("turn"):
        last = turn.iloc[-1]
        if last["whole"]:
            turns[last["object"], last["repeat"], last["distance"]] = turn[row].to_numpy()
    return turns


def _sensors(count: int) -> tuple[str, ...]:
    return tuple(f"sensor_{index}" for index in range(count))


def reading_times(folder: str | Path) -> NDArray[np.float64]:
    """Return the duration of every reading of the sensors, s."""
    path = Path(folder) / "sensors.csv"
    table = files.read_csv(path, {"seconds": files.number}, drop_torn_line=True)
    return table["seconds"].to_numpy()


class _Whereabouts(Odometry):
    """The robot's pose by its counters, relative to its start."""

    def __init__(self, robot: Sampler):
        super().__init__(robot, np.zeros(3))
        self._since = robot.clock.now()

    @property
    def turned(self) -> float:
        """Turn to the left, in counts of a wheel."""
        return (self.counts[1] - self.counts[0]) / 2

    def read(self) -> NDArray[np.float64]:
        """Read the counters; return the pose, [3] (m, m, rad).

        Raises:
            RobotError: if they do not change for too long.
        """
        robot, now, before = self._robot, self._robot.clock.now(), self.counts
        pose = super().read()
        if self.counts != before:
            self._since = now
        elif now - self._since > STUCK:
            robot.stop()
            raise RobotError(
                "the robot's wheels do not turn: is it held, or is its battery empty? Correct "
                "this and continue with --resume"
            )
        return pose

    def go(self, left: int, right: int, to_go: Callable[[], float]) -> None:
        """Drive slowly to the goal and stop."""
        pace, self._since = pace_of(self._robot, SLOW), self._robot.clock.now()
        self.read()
        if to_go() > 0:
            self._robot.set_speeds(left * pace, right * pace)
        while to_go() > 0:
            self.read()
        self._robot.stop()


def _further(whereabouts: _Whereabouts, away: float) -> float:
    return whereabouts.pose[0] + away


def _turn(
    robot: Sampler,
    whereabouts: _Whereabouts,
    log: files.LineLog,
    what: tuple[Any, ...],
    signs: tuple[int, int] = (-1, 1),
) -> None:
    """Turn by more than a full turn, to the left by default, and back; record the readings."""
    read = robot.lights if what[0] == LIGHT else robot.activations  # type: ignore[attr-defined]
    full = TURNS * math.pi * robot.geometry.wheel_base * robot.pulses_per_metre
    pace = pace_of(robot, SLOW)
    whereabouts.read()
    sense = math.copysign(1.0, signs[1] - signs[0])
    for back in (False, True):
        robot.set_speeds(*(-pace * sign if back else pace * sign for sign in signs))
        done = False
        while not done:
            # The sensors are read directly after the counters.
            whereabouts.read()
            begin = robot.clock.now()
            readings = read()
            now = robot.clock.now()
            robot.clock.sleep_until(begin + robot.scan)  # until then their readings do not change
            turned = sense * whereabouts.turned
            done = turned <= 0 if back else turned >= full
            ahead, aside, _ = map(float, whereabouts.pose)
            whole = done and back
            log.append(*what, whole, now, now - begin, *whereabouts.counts, ahead, aside, *readings)
    robot.stop()


def pace_of(robot: Sampler, speed: float) -> int:
    """Return the robot's speed number nearest to ``speed`` of full speed, 1 or more."""
    return max(round(speed * robot.full_speed), 1)
