"""Logs with several drives, separate clocks, jumps and wrong units: corrected, or reported."""

import numpy as np
import pytest

from neurosim.base import se2
from neurosim.base.errors import FileError, UserError
from tracking.datasets import clocks, logs
from tracking.datasets.csv_files import Conventions, import_csv
from tracking.datasets.logs import Settings
from tracking.datasets.sessions import without_lost

DT = 0.05


def drive(seconds=60.0, seed=0, lag=0.15, commands=None):
    """Return time (N,), poses (N, 3), headings wrapped, and commands v, w (N, 2) of a unicycle."""
    rng = np.random.default_rng(seed)
    count = round(seconds / DT)
    if commands is None:
        held = rng.integers(10, 40, count)
        random = rng.uniform((-0.3, -1.5), (0.3, 1.5), (count, 2)).round(2)
        commands = np.repeat(random, held, axis=0)[:count]
    pose, velocity, poses = np.zeros(3), np.zeros(2), []
    for command in commands:
        poses.append(pose)
        for _ in range(5):
            velocity = velocity + (command - velocity) * (1 - np.exp(-DT / 5 / lag))
            pose = se2.compose(pose, se2.exp([DT / 5 * velocity[0], 0, DT / 5 * velocity[1]]))
    poses = np.array(poses)
    poses[:, 2] = np.angle(np.exp(1j * poses[:, 2]))
    return np.arange(count) * DT, poses, commands


def write(path, time, poses, commands, names="v,w", **more):
    header = ",".join(["time,x,y,heading", names, *more])
    columns = [time, poses, commands, *(np.asarray(column)[:, None] for column in more.values())]
    columns[0] = time[:, None]
    lines = [",".join(f"{value:.9g}" for value in line) for line in np.hstack(columns)]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


@pytest.fixture
def imported(tmp_path):
    """Write a log and import it; return the dataset and its warnings in one text."""

    def run(time, poses, commands, names="v,w", settings=None, conventions=None, **more):
        session, counters = more.pop("session", None), more.pop("counters", ())
        number = len(list(tmp_path.iterdir()))
        path = write(tmp_path / f"{number}.csv", time, poses, commands, names, **more)
        made = import_csv(
            path,
            tmp_path / f"d{number}",
            columns=dict.fromkeys(()) | {name: name for name in names.split(",")},
            settings=settings,
            conventions=conventions,
            session=session,
            counters=counters,
        )
        return made, "\n".join(made.meta["warnings"])

    return run


def same(a, b, within=1e-6):
    assert a.input_array() == pytest.approx(b.input_array(), abs=within)
    assert a.output_array() == pytest.approx(b.output_array(), abs=within)


def test_a_plain_log_is_not_suspicious(imported):
    made, warnings = imported(*drive())
    assert warnings == ""
    assert len(made) > 25


@pytest.mark.slow
@pytest.mark.parametrize("apart", [-60.0, 30.0])
def test_drives_in_one_file_are_as_drives_in_two(imported, tmp_path, apart):
    first, second = drive(seed=1), drive(seed=2)
    paths = [write(tmp_path / f"{k}.txt", *each) for k, each in enumerate((first, second))]
    expected = import_csv(paths, tmp_path / "two")
    begins = 60.0 + apart
    both = [np.concatenate(pair) for pair in zip(first, second, strict=True)]
    both[0][len(first[0]) :] += begins
    made, warnings = imported(*both)
    assert "2 drives in one file" in warnings
    same(made, expected)
    assert made.table["recording"].nunique() == 2
    column = np.repeat([3, 7], len(first[0]))
    made, warnings = imported(*both, session="run", run=column)
    assert warnings == ""
    same(made, expected)
    assert made.table["recording"].unique().tolist() == ["5/3", "5/7"]


def test_a_column_that_is_no_name_of_drives(imported):
    time, poses, commands = drive()
    with pytest.raises(FileError, match="names another drive on nearly every line"):
        imported(time, poses, commands, session="n", n=time)
    with pytest.raises(FileError, match="no such column; found time"):
        imported(time, poses, commands, session="m")


def test_lines_out_of_order_or_twice(imported):
    time, poses, commands = drive()
    expected, _ = imported(time, poses, commands)
    order = np.arange(len(time))
    order[[100, 101, 300, 301]] = order[[101, 100, 301, 300]]
    order = np.insert(order, 500, order[500])
    made, warnings = imported(time[order], poses[order], commands[order])
    assert "2 lines are earlier than the line before; they are put in order" in warnings
    assert "1 lines have the time of another line; one of each counts" in warnings
    same(made, expected)


def test_a_robot_that_is_carried_elsewhere_and_a_false_pose(imported):
    time, poses, commands = drive()
    expected, _ = imported(time, poses, commands)
    poses[200, :2] += 1.5
    poses[700:, :2] += (1.5, -1.0)
    poses[700:, 2] = np.angle(np.exp(1j * (poses[700:, 2] + 2.0)))
    made, warnings = imported(time, poses, commands)
    assert warnings.endswith("the pose jumps once (at 35.00 s); the log is cut there")
    # Commands continue: the first row after the jump has its previous command.
    assert len(made) >= len(expected) - 1
    moved = np.hypot(*made.output_array()[:, :2].T)
    assert moved.max() < 1.0


def test_two_samples_close_together_are_no_jump(imported):
    """One more line where a command begins: 1 mm of noise in 2 ms is not a speed of 0.5 m/s."""
    time, poses, commands = drive()
    poses[:, :2] += np.random.default_rng(0).normal(0.0, 0.001, (len(time), 2))
    twice = np.arange(20, len(time), 40)
    time = np.insert(time, twice, time[twice] - 0.002)
    again = poses[twice] + [0.003, 0.0, 0.0]
    poses = np.insert(poses, twice, again, axis=0)
    _, warnings = imported(time, poses, np.insert(commands, twice, commands[twice - 1], axis=0))
    assert "jumps" not in warnings


@pytest.mark.slow
@pytest.mark.parametrize("late", [-0.4, 1.0])
def test_clocks_that_differ(imported, late):
    time, poses, commands = drive(120.0)
    expected, _ = imported(time, poses, commands)
    shifted = np.column_stack(
        [np.interp(time, time + late, column) for column in np.unwrap(poses, axis=0).T]
    )
    made, warnings = imported(time, shifted, commands)
    side = "after" if late > 0 else "before"
    assert f"{side} their commands, as no robot does: their clocks differ; corrected" in warnings
    result = float(warnings.split("--delay ")[1].split()[0])
    assert result == pytest.approx(late, abs=0.06)
    left, warnings = imported(time, shifted, commands, settings=Settings(delay=0.0))
    assert warnings == ""
    worse = np.abs(left.output_array()[3:-3] - expected.output_array()[3:-3]).mean()
    n = len(made)
    better = np.abs(made.output_array()[3 : n - 3] - expected.output_array()[3 : n - 3]).mean()
    assert better < 0.2 * worse
    exact, warnings = imported(time, shifted, commands, settings=Settings(delay=late))
    assert warnings == ""
    assert exact.output_array()[3:-3] == pytest.approx(
        expected.output_array()[3 : len(exact) - 3], abs=0.01
    )


@pytest.mark.slow
@pytest.mark.parametrize("held", [1.0, 0.5])
def test_held_commands_that_are_half_of_a_log_are_not_all_that_is_learned_from(imported, held):
    """Then the rest would be thrown away, even if there are many of them."""
    rng = np.random.default_rng(1)
    lengths = rng.integers(12, 40, 300)
    commands = np.repeat(rng.uniform((-0.3, -1.5), (0.3, 1.5), (300, 2)).round(2), lengths, axis=0)
    alone = np.arange(300) < 300 * held
    quick = ~np.repeat(alone, lengths)
    commands[quick] = rng.uniform((-0.3, -1.5), (0.3, 1.5), (quick.sum(), 2)).round(2)
    time, poses, _ = drive(len(commands) * DT, commands=commands)
    made, _ = imported(time, poses, commands)
    assert made.meta["windows"] is (held < 1.0)
    lasts = made.input_array()[:, -1].sum()
    assert lasts == pytest.approx(time[-1], rel=0.03)
    assert len(made) > (1000 if held < 1.0 else 290)


def test_a_body_that_answers_in_three_steps_is_no_other_clock(imported):
    """A delay of 0.77 s would explain it better, but hardly."""
    time, _, commands = drive(160.0, seed=3)
    slow = commands.copy()
    for _ in range(2):
        for k in range(1, len(slow)):
            slow[k] = slow[k - 1] + (slow[k] - slow[k - 1]) * (1 - np.exp(-DT / 0.7))
    poses = drive(160.0, lag=0.7, commands=slow)[1]
    poses += np.random.default_rng(0).normal(0.0, 0.01, poses.shape)
    log = logs.Log("a", time, commands, time >= 0, time, np.unwrap(poses, axis=0))
    assert clocks.lateness([log]).delay == clocks.ROBOTS
    assert "clock" not in imported(time, poses, commands)[1]


def test_a_slow_body_is_no_other_clock(imported):
    time, poses, commands = drive(seconds=120.0, lag=1.5)
    log = logs.Log("a", time, commands, time >= 0, time, np.unwrap(poses, axis=0))
    assert abs(clocks.lateness([log]).delay) < 0.1
    assert "clock" not in imported(time, poses, commands)[1]


def test_a_body_that_answers_for_longer_than_clocks_are_compared_is_no_other_clock(imported):
    """The later, the better its motion is explained, until 3 s: no delay is seen in that."""
    rng = np.random.default_rng(5)
    slow = np.repeat(rng.uniform((-0.3, -1.5), (0.3, 1.5), (40, 2)).round(2), 300, axis=0)
    commands = slow.copy()
    for _ in range(2):
        for k in range(1, len(slow)):
            slow[k] = slow[k - 1] + (slow[k] - slow[k - 1]) * (1 - np.exp(-DT / 5.0))
    time, poses, _ = drive(len(slow) * DT, lag=5.0, commands=slow)
    log = logs.Log("a", time, commands, time >= 0, time, np.unwrap(poses, axis=0))
    assert clocks.lateness([log]).delay <= clocks.ROBOTS
    assert "clock" not in imported(time, poses, commands)[1]


@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_a_pose_that_stands_beside_the_command_that_led_to_it(imported, noise):
    """As where a simulator is logged after each step; the pose before it needs no warning."""
    held = np.repeat(np.random.default_rng(2).uniform(-1, 1, (500, 2)), 3, axis=0)
    time, poses, commands = drive(len(held) * DT, lag=1e-3, commands=held * (0.3, 1.5))
    poses = np.unwrap(poses, axis=0) + np.random.default_rng(3).normal(0, noise, poses.shape)
    before, warnings = imported(time, poses, commands)
    assert warnings == ""
    after = time[:-1], poses[1:], commands[:-1]
    made, warnings = imported(*after)
    assert "is the one after its command" in warnings
    count = min(len(made), len(before)) - 2
    assert made.input_array()[1:count] == pytest.approx(before.input_array()[1:count])
    assert made.output_array()[1:count] == pytest.approx(before.output_array()[1:count], abs=1e-3)
    left, warnings = imported(*after, settings=Settings(delay=0.0))
    assert warnings == ""
    apart = np.abs(left.output_array()[1:count] - before.output_array()[1:count])
    assert np.median(apart[:, 2]) > 0.02


@pytest.mark.parametrize("late", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_clock_of_short_drives_of_four_wheels(seed, late):
    """One of them alone is explained by chance: with 14 terms, at any of 100 shifts."""
    rng, drives = np.random.default_rng(seed), []
    for name in "abcde":
        commands = np.zeros((200, 4))
        for wheel in range(4):
            begins = np.cumsum(rng.integers(6, 75, 40))
            held = np.searchsorted(begins, np.arange(200))
            commands[:, wheel] = rng.uniform(-1, 1, 41)[held]
        speeds, pose, poses = np.zeros(4), np.zeros(3), []
        for command in commands:
            poses.append(pose)
            speeds = speeds + 0.15 * (command - speeds)
            twist = 0.1 * speeds.sum(), 0.0, 0.5 * speeds @ (-1, 1, -1, 1)
            pose = se2.compose(pose, np.array(twist) / 30)
        poses = poses + rng.normal(0, (0.0005, 0.0005, 0.01), (200, 3))
        time = np.arange(200) / 30
        drives.append(logs.Log(name, time, commands, time >= 0, time + late, poses))
    assert clocks.lateness(drives).delay == pytest.approx(late, abs=0.11)


@pytest.mark.slow
def test_a_robots_own_delay_is_left_to_training(imported):
    time, poses, commands = drive(120.0, lag=0.1)
    late = np.vstack([np.repeat(commands[:1], 6, axis=0), commands[:-6]])  # 0.3 s
    poses = drive(120.0, lag=0.1, commands=late)[1]
    _, warnings = imported(time, poses, commands)
    assert warnings == ""
    log = clocks.Log("a", time, commands, time >= 0, time, np.unwrap(poses, axis=0))
    assert clocks.lateness([log]).delay == pytest.approx(0.3, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "conventions"),
    [
        ((1, 1000, 1), {"length": "mm"}),
        ((1, 100, 1), {"length": "cm"}),
        ((1000, 1, 1), {"time": "ms"}),
        ((1000, 1000, 1), {"length": "mm", "time": "ms"}),
        ((1, 1, 180 / np.pi), {"angle": "deg"}),
        ((1000, 100, 180 / np.pi), {"length": "cm", "angle": "deg", "time": "ms"}),
    ],
)
def test_units_that_are_not_what_the_options_say(imported, scale, conventions):
    time, poses, commands = drive()
    expected, _ = imported(time, poses, commands)
    poses = poses * (scale[1], scale[1], scale[2])
    settings = Settings(longest_gap=1000.0, longest=100_000.0) if scale[0] > 1 else None
    _, warnings = imported(scale[0] * time, poses, commands, settings=settings)
    options = " ".join(f"--{name} {unit}" for name, unit in conventions.items())
    assert f"they would with {options}" in warnings
    made, warnings = imported(
        scale[0] * time, poses, commands, conventions=Conventions(**conventions)
    )
    assert warnings == ""
    same(made, expected, 1e-5)


def test_lengths_of_a_robot_of_two_wheels(imported):
    time, poses, commands = drive()
    wheels = np.column_stack([commands @ (1, -0.1), commands @ (1, 0.1)]) * 200  # percent
    _, warnings = imported(time, poses, wheels, "left,right")
    assert warnings == ""
    _, warnings = imported(time, poses * (100, 100, 1), wheels, "left,right")
    assert "they would with --length" in warnings
    _, warnings = imported(time, poses, wheels[:, ::-1], "left,right")
    assert "are left and right exchanged in --columns" in warnings


def test_turns_that_go_the_other_way(imported):
    time, poses, commands = drive()
    expected, _ = imported(time, poses, commands)
    picture = poses * (1, -1, -1)
    _, warnings = imported(time, picture, commands)
    assert "turns the other way than w says: does y point to the right (--y right)?" in warnings
    made, warnings = imported(time, picture, commands, conventions=Conventions(y="right"))
    assert warnings == ""
    same(made, expected)


def test_a_command_whose_sign_is_not_that_of_the_motion(imported):
    time, poses, commands = drive()
    _, warnings = imported(time, poses, commands * (1, -1))
    assert "If only w counts clockwise, change its sign" in warnings
    _, warnings = imported(time, poses, commands * (-1, 1))
    assert "the robot goes backwards where v is above 0" in warnings


@pytest.mark.parametrize("lines", [1, 30, 100])
def test_headings_that_turn_round(imported, lines):
    """Markers that are taken for each other: no row has a wrong turn."""
    time, poses, commands = drive()
    expected, _ = imported(time, poses, commands)
    wrong = poses.copy()
    turned = np.arange(len(time)) // lines % 5 == 3
    wrong[turned, 2] = np.angle(np.exp(1j * (wrong[turned, 2] + np.pi)))
    made, warnings = imported(time, wrong, commands)
    assert f"{turned.sum()} lines, fewer than the others, are left out; --keep" in warnings
    table = expected.table.set_index(["v", "w", "duration"])
    for row in made.table.itertuples():
        right = table.loc[(row.v, row.w, row.duration)]
        assert abs(row.dtheta - float(right["dtheta"])) < 0.02
        assert abs(row.dx - float(right["dx"])) < 0.005
    assert len(made) > 15
    _, warnings = imported(time, wrong, commands, settings=Settings(keep=True))
    assert "turn round" not in warnings
    # A robot that turns quickly, seen rarely, does not turn round.
    rarely = slice(None, None, 40)
    _, warnings = imported(
        time[rarely], poses[rarely], commands[rarely], settings=Settings(longest_gap=5.0)
    )
    assert "turn round" not in warnings


def test_a_command_that_is_never_zero(imported):
    """Pulses of servos: 1500 us mean standing still."""
    time, poses, commands = drive()
    wheels = np.column_stack([commands @ (1, -0.1), commands @ (1, 0.1)]) * 900
    _, warnings = imported(time, poses, wheels.round() + 1500, "left,right")
    assert "0 must mean standing still or straight on; if another value does, subtract" in warnings
    assert warnings.startswith("left is 1")
    # A robot that only drives forwards, from a third of its speed to full speed.
    rng = np.random.default_rng(4)
    forward = np.repeat(rng.uniform((0.1, -1.0), (0.3, 1.0), (60, 2)), 25, axis=0)
    assert imported(*drive(75.0, commands=forward))[1] == ""


def test_a_command_that_is_once_far_larger(imported):
    time, poses, commands = drive()
    commands = commands.copy()
    commands[300:320, 1] = 65535.0
    _, warnings = imported(time, poses, commands, "speed,rate")
    assert "the command rate is up to 65535 in 1." in warnings
    assert "at most 1.47 otherwise" in warnings


def test_lengths_that_may_be_of_two_units(imported):
    time, poses, commands = drive()
    wheels = np.column_stack([commands @ (1, -0.1), commands @ (1, 0.1)]) * 200
    _, warnings = imported(time, poses * (1000, 1000, 1), wheels, "left,right")
    assert warnings.endswith("they would with --length cm or --length mm")


def test_headings_in_radians_that_have_large_steps_are_not_in_degrees(imported):
    """Unwrapped, a sample every second, turning by up to 4 rad from one to the next."""
    rng = np.random.default_rng(2)
    held = np.repeat(rng.uniform((-0.3, -4.0), (0.3, 4.0), (120, 2)), 60, axis=0)
    time, poses, commands = drive(360.0, commands=held)
    poses[:, 2] = np.unwrap(poses[:, 2])
    each = slice(None, None, 20)
    given = time[each], poses[each], commands[each], "left,right"
    assert "--angle" not in imported(*given, settings=Settings(longest_gap=2.0))[1]


def test_nanoseconds_that_are_taken_for_seconds(imported):
    time, poses, commands = drive()
    with pytest.raises(UserError, match=r"samples are 5e\+07 s apart: check --time"):
        imported(time * 1e9, poses, commands)


def test_headings_that_do_not_fit_the_motion(imported):
    time, poses, commands = drive()
    wrong = poses.copy()
    wrong[400:600, 2] = poses[400, 2]  # it froze for 10 s
    made, warnings = imported(time, wrong, commands)
    assert "headings do not fit the way that the robot goes from 2" in warnings
    assert "left out; --keep keeps them" in warnings
    kept, warnings = imported(time, wrong, commands, settings=Settings(keep=True))
    assert "headings" not in warnings
    assert len(kept) > len(made)
    whole, _ = imported(time, poses, commands)
    made, warnings = imported(time, poses + np.array([0, 0, 1.5]), commands)  # it drives sideways
    assert "headings do not fit" not in warnings
    assert len(made) == len(whole)


@pytest.mark.parametrize("wrong", ["turned", "swapped", "mirrored", "clockwise"])
def test_headings_that_fit_nowhere(imported, wrong):
    time, poses, commands = drive()
    x, y, heading = poses.T
    other = {
        "turned": (x, y, heading + np.pi / 2),
        "swapped": (y, x, heading),
        "mirrored": (x, -y, heading),
        "clockwise": (x, y, -heading),
    }[wrong]
    _, warnings = imported(time, np.column_stack(other), commands)
    assert "degrees off its headings (median): are x and y swapped, is one mirrored" in warnings
    assert warnings.count("\n") == 0  # a unit would be the wrong advice
    # With three commands it may go sideways.
    more = np.column_stack([commands, np.roll(commands[:, 0], 7)])
    _, warnings = imported(time, np.column_stack(other), more, "v,w,u")
    assert "headings" not in warnings


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (-1.0, -1.0, -1.0), (0.0, 0.0, None)])
@pytest.mark.parametrize("share", [0.02, 0.2])
def test_the_place_of_a_robot_that_is_lost(imported, place, share):
    time, poses, commands = drive()
    poses[:, :2] += (4.0, 5.0)
    whole, _ = imported(time, poses, commands)
    lost = poses.copy()
    rows = np.random.default_rng(5).random(len(time)) < share
    rows[0] = rows[-1] = share > 0.1
    for column, value in enumerate(place):
        if value is not None:
            lost[rows, column] = value
    made, warnings = imported(time, lost, commands)
    at = f"{rows.sum()} lines have the robot at exactly {place[0]:g}, {place[1]:g} m"
    assert at in warnings
    assert warnings.count("\n") == 0
    assert len(made) >= len(whole) - 2
    # Between poses that are seen it is interpolated.
    largest = np.abs(whole.output_array()[:, :2]).max()
    assert np.abs(made.output_array()[:, :2]).max() < 1.02 * largest
    kept, _ = imported(time, lost, commands, settings=Settings(keep=True))
    assert np.abs(kept.output_array()[:, :2]).max() > 4.0


@pytest.mark.parametrize("begins", [True, False])
def test_a_robot_that_drives_past_the_same_places_or_begins_there_is_not_lost(begins):
    """It drives there and back along a line, in millimetres; most of the time it creeps."""
    drive = np.concatenate([np.arange(0.0, 1.0, 0.05), np.arange(1.0, 1.02, 0.001)])
    rounds = [drive] * 8 if begins else [drive, drive[::-1]] * 8
    x = np.round(np.concatenate(rounds), 3)
    poses = np.column_stack([x, 0 * x, 0 * x])
    result, warnings = without_lost(poses)
    assert warnings == []
    assert (result == poses).all()


def test_many_outliers_at_different_places_are_left_out(imported):
    time, poses, commands = drive()
    whole, _ = imported(time, poses, commands)
    wrong, rng = poses.copy(), np.random.default_rng(6)
    wrong[20::50, :2] += rng.uniform(1.0, 3.0, (len(wrong[20::50]), 2))
    made, warnings = imported(time, wrong, commands)
    assert warnings == ""
    assert np.abs(made.output_array() - whole.output_array()).max() < 0.02


def test_a_robot_that_is_put_back_every_few_seconds(imported):
    time, poses, commands = drive()
    for begin in range(0, len(time), 70):
        own = slice(begin, begin + 70)
        poses[own] = se2.between(poses[begin], poses[own])
    made, warnings = imported(time, poses, commands)
    far = np.hypot(*poses[69:-1:70, :2].T) > 0.1  # others are nearly where they began
    assert far.sum() > 12
    assert f"the pose jumps {far.sum()} times" in warnings
    speed = np.hypot(*made.output_array()[:, :2].T) / made.input_array()[:, -1]
    assert speed.max() < 0.32


def test_commands_that_were_measured_or_never_change(imported):
    time, poses, commands = drive()
    rng = np.random.default_rng(3)
    noisy = np.column_stack([commands, rng.normal(0, 1, len(time))])
    settings = Settings(shortest=0.05)
    _, warnings = imported(time, poses, noisy, "v,w,gyro", settings=settings)
    assert "gyro change with every sample, as measured speeds do" in warnings
    still = np.column_stack([commands, np.full(len(time), 4.0)])
    _, warnings = imported(time, poses, still, "v,w,arm")
    assert warnings == "the command arm never changes: leave it out of --columns"


def test_rows_that_turned_further_than_half_a_turn(tmp_path):
    rng = np.random.default_rng(4)
    duration = rng.uniform(0.5, 4.0, 80)
    rate = rng.uniform(-2.0, 2.0, 80)
    turn = rate * duration + rng.normal(0, 0.05, 80)
    far = int((np.abs(turn) > np.pi).sum())
    for wrapped in (False, True):
        given = np.angle(np.exp(1j * turn)) if wrapped else turn
        moved = se2.exp(np.column_stack([np.full(80, 0.1), np.zeros(80), turn]))
        lines = np.column_stack([rate, duration, moved[:, :2], given])
        path = tmp_path / f"{wrapped}.csv"
        np.savetxt(path, lines, delimiter=",", header="u,duration,dx,dy,dtheta")
        made = import_csv(path, tmp_path / f"d{wrapped}", columns={"u": "u"})
        warnings = "".join(made.meta["warnings"])
        assert ("of 80 commands turned by more than half a turn" in warnings) == wrapped
        if wrapped:
            assert abs(int(warnings.split()[0]) - far) <= 2


# Rows that follow one another


def test_rows_that_follow_one_another_by_hand():
    time = np.arange(13) * 0.05
    commands = np.array([[0], [0], [1], [2], [2], [2], [2], [2], [2], [2], [5], [6], [7]], float)
    poses = np.column_stack([time, 0 * time, 0 * time])
    log = logs.Log("a", time, commands, time >= 0, time, poses)
    rows, left_out = logs.chained_rows_of(log, ("u",), Settings())
    # Held for 0.1 s; then 0.05 s of 1 and of 2 with their mean; 2 for the rest; 5 and 6.
    assert [row["u"] for row in rows] == pytest.approx([0.0, 1.5, 2.0, 5.5])
    assert [row["prev_u"] for row in rows] == pytest.approx([0.0, 0.0, 1.5, 2.0])
    assert [row["duration"] for row in rows] == [0.1, 0.1, 0.3, 0.1]
    assert [row["command"] for row in rows] == [1, 2, 3, 4]
    assert [row["dx"] for row in rows] == pytest.approx([0.1, 0.1, 0.3, 0.1])
    assert [[pose["time"] for pose in row["within"]] for row in rows] == [[], [], [], []]
    assert sum(left_out.values()) == 0
    silent = logs.Log(
        "a", time * 4, commands, time >= 0, time[[0, 2, 6, 12]] * 4, poses[[0, 2, 6, 12]]
    )
    rows, left_out = logs.chained_rows_of(silent, ("u",), Settings(longest_gap=0.9))
    # Poses are silent from 1.2 s to 2.4 s; there 2 is held from 0.6 s to 2 s.
    assert [row["command"] for row in rows] == [1, 2]
    assert left_out["gap"] == 3


@pytest.mark.slow
def test_windows_where_few_commands_were_held(imported):
    rng = np.random.default_rng(7)
    commands = np.repeat(rng.uniform(-1, 1, (600, 2)) * (0.3, 1.5), 2, axis=0)
    time, poses, _ = drive(60.0, commands=commands)
    made, warnings = imported(time, poses, commands)
    assert warnings == ""
    assert made.meta["windows"] is True
    assert len(made) > 500
    assert made.joined.sum() == len(made) - 1
    with pytest.raises(UserError, match=r"no command is held for 0\.5 s"):
        imported(time, poses, commands, settings=Settings(windows=False))
    held, _ = imported(*drive())
    assert held.meta["windows"] is False
    assert held.joined is None
    chained, _ = imported(*drive(), settings=Settings(windows=True))
    assert chained.table["duration"].sum() > held.table["duration"].sum()


def test_poses_that_come_less_often_than_lines(imported):
    time, poses, commands = drive()
    expected, _ = imported(time, poses, commands)
    made, warnings = imported(time, poses[np.arange(len(time)) // 4 * 4], commands)
    assert warnings == ""
    # Without a correction they would be late by half of 0.2 s on average.
    assert np.abs(made.output_array() - expected.output_array()[: len(made)]).mean() < 0.01


def test_a_model_car_driven_by_hand(shared_data, tmp_path):
    names = {"time": "vicon time", "x": "vicon x", "y": "vicon y", "heading": "vicon yaw"}
    columns = {**names, "throttle": "throttle", "steering": "steering"}
    made = import_csv(
        shared_data / "real" / "dart" / "drive-1.csv", tmp_path / "d", columns=columns
    )
    assert made.meta["windows"] is True
    assert made.table["duration"].sum() > 0.98 * 67.8
    assert made.meta["warnings"] == []


def counted_wheels(poses, ticks=3000.0, track=0.2):
    """Return the counts (N, 2) of the wheels, by counters of 16 bits, of a robot with poses."""
    moved = se2.between(poses[:-1], poses[1:])
    turn = np.angle(np.exp(1j * moved[:, 2]))
    ahead = np.cos(turn / 2) * moved[:, 0] + np.sin(turn / 2) * moved[:, 1]
    each = np.stack([ahead - turn * track / 2, ahead + turn * track / 2], 1)
    counts = ticks * (20.0 + np.concatenate([np.zeros((1, 2)), each.cumsum(0)]))
    return np.floor(counts) % 2**16


@pytest.mark.slow
def test_counters_of_wheels_become_how_fast_they_count(imported):
    time, poses, _ = drive(120.0)
    counts = counted_wheels(poses)
    assert np.abs(np.diff(counts, axis=0)).max() > 6e4  # one begins again
    _, raw = imported(time, poses, counts, "left,right")
    assert "--counters left,right" in raw
    made, warnings = imported(time, poses, counts, "left,right", counters=("left", "right"))
    assert warnings == ""
    assert {"name": "left", "unit": "1/s"} in made.meta["inputs"]
    table = made.table
    speed = (table["left"] + table["right"]) / 2 / 3000.0
    turn = (table["right"] - table["left"]) / 3000.0 / 0.2
    off = np.abs(turn * table["duration"] - table["dtheta"])
    assert off.max() < 0.02
    assert np.abs(speed * table["duration"] - table["dx"]).max() < 0.002


@pytest.mark.slow
def test_a_counter_that_was_set_to_zero_has_no_rate_there(imported):
    time, poses, _ = drive(120.0)
    counts = counted_wheels(poses) + 1e6
    given = {"names": "left,right", "counters": ("left", "right")}
    expected, _ = imported(time, poses, counts, **given)
    reset = counts.copy()
    reset[len(counts) // 2 :] -= counts[len(counts) // 2] - 7
    made, warnings = imported(time, poses, reset, **given)
    assert warnings == ""
    largest = np.abs(expected.input_array()).max(0)
    assert (np.abs(made.input_array()).max(0) <= 1.01 * largest).all()


@pytest.mark.slow
def test_commands_that_were_sent_are_no_counters(imported):
    for seed in range(3):
        assert "counters" not in imported(*drive(60.0, seed=seed))[1]
    # Neither are many commands that hardly ever change, each for a moment of its own.
    time, poses, _ = drive(60.0)
    rare = np.zeros((len(time), 24))
    rare[np.arange(len(time)), np.arange(len(time)) // 50] = 1.0
    assert "counters" not in imported(time, poses, rare, ",".join(f"c{n}" for n in range(24)))[1]


def test_counters_that_do_not_exist_or_are_not_of_a_log_are_refused(imported, tmp_path):
    time, poses, commands = drive(20.0)
    with pytest.raises(UserError, match="a counter is given for ticks, which is not a command"):
        imported(time, poses, commands, counters=("ticks",))
    with pytest.raises(UserError, match="a counter is given for an empty name, which"):
        imported(time, poses, commands, counters=("",))
    rows = tmp_path / "rows.csv"
    rows.write_text("duration,v,w,dx,dy,dtheta\n" + "1.0,0.1,0,0.1,0,0\n" * 9)
    with pytest.raises(UserError, match="--counters is for logs"):
        import_csv(rows, tmp_path / "out", counters=("v",))


@pytest.mark.parametrize("form", ["rare lines", "empty", "repeated"])
def test_places_that_are_known_once_in_a_second(imported, form):
    commands = np.repeat(np.random.default_rng(1).uniform((0.1, -0.2), (0.3, 0.2), (20, 2)), 60, 0)
    time, poses, commands = drive(seconds=60.0, lag=2.0, commands=commands)
    plain, _ = imported(time, poses, commands)
    known = np.arange(len(time)) % 20 == 0
    if form == "rare lines":
        time, poses, commands = time[known], poses[known], commands[known]
    elif form == "repeated":
        poses = poses[known].repeat(20, axis=0)
    else:
        poses[~known] = np.nan
    made, warnings = imported(time, poses, commands)
    assert warnings.startswith("samples or poses are 1 s apart, so gaps of up to 2.5 s are allowed")
    assert made.meta["settings"]["longest_gap"] == 2.5
    assert len(plain) == 19
    # The last one ends after the last place.
    assert len(made) >= 18
    assert made.output_array()[:18] == pytest.approx(plain.output_array()[:18], abs=1e-6)
    with pytest.raises(UserError):
        imported(time, poses, commands, settings=Settings(longest_gap=0.5))


def test_samples_that_are_very_far_apart_are_refused(imported):
    time, poses, commands = drive(seconds=20.0)
    with pytest.raises(UserError, match=r"samples are 2\.5 s apart, more than --longest-gap 0\.5"):
        imported(50.0 * time, poses, commands)
