"""Recordings whose commands change all the time, by hand or by a network, as logs.

A stretch is a run of commands that follow one another, up to the line that ends the last. The time
after a stop until the next command is left out (the robot may be carried), and so are manoeuvres of
the guard. Commands have their times of sending; training estimates the motors' delay.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tracking.datasets.logs import Log, Settings
from tracking.datasets.recordings import CommandLine, Poses, Recording
from tracking.datasets.sessions import sessions_of

#: Time from a log's beginning to its first command, s, so that the first pose has frames before it.
LEAD = 0.25


def lasting(recording: Recording, shortest: float) -> tuple[int, int]:
    """Return the counts of commands with at least a planned duration (s), and with shorter ones."""
    table = recording.commands()
    planned = table.loc[table["kind"] == "command", "duration"]
    return int((planned >= shortest).sum()), int((planned < shortest).sum())


def logs_of(
    recording: Recording, name: str, settings: Settings, *, doubtful: bool = False
) -> tuple[list[Log], list[str]]:
    """Return the stretches of a tracked recording as logs.

    Args:
        recording: tracked.
        name: of it, for the rows.
        settings: as for any log.
        doubtful: whether doubtful poses count, too.

    Returns:
        Logs, and a sentence for each suspicious finding in their poses.

    Raises:
        FileError: if commands.csv or poses.csv is missing or wrong somewhere.
    """
    lines = [line for line in recording.commands().itertuples() if line.is_motor]
    every = recording.poses()
    every = every if doubtful else every.certain()
    logs: list[Log] = []
    warnings: list[str] = []
    for number, (run, before, since) in enumerate(_runs(lines, recording.takes.rest()), start=1):
        poses = every.of_session(run[0].session)
        more, why = _log_of(run, before, since, poses, f"{name}/{number}", settings)
        logs += more
        warnings += [f"stretch {number}: {sentence}" for sentence in why]
    return logs, warnings


def _runs(
    lines: list[CommandLine], rest: tuple[float, ...]
) -> Iterator[tuple[list[CommandLine], tuple[float, ...], float]]:
    """Give the commands of each stretch with the line that ends it.

    Also give the previous command and its beginning, s. The last command of an interrupted session
    has no end: it ends the stretch.
    """
    run: list[CommandLine] = []
    session, last = None, (rest, -np.inf)
    before, since = last
    for line in [*lines, None]:
        if line is None or line.session != session:
            if len(run) > 1:
                yield run, before, since
            if line is None:
                return
            run, session, last = [], line.session, (rest, -np.inf)
        if line.kind == "command":
            if not run:
                before, since = last
            run.append(line)
        elif run:
            yield [*run, line], before, since
            run = []
        last = (line.numbers, line.time)


def _log_of(
    run: list[CommandLine],
    before: tuple[float, ...],
    since: float,
    poses: Poses,
    name: str,
    settings: Settings,
) -> tuple[list[Log], list[str]]:
    """Return a stretch as a log: a sample at each command, and at each frame in between."""
    sent = np.array([line.time for line in run])
    begin = max(since, sent[0] - LEAD)
    frames = (poses.time >= begin) & (poses.time <= sent[-1])
    time, places = np.unique(np.concatenate([sent, poses.time[frames]]), return_inverse=True)
    where = np.full((len(time), 3), np.nan)
    where[places[len(sent) :]] = poses.pose[frames]
    if not np.isfinite(where).all(axis=1).any():
        return [], []
    numbers = np.array([before, *(line.numbers for line in run)], float)
    logs, warnings = sessions_of(
        name, time, numbers[np.searchsorted(sent, time, side="right")], where, settings
    )
    if logs and logs[0].before is None:
        logs[0] = replace(logs[0], before=numbers[0])
    return logs, warnings
