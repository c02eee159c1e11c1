"""Readings of sensors, with the robot's pose and motion at their times.

During a recording, the robot's sensors may be read continuously (``observations.csv``).
``readings.csv`` in the folder of a dataset has those during which the camera saw the robot, with
the columns ``recording, time, x, y, theta, vx, vy, omega`` and one for each sensor:

- ``time``: beginning of the scan, s on the clock of the recording's robot; never decreasing within
  a session;
- ``x, y`` (m), ``theta`` (rad): the robot's pose then, in the board's frame;
- ``vx, vy`` (m/s), ``omega`` (rad/s): its motion, in the board's frame. Each sensor is read at
another time after the scan began; these give the pose at that time.

Many robots measure more slowly than they answer: readings that were only read again are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neurosim.base import files
from neurosim.base.errors import FileError, UserError
from tracking.datasets.recordings import Recording

PLACE = ("x", "y", "theta", "vx", "vy", "omega")
COLUMNS = ("recording", "time", *PLACE)

#: Largest time between two frames for a pose between them, s; number of frames before and after for
#: the motion.
GAP, AROUND = 0.1, 2
#: A reading that equals the one less than ``AGAIN`` seconds before may be the same measurement. One
#: in ``EVERY`` seconds is kept.
AGAIN, EVERY = 0.02, 0.1

_DIGITS = 6


def sensors_of(readings: pd.DataFrame) -> tuple[str, ...]:
    """Return the names of the sensors in a table's columns."""
    return tuple(readings.columns[len(COLUMNS) :])


def no_readings() -> pd.DataFrame:
    """Return a table without readings."""
    return pd.DataFrame({name: [] for name in COLUMNS})


def readings_of(recording: Recording, name: str, *, doubtful: bool = False) -> pd.DataFrame:
    """Return the readings of a recording during which the robot was seen.

    Args:
        recording: tracked.
        name: of it, in the table.
        doubtful: whether doubtful poses count, too.
    """
    observed = recording.observations()
    if observed is None or not observed.names:
        return no_readings()
    poses = recording.poses()
    parts = []
    for session in np.unique(observed.session):
        track = poses.of_session(session)
        track = track if doubtful else track.certain()
        seen = np.isfinite(track.pose).all(axis=1)
        looks = observed.of_session(session)
        known, where = _motion_at(track.time[seen], track.pose[seen], looks.time)
        known &= _measured(looks.time, looks.readings) & np.isfinite(looks.readings).all(axis=1)
        rows = pd.DataFrame(where[known].round(_DIGITS), columns=list(PLACE))
        rows.insert(0, "time", looks.time[known])
        rows.insert(0, "recording", name)
        for place, sensor in enumerate(observed.names):
            rows[sensor] = looks.readings[known, place].round(_DIGITS)
        parts.append(rows)
    return pd.concat(parts, ignore_index=True) if parts else no_readings()


def _measured(times: NDArray, readings: NDArray) -> NDArray[np.bool_]:
    """Return whether readings [N, S] at times [N] s are new, [N]; see :data:`AGAIN`."""
    same = (readings[1:] == readings[:-1]).all(axis=1) & (np.diff(times) < AGAIN)
    periods = np.diff(np.floor(times / EVERY))
    return np.append(True, ~same | (periods > 0))[: len(times)]


def _motion_at(
    times: NDArray, poses: NDArray, at: NDArray
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return whether a track has the pose at instants [N], and pose and motion [N, 6].

    Args:
        times: [M] of the frames that saw the robot, increasing, s.
        poses: [M, 3].
        at: [N] s.
    """
    where = np.zeros((len(at), 6))
    if len(times) < 2:
        return np.zeros(len(at), bool), where
    after = np.searchsorted(times, at)
    known = (after > 0) & (after < len(times))
    after = after.clip(1, len(times) - 1)
    begin, end = times[after - 1], times[after]
    known &= end - begin <= GAP
    fraction = ((at - begin) / (end - begin))[:, None]
    where[:, :3] = poses[after - 1] + fraction * (poses[after] - poses[after - 1])
    first = (after - AROUND).clip(0)
    last = (after + AROUND - 1).clip(max=len(times) - 1)
    known &= times[last] - times[first] <= 2 * AROUND * GAP
    where[:, 3:] = (poses[last] - poses[first]) / (times[last] - times[first])[:, None]
    return known, where


def joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the readings of several recordings; those without any add nothing.

    Raises:
        UserError: if they are of different sensors.
    """
    tables = [table for table in tables if len(table)]
    if not tables:
        return no_readings()
    first = sensors_of(tables[0])
    for table in tables:
        if sensors_of(table) != first:
            raise UserError(
                f"the recordings are of different sensors ({', '.join(first)}; "
                f"{', '.join(sensors_of(table))}): make a dataset of each"
            )
    return pd.concat(tables, ignore_index=True)


def write(path: Path, readings: pd.DataFrame) -> None:
    """Write readings.csv."""
    files.write_csv(path, {name: readings[name].tolist() for name in readings.columns})


def read(path: Path, expected: Any) -> pd.DataFrame:
    """Read and check readings.csv; without the file and a count of its readings there are none.

    Args:
        path: of readings.csv.
        expected: number of readings by dataset.json, None if it has none.

    Raises:
        FileError: naming the wrong line and field, or if readings are missing.
    """
    if not path.exists() and not expected:
        return no_readings()
    names = files.read_header(path)
    sensors = names[len(COLUMNS) :]
    if names[: len(COLUMNS)] != COLUMNS or not all(sensors) or not sensors:
        raise FileError(path, f"expected the columns {', '.join(COLUMNS)} and sensors", line=1)
    columns = {"recording": str} | dict.fromkeys(names[1:], files.number)
    readings = files.read_csv(path, columns, rows=expected)
    for name in sensors:
        wrong = ~readings[name].between(0, 1)
        files.refuse_lines(path, readings, wrong, "expected a reading from 0 to 1", name)
    return readings.reset_index(drop=True)
