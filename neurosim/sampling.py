"""A robot samples its own sensors and motors: Lund and Miglino 1996, "Model".

In front of an object the robot turns on the spot and writes down what its sensors say, backs off,
and so on; in the open it drives its motor settings. Its position counters say how far it turned
and drove. How many counts a full turn is, it finds from its sensors: after one they say the same
again; so the distance between the wheels, as the floor has it, is measured too. It turns as far
back after every turn, so that neither cable nor errors wind up.

Everything is written down as it is read (``sensors.csv``, ``motors.csv``); the ``.sample`` files
are made of that when an object is done.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files, se2
from neurosim.base.errors import FileError, RobotError, UserError
from neurosim.base.progress import Progress
from neurosim.robots import Khepera
from neurosim.simulators.motor_table import MotorTable
from neurosim.simulators.samples import Samples
from neurosim.simulators.sensor_table import OBJECTS

FORMAT, VERSION = "neurosim-sampling", 1
#: How far it turns, in nominal full turns: enough to see the beginning of the turn again.
TURNS = 7 / 6
#: Wheel speeds when turning to sample or ending a motion, and on the way back, m/s.
SLOW, FAST = 0.008, 0.032
#: The last of a fast motion is slow, m of a wheel's way.
BRAKE = 0.004
#: Seconds that motors get to reach their speed before a motor sample, and to stop after it.
SETTLE = 0.3
#: A robot whose counters stand for so long while it should move is stuck, s.
STUCK = 3.0

_SENSOR_COLUMNS = (
    "object", "repeat", "distance", "turn", "whole", "time", "left", "right",
    *(f"sensor_{index}" for index in range(8)),
)  # fmt: skip
_MOTOR_COLUMNS = ("left", "right", "duration", "dx", "dy", "dtheta", "repeat")

#: Asks a person to put the robot down, at an object ("wall", "cylinder") or in the open ("open").
Place = Callable[[str], None]


@dataclass(frozen=True)
class SampleSettings:
    """What to sample.

    Attributes:
        angles: of a full turn in the ``.sample`` files.
        distances: from the object.
        first: distance, from rim to surface, m.
        step: from distance to distance, m.
        repeats: of everything; two or more give the spread.
        grid: speeds of each motor, evenly from full speed back to full speed forward; 0: every
            whole speed of the robot.
        held_out: settings beside a grid that are driven to see what interpolation costs.
        duration: of a motor sample, s.
    """

    angles: int = 180
    distances: int = 20
    first: float = 0.005
    step: float = 0.002
    repeats: int = 1
    grid: int = 0
    held_out: int = 12
    duration: float = 1.0

    def __post_init__(self) -> None:
        if self.angles < 4 or self.distances < 2 or self.repeats < 1 or self.held_out < 0:
            raise UserError("sample at 4 angles or more, 2 distances or more, once or more")
        if not (0 <= self.first <= 1 and 0 < self.step <= 1):
            raise UserError("distances must be above 0 and below 1 m")
        if not 0.1 <= self.duration <= 10:
            raise UserError(f"a motor sample lasts 0.1 to 10 s, not {self.duration:g}")

    def levels(self, full_speed: int) -> NDArray[np.int64]:
        """Return the speeds to drive, in the robot's units.

        Raises:
            UserError: if a grid's speeds are not whole.
        """
        count = self.grid or 2 * full_speed + 1
        if count < 2 or (2 * full_speed) % (count - 1):
            good = [n + 1 for n in range(1, 2 * full_speed + 1) if 2 * full_speed % n == 0]
            raise UserError(
                f"a grid of {count} does not fall on the robot's {2 * full_speed + 1} whole "
                f"speeds; use {', '.join(map(str, good))}"
            )
        return np.arange(-full_speed, full_speed + 1, 2 * full_speed // (count - 1))


def sample(
    out: str | Path,
    robot: Khepera,
    settings: SampleSettings,
    place: Place,
    *,
    resume: bool = False,
    seed: int = 0,
    progress: bool = True,
) -> dict[str, Any]:
    """Sample both objects and the motors into a folder.

    Args:
        out: folder with ``sampling.json``, ``sensors.csv``, ``motors.csv`` and, for every object
            and repeat, a ``.sample`` file (``wall.sample``, ``wall-2.sample``, ...).
        robot: connected.
        settings: what to sample.
        place: asks a person to put the robot down: at an object facing it and touching it.
        resume: go on where an earlier call was interrupted, with the same settings.
        seed: of the choice of settings held out.
        progress: whether to show progress on stderr.

    Returns:
        ``samples`` (files), ``wheel_base`` (m, measured), ``motor_settings``, and, with a grid,
        ``interpolation``: median and largest error at the held-out settings, in m/s (``forward``)
        and rad/s (``turn``).

    Raises:
        UserError: if something stands at ``out``, or on resuming other settings do.
        RobotError: if the robot is lost or stuck; what was sampled is kept.
    """
    out = Path(out)
    levels = settings.levels(robot.full_speed)
    _begin(out, settings, seed, robot, resume)
    total = settings.repeats * settings.distances * len(OBJECTS)
    bar = Progress("sample", total, "turns") if progress else None
    try:
        for name in OBJECTS:
            for repeat in range(1, settings.repeats + 1):
                _sample_object(out, robot, settings, name, repeat, place, bar)
    finally:
        robot.stop()
        if bar is not None:
            bar.close()
    turns = read_turns(out)
    pulses = full_turn(turns)
    wheel_base = pulses / robot.pulses_per_metre / math.pi
    made = [
        _write_samples(out, settings, turns, pulses, name, repeat)
        for name in OBJECTS
        for repeat in range(1, settings.repeats + 1)
    ]
    try:
        _sample_motors(out, robot, settings, levels, wheel_base, place, seed)
    finally:
        robot.stop()
    result = {
        "samples": [path.name for path in made],
        "wheel_base": wheel_base,
        "motor_settings": len(levels) ** 2,
    }
    cost = interpolation_cost(out)
    if cost is not None:
        result["interpolation"] = cost
    content = files.read_json(out / "sampling.json", FORMAT, VERSION)
    described = {key: content[key] for key in ("settings", "seed", "robot")}
    files.write_json(out / "sampling.json", FORMAT, VERSION, {**described, "result": result})
    return result


def read_turns(folder: str | Path) -> dict[tuple[str, int, int], NDArray[np.float64]]:
    """Read what was sampled: (object, repeat, distance) -> rows [N, 1 + S].

    The first column is how far the robot had turned, in counts of a wheel (half the difference
    of both); the others are activations. Turns that did not come to their end are left out; of a
    turn that was made again the last counts.
    """
    path = Path(folder) / "sensors.csv"
    names = _SENSOR_COLUMNS[8:]
    parsers: dict[str, Any] = {"object": str, "whole": files.flag}
    parsers |= dict.fromkeys(("repeat", "distance", "turn"), files.integer)
    parsers |= dict.fromkeys(("left", "right", *names), files.number)
    table = files.read_csv(path, parsers, drop_torn_line=True)
    turned = (np.array(table["right"]) - np.array(table["left"])) / 2
    rows = np.column_stack([turned, *(table[name] for name in names)])
    number, found = np.array(table["turn"], int), {}
    for turn in np.unique(number):
        places = np.flatnonzero(number == turn)
        last = places[-1]
        if table["whole"][last]:
            key = (table["object"][last], table["repeat"][last], table["distance"][last])
            found[key] = rows[places]
    return found


def full_turn(turns: dict[tuple[str, int, int], NDArray[np.float64]]) -> float:
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
    turned, readings = rows[:, 0], rows[:, 1:]
    nominal = turned[-1] / TURNS
    periods = nominal * np.linspace(0.9, 1.1, 401)
    errors = []
    for period in periods:
        late = turned >= period
        again = np.stack([np.interp(turned[late] - period, turned, r) for r in readings.T], axis=1)
        errors.append(((readings[late] - again) ** 2).mean())
    return float(periods[int(np.argmin(errors))])


def interpolation_cost(folder: str | Path) -> dict[str, Any] | None:
    """Return what a grid's interpolation misses at the settings held out; None without any.

    Median and largest absolute error of the speed forward (m/s) and of the turn (rad/s).
    """
    motors = MotorTable.read_csv(Path(folder) / "motors.csv")
    path = Path(folder) / "held_out.csv"
    if not path.exists():
        return None
    columns = dict.fromkeys(_MOTOR_COLUMNS[:6], files.number)
    table = files.read_csv(path, columns, drop_torn_line=True)
    if not table["left"]:
        return None
    moved = np.column_stack([table[name] for name in ("dx", "dy", "dtheta")])
    twist = se2.log(moved) / np.array(table["duration"])[:, None]
    errors = np.abs(twist - _interpolated(motors, table["left"], table["right"]))
    return {
        "settings": len(errors),
        **{
            name: {"median": float(np.median(errors[:, column])), "max": float(column_max)}
            for name, column, column_max in (
                ("forward", 0, errors[:, 0].max()),
                ("turn", 2, errors[:, 2].max()),
            )
        },
    }


def _interpolated(motors: MotorTable, left: Any, right: Any) -> NDArray[np.float64]:
    """Return twists [N, 3] between a table's settings, bilinear, as the simulator has them."""
    levels, place = motors.levels, []
    for speed in (left, right):
        at = (np.asarray(speed, float) - levels[0]) / (levels[1] - levels[0])
        below = np.clip(at.astype(int), 0, len(levels) - 2)
        place.append((below, (at - below)[:, None]))
    (i, u), (j, v) = place
    t = motors.twist
    low, high = ((1 - v) * t[k, j] + v * t[k, j + 1] for k in (i, i + 1))
    return (1 - u) * low + u * high


def _begin(out: Path, settings: SampleSettings, seed: int, robot: Khepera, resume: bool) -> None:
    path = out / "sampling.json"
    if not resume:
        files.check_new_folder(out)
        about = {"settings": asdict(settings), "seed": seed, "robot": robot.describe()}
        files.write_json(path, FORMAT, VERSION, about)
        return
    found = files.read_json(path, FORMAT, VERSION, {"settings": dict, "seed": int, "robot": dict})
    if found["settings"] != asdict(settings) or found["seed"] != seed:
        raise FileError(
            path, "was begun with other settings; give the same to go on", field="settings"
        )


def _sample_object(
    out: Path,
    robot: Khepera,
    settings: SampleSettings,
    name: str,
    repeat: int,
    place: Place,
    bar: Progress | None,
) -> None:
    path = out / "sensors.csv"
    done = read_turns(out) if path.exists() else {}
    left_to_do = [d for d in range(settings.distances) if (name, repeat, d) not in done]
    if bar is not None:
        bar.advance(settings.distances - len(left_to_do))
    if not left_to_do:
        return
    place(name)
    robot.set_counts(0, 0)
    last = 0
    if path.exists():
        numbers = files.read_csv(path, {"turn": files.integer}, drop_torn_line=True)["turn"]
        last = max(numbers, default=0)
    with files.LineLog(path, _SENSOR_COLUMNS) as log:
        for turn, distance in enumerate(left_to_do, last + 1):
            away = settings.first + distance * settings.step
            _until(robot, -1, -1, partial(_ahead_of, -away * robot.pulses_per_metre))
            _turn(robot, log, (name, repeat, distance, turn))
            _until(robot, 1, -1, _turned)
            if bar is not None:
                bar.advance(note=f"{name}, {1000 * away:g} mm")


def _turned(counts: tuple[int, int]) -> float:
    """Return how far the robot has turned to the left, in counts of a wheel."""
    return (counts[1] - counts[0]) / 2


def _ahead_of(place: float, counts: tuple[int, int]) -> float:
    return (counts[0] + counts[1]) / 2 - place


def _turn(robot: Khepera, log: files.LineLog, what: tuple) -> None:
    """Turn to the left by more than a full turn and write down what the sensors say."""
    way = TURNS * math.pi * robot.geometry.wheel_base * robot.pulses_per_metre
    pace = _pace(robot, SLOW)
    counts = robot.read_counts()
    watch, whole = _Stuck(robot, counts), False
    robot.set_speeds(-pace, pace)
    while not whole:
        readings, before = robot.activations(), counts
        counts = robot.read_counts()
        whole = _turned(counts) >= way
        # The sensors were read between the two.
        between = ((a + b) / 2 for a, b in zip(before, counts, strict=True))
        log.append(*what, whole, robot.clock.now(), *between, *readings)
        watch.check(counts)
    robot.stop()


def _until(
    robot: Khepera, left: int, right: int, to_go: Callable[[tuple[int, int]], float]
) -> None:
    """Drive until nothing is to go (in counts of a wheel), slowly at last, and stop."""
    counts = robot.read_counts()
    watch, pace = _Stuck(robot, counts), 0
    while (rest := to_go(counts)) > 0:
        wanted = _pace(robot, FAST if rest > BRAKE * robot.pulses_per_metre else SLOW)
        if wanted != pace:
            pace = wanted
            robot.set_speeds(left * pace, right * pace)
        counts = robot.read_counts()
        watch.check(counts)
    robot.stop()


def _pace(robot: Khepera, speed: float) -> int:
    """Return the whole speed of the robot's that is nearest to ``speed`` (m/s), 1 or more."""
    return max(round(speed / robot.speed_unit), 1)


class _Stuck:
    """Notices that wheels do not turn."""

    def __init__(self, robot: Khepera, counts: tuple[int, int]):
        self._robot, self._counts, self._since = robot, counts, robot.clock.now()

    def check(self, counts: tuple[int, int]) -> None:
        now = self._robot.clock.now()
        if counts != self._counts:
            self._counts, self._since = counts, now
        elif now - self._since > STUCK:
            self._robot.stop()
            raise RobotError(
                "the robot's wheels do not turn: is it held, or its battery empty? Put it right "
                "and go on with --resume"
            )


def _write_samples(
    out: Path,
    settings: SampleSettings,
    turns: dict[tuple[str, int, int], NDArray[np.float64]],
    pulses: float,
    name: str,
    repeat: int,
) -> Path:
    """Write an object's samples at even angles, interpolated between readings."""
    at = pulses * np.arange(settings.angles) / settings.angles
    found = np.stack(
        [
            np.stack([np.interp(at, rows[:, 0], column) for column in rows[:, 1:].T], axis=1)
            for rows in (turns[name, repeat, distance] for distance in range(settings.distances))
        ]
    )
    path = out / (f"{name}.sample" if repeat == 1 else f"{name}-{repeat}.sample")
    if not path.exists():
        Samples(found, settings.first, settings.step).write(path)
    return path


def _sample_motors(
    out: Path,
    robot: Khepera,
    settings: SampleSettings,
    levels: NDArray[np.int64],
    wheel_base: float,
    place: Place,
    seed: int,
) -> None:
    full = robot.full_speed
    pairs = [(int(a), int(b)) for a in levels for b in levels]
    others = [
        (a, b)
        for a in range(-full, full + 1)
        for b in range(-full, full + 1)
        if a not in levels or b not in levels
    ]
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(others))[: settings.held_out]
    asked = False
    for path, wanted, repeats in (
        (out / "motors.csv", pairs, settings.repeats),
        (out / "held_out.csv", [others[k] for k in chosen], 1),
    ):
        if not wanted:
            continue
        with files.LineLog(path, _MOTOR_COLUMNS) as log:
            columns = {"left": files.number, "right": files.number, "repeat": files.integer}
            done = set(zip(*files.read_csv(path, columns).values(), strict=True))
            for repeat in range(1, repeats + 1):
                for left, right in wanted:
                    speeds = 100.0 * left / full, 100.0 * right / full
                    if (*speeds, repeat) in done:
                        continue
                    if not asked:
                        place("open")
                        asked = True
                    moved = _drive(robot, left, right, settings.duration, wheel_base)
                    log.append(*speeds, *moved, repeat)


def _drive(
    robot: Khepera, left: int, right: int, duration: float, wheel_base: float
) -> tuple[float, ...]:
    """Drive at a setting and back; return the time (s) and the displacement (m, m, rad)."""
    clock = robot.clock
    robot.set_speeds(left, right)
    begin = clock.now()
    clock.sleep_until(begin + SETTLE)
    before, first = robot.read_counts(), clock.now()
    clock.sleep_until(first + duration)
    after, last = robot.read_counts(), clock.now()
    robot.set_speeds(-left, -right)
    clock.sleep_until(2 * clock.now() - begin)
    robot.stop()
    clock.sleep_until(clock.now() + SETTLE)
    ways = [(b - a) / robot.pulses_per_metre for a, b in zip(before, after, strict=True)]
    twist = [sum(ways) / 2, 0.0, (ways[1] - ways[0]) / wheel_base]
    return (last - first, *map(float, se2.exp(twist)))
