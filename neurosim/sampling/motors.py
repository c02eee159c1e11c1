"""A robot drives its motor settings; its counters, or a camera, measure the motion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files, se2
from neurosim.sampling.settings import Sampler, SampleSettings
from neurosim.simulators.tables.motor_table import MotorTable

#: Seconds in which motors reach their speed before a motor sample, and stop after it.
SETTLE = 0.3

#: Waits some seconds; returns their exact number and the displacement [3] in them.
Measure = Callable[[float], tuple[float, NDArray[np.float64]]]

_COLUMNS = ("left", "right", "duration", "dx", "dy", "dtheta", "repeat")


def sample_motors(
    out: Path,
    robot: Sampler,
    settings: SampleSettings,
    levels: NDArray[np.int64],
    measure: Measure,
    in_the_open: Callable[[], None],
    seed: int,
) -> None:
    """Drive every setting that was not driven yet, there and back.

    Args:
        out: folder.
        robot: connected.
        settings: of the sampling.
        levels: speeds of a wheel.
        measure: measures motion: :class:`Counters` or an :class:`~neurosim.sampling.eye.Eye`.
        in_the_open: asks for the robot to be placed on open floor.
        seed: of the choice of settings held out.
    """
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
    for path, wanted, repeats in (
        (out / "motors.csv", pairs, settings.repeats),
        (out / "held_out.csv", [others[k] for k in chosen], 1),
    ):
        if not wanted:
            continue
        with files.LineLog(path, _COLUMNS) as log:
            columns = {"left": files.number, "right": files.number, "repeat": files.integer}
            done = set(files.read_csv(path, columns).itertuples(index=False, name=None))
            for repeat in range(1, repeats + 1):
                for left, right in wanted:
                    speeds = 100.0 * left / full, 100.0 * right / full
                    if (*speeds, repeat) in done:
                        continue
                    in_the_open()
                    time, moved = _drive(robot, left, right, settings.duration, measure)
                    log.append(*speeds, time, *map(float, moved), repeat)


class Counters:
    """Measures steady motions by the robot's counters.

    Args:
        robot: connected.
        wheel_base: m.
        sizes: sizes of the left and the right wheel over their mean.
    """

    def __init__(self, robot: Sampler, wheel_base: float, sizes: tuple[float, float] = (1.0, 1.0)):
        self._robot, self._wheel_base, self._sizes = robot, wheel_base, sizes

    def measure(self, duration: float) -> tuple[float, NDArray[np.float64]]:
        """Wait ``duration`` s; return the exact time and the displacement [3] in it."""
        robot, clock = self._robot, self._robot.clock
        before, first = robot.read_counts(), clock.now()
        clock.sleep_until(first + duration)
        after, last = robot.read_counts(), clock.now()
        distances = [
            size * (b - a) / robot.pulses_per_metre
            for size, a, b in zip(self._sizes, before, after, strict=True)
        ]
        return last - first, se2.exp(se2.of_wheels(*distances, self._wheel_base))


def _drive(
    robot: Sampler, left: int, right: int, duration: float, measure: Measure
) -> tuple[float, NDArray[np.float64]]:
    """Drive at a setting and back; return the time (s) and the displacement (m, m, rad)."""
    clock = robot.clock
    robot.set_speeds(left, right)
    begin = clock.now()
    clock.sleep_until(begin + SETTLE)
    measured = measure(duration)
    robot.set_speeds(-left, -right)
    clock.sleep_until(2 * clock.now() - begin)
    robot.stop()
    clock.sleep_until(clock.now() + SETTLE)
    return measured


def interpolation_cost(folder: str | Path) -> dict[str, Any] | None:
    """Return the error of a grid's interpolation at the held-out settings; None without any.

    Median and largest absolute error of the speed forward (m/s) and of the turn (rad/s).
    """
    motors = MotorTable.read_csv(Path(folder) / "motors.csv")
    path = Path(folder) / "held_out.csv"
    if not path.exists():
        return None
    columns = dict.fromkeys(_COLUMNS[:6], files.number)
    table = files.read_csv(path, columns, drop_torn_line=True)
    if table.empty:
        return None
    moved = table[["dx", "dy", "dtheta"]].to_numpy()
    twist = se2.log(moved) / table[["duration"]].to_numpy()
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
    """Return twists [N, 3] between a table's settings, bilinear, like the simulator."""
    levels, place = motors.levels, []
    for speed in (left, right):
        at = (np.asarray(speed, float) - levels[0]) / (levels[1] - levels[0])
        below = np.clip(at.astype(int), 0, len(levels) - 2)
        place.append((below, (at - below)[:, None]))
    (i, u), (j, v) = place
    t = motors.twist
    low, high = ((1 - v) * t[k, j] + v * t[k, j + 1] for k in (i, i + 1))
    return (1 - u) * low + u * high
