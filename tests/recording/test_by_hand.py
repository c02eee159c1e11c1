"""A person drives, by levers: on a robot without physics, and at moments that are known."""

import math
import threading

import numpy as np
import pytest

from neurosim.base import se2
from neurosim.base.commands import TWO_WHEELS, Commands, Number
from neurosim.base.errors import UserError
from neurosim.recording.by_hand import SILENT, Hand, command_of, levers_of
from neurosim.recording.hand_session import IDLE, REFRESH, STEP
from neurosim.recording.record import Guard, RecordSettings, Rig, record
from tracking.datasets.dataset import build
from tracking.datasets.recordings import Poses, Recording

CAR = Commands(
    (Number("v", "m/s", -0.4, 0.8), Number("steer", "rad", -0.5, 0.5, speed=False)),
    "car",
    {"wheelbase": 0.2},
)
OMNI = Commands(tuple(Number(n, u, -2.0, 2.0) for n, u in
                      (("vx", "m/s"), ("vy", "m/s"), ("omega", "rad/s"))), "twist")  # fmt: skip
ARM = Commands(tuple(Number(f"joint_{n}", "rad/s", -1.0, 1.0) for n in range(10)))


def test_two_wheels_have_a_lever_for_forward_and_one_for_turns():
    assert [lever.name for lever in levers_of(TWO_WHEELS)] == ["forward", "turn left"]
    for levers, wanted in (
        ((1, 0), (60, 60)),
        ((-0.5, 0), (-30, -30)),
        ((0, 1), (-60, 60)),
        ((1, -1), (60, 0)),
        ((0, 0), (0, 0)),
    ):
        assert command_of(TWO_WHEELS, levers, 60.0) == wanted


def test_other_robots_have_a_lever_for_each_number_by_its_name():
    assert [lever.name for lever in levers_of(CAR)] == ["v", "steer"]
    # A speed is limited, an angle is not; each goes to its own limit.
    assert command_of(CAR, (1, 1), 50.0) == (0.4, 0.5)
    assert command_of(CAR, (-1, -0.5), 50.0) == (-0.2, -0.25)
    assert command_of(OMNI, (0.25, -1, 0.1), 100.0) == (0.5, -2.0, 0.2)
    levers = levers_of(ARM)
    keys = [key for lever in levers for key in (*lever.push, *lever.pull)]
    assert len(set(keys)) == len(keys)
    assert [lever.push for lever in levers[8:]] == [(), ()]
    assert [lever.axis for lever in levers] == [1, 0, 2, 3, *[None] * 6]
    assert math.copysign(1, command_of(ARM, (-0.0,) * 10, 50.0)[0]) == 1.0


class Clock:
    """A clock that runs the actions of a script at their times while somebody sleeps."""

    def __init__(self, script=()):
        self.time, self.script = 0.0, sorted(script, key=lambda each: each[0])
        self.each = lambda: None

    def now(self):
        return self.time

    def sleep_until(self, time):
        while self.script and self.script[0][0] <= time:
            self.time = max(self.time, self.script[0][0])
            self.script.pop(0)[1]()
        self.time = max(self.time, time)
        self.each()


class Robot:
    """Two wheels 10 cm apart that follow at once; a line stands where x > ``line``, m."""

    commands = TWO_WHEELS.measured(full=0.5, track=0.1)
    sensor_names = ("line_left",)

    def __init__(self, clock, *, line=math.inf, slow=0.0):
        self.clock, self.line, self.slow = clock, line, slow
        self.pose, self.numbers, self.since = np.zeros(3), (0.0, 0.0), 0.0
        self.path, self.held = [], []

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def move(self):
        now = self.clock.now()
        twist = self.commands.twist(self.numbers)
        self.pose = se2.compose(self.pose, se2.exp(twist * (now - self.since)))
        self.since = now

    def drive(self, command):
        self.move()
        self.numbers = tuple(command)
        self.clock.time += self.slow

    def drive_for(self, command, seconds):
        self.held.append((self.clock.now(), seconds))
        self.drive(command)

    def stop(self):
        self.drive((0.0, 0.0))

    def read_sensors(self):
        self.move()
        return {"line_left": 0.1 if self.pose[0] > self.line else 0.6}

    def describe(self):
        return {"kind": "two-wheels"}


#: Seconds that the robot stands before a person may drive, while its lamp flashes.
BEFORE = 1.5


def drive(folder, wishes, end, *, at_line="return", heartbeat=0.1, silent=(), resume=False, **own):
    """Drive by levers that stand at ``wishes``, (s, levers) from the beginning, until ``end``.

    Between the times of ``silent`` the page sends nothing.
    """
    clock = Clock()
    hand = Hand(80.0, now=clock.now)
    robot = Robot(clock, **own)

    def tell():
        past = clock.now() - BEFORE
        if not any(begin <= past < until for begin, until in silent):
            hand.take("page", [levers for since, levers in wishes if since <= past + 1e-9][-1])

    beats = np.arange(0.0, end, heartbeat)
    moments = sorted({*beats.round(6), *(time for time, _ in wishes)})
    clock.script = [(BEFORE + moment, tell) for moment in moments] + [(BEFORE + end, hand.end)]
    # Every pose is seen, 100 times a second.
    clock.each = lambda: (robot.move(), robot.path.append((clock.time, *robot.pose)))
    messages = []
    made = record(folder, Rig(robot), hand, guarded(at_line), resume=resume, say=messages.append)
    return made, robot, hand, messages


def guarded(at_line):
    return RecordSettings(guard=Guard(at_line))


def motor(recording):
    return [line for line in recording.commands().itertuples() if line.is_motor]


STILL, AHEAD, BACK, LEFT = (0, 0), (1, 0), (-1, 0), (0, 1)


def test_commands_are_kept_as_they_are_given_at_their_times(tmp_path):
    wishes = [(0.0, STILL), (0.5, AHEAD), (1.25, LEFT), (1.7, (0.5, 0.1)), (2.4, STILL)]
    recording, robot, hand, message = drive(tmp_path / "r", wishes, 3.0)
    lines = motor(recording)
    assert [(line.kind, line.numbers) for line in lines] == [
        ("command", (80.0, 80.0)),
        ("command", (-80.0, 80.0)),
        ("command", (32.0, 48.0)),
        ("command", (0.0, 0.0)),
        ("stop", (0.0, 0.0)),
    ]
    assert [line.command for line in lines[:4]] == [0, 1, 2, 3]
    given = BEFORE + np.array([time for time, _ in wishes[1:]])
    late = np.array([line.time for line in lines[:4]]) - given
    assert (late >= 0).all()
    assert (late < 0.04).all()
    assert all(math.isnan(line.duration) for line in lines[:4])
    assert recording.meta["complete"] is True
    assert recording.meta["settings"]["source"] == {"kind": "by-hand", "max_speed": 80.0}
    assert message == []
    shown = hand.state()
    assert shown["phase"] == "over"
    assert shown["commands"] == 4
    assert shown["seconds"] == pytest.approx(3.0, abs=0.1)
    # A command that continues is repeated to a robot that stops by itself, and is written once.
    assert {seconds for _, seconds in robot.held} == {2 * REFRESH}
    driven = [time for time, _ in robot.held]
    assert len(driven) > 6
    assert np.diff([*driven[:6]]).max() < 1.5 * REFRESH


def test_no_more_commands_than_the_robot_takes(tmp_path):
    wishes = [(0.0, STILL), *((0.2 + 0.01 * n, (0.3 + 0.005 * n, 0)) for n in range(100))]
    for slow, least in ((0.0, STEP), (0.15, 0.15)):
        folder = tmp_path / str(slow)
        recording, *_ = drive(folder, wishes, 1.5, slow=slow)
        times = [line.time for line in motor(recording) if line.kind == "command"]
        assert np.diff(times).min() >= least - 1e-6
        assert np.diff(times[:5]).max() < least + 0.1
        # The last wish is what it ends with.
        assert motor(recording)[-2].numbers == (64.0, 64.0)


@pytest.mark.parametrize("when", [1.0, 1.03, 1.07])
def test_a_robot_that_nobody_drives_stops(tmp_path, when):
    recording, *_ = drive(tmp_path / "r", [(0.0, STILL), (0.5, AHEAD)], 2.5, silent=[(when, 2.0)])
    lines = motor(recording)
    assert [line.kind for line in lines] == ["command", "stop", "command", "stop"]
    # Its last message came one beat before.
    assert lines[1].time - (BEFORE + when) < 0.5
    assert lines[1].time - (BEFORE + when) > SILENT - 0.11
    # A page that comes back with its keys still pressed continues.
    assert lines[2].time == pytest.approx(BEFORE + 2.0, abs=0.1)


def test_a_page_that_goes_away_stops_the_robot_at_once():
    hand = Hand()
    hand.begin(TWO_WHEELS)
    assert hand.wish() is None
    hand.take("one", [1.0, 0.0])
    assert hand.wish() == (50, 50)
    hand.take("one", [1.0, 1.0], 0.5)
    assert hand.wish() == (0, 25)
    with pytest.raises(UserError, match="another page drives"):
        hand.take("two", [0.0, 0.0])
    with pytest.raises(UserError, match="controls of another robot"):
        hand.take("one", [1.0])
    hand.take("one", None)
    assert hand.wish() is None
    hand.take("two", [0.0, 1.0])
    assert hand.wish() == (-50, 50)


def test_at_the_line_the_robot_is_stopped_and_may_be_driven_back(tmp_path):
    wishes = [
        (0.0, STILL), (0.2, AHEAD),  # on the line after 1.25 s
        (2.0, BACK), (2.3, STILL),  # ignored until the levers are let go
        (2.6, AHEAD), (3.0, STILL),  # ignored: farther out
        (3.2, BACK), (3.6, STILL),
        (4.0, AHEAD), (5.0, STILL),  # inside again: the line stops it again
    ]  # fmt: skip
    recording, robot, hand, message = drive(tmp_path / "r", wishes, 5.5, line=0.5)
    lines = motor(recording)
    assert [(line.kind, line.numbers[0]) for line in lines] == [
        ("command", 80), ("stop", 0),
        ("command", -80), ("command", 0),
        ("command", 80), ("stop", 0),
        ("stop", 0),
    ]  # fmt: skip
    assert lines[2].time == pytest.approx(BEFORE + 3.2, abs=0.05)
    assert max(x for _, x, *_ in robot.path) < 0.53
    assert message[0].startswith("the robot was stopped at the perimeter line by its light sensor")
    assert message[1] == "this command leads off the board"
    assert "Let go, then drive back inside or carry" in hand.state()["standing"]
    ignored, robot, *_ = drive(tmp_path / "i", wishes, 5.5, line=0.5, at_line="ignore")
    assert max(x for _, x, *_ in robot.path) > 0.6
    assert "stop" not in [line.kind for line in motor(ignored)[:-1]]
    ended, *_ = drive(tmp_path / "e", wishes, 5.5, line=0.5, at_line="end")
    assert [line.kind for line in motor(ended)] == ["command", "stop", "stop"]
    assert ended.meta["stopped"]["code"] == 1
    assert ended.meta["complete"] is True


def test_a_robot_that_stands_for_long_waits(tmp_path):
    wishes = [(0.0, STILL), (0.2, AHEAD), (0.6, STILL), (6.0, BACK), (6.5, STILL)]
    recording, *_ = drive(tmp_path / "r", wishes, 7.0)
    lines = motor(recording)
    assert [line.kind for line in lines] == [*["command"] * 2, "stop", *["command"] * 2, "stop"]
    assert lines[2].time - lines[1].time == pytest.approx(IDLE, abs=0.1)


def tracked(recording, robot):
    """Add the true path as poses, 30 a second."""
    path = np.array(robot.path)
    times = np.arange(0.5, path[-1, 0], 1 / 30)
    pose = np.column_stack([np.interp(times, path[:, 0], path[:, i]) for i in (1, 2, 3)])
    ones = np.ones(len(times))
    recording.write_poses(Poses(ones.astype(int), np.arange(len(times)), times, pose, ones))
    return Recording(recording.path)


def wandering(seconds, seed=1):
    """Return wishes that change every 0.15 to 0.6 s."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.15, 0.6, int(seconds / 0.375)))
    return [(0.0, STILL), *((t, tuple(rng.uniform(-1, 1, 2).round(2))) for t in times)]


def test_a_dataset_of_it_has_the_commands_with_their_times(tmp_path):
    recording, robot, *_ = drive(tmp_path / "r", wandering(15.0), 15.0, silent=[(7.0, 8.0)])
    recording = tracked(recording, robot)
    dataset = build([recording.path], tmp_path / "d")
    assert dataset.meta["windows"] is True
    assert dataset.inputs == ("prev_left", "prev_right", "left", "right", "duration")
    # Two stretches, each from rest; within them rows follow one another.
    assert list(dict.fromkeys(dataset.table["recording"])) == ["r/1", "r/2"]
    joined = dataset.joined
    assert (~joined).sum() == 2
    begins = dataset.table[~joined]
    assert (begins[["prev_left", "prev_right"]] == 0).all(axis=None)
    sent = [line for line in motor(recording) if line.kind == "command"]
    held = {line.numbers for line in sent}
    table = dataset.table
    assert {*zip(table["left"], table["right"], strict=True)} <= held | {(0.0, 0.0)}
    # Each command lasts as long as until the next line: to a frame at the ends of a stretch.
    ends = {line.command: after.time for line, after in zip(motor(recording), motor(recording)[1:],
                                                           strict=False)}  # fmt: skip
    for line in sent:
        rows = table[(table["left"] == line.left) & (table["right"] == line.right)]
        assert rows["duration"].sum() == pytest.approx(ends[line.command] - line.time, abs=0.04)
    # The robot follows its commands at once.
    moved = se2.exp(robot.commands.twist(table[["left", "right"]].to_numpy())
                    * table[["duration"]].to_numpy())  # fmt: skip
    assert np.abs(moved - dataset.output_array()).max() < 0.03


def test_a_recording_that_was_interrupted_has_what_was_driven(tmp_path, monkeypatch):
    ended = threading.Event()

    def end(self):
        ended.set()
        raise KeyboardInterrupt

    monkeypatch.setattr(Hand, "end", end)
    robots = []
    monkeypatch.setattr(
        Robot, "describe", lambda self: robots.append(self) or {"kind": "two-wheels"}
    )
    with pytest.raises(KeyboardInterrupt):
        drive(tmp_path / "r", wandering(12.0), 12.0)
    assert ended.is_set()
    assert robots[-1].numbers == (0.0, 0.0)
    recording = tracked(Recording(tmp_path / "r"), robots[-1])
    assert recording.meta["complete"] is False
    dataset = build([recording.path], tmp_path / "d")
    assert len(dataset) > 20
    with pytest.raises(UserError, match="was driven by hand, where no command is held"):
        build([recording.path], tmp_path / "held", windows=False)


def test_a_recording_that_was_interrupted_is_resumed(tmp_path, monkeypatch):
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Hand, "end", interrupt)
        drive(tmp_path / "r", wandering(4.0), 4.0)
    with pytest.raises(UserError, match=r"max_speed \(80.0, now 50.0\)"):
        record(tmp_path / "r", Rig(Robot(Clock())), Hand(), guarded("return"), resume=True)
    begun = (tmp_path / "r" / "commands.csv").read_text()
    recording, *_ = drive(tmp_path / "r", wandering(4.0), 4.0, resume=True)
    assert (tmp_path / "r" / "commands.csv").read_text().startswith(begun)
    assert recording.sessions == 2
    assert recording.meta["complete"] is True
    sent = [line for line in motor(recording) if line.kind == "command"]
    assert [line.command for line in sent] == list(range(len(sent)))
    assert {line.session for line in sent} == {1, 2}
    with pytest.raises(UserError, match="is complete"):
        drive(tmp_path / "r", wandering(4.0), 4.0, resume=True)


def interrupt(self):
    raise KeyboardInterrupt
