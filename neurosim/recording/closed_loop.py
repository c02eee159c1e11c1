"""A session in closed loop: a controller gives every command.

A command is due at the end of the previous one, at a steady rate if all are equally long. Shortly
before, the robot is observed. Its sensors are read last, so that the controller's inputs are hardly
older than the duration of a reading. The last few observations tell this duration; the first ones
are made while the robot stands.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurosim.base.perimeter import UNSEEN, Perimeter
from neurosim.base.progress import Progress
from neurosim.recording.commands import Observation, SeeingSource
from neurosim.recording.session import BATTERY_EVERY, BEGIN_AGAIN, LINES, Session
from neurosim.robots.base import (
    Counters,
    Robot,
    Sensors,
    SeparateSensors,
    read_sensors,
    sensors_read_with,
)
from neurosim.robots.odometry import Odometry
from tracking.datasets.recordings import Recording

#: Number of observations that give their duration; the longest, possibly an accident, is left out.
LOOKS = 5
#: Longest time of the observations before the first command, s; there are fewer (at least two) if
#: they take longer, because long ones differ little.
TIMED = 0.5
#: Factor of the time for an observation over its duration.
MARGIN = 1.1
#: A robot that was seen less than this time ago, s, farther than this from the line, m, does not
#: reach it within two short commands.
JUST, SOON = 0.15, 0.1
#: A command that is later than this fraction of its duration has missed its deadline.
LATE = 0.1
#: Late commands are shortened by this time at most, s, and by this fraction of their duration; but
#: long ones by :data:`LATE` of theirs.
SHORTENED, AT_MOST = 0.05, 0.5


@dataclass
class Deadlines:
    """Late commands of a controller.

    Attributes:
        steps: commands that were sent.
        missed: commands that were late by more than a tenth of their duration.
        worst_late_s: greatest delay, s.
    """

    steps: int = 0
    missed: int = 0
    worst_late_s: float = 0.0

    def sent(self, due: float, at: float, duration: float) -> float:
        """Count a command; return when the next one is due, s.

        A command that is a little late is shortened, so that a trial takes as long as in a
        simulator; one that is later (see :data:`SHORTENED`) keeps its duration.

        Args:
            due: time when it was due, s.
            at: time when it was sent, s.
            duration: of the command, s.
        """
        late = at - due
        self.steps += 1
        self.missed += late > LATE * duration
        self.worst_late_s = round(max(self.worst_late_s, late), 6)
        slight = late <= max(LATE * duration, min(SHORTENED, AT_MOST * duration))
        return (due if slight else at) + duration


def missing(source: SeeingSource, robot: Robot, *, sees: bool) -> list[str]:
    """Return the inputs of a controller that a robot lacks, a sentence for each.

    Args:
        source: the controller.
        robot: connected or not.
        sees: whether a camera tracks the robot while it drives.
    """
    kind = robot.describe().get("kind", "robot")
    names = sensors_read_with(robot)
    lacking = [name for name in source.sensors if name not in names]
    gaps = []
    if lacking:
        there = f"it reads {', '.join(names)}" if names else "it has no sensors"
        gaps.append(
            f"the controller needs {', '.join(lacking)}, which this robot ({kind}) has not: {there}"
        )
    if source.needs_pose and not sees and not isinstance(robot, Counters):
        gaps.append(
            f"the controller needs the robot's pose, and nothing says it: this robot ({kind}) does "
            "not count how far its wheels turn, and no camera with a calibration that has points "
            "on the board tracks it while it drives"
        )
    return gaps


class ClosedLoopSession(Session):
    """One session in which a controller gives every command; see :class:`Session`.

    It ends at a line, at the edge of the board and when the robot is lost, unless the guard ignores
    the perimeter. A controller that needs the pose never drives without one.

    Attributes:
        deadlines: late commands so far.
    """

    go_on = BEGIN_AGAIN

    def __init__(
        self,
        recording: Recording,
        session: int,
        robot: Robot,
        source: SeeingSource,
        *others: Any,
    ):
        super().__init__(recording, session, robot, source, *others)
        self.deadlines = Deadlines()
        self._seeing = source
        self._must_agree = self._must_agree or (source.needs_pose and self._takes.moves_as_known)
        self._odometry: Odometry | None = None
        self._took: deque[float] = deque(maxlen=LOOKS)
        self._turns = 0
        wanted = set(source.sensors)
        if source.reads and not wanted and isinstance(robot, Sensors):
            wanted.update(robot.sensor_names)
        # Those of the guard are read, too: all at every step, or in turn, see _to_read().
        self._in_turn = not wanted and isinstance(robot, SeparateSensors)
        if self._guard.at_line != "ignore" and self._guard.by == "both":
            wanted.update(LINES)
        self._names = sensors_read_with(robot, wanted)
        self._around = Perimeter.of_recording(recording.meta)

    def run(self) -> bool:
        """Drive between two flashes; return whether no command is left."""
        if self._spotter is None and isinstance(self._robot, Counters):
            self._odometry = Odometry(self._robot, self._seeing.start)
        with self._recording.observation_log(self._names) as log:
            self._seen_log = log
            return self._run()

    def _drive(self) -> bool:
        """Get and send all commands; a stopped drive counts as finished."""
        source = self._seeing
        self._check_battery()
        self._time_looks()
        asked = self._clock.now()
        begin = due = asked + 2 * self._lead
        with Progress("driving", source.steps, "steps") as progress:
            for number in range(source.steps):
                self._sleep_until(due - self._lead)
                looked = self._clock.now()
                time, seen = self._observe(due, due - begin)
                if not self._may_go_on(seen):
                    return self._cut()
                self._keep(time, seen, number)
                command = source.react(seen)
                self._took.append(self._clock.now() - looked)
                if command is None:
                    break
                self._clock.sleep_until(due)
                self._write("command", command.numbers, command.duration, number)
                due = self.deadlines.sent(due, self._sent, command.duration)
                progress.advance()
                if self._clock.now() - asked > BATTERY_EVERY:
                    asked = self._clock.now()
                    self._check_battery()
                if not self._hold(command, due - self._lead, self._lead):
                    return self._cut()
        self._look(due)
        self._sleep_until(due)
        return True

    @property
    def _lead(self) -> float:
        """Time between an observation and its command, s."""
        return MARGIN * sorted(self._took)[-2]

    def _time_looks(self) -> None:
        """Observe and compute commands while the robot stands, to measure their duration."""
        while len(self._took) < 2 or (len(self._took) < LOOKS and sum(self._took) < TIMED):
            looked = self._clock.now()
            _, seen = self._observe(looked, 0.0)
            if seen.pose is not None or not self._seeing.needs_pose:
                self._seeing.react(seen)
            self._took.append(self._clock.now() - looked)
        self._seeing.begin()

    def _observe(self, due: float, since: float) -> tuple[float, Observation]:
        """Look at the robot.

        Args:
            due: time of the next command, to which a tracked pose is predicted.
            since: the same since the first command was due, s.

        Returns:
            Time of the pose (or of the readings, if there is no pose) by the robot's clock, and the
            observation.
        """
        time, pose, sight = self._clock.now(), None, None
        if self._odometry is not None:
            pose = self._odometry.read()
        elif (tracked := self._pose(due)) is not None:
            time, pose = due, tracked
            assert self._spotter is not None
            last = self._spotter.last
            sight = None if last is None else (last[1], due - last[0])
        readings = read_sensors(self._robot, self._to_read())
        return time, Observation(since, pose, readings, sight)

    def _to_read(self) -> tuple[str, ...]:
        """Return the names of the sensors to read now.

        Where only the guard needs them, each takes a round trip, and the camera has just seen the
        robot far from the line, they are read in turn, one at a time: all of them would make the
        next command late.
        """
        last = None if self._spotter is None else self._spotter.last
        if not self._in_turn or not self._names or last is None:
            return self._names
        if self._clock.now() - last[0] > JUST or self._around.near_line(last[1], SOON):
            return self._names
        self._turns += 1
        return (self._names[self._turns % len(self._names)],)

    def _keep(self, time: float, seen: Observation, number: int | None = None) -> None:
        """Write down the observation, and its command, if any."""
        pose = (None,) * 3 if seen.pose is None else np.round(seen.pose, 6)
        readings = (seen.readings.get(name) for name in self._names)
        self._seen_log.append(self._session, number, round(time, 6), *pose, *readings)

    def _look(self, due: float) -> None:
        """Observe and write down the pose, at the end of the last command or later."""
        self._keep(*self._observe(due, math.nan))

    def _stopped(self) -> None:
        """Observe the robot until it is at rest."""
        self._sleep_until(self._sent + self._seeing.rest)
        self._look(self._clock.now())

    def _may_go_on(self, seen: Observation) -> bool:
        self._check_camera()
        if self._seeing.needs_pose and seen.pose is None:
            self._note_stop(UNSEEN)
            return False
        return self._guard.at_line == "ignore" or not self._must_stop(seen.readings)

    def _cut(self) -> bool:
        """Stop at once and observe the pose; return True, because the drive is over."""
        if self.deadlines.steps:
            self._write("cut", self._rest, number=self.deadlines.steps - 1)
        self._end_early()
        self._look(self._clock.now())
        return True

    def _is_lost(self) -> bool:
        """Return whether the pose is unknown, although it is needed."""
        if self._seeing.needs_pose and self._spotter is not None:
            return self._spotter.unseen(self._clock.now()) > self._guard.unseen
        return super()._is_lost()
