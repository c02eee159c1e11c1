"""One session of a recording: sends commands to the robot, and keeps it on the board.

Here the commands are a list; in :mod:`.closed_loop` a controller gives them one by one, and in
:mod:`.hand_session` a person does.

Section 5.1 and 6.1 of Pretorius, du Plessis and Cilliers (2009): random commands without pauses
between them, a perimeter line that the light sensors guard, and a lamp whose flashes align the
video's clock.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.base.files import LineLog
from neurosim.base.perimeter import EDGE, LINE, UNSEEN
from neurosim.base.progress import Progress
from neurosim.recording.agreement import SLOWEST_GUARDED, Agreement, Pictures
from neurosim.recording.by_hand import Hand
from neurosim.recording.commands import Command, CommandSource, FixedCommands, SeeingSource
from neurosim.recording.homing import Homing, bearing
from neurosim.recording.perimeter import PositionGuard, Stop
from neurosim.recording.settings import RecordSettings
from neurosim.recording.spotter import Spotter
from neurosim.robots.base import Battery, Lamp, Robot, Sensors, drive_for
from tracking.camera.cameras import STALLED, Camera
from tracking.datasets.recordings import CommandLine, Recording, ended_sessions

#: Seconds that the lamp is on, off, on: two flashes of different length, unlike any reflection, and
#: not a whole number of frames, so that each edge has another phase of the shutter.
FLASHES = ((0.608, True), (0.408, False), (0.308, True))
#: Seconds of stillness before and after the flashes.
STILL = 0.5
#: Sensors that see the perimeter line.
LINES = ("line_left", "line_right")
#: Shortest time between two readings of the sensors, and time between two checks of the position
#: without light sensors, s.
READ_EVERY, LOOK_EVERY = 0.01, 1 / 30
#: Time between two checks of the battery, if commands are not in a list, s.
BATTERY_EVERY = 30.0
#: Time in which a lost robot must be put into view again, s.
PATIENCE = 60.0
#: Largest delay of writing a frame into the video, s.
WRITTEN_LATE = 2.0
#: Duration of one arc on the way back of a robot that cannot turn on the spot, s.
ARC = 1.2
#: Distance from the goal at which a return by position ends, m.
NEAR = 0.25
#: A robot that does not come nearer to its goal by this distance, m, in this number of manoeuvres
#: is stuck: in straight pieces, and by arcs, on which it also drives back and forth.
CLOSER, PIECES, ARCS = 0.02, 12, 60


class CameraLost(UserError):
    """The camera delivers no more frames; the recording is readable and can be resumed."""


class SeenToStand(CameraLost):
    """The robot is commanded to move and seen to stand; what was recorded can be resumed."""


class BatteryLow(UserError):
    """The battery fell below its limit; the recording is readable and can be resumed."""


def flash(
    robot: Lamp, wait: Callable[[float], None], note: Callable[[str], float]
) -> list[tuple[float, float]]:
    """Flash a robot's lamp; return the (on, off) times by its clock, s.

    Args:
        robot: with a lamp.
        wait: waits some seconds.
        note: gets lamp-on or lamp-off just before this is done, and returns the time, s.
    """
    times = []
    for seconds, on in (*FLASHES, (0.0, False)):
        times.append(note("lamp-on" if on else "lamp-off"))
        robot.lamp(on)
        wait(seconds)
    return list(zip(times[::2], times[1::2], strict=True))


@dataclass
class _Todo:
    """A command that waits to be sent."""

    index: int
    attempt: int = 1


#: Advice for a user after an interrupted trial.
BEGIN_AGAIN = "at its start and begin again, in a new folder"


class Session:
    """One session: from the flash at its start to the flash at its end.

    Attributes:
        stopped: reason why the guard ended the drive; None: it did not.
    """

    #: Advice for a user after an interrupted session.
    go_on = "in the middle of the board and continue with --resume"

    def __init__(
        self,
        recording: Recording,
        session: int,
        robot: Robot,
        source: CommandSource | SeeingSource | Hand,
        settings: RecordSettings,
        log: LineLog,
        say: Callable[[str], None],
        camera: Camera | None,
        spotter: Spotter | None,
        pictures: Pictures | None = None,
    ):
        self._camera = camera
        self._running: int | None = None
        self._spotter = spotter
        takes = robot.commands.measured(full=settings.full_speed, track=settings.track)
        self._takes = takes
        self._perimeter = PositionGuard(settings.board, settings.guard.margin)
        self.stopped: Stop | None = None
        self._stop: Stop | None = None
        known = takes.moves_as_known
        self._agreement = Agreement(*((takes.fastest, takes.arm) if known else (1.0, 1.0)))
        self._sights = spotter or pictures
        # An unguarded robot may stand at a wall.
        self._must_agree = known and (spotter is None or settings.guard.at_line != "ignore")
        self._session = session
        self._path = recording.path
        self._recording = recording
        self._robot = robot
        self._clock = robot.clock
        self._source = source
        trial = isinstance(source, FixedCommands) and source.how["kind"] == "fixed"
        if trial and settings.guard.at_line != "return":
            self.go_on = BEGIN_AGAIN
        self._settings = settings
        self._guard = settings.guard
        self._log = log
        self._say = say
        self._waiting = _waiting(recording, settings)
        self._numbers = takes.rest()
        self._since = self._clock.now()
        self._homing = Homing()
        self._sent = 0.0
        self._board: dict[str, float] = {}
        self._readings: LineLog | None = None
        # Random turns on the way back inside. The seed differs from the commands' and between
        # sessions, so that a robot that was stuck does not repeat its moves.
        self._rng = np.random.default_rng([session, settings.commands])

    def run(self) -> bool:
        """Drive between two flashes; return whether all commands were sent.

        Raises:
            CameraLost: when the camera delivers no more frames; the robot was stopped.
            BatteryLow: if the battery fell below the limit.
            UserError: if the robot cannot return inside, or is not seen for too long.
        """
        with contextlib.ExitStack() as stack:
            if self._settings.readings and isinstance(self._robot, Sensors):
                log = self._recording.observation_log(self._robot.sensor_names)
                self._readings = stack.enter_context(log)
            return self._run()

    def _run(self) -> bool:
        """Drive; see :meth:`run`."""
        try:
            flash = self._flash()
            if flash and self._spotter is not None:
                self._spotter.time_by_flash(flash)
            self._learn_board()
            if self._board:
                self._agreement.slowest = SLOWEST_GUARDED
            if self._is_lost():
                self._wait_for_sight()
            done = self._drive()
            self._write("stop", self._rest)
            self._stopped()
            self._flash()
            self._write("end")
        except CameraLost:
            kind = "stop" if self._running is None else "cut"
            self._write(kind, self._rest, number=self._running)
            raise
        return done

    def _drive(self) -> bool:
        """Send the waiting commands; return whether all were sent."""
        total = self._settings.commands
        with Progress("recording", total, "commands") as progress:
            progress.advance(total - len(self._waiting))
            since_battery = 0
            while self._waiting:
                self._check_camera()
                if since_battery % 20 == 0:
                    self._check_battery()
                since_battery += 1
                todo = self._waiting.popleft()
                command = self._source.command(todo.index)
                before = self._numbers
                self._write("command", command.numbers, command.duration, todo.index)
                if self._hold(command, self._sent + command.duration):
                    progress.advance()
                    continue
                self._write("cut", self._rest, number=todo.index)
                if self._guard.at_line == "end":
                    self._waiting.clear()
                    self._end_early()
                    break
                self._return_inside()
                if todo.attempt < self._guard.attempts:
                    self._waiting.appendleft(replace(todo, attempt=todo.attempt + 1))
                    self._lead_in(before)
                else:
                    progress.advance()
        return not self._waiting

    def _end_early(self) -> None:
        """Keep and print the reason why the guard ended the drive."""
        self.stopped = self._stop
        self._say(str(self.stopped))

    def _stopped(self) -> None:
        """Do the work between the last command and the flash."""

    # Commands are written down just before they are sent

    def _write(
        self,
        kind: str,
        numbers: tuple[float, ...] | None = None,
        duration: float | None = None,
        number: int | None = None,
    ) -> float:
        """Log a line, and command the robot if there are ``numbers``; return the time, s."""
        now = round(self._clock.now(), 6)
        written = [None] * len(self._numbers) if numbers is None else numbers
        self._log.append(self._session, number, kind, now, *written, duration)
        if numbers is not None:
            if self._takes.moves_as_known:
                twist = self._takes.twist(numbers)
                self._homing.moved(self._takes.twist(self._numbers), now - self._since)
                self._perimeter.sent(now, twist)
                self._agreement.sent(now, twist)
            self._since = now
            if kind in ("cut", "stop"):
                self._robot.stop()
            else:
                self._send(numbers, duration)
            self._numbers = numbers
            self._running = number if kind == "command" else None
        self._sent = now
        return now

    def _send(self, numbers: tuple[float, ...], duration: float | None) -> None:
        """Send a command of some duration (s); None: until the next one."""
        if duration is None:
            self._robot.drive(numbers)
        else:
            drive_for(self._robot, numbers, duration)

    @property
    def _rest(self) -> tuple[float, ...]:
        """The command for rest."""
        return self._takes.rest(self._numbers)

    def _flash(self) -> list[tuple[float, float]]:
        """Stand still, and flash the lamp, if there is one; return when it was on and off, s."""
        self._wait(2 * STILL)
        times = flash(self._robot, self._wait, self._write) if isinstance(self._robot, Lamp) else []
        self._wait(STILL)
        return times

    def _wait(self, seconds: float) -> None:
        self._sleep_until(self._clock.now() + seconds)

    def _sleep_until(self, time: float) -> None:
        """Wait, and check the camera meanwhile.

        Raises:
            CameraLost: if it fails.
        """
        # By rounding, a clock may be just before a time and not sleep any more.
        watched = self._camera is not None and self._camera.looked_after
        while watched and (now := self._clock.now()) < time - 1e-3:
            self._check_camera()
            self._clock.sleep_until(min(time, now + LOOK_EVERY))
        self._clock.sleep_until(time)

    def _check_camera(self) -> None:
        """Raise CameraLost when the camera delivers no more frames, or always the same one.

        A robot that is held, or whose wheels do not turn, looks like the latter.
        """
        camera = self._camera
        stalled = camera is not None and camera.stalled
        if stalled or (camera is not None and camera.failed):
            what = f"delivered no frame for {STALLED:g} s or more" if stalled else "stopped"
            raise CameraLost(
                f"the camera {what}, and the robot was stopped; {self._path} keeps what was "
                f"filmed: check the camera, put the robot {self.go_on}"
            )
        last = None if self._sights is None else self._sights.last
        if last is None or not self._must_agree:
            return
        if self._agreement.seen(*last) and self._agreement.broken():
            raise SeenToStand(
                "the robot was commanded to move and is seen to stand, so it was stopped: the "
                "camera shows old pictures, or the robot is held or switched off; "
                f"{self._path} keeps what was filmed: put the robot {self.go_on}"
            )

    def _hold(self, command: Command, end: float, took: float = 0.0) -> bool:
        """Let a command run until ``end`` (s); return False when the robot must stop.

        Args:
            command: the last sent command.
            end: the robot's time.
            took: duration of an observation, s, if known: the last one must not make the next
                command late.
        """
        moving = not self._takes.stands(command.numbers)
        guarded = self._guard.at_line != "ignore" and bool(self._board or self._spotter)
        if moving and (guarded or self._readings is not None):
            while (now := self._clock.now()) + 1.5 * took < end:
                self._check_camera()
                readings = self._lines()
                if guarded and self._must_stop(readings):
                    return False
                again = now + (READ_EVERY if readings else LOOK_EVERY)
                self._clock.sleep_until(min(again, end))
                took = max(took, self._clock.now() - now)
        self._sleep_until(end)
        return True

    # The perimeter

    def _must_stop(self, readings: Mapping[str, float]) -> bool:
        """Return whether the robot is on a line, leaves the board, or is lost; note the reason.

        Args:
            readings: of the sensors, by name; those that see no line are ignored.
        """
        sensor = self._on_line(readings)
        if sensor is not None:
            code = LINE
        elif self._leaves():
            code = EDGE
        elif self._is_lost():
            code = UNSEEN
        else:
            return False
        self._note_stop(code, sensor)
        return True

    def _note_stop(self, code: int, sensor: str | None = None) -> None:
        """Note why the robot must stop now, and its pose, if known."""
        now = self._clock.now()
        last = None if self._spotter is None else self._spotter.last
        pose, since = None, None
        if last is not None:
            known = last[1] if code == UNSEEN else self._perimeter.predict(last[1], last[0], now)[0]
            pose = tuple(float(value) for value in known)
            since = float(last[0]) if code == UNSEEN else None
        self._stop = Stop(code, now, self._running, now - self._sent, sensor, pose, since)

    def _lines(self) -> dict[str, float]:
        if not self._board and self._readings is None:
            return {}
        assert isinstance(self._robot, Sensors)
        looked = round(self._clock.now(), 6)
        readings = self._robot.read_sensors()
        if self._readings is not None:
            nowhere = (None,) * 3  # the camera gives the position later
            self._readings.append(
                self._session, self._running, looked, *nowhere, *readings.values()
            )
        return readings

    def _learn_board(self) -> None:
        """Read the bare board's brightness with the sensors that see lines."""
        if self._guard.at_line == "ignore" or self._guard.by == "position":
            return
        robot = self._robot
        names = set(LINES) & set(robot.sensor_names if isinstance(robot, Sensors) else ())
        looks = [robot.read_sensors() for _ in range(5)] if names else []
        self._board = {name: float(np.median([look[name] for look in looks])) for name in names}
        if not self._board and self._spotter is None:
            self._say("no light sensors: the perimeter is not guarded, stay with the robot")

    def _on_line(self, readings: Mapping[str, float]) -> str | None:
        """Return the first light sensor that does not see the bare board; None: all see it."""
        for name, bare in self._board.items():
            if name in readings and abs(readings[name] - bare) > self._guard.contrast:
                return name
        return None

    def _leaves(self) -> bool:
        """Return whether the robot, by its position, must stop now to stay on the board."""
        if self._spotter is None or (last := self._spotter.last) is None:
            return False
        since = last[0] - self._spotter.uncertainty
        return self._perimeter.leaves(last[1], since, self._clock.now())

    def _is_lost(self) -> bool:
        """Return whether the robot is lost: it has no light sensors, and is not seen."""
        if self._spotter is None or self._board or self._guard.at_line == "ignore":
            return False
        return self._spotter.unseen(self._clock.now()) > self._guard.unseen

    def _pose(self, at: float | None = None) -> NDArray | None:
        """Return the robot's pose at a near time (s), or now; None if it is not in sight."""
        last = None if self._spotter is None else self._spotter.last
        now = self._clock.now()
        if last is None or now - last[0] > self._guard.unseen:
            return None
        return self._perimeter.predict(last[1], last[0], now if at is None else at)[0]

    def _wait_for_sight(self) -> None:
        """Wait until a robot that cannot drive unseen is seen."""
        self._say("the robot is not seen, and cannot drive unseen: put it on the board, in view")
        end = self._clock.now() + PATIENCE
        while self._is_lost():
            if self._clock.now() > end:
                self._write("stop", self._rest)
                raise UserError(
                    f"the robot was not seen for {PATIENCE:.0f} s; look at neurosim watch, put the "
                    f"robot {self.go_on}"
                )
            self._wait(LOOK_EVERY)

    def _return_inside(self) -> None:
        """Return inside: by position if the robot is seen, else by dead reckoning."""
        if self._is_lost():
            self._wait_for_sight()
        if self._pose() is None:
            self._return_from_line()
        else:
            self._return_to_middle()

    def _return_to_middle(self) -> None:
        """Drive by position to a point with room for a long straight run, and turn at random."""
        goal = self._perimeter.middle(self._guard.retreat, self._rng)
        if not self._takes.turns_on_the_spot:
            self._return_by_arcs(goal)
            return
        for pose, distance in self._approach(goal, PIECES):
            if pose is None:
                self._return_inside()
                return
            if distance < NEAR:
                self._turn(float(self._rng.uniform(-math.pi, math.pi)))
                return
            angle, direction = bearing(pose, goal)
            self._turn(angle)
            straight, speed = self._straight(direction)
            # In pieces, so that errors are noticed.
            self._manoeuvre(straight, min(distance / speed, 1.0), look=False)
            self._manoeuvre(self._rest, 0.3, look=False)
        self._give_up()

    def _return_by_arcs(self, goal: NDArray) -> None:
        """Drive to a position [2] like a car, forward and back, each time by the best of some arcs.

        The best arc ends nearest to the position, and on the board.
        """
        speed = self._guard.speed / 100 * self._takes.fastest
        turns = np.linspace(-1, 1, 5) * speed / self._takes.arm
        arcs = {self._takes.toward(sign * speed, turn) for sign in (1, -1) for turn in turns}
        choices = sorted(arcs)
        twists = self._takes.twist(np.array(choices))
        for pose, distance in self._approach(goal, ARCS):
            if pose is None:
                self._return_inside()
                return
            if distance < NEAR:
                return
            ends = se2.compose(pose, se2.exp(twists * ARC))
            outside = np.maximum([self._perimeter.beyond(end) for end in ends], 0.0)
            costs = np.hypot(*(ends[:, :2] - goal).T) + 10.0 * outside
            self._manoeuvre(choices[int(costs.argmin())], ARC / 2, look=False)
        self._give_up()

    def _approach(self, goal: NDArray, tries: int) -> Iterator[tuple[NDArray | None, float]]:
        """Give the robot's pose, None if it is not seen, and its distance from a goal [2], m.

        They are asked for before each manoeuvre. They end if the robot comes no nearer.
        """
        nearest, left = math.inf, tries
        while left:
            pose = self._pose()
            distance = math.inf if pose is None else math.dist(goal, pose[:2])
            if distance < nearest - CLOSER:
                nearest, left = distance, tries
            left -= 1
            yield pose, distance

    def _return_from_line(self) -> None:
        """Drive from the line over the robot's former positions and beyond, then turn at random.

        A distance of most of the board's width leaves room for a long straight run.
        """
        guard = self._guard
        for _ in range(12):
            angle, direction = self._homing.turn_inside()
            self._turn(angle)
            straight, speed = self._straight(direction)
            seconds = guard.retreat / speed
            # The first stretch moves the sensors off the line.
            self._manoeuvre(straight, 0.3 * seconds, look=False)
            began = self._clock.now()
            arrived = self._manoeuvre(straight, 0.7 * seconds, look=True)
            if not arrived and self._clock.now() - began > 0.2 * seconds:
                # At this distance, this line is on the other side: go half way back.
                self._manoeuvre(self._straight(-direction)[0], 0.3 * seconds, look=False)
                arrived = True
            if arrived:
                self._turn(float(self._rng.uniform(-math.pi, math.pi)))
                return
        self._give_up()

    def _give_up(self) -> NoReturn:
        self._write("stop", self._rest)
        raise UserError(f"the robot cannot return inside the lines; put it {self.go_on}")

    def _straight(self, direction: float) -> tuple[tuple[float, ...], float]:
        """Return the command that drives straight on (1) or back (-1), and its speed, m/s."""
        speed = self._guard.speed / 100 * self._takes.fastest
        command = self._takes.toward(direction * speed, 0.0)
        return command, float(abs(self._takes.twist(command)[0]))

    def _turn(self, angle: float) -> None:
        speed = self._guard.speed / 200 * self._takes.fastest
        command = self._takes.toward(0.0, math.copysign(speed / self._takes.arm, angle))
        rate = float(abs(self._takes.twist(command)[2]))
        if rate > 0 and abs(angle) / rate > 0.05:
            self._manoeuvre(command, abs(angle) / rate, look=False)

    def _manoeuvre(self, numbers: tuple[float, ...], seconds: float, *, look: bool) -> bool:
        command = Command(numbers, seconds)
        self._write("manoeuvre", numbers, round(seconds, 3))
        if not look:
            self._sleep_until(self._sent + seconds)
            return True
        return self._hold(command, self._sent + seconds)

    def _lead_in(self, numbers: tuple[float, ...]) -> None:
        moves = not self._takes.stands(numbers)
        self._manoeuvre(numbers, self._guard.lead_in, look=moves)

    # The battery

    def _check_battery(self) -> None:
        if not isinstance(self._robot, Battery):
            return
        volts, limit = self._robot.battery(), self._settings.battery_limit
        if not volts < limit:
            return
        self._write("stop", self._rest)
        self._write("pause")
        raise BatteryLow(
            f"the battery is at {volts:.2f} V, below the limit of {limit:.2f} V; charge it, put "
            f"the robot {self.go_on}"
        )


def _waiting(recording: Recording, settings: RecordSettings) -> deque[_Todo]:
    """Return the remaining commands: all that no session has completed and filmed."""
    attempts: dict[int, int] = {}
    settled: set[int] = set()
    every = list(recording.commands().itertuples())
    filmed = _filmed_until(recording, every)
    lines = [line for line in every if line.is_motor]
    for line, after in zip_longest(lines, lines[1:]):
        if line.kind != "command":
            continue
        attempts[line.command] = attempts.get(line.command, 0) + 1
        ran = after is not None and after.session == line.session and after.kind != "cut"
        ran = ran and after.time <= filmed[line.session]
        if ran or attempts[line.command] >= settings.guard.attempts:
            settled.add(line.command)
    todo = (
        _Todo(index, attempts.get(index, 0) + 1)
        for index in range(settings.commands)
        if index not in settled
    )
    return deque(todo)


def _filmed_until(recording: Recording, lines: list[CommandLine]) -> dict[int, float]:
    """Return the time of the last filmed frame in each session, s on the robot's clock.

    A kill loses frames that were not yet written into the video, although they are counted. Live
    tracking does not depend on the video.
    """
    until = {line.session: math.inf for line in lines}
    for session in until.keys() - ended_sessions(lines):
        lost = recording.lost_film(session)
        if lost > 0:
            last = max(line.time for line in lines if line.session == session)
            until[session] = last - lost - WRITTEN_LATE
    return until
