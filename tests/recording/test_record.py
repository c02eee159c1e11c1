"""The recorder against a robot without physics, whose clock is the test's."""

import itertools
import json
import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from processes import finished, process

from neurosim.base import files
from neurosim.base.commands import TWO_WHEELS
from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.recording.commands import Command, FixedCommands, RandomCommands
from neurosim.recording.record import BatteryLow, Guard, RecordSettings, Rig, _wanted, record
from neurosim.recording.session import _waiting
from neurosim.robots import Robot
from neurosim.robots.khepera.driver import Khepera
from tracking.camera.camera_model import CameraModel
from tracking.camera.cameras import VideoSink
from tracking.datasets.recordings import Recording

SETTINGS = RecordSettings(3)


class FakeClock:
    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def sleep_until(self, time):
        self.time = max(self.time, time)


class FakeRobot:
    """A point on an endless strip with lines at +-half_width across its path; 0.5 m/s at 100 %."""

    def __init__(self, half_width=math.inf, volts=8.0, dies_after=math.inf):
        self.clock = FakeClock()
        self.half_width = half_width
        self.volts = volts
        self.dies_after = dies_after
        self.place = 0.0
        self.speeds = (0.0, 0.0)
        self.since = 0.0
        self.sent = []
        self.lamps = []
        self.closed = False

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.closed = True

    def _move(self):
        now = self.clock.now()
        if self.speeds[0] == self.speeds[1]:
            self.place += self.speeds[0] / 100 * 0.5 * (now - self.since)
        self.since = now

    commands = TWO_WHEELS

    def drive(self, command):
        self._move()
        if len(self.sent) >= self.dies_after:
            raise LinkLost("the robot stopped answering")
        self.speeds = tuple(command)
        self.sent.append(self.speeds)

    def stop(self):
        self._move()
        self.speeds = (0.0, 0.0)

    sensor_names = ("line_left", "line_right")

    def read_sensors(self):
        self.clock.time += 0.03
        self._move()
        dark = 0.25 if abs(self.place) > self.half_width else 0.55
        return {"line_left": dark, "line_right": 0.55}

    def lamp(self, on):
        self.lamps.append((self.clock.now(), on))

    def battery(self):
        return self.volts

    def describe(self):
        return {"kind": "fake"}


def run(path, robot, commands, source=None, finish=None, **options):
    settings = RecordSettings(commands, **options.pop("settings", {}))
    rig = Rig(robot, finish=finish)
    return record(path, rig, source or RandomCommands(seed=3), settings, **options)


def kinds(recording):
    return [line.kind for line in recording.commands().itertuples()]


def test_random_commands_have_the_shares_and_limits_of_the_paper():
    commands = [RandomCommands(seed=1).command(i) for i in range(4000)]
    stops = sum(c.numbers == (0, 0) for c in commands)
    equal = sum(c.numbers[0] == c.numbers[1] != 0 for c in commands)
    assert stops / 4000 == pytest.approx(0.2, abs=0.02)
    assert equal / 4000 == pytest.approx(0.3, abs=0.02)
    assert max(abs(c.numbers[0]) for c in commands) == 50
    durations = [c.duration for c in commands]
    assert min(durations) >= 0.5
    assert max(durations) <= 3.0
    assert np.mean(durations) == pytest.approx(1.75, abs=0.05)
    forwards = sum(c.numbers[0] > 0 for c in commands) / (4000 - stops)
    assert forwards == pytest.approx(0.5, abs=0.03)


def test_command_k_is_the_same_wherever_one_begins():
    assert RandomCommands(seed=5).command(17) == RandomCommands(seed=5).command(17)
    assert RandomCommands(seed=5).command(17) != RandomCommands(seed=6).command(17)


@pytest.mark.parametrize(
    "wrong",
    [{"max_speed": 0}, {"max_speed": 101}, {"durations": (2, 1)}, {"straight": 0.9}],
)
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(UserError):
        RandomCommands(**wrong)


def test_motors_go_straight_from_one_command_into_the_next(tmp_path):
    robot = FakeRobot()
    recording = run(tmp_path / "r", robot, 20)
    lines = [line for line in recording.commands().itertuples() if line.is_motor]
    assert [line.kind for line in lines] == ["command"] * 20 + ["stop"]
    for line, after in itertools.pairwise(lines):
        assert after.time - line.time == pytest.approx(line.duration, abs=1e-5)
    assert [(line.left, line.right) for line in lines[:-1]] == robot.sent
    assert recording.meta["complete"] is True
    assert robot.closed


def test_the_lamp_flashes_at_the_beginning_and_at_the_end(tmp_path):
    robot = FakeRobot()
    recording = run(tmp_path / "r", robot, 3)
    logged = [
        (line.time, line.kind == "lamp-on")
        for line in recording.commands().itertuples()
        if "lamp" in line.kind
    ]
    assert logged == [(pytest.approx(time), on) for time, on in robot.lamps]
    assert [on for _, on in logged] == [True, False, True, False] * 2
    first_command = next(
        line for line in recording.commands().itertuples() if line.kind == "command"
    )
    assert logged[3][0] < first_command.time
    assert kinds(recording)[-1] == "end"


def test_a_command_cut_at_the_line_is_repeated_from_the_same_speeds(tmp_path):
    robot = FakeRobot(half_width=1.2)
    source = FixedCommands([Command((20, 20), 2), *[Command((50, 50), 3)] * 4, Command((0, 0), 1)])
    recording = run(tmp_path / "r", robot, 6, source)
    lines = [line for line in recording.commands().itertuples() if line.is_motor]
    cut = [i for i, line in enumerate(lines) if line.kind == "cut"]
    assert cut
    for i in cut:
        assert lines[i - 1].kind == "command"
        assert lines[i].command == lines[i - 1].command
        assert lines[i].time - lines[i - 1].time < lines[i - 1].duration
        again = next(j for j in range(i, len(lines)) if lines[j].kind == "command")
        assert lines[again].command == lines[i].command
        before = next(line for line in lines if line.command == lines[i].command - 1)
        assert (lines[again - 1].left, lines[again - 1].right) == (before.left, before.right)
    # After the retries every command ran to its end.
    done = {
        a.command for a, b in itertools.pairwise(lines) if a.kind == "command" and b.kind != "cut"
    }
    assert done == set(range(6))
    assert abs(robot.place) < 1.2 + 0.1


def test_a_guard_that_ends_stops_at_the_line(tmp_path):
    robot = FakeRobot(half_width=0.3)
    source = FixedCommands([Command((50, 50), 3), Command((50, 50), 3)])
    recording = run(tmp_path / "r", robot, 2, source, settings={"guard": Guard("end")})
    assert [line.kind for line in recording.commands().itertuples() if line.is_motor] == [
        "command",
        "cut",
        "stop",
    ]


def test_a_robot_that_does_not_find_back_asks_for_help(tmp_path):
    class Lost(FakeRobot):
        def read_sensors(self):
            reading = super().read_sensors()
            return {**reading, "line_left": 0.1} if self.clock.now() > 6 else reading

    robot = Lost()
    with pytest.raises(UserError, match="middle of the board"):
        run(tmp_path / "r", robot, 20, FixedCommands([Command((30, 30), 2)] * 20))
    assert robot.speeds == (0.0, 0.0)


def test_a_lost_link_leaves_a_recording_that_resumes(tmp_path):
    source = RandomCommands(seed=3)
    with pytest.raises(LinkLost, match=r"stopped answering; .* continue with --resume"):
        run(tmp_path / "r", FakeRobot(dies_after=7), 15, source)
    broken = Recording(tmp_path / "r")
    assert broken.meta["complete"] is False
    assert sum(kind == "command" for kind in kinds(broken)) == 8  # the eighth never arrived
    recording = run(tmp_path / "r", FakeRobot(), 15, source, resume=True)
    assert recording.sessions == 2
    assert recording.meta["complete"] is True
    second = [line for line in recording.commands().itertuples() if line.session == 2]
    sent = [(line.command, line.numbers) for line in second if line.kind == "command"]
    # By the log, the last two of the first session did not run to their end.
    assert sent == [(i, source.command(i).numbers) for i in range(7, 15)]


def test_resuming_with_other_settings_is_refused_and_names_the_setting(tmp_path):
    with pytest.raises(LinkLost):
        run(tmp_path / "r", FakeRobot(dies_after=2), 5)
    with pytest.raises(UserError, match=r"settings\.source\.seed.*3, now 4"):
        run(tmp_path / "r", FakeRobot(), 5, RandomCommands(seed=4), resume=True)
    with pytest.raises(UserError, match=r"settings\.commands"):
        run(tmp_path / "r", FakeRobot(), 6, resume=True)
    with pytest.raises(UserError, match=r"settings\.guard\.contrast"):
        run(tmp_path / "r", FakeRobot(), 5, settings={"guard": Guard(contrast=0.2)}, resume=True)


def test_a_complete_recording_is_neither_resumed_nor_overwritten(tmp_path):
    run(tmp_path / "r", FakeRobot(), 2)
    with pytest.raises(UserError, match="nothing to resume"):
        run(tmp_path / "r", FakeRobot(), 2, resume=True)
    with pytest.raises(UserError, match="not empty"):
        run(tmp_path / "r", FakeRobot(), 2)


def test_a_low_battery_pauses_and_says_so(tmp_path):
    robot = FakeRobot(volts=6.0)
    with pytest.raises(BatteryLow, match=r"6\.00 V.*--resume"):
        run(tmp_path / "r", robot, 2)
    assert kinds(Recording(tmp_path / "r"))[-1] == "pause"
    assert json.loads((tmp_path / "r" / "recording.json").read_text())["complete"] is False
    assert run(tmp_path / "r", FakeRobot(), 2, resume=True).meta["complete"] is True


def test_a_low_battery_before_a_plan_says_to_begin_again(tmp_path):
    plan = FixedCommands([Command((20.0, 20.0), 1.0)] * 2)
    guarded = {"guard": Guard("end")}
    with pytest.raises(BatteryLow, match=r"put the robot at its start and begin again, in a new"):
        run(tmp_path / "r", FakeRobot(volts=6.0), 2, plan, settings=guarded)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, LinkLost("gone")])
def test_the_motors_are_stopped_whatever_happens(tmp_path, error):
    class Faulty(FakeRobot):
        def drive(self, command):
            super().drive(command)
            if len(self.sent) == 4:
                raise error

    robot = Faulty()
    finished = []
    with pytest.raises((KeyboardInterrupt, RuntimeError, LinkLost)):
        run(tmp_path / "r", robot, 9, finish=lambda folder, session: finished.append(session))
    assert robot.speeds == (0.0, 0.0)
    assert robot.closed
    assert finished == [1]
    assert len(Recording(tmp_path / "r").commands())


class Bare:
    """A robot with no ability but driving."""

    def __init__(self):
        self.clock, self.sent = FakeClock(), []

    def connect(self):
        pass

    def close(self):
        pass

    commands = TWO_WHEELS

    def drive(self, command):
        self.sent.append(tuple(command))

    def stop(self):
        pass

    def describe(self):
        return {"kind": "bare"}

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()


def test_a_robot_without_lamp_battery_and_sensors_is_recorded(tmp_path):
    robot, messages = Bare(), []
    assert isinstance(robot, Robot)
    recording = run(tmp_path / "r", robot, 4, say=messages.append)
    assert kinds(recording) == [*["command"] * 4, "stop", "end"]
    assert len(robot.sent) == 4
    assert recording.meta["complete"] is True
    assert "no light sensors" in messages[0]


@pytest.mark.parametrize(
    ("then", "field"),
    [
        ({"dialect": "khepera3"}, "robot.dialect"),
        ({"baud": 19200}, "robot.baud"),
        ({"full_speed": 20}, "robot.full_speed"),
    ],
)
def test_a_khepera_resumed_on_another_dialect_or_line_is_refused(tmp_path, then, field):
    folder = tmp_path / "r"
    made = Recording.create(folder, _wanted(Khepera("x"), None, RandomCommands(seed=3), SETTINGS))
    with pytest.raises(UserError, match=f"with another {field}"):
        run(folder, Khepera("x", **then), 3, resume=True)
    # Older recordings have its kind under another key: this alone is not a difference.
    made.meta["robot"]["robot"] = made.meta["robot"].pop("kind")
    made.save_meta()
    with pytest.raises(UserError, match=r"with another robot\.kind"):
        run(folder, Bare(), 3, resume=True)
    with pytest.raises(UserError, match=f"with another {field}"):
        run(folder, Khepera("x", **then), 3, resume=True)
    with pytest.raises(RobotError):
        run(folder, Khepera("no-such-port"), 3, resume=True)


def test_a_recording_says_what_chose_its_commands():
    source = FixedCommands([Command((10, -20), 1.5)], {"kind": "guided", "round": 2})
    assert source.command(0) == Command((10, -20), 1.5)
    assert source.describe() == {"kind": "guided", "round": 2, "commands": [[10, -20, 1.5]]}


# Killed between two steps, and two at once

KILLED = """
import os, signal, sys
sys.path[:0] = [{tests!r}, {tests!r} + "/../support"]
from test_record import FakeRobot, run
from neurosim.base import files
replace, left = os.replace, {steps}

def counted(*paths):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(*paths)

files.os.replace = counted
run({folder!r}, FakeRobot(), 3, calibration={calibration!r}, say=print)
"""


def calibration_of(tmp_path):
    path = tmp_path / "calibration.json"
    CameraModel((640, 480), np.diag([600.0, 600.0, 1.0]), np.zeros(5)).write(path)
    return path


@pytest.mark.skipif(os.name == "nt", reason="Windows has no kill -9")
@pytest.mark.slow
def test_a_recording_killed_at_any_step_goes_on_or_starts_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_STALE", 0.0)
    calibration, resumed, steps = calibration_of(tmp_path), 0, 0
    while True:
        steps += 1
        folder = tmp_path / f"r{steps}"
        script = KILLED.format(
            tests=str(Path(__file__).parent),
            steps=steps,
            folder=str(folder),
            calibration=str(calibration),
        )
        done = finished(process(script))
        if done.returncode == 0:
            break
        assert done.returncode == -signal.SIGKILL
        begun = folder.exists()
        resumed += begun
        recording = run(folder, FakeRobot(), 3, calibration=calibration, resume=begun)
        assert recording.meta["complete"] is True
        assert (folder / "calibration.json").read_bytes() == calibration.read_bytes()
        assert not [path for path in tmp_path.rglob(".*") if f"r{steps}" in str(path)]
    assert steps >= 4  # the folder, its session, the complete recording
    assert resumed == steps - 3  # before the folder gets its name there is nothing


def test_two_do_not_record_into_one_folder(tmp_path):
    class Second(FakeRobot):
        def drive(self, command):
            super().drive(command)
            if len(self.sent) == 2:
                with pytest.raises(UserError, match="is being recorded into by process"):
                    run(tmp_path / "r", FakeRobot(), 5, resume=True)
                raise LinkLost("gone")

    with pytest.raises(LinkLost):
        run(tmp_path / "r", Second(), 5)
    assert run(tmp_path / "r", FakeRobot(), 5, resume=True).meta["complete"] is True
    assert not (tmp_path / "r" / ".lock").exists()


@pytest.mark.parametrize(("ends", "again"), [("killed", range(4, 10)), ("end", range(9, 10))])
def test_commands_whose_film_a_kill_lost_are_sent_again(tmp_path, ends, again):
    """A quarter of the video was still to be written when its program was killed."""
    folder = tmp_path / "r"
    recording = Recording.create(folder, {})
    recording.begin_session(video="video-001.avi")
    rng = np.random.default_rng(0)
    with recording.frame_log() as frames, recording.command_log() as log:
        sink = VideoSink(folder / "video-001.avi", frames, 1, (160, 120), 30.0)
        for frame in range(300):
            sink.write(frame / 30, rng.integers(0, 255, (120, 160, 3), np.uint8))
        sink.close()
        for number in range(10):
            log.append(1, number, "command", float(number), 10, 10, 1.0)
        if ends == "end":
            log.append(1, None, "end", 10.0, None, None, None)
    settings = RecordSettings(10)
    assert [todo.index for todo in _waiting(recording, settings)] == [9]
    video = folder / "video-001.avi"
    video.write_bytes(video.read_bytes()[: video.stat().st_size * 3 // 4])
    assert [todo.index for todo in _waiting(recording, settings)] == list(again)
