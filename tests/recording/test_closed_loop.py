"""Closed-loop controllers, driven at a steady rate, on robots without physics and in the lab."""

import math

import numpy as np
import pytest

from neurosim.base.commands import TWO_WHEELS
from neurosim.base.errors import UserError
from neurosim.recording.closed_loop import Deadlines
from neurosim.recording.commands import Command
from neurosim.recording.record import BatteryLow, Guard, RecordSettings, Rig, record
from neurosim.robots.base import Geometry
from tracking.datasets.recordings import Recording

FULL_SPEED = 0.5  # m/s


class Clock:
    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def sleep_until(self, time):
        self.time = max(self.time, time)


class Robot:
    """Two wheels 10 cm apart that follow at once; a line stands where x > ``line``."""

    sensor_names = ("line_left", "sensor_0")
    pulses_per_metre, geometry = 10_000.0, Geometry(0.05, 0.1)

    def __init__(self, *, line=math.inf, slow_at=(), slow=0.25, volts=8.0):
        self.clock = Clock()
        self.line, self.slow_at, self.slow, self.volts = line, slow_at, slow, volts
        self.speeds, self.since = (0.0, 0.0), 0.0
        self.distances, self.zero = [0.0, 0.0], (0, 0)
        self.sent, self.looks = [], 0

    def connect(self):
        pass

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def _move(self):
        now = self.clock.now()
        for wheel, speed in enumerate(self.speeds):
            self.distances[wheel] += speed / 100 * FULL_SPEED * (now - self.since)
        self.since = now

    commands = TWO_WHEELS

    def drive(self, command):
        self._move()
        self.speeds = tuple(command)
        self.sent.append((self.clock.now(), *command))

    def stop(self):
        self._move()
        self.speeds = (0.0, 0.0)

    def _pulses(self):
        return [round(distance * self.pulses_per_metre) for distance in self.distances]

    def read_counts(self):
        self.clock.time += 0.01
        self._move()
        return tuple(a - b for a, b in zip(self._pulses(), self.zero, strict=True))

    def set_counts(self, left, right):
        self._move()
        pulses = self._pulses()
        self.zero = (pulses[0] - left, pulses[1] - right)

    def read_sensors(self):
        self.looks += 1
        self.clock.time += self.slow if self.looks in self.slow_at else 0.02
        self._move()
        ahead = sum(self.distances) / 2
        return {"line_left": 0.1 if ahead > self.line else 0.6, "sensor_0": min(ahead, 1.0)}

    def battery(self):
        return self.volts

    def describe(self):
        return {"kind": "two-wheels"}


class Source:
    """Drives straight ahead, slower the more it sees, and keeps its observations."""

    step, rest, start = 0.1, 0.5, (1.0, 2.0, math.pi / 2)
    reads, needs_pose = True, False

    def __init__(self, steps, sensors=("sensor_0",), needs_pose=False):
        self.steps, self.sensors, self.needs_pose = steps, sensors, needs_pose
        self.seen, self.begun = [], 0

    def begin(self):
        self.begun += 1
        self.seen.clear()

    def react(self, seen):
        self.seen.append(seen)
        speed = 50.0 - 40.0 * seen.readings["sensor_0"]
        return Command((speed, speed), self.step)

    def describe(self):
        return {"kind": "test"}


def drive(folder, robot, source, *, at_line="ignore", **options):
    messages, settings = [], RecordSettings(source.steps, Guard(at_line))
    return record(folder, Rig(robot), source, settings, say=messages.append, **options), messages


def test_commands_follow_from_what_is_seen_at_a_steady_rate(tmp_path):
    robot, source = Robot(), Source(20)
    recording, _ = drive(tmp_path / "r", robot, source)
    assert source.begun == 1
    sent = [line for line in recording.commands().itertuples() if line.kind == "command"]
    assert [line.command for line in sent] == list(range(20))
    assert np.diff([line.time for line in sent]) == pytest.approx(0.1)
    assert [line.duration for line in sent] == [0.1] * 20
    seen = recording.observations()
    assert seen.names == robot.sensor_names
    assert seen.command.tolist() == [*range(20), -1, -1]
    assert [line.left for line in sent] == pytest.approx(50 - 40 * seen.readings[:20, 1])
    assert [s.time for s in source.seen] == pytest.approx(0.1 * np.arange(20))
    # Odometry, from the start pose: up along y, by the distance that the wheels turned.
    assert seen.pose[:, 0] == pytest.approx(1.0)
    # The first look came before the robot moved.
    distances = [FULL_SPEED * line.left / 100 * 0.1 for line in sent]
    assert np.diff(seen.pose[1:20, 1]) == pytest.approx(distances[1:-1], abs=1e-3)
    assert seen.pose[:, 2] == pytest.approx(math.pi / 2)
    assert np.array([s.pose for s in source.seen]) == pytest.approx(seen.pose[:20], abs=1e-6)
    assert recording.meta["deadlines"] == {"steps": 20, "missed": 0, "worst_late_s": 0.0}
    assert recording.meta["complete"] is True


def test_the_last_command_is_held_as_long_as_the_others_and_then_comes_rest(tmp_path):
    recording, _ = drive(tmp_path / "r", Robot(), Source(5))
    motor = [line for line in recording.commands().itertuples() if line.is_motor]
    assert [line.kind for line in motor] == [*["command"] * 5, "stop"]
    assert np.diff([line.time for line in motor]) == pytest.approx(0.1)
    seen = recording.observations()
    before, after = seen.time[-2] - motor[-1].time, seen.time[-1] - motor[-1].time
    assert -0.05 < before < 0
    assert after >= 0.5


def test_a_trial_with_late_commands_takes_as_long_as_one_without(tmp_path):
    """The 3rd and the 8th of twelve looks take 0.04 s longer; their commands are shortened."""
    robot = Robot(slow_at=(8, 13), slow=0.06)
    recording, _ = drive(tmp_path / "r", robot, Source(12))
    sent = [line.time for line in recording.commands().itertuples() if line.kind == "command"]
    assert recording.meta["deadlines"]["missed"] == 2
    late = recording.meta["deadlines"]["worst_late_s"]
    assert late == pytest.approx(0.037)
    shortened = [0.1, 0.1 + late, 0.1 - late]
    assert np.diff(sent) == pytest.approx([*shortened, 0.1, 0.1, *shortened, *[0.1] * 3])


@pytest.mark.parametrize(
    ("late", "duration", "due"),
    [
        (0.0, 0.1, 5.1),
        (0.04, 0.1, 5.1),
        (0.06, 0.1, 5.16),  # it lasts whole
        (0.012, 0.02, 5.032),
        (0.1, 1.5, 6.5),
        (0.2, 1.5, 6.7),
    ],
)
def test_when_the_next_command_is_due(late, duration, due):
    assert Deadlines().sent(5.0, 5.0 + late, duration) == pytest.approx(due)


def test_what_is_very_late_does_not_shorten_what_follows(tmp_path):
    # Five looks before the start; the 3rd and the 8th step's are slow.
    recording, _ = drive(tmp_path / "r", Robot(slow_at=(8, 13)), Source(12))
    sent = [line.time for line in recording.commands().itertuples() if line.kind == "command"]
    result = recording.meta["deadlines"]
    assert (result["steps"], result["missed"]) == (12, 2)
    assert result["worst_late_s"] == pytest.approx(0.227)
    assert np.diff(sent) == pytest.approx([0.1, 0.327, *[0.1] * 4, 0.327, *[0.1] * 4])


def test_looks_that_take_longer_are_begun_earlier(tmp_path):
    recording, _ = drive(tmp_path / "r", Robot(slow_at=range(8, 100), slow=0.04), Source(20))
    result = recording.meta["deadlines"]
    assert (result["steps"], result["missed"]) == (20, 2)
    assert result["worst_late_s"] == pytest.approx(0.017)


@pytest.mark.parametrize("at_line", ["end", "return"])
def test_a_line_ends_the_drive(tmp_path, at_line):
    robot = Robot(line=0.2)
    recording, message = drive(tmp_path / "r", robot, Source(50), at_line=at_line)
    motor = [line for line in recording.commands().itertuples() if line.is_motor]
    assert [line.kind for line in motor[-3:]] == ["command", "cut", "stop"]
    assert motor[-2].command == motor[-3].command < 30
    assert sum(robot.distances) / 2 < 0.2 + 0.03
    assert "was stopped at the perimeter line by its light sensor line_" in message[0]
    drive(tmp_path / "ignored", robot := Robot(line=0.2), Source(50))
    assert sum(robot.distances) / 2 > 0.3


def test_a_line_is_seen_though_the_controller_reads_nothing(tmp_path):
    class Blindly(Source):
        reads = False

        def react(self, seen):
            return Command((50, 50), self.step)

    robot = Robot(line=0.2)
    recording, _ = drive(tmp_path / "r", robot, Blindly(50, ()), at_line="end")
    assert sum(robot.distances) / 2 < 0.2 + 0.03
    recording, _ = drive(tmp_path / "ignored", Robot(line=0.2), Blindly(5, ()))
    assert recording.observations().names == ()


class Dumb:
    """A robot that drives, and nothing else."""

    def __init__(self):
        self.clock, self.driven = Clock(), False

    def connect(self):
        pass

    def close(self):
        pass

    commands = TWO_WHEELS

    def drive(self, command):
        self.driven = True

    def stop(self):
        pass

    def describe(self):
        return {"kind": "dumb"}

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass


def test_what_a_robot_lacks_is_said_before_anything_moves(tmp_path):
    dumb, robot = Dumb(), Robot()
    with pytest.raises(UserError) as refused:
        drive(tmp_path / "r", robot, Source(5, ("sensor_0", "sensor_3", "sensor_4")))
    assert str(refused.value) == (
        "the controller needs sensor_3, sensor_4, which this robot (two-wheels) has not: it reads "
        "line_left, sensor_0"
    )
    with pytest.raises(UserError, match=r"this robot \(dumb\) has not: it has no sensors"):
        drive(tmp_path / "r", dumb, Source(5))
    with pytest.raises(UserError, match="needs the robot's pose, and nothing says it"):
        drive(tmp_path / "r", dumb, Source(5, (), needs_pose=True))
    assert not dumb.driven
    assert not robot.sent
    assert not (tmp_path / "r").exists()
    drive(tmp_path / "r", robot, Source(5, needs_pose=True))


def test_a_low_battery_ends_it_and_it_is_begun_anew(tmp_path):
    with pytest.raises(BatteryLow, match="at its start and begin again"):
        drive(tmp_path / "r", Robot(volts=6.0), Source(5))
    with pytest.raises(UserError, match="in closed loop cannot be resumed"):
        drive(tmp_path / "r", Robot(), Source(5), resume=True)


def test_observations_that_are_damaged_are_named(tmp_path):
    recording, _ = drive(tmp_path / "r", Robot(), Source(5))
    path = recording.path / "observations.csv"
    whole = path.read_text()
    path.write_text(whole[:-5])
    assert len(Recording(recording.path).observations().time) == 6
    path.write_text(whole.replace("0.6", "dark", 1))
    with pytest.raises(UserError, match="line 2, field 'line_left': expected a finite number"):
        recording.observations()
    path.write_text(whole.replace("theta", "angle", 1))
    with pytest.raises(UserError, match="expected the columns session, command, time, x, y, theta"):
        recording.observations()
    path.unlink()
    assert recording.observations() is None
