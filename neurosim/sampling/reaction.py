"""A robot measures its delay from a command to its counters' motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files
from neurosim.base.errors import UserError
from neurosim.sampling.settings import Sampler
from neurosim.simulators.tables.reaction import Reaction

#: Number of starts from rest, forwards and backwards in turn.
STARTS = 20
#: Seconds for which a start is measured, and of rest before it.
FOLLOWED, REST = 0.4, 0.4
#: Fraction of readings that are shorter than the time allowed for one.
IN_TIME = 0.95
_STEP = 0.0005

_COLUMNS = ("start", "whole", "time", "left", "right")


def sample_reaction(out: Path, robot: Sampler, in_the_open: Callable[[], None]) -> None:
    """Start from rest several times, and write down the counters over time.

    ``reaction.csv``: seconds from the command to the request for the counters, and pulses since the
    command, forward. Earlier samples are kept; ``in_the_open`` asks for the robot to be placed on
    open floor.
    """
    path, clock = out / "reaction.csv", robot.clock
    with files.LineLog(path, _COLUMNS) as log:
        parsers = {"start": files.integer, "whole": files.flag}
        table = files.read_csv(path, parsers, drop_torn_line=True)
        done = set(table["start"][table["whole"]])
        for start in range(STARTS):
            if start in done:
                continue
            in_the_open()
            sign = 1 if start % 2 == 0 else -1
            robot.stop()
            clock.sleep_until(clock.now() + REST)
            first, begin = robot.read_counts(), clock.now()
            robot.set_speeds(sign * robot.full_speed, sign * robot.full_speed)
            while (asked := clock.now() - begin) < FOLLOWED:
                counts = robot.read_counts()
                distances = [sign * (b - a) for a, b in zip(first, counts, strict=True)]
                log.append(start, False, asked, *distances)
            log.append(start, True, asked, *distances)
    robot.stop()


def read_reaction(folder: str | Path, seconds: NDArray[np.float64], scan: float) -> Reaction:
    """Return the reaction that fits ``reaction.csv`` best.

    Least squares over both wheels of v (s - lag (1 - exp(-s / lag))), with s the time since a
    delay that both share.

    Args:
        folder: of the sampling.
        seconds: durations of readings of the sensors, [N].
        scan: duration of the robot's reading of all sensors, s.

    Raises:
        UserError: if the wheels did not turn.
    """
    path = Path(folder) / "reaction.csv"
    columns = {"whole": files.flag} | dict.fromkeys(("time", "left", "right"), files.number)
    table = files.read_csv(path, columns, drop_torn_line=True)
    table = table[~table["whole"]]
    time, distances = table["time"].to_numpy(), table[["left", "right"]].to_numpy().T
    if len(time) < 10 or not (distances.max(axis=1) > 0).all():
        raise UserError(f"{path}: the wheels did not turn as they were commanded")
    delays, lags = np.arange(0.0, 0.15, _STEP), np.arange(_STEP, 0.3, 4 * _STEP)
    errors = np.stack(
        [[_errors(time, distance, d, lags) for d in delays] for distance in distances]
    )
    best = int(errors.min(axis=2).sum(axis=0).argmin())
    lag = tuple(float(lags[errors[wheel, best].argmin()]) for wheel in range(2))
    return Reaction(float(np.quantile(seconds, IN_TIME)), float(delays[best]) + scan / 2, lag)


def _errors(
    time: NDArray[np.float64],
    distance: NDArray[np.float64],
    delay: float,
    lags: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the squared errors of a delay with every lag, each with its best speed."""
    s = np.maximum(time - delay, 0.0)[None, :]
    model = s - lags[:, None] * (1.0 - np.exp(-s / lags[:, None]))
    speed = (model @ distance) / np.maximum((model**2).sum(axis=1), math.ulp(1.0))
    return ((distance - speed[:, None] * model) ** 2).sum(axis=1)
