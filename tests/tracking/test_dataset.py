"""Displacements are correct, unusable rows are left out and counted, bad files are named."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base import se2
from neurosim.base.errors import FileError, UserError
from neurosim.cli.dataset import dataset as command_line
from tracking.datasets import dataset as dataset_module
from tracking.datasets.dataset import MOTOR_INPUTS, Dataset, build, cutting, make
from tracking.datasets.displacements import Settings, Track, fit_pose
from tracking.datasets.recordings import Poses, Recording
from tracking.datasets.within import WITHIN, choose_instants

TRACK_WIDTH, FULL_SPEED = 0.13, 0.5
DELAY = 0.04  # motors answer later than one frame at 30 per second
FRAME = 1 / 30


def twist(left, right):
    """Body twist of ideal wheels, in percent of full speed."""
    v = FULL_SPEED * (left + right) / 200
    return np.array([v, 0.0, FULL_SPEED * (right - left) / 100 / TRACK_WIDTH])


def drive(lines, until, delay=DELAY, start=(0.1, -0.2, 7.0)):
    """Return the pose as a function of time; ``lines`` are (time, left, right)."""
    changes = [(time + delay, twist(left, right)) for time, left, right in lines]
    knots, poses, speeds = [-10.0], [np.array(start)], [np.zeros(3)]
    for time, speed in changes:
        poses.append(se2.compose(poses[-1], se2.exp(speeds[-1] * (time - knots[-1]))))
        knots.append(time)
        speeds.append(speed)

    def pose(time):
        i = int(np.searchsorted(knots, time, side="right")) - 1
        return se2.compose(poses[i], se2.exp(speeds[i] * (time - knots[i])))

    return pose


def write_recording(path, sessions, *, edit=None, until=None, robot=None):
    """Write a recording; each session is a list of (command, kind, time, left, right, duration)."""
    recording = Recording.create(path, {"robot": {"kind": "test", **(robot or {})}})
    columns = ([], [], [], [], [])
    with recording.command_log() as log:
        for lines in sessions:
            session = recording.begin_session(video=None)
            for command, kind, time, left, right, duration in lines:
                log.append(session, command, kind, time, left, right, duration)
            motor = [(t, a, b) for _, k, t, a, b, _ in lines if not k.startswith("lamp")]
            end = until or lines[-1][2] + 0.5
            pose = drive(motor, end)
            times = np.arange(-0.3, end, FRAME) + 0.011
            for column, values in zip(
                columns,
                (
                    np.full(len(times), session),
                    np.arange(len(times)),
                    times,
                    np.array([pose(t) for t in times]),
                    np.full(len(times), 0.9),
                ),
                strict=True,
            ):
                column.append(values)
    poses = Poses(*(np.concatenate(column) for column in columns))
    if edit is not None:
        edit(poses)
    recording.write_poses(poses)
    return path


#: A session of four commands, the last one stopped.
SESSION = [
    (None, "lamp-on", 0.0, None, None, None),
    (None, "lamp-off", 0.5, None, None, None),
    (1, "command", 1.0, 40.0, 20.0, 1.0),
    (2, "command", 2.0, -30.0, -30.0, 2.0),
    (3, "command", 4.0, 0.0, 0.0, 0.5),
    (4, "command", 4.5, 25.0, 50.0, 3.0),
    (None, "stop", 7.5, 0.0, 0.0, None),
]


def test_rows_hold_the_displacement_in_the_robots_frame(tmp_path):
    path = write_recording(tmp_path / "rec", [SESSION])
    dataset = build([path], tmp_path / "out")
    assert dataset.table["command"].tolist() == [1, 2, 3, 4]
    assert dataset.input_array().tolist() == [
        [0, 0, 40, 20, 1],
        [40, 20, -30, -30, 2],
        [-30, -30, 0, 0, 0.5],
        [0, 0, 25, 50, 3],
    ]
    # By hand: the previous command continues for the delay, then the command itself.
    previous = np.zeros(2)
    for row, (left, right, duration) in zip(
        dataset.output_array(), dataset.input_array()[:, 2:], strict=True
    ):
        before = se2.exp(twist(*previous) * DELAY)
        expected = se2.compose(before, se2.exp(twist(left, right) * (duration - DELAY)))
        assert row == pytest.approx(expected, abs=5e-6)
        previous = (left, right)
    assert set(dataset.table["quality"]) == {0.9}
    assert sum(dataset.meta["left_out"].values()) == 0


def test_poses_within_commands_are_those_of_the_frames(tmp_path):
    path = write_recording(tmp_path / "rec", [SESSION])
    dataset = build([path], tmp_path / "out")
    pose = drive([(t, a, b) for _, kind, t, a, b, _ in SESSION if kind[:4] != "lamp"], 8.0)
    starts = [1.0, 2.0, 4.0, 4.5]
    for row, time, *moved in dataset.within.itertuples(index=False):
        expected = se2.between(pose(starts[row]), pose(starts[row] + time))
        assert moved == pytest.approx(expected, abs=5e-6)
    # By hand: frames are at 0.011 + n / 30 - 0.3 s. Wanted are 0.125, 0.25, 0.375, 0.5 s and
    # fifths of the second 0.2, 0.4, 0.6, 0.8 s.
    frames = 0.011 - 0.3 + FRAME * np.arange(300) - 1.0
    wanted = [0.125, 0.2, 0.25, 0.375, 0.4, 0.5, 0.6, 0.8]
    nearest = [frames[np.abs(frames - time).argmin()] for time in wanted]
    first = dataset.within[dataset.within["row"] == 0]
    assert first["time"].tolist() == pytest.approx(nearest, abs=1e-6)
    # Left 40 %, right 20 %, for the time since the motors answered: an arc to the right.
    arc = se2.exp(twist(40, 20) * (first["time"].to_numpy() - DELAY)[:, None])
    assert first[["dx", "dy", "dtheta"]].to_numpy() == pytest.approx(arc, abs=5e-6)


def test_frames_in_which_the_robot_was_lost_are_no_poses_within(tmp_path):
    def edit(poses):
        gone = (poses.time > 2.1) & (poses.time < 2.3)
        poses.pose[gone] = np.nan

    dataset = build([write_recording(tmp_path / "rec", [SESSION], edit=edit)], tmp_path / "out")
    time = dataset.within.loc[dataset.within["row"] == 1, "time"]
    assert not time.between(0.1, 0.3).any()
    assert time.tolist()[:2] == pytest.approx([0.011 + 2 / 30, 0.011 + 9 / 30], abs=1e-6)


def test_poses_within_count_from_when_the_motors_answered(tmp_path):
    rng = np.random.default_rng(1)
    speeds = rng.uniform(-50, 50, (60, 2)).round(1)
    lines = [(n, "command", 1.0 * n, *pair, 1.0) for n, pair in enumerate(speeds.tolist(), 1)]
    lines.append((None, "stop", 61.0, 0.0, 0.0, None))
    path = write_recording(tmp_path / "rec", [lines])
    late = build([path], tmp_path / "late")
    (delay,) = late.meta["motor_delays"]
    assert delay["corrected"]
    sent = build([path], tmp_path / "sent", correct_delay=False)
    begin = {False: 5.0, True: 5.0 + delay["delay"]}
    pose = drive([line[2:5] for line in lines], 62.0)
    for dataset, corrected in ((sent, False), (late, True)):
        assert dataset.table["command"][4] == 5
        for _, time, *moved in dataset.within.query("row == 4").itertuples(index=False):
            expected = se2.between(pose(begin[corrected]), pose(begin[corrected] + time))
            assert moved == pytest.approx(expected, abs=2e-3)


@given(
    st.lists(st.integers(-10, 200), unique=True, max_size=150),
    st.floats(0.1, 4.0),
)
@settings(max_examples=60, deadline=None)
def test_the_choice_of_instants(frames, duration):
    times = np.sort(np.array(frames, float)) * FRAME + 0.004
    chosen = choose_instants(times, duration)
    inside = (times > 1e-6) & (times < duration - 1e-6)
    assert len(chosen) <= WITHIN
    assert (np.diff(chosen) > 0).all()
    assert inside[chosen].all()
    assert (len(chosen) > 0) == inside.any()
    if inside.sum() > 3 * duration / FRAME - 3:
        assert len(chosen) >= 4


def test_round_trip_and_sources(tmp_path):
    path = write_recording(tmp_path / "rec", [SESSION])
    written = build([path], tmp_path / "out")
    read = Dataset.read(tmp_path / "out")
    pd.testing.assert_frame_equal(read.table, written.table)
    pd.testing.assert_frame_equal(read.within, written.within)
    assert read.meta["within"] == len(read.within) > 20
    assert (read.inputs, read.outputs) == (tuple(MOTOR_INPUTS), ("dx", "dy", "dtheta"))
    assert [source["path"] for source in read.meta["sources"]] == [
        "rec/commands.csv",
        "rec/poses.csv",
    ]
    assert all(len(source["sha256"]) == 64 for source in read.meta["sources"])
    assert read.meta["rows"] == 4
    build([path], tmp_path / "again")
    for name in ("dataset.csv", "dataset.json", "within.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_a_turn_of_more_than_a_full_circle_stays_one(tmp_path):
    lines = [(1, "command", 1.0, -50.0, 50.0, 3.0), (None, "stop", 4.0, 0.0, 0.0, None)]
    dataset = build([write_recording(tmp_path / "rec", [lines])], tmp_path / "out")
    assert dataset.output_array()[0, 2] == pytest.approx(0.5 / 0.13 * (3.0 - DELAY), abs=1e-4)


def test_poses_of_what_may_not_be_the_robot_make_no_rows_unless_they_are_wanted(tmp_path):
    def edit(poses):
        poses.doubtful[(poses.time > 2.4) & (poses.time < 3.0)] = True

    path = write_recording(tmp_path / "rec", [SESSION], edit=edit)
    dataset = build([path], tmp_path / "out")
    assert dataset.table["command"].tolist() == [1, 3, 4]
    assert dataset.meta["left_out"]["doubtful"] == 1
    done = CliRunner().invoke(command_line, [str(path), "-o", str(tmp_path / "all"), "--doubtful"])
    assert done.exit_code == 0, done.exception
    assert len(Dataset.read(tmp_path / "all")) == 4
    done = CliRunner().invoke(command_line, [str(path), "-o", str(tmp_path / "b")])
    assert "1 doubtful" in done.stdout


def test_commands_that_were_cut_or_ended_otherwise_are_counted(tmp_path):
    first = [
        (1, "command", 1.0, 40.0, 40.0, 2.0),
        (1, "cut", 1.8, 0.0, 0.0, None),
        (None, "manoeuvre", 1.8, -30.0, -20.0, 1.0),
        (2, "command", 2.8, 20.0, 30.0, 1.0),
        (3, "command", 3.8, 20.0, 20.0, 1.0),
        (4, "command", 5.5, 20.0, 20.0, 1.0),
        (None, "stop", 5.9, 0.0, 0.0, None),
        (5, "command", 7.0, 10.0, 10.0, 1.0),
    ]
    second = [(6, "command", 1.0, 10.0, 20.0, 1.0), (None, "stop", 2.0, 0.0, 0.0, None)]
    dataset = build([write_recording(tmp_path / "rec", [first, second])], tmp_path / "out")
    assert dataset.table["command"].tolist() == [2, 6]
    # After the manoeuvre its speeds are the previous ones; a new session starts from rest.
    assert dataset.input_array()[:, :2].tolist() == [[-30, -20], [0, 0]]
    counts = {"cut": 1, "incomplete": 2, "clock": 1, "lost track": 0, "jump": 0, "doubtful": 0}
    assert dataset.meta["left_out"] == counts
    straight = dataset.meta["cutting"]["by_class"]["equal"]
    assert straight == {"sent": 4, "cut": 1, "completed": 0}


def test_a_lost_track_leaves_out_the_commands_it_touches(tmp_path):
    def lose(first, last):
        def edit(poses):
            gone = (poses.time > first) & (poses.time < last)
            poses.pose[gone] = np.nan
            poses.quality[gone] = 0

        return edit

    near = write_recording(tmp_path / "near", [SESSION], edit=lose(1.95, 2.05))
    dataset = build([near], tmp_path / "near-out")
    assert dataset.table["command"].tolist() == [3, 4]
    assert dataset.meta["left_out"]["lost track"] == 2
    long = write_recording(tmp_path / "long", [SESSION], edit=lose(2.5, 3.2))
    dataset = build([long], tmp_path / "long-out")
    assert dataset.table["command"].tolist() == [1, 3, 4]
    short = write_recording(tmp_path / "short", [SESSION], edit=lose(2.5, 2.7))
    assert len(build([short], tmp_path / "short-out")) == 4


def test_a_jump_leaves_out_its_command_only(tmp_path):
    def edit(poses):
        poses.pose[np.searchsorted(poses.time, 3.0), 0] += 0.08

    path = write_recording(tmp_path / "rec", [SESSION], edit=edit)
    dataset = build([path], tmp_path / "out")
    assert dataset.table["command"].tolist() == [1, 3, 4]
    assert dataset.meta["left_out"]["jump"] == 1
    relaxed = build([path], tmp_path / "all", settings=Settings(max_speed=10.0))
    assert len(relaxed) == 4


def test_a_video_that_ends_early(tmp_path):
    path = write_recording(tmp_path / "rec", [SESSION], until=5.0)
    dataset = build([path], tmp_path / "out")
    assert dataset.table["command"].tolist() == [1, 2, 3]
    assert dataset.meta["left_out"]["incomplete"] == 1
    assert "warnings" not in dataset.meta


def test_a_session_that_was_not_tracked_is_named(tmp_path):
    path = write_recording(tmp_path / "rec", [SESSION, SESSION])
    recording = Recording(path)
    recording.write_poses(recording.poses().of_session(1))
    (warning,) = build([path], tmp_path / "out").meta["warnings"]
    assert warning.startswith("rec: session 2: no pose from 4 commands at its end")
    assert warning.endswith("run neurosim track again")


def test_no_usable_command_is_an_error_that_says_why(tmp_path):
    path = write_recording(tmp_path / "rec", [SESSION], until=1.5)
    with pytest.raises(UserError, match=r"no usable command \(left out: 4 incomplete\)"):
        build([path], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_clock_that_goes_backwards_is_named_with_its_line(tmp_path):
    path = write_recording(tmp_path / "rec", [SESSION])
    text = (path / "commands.csv").read_text().replace("1,4,command,4.5", "1,4,command,3.9")
    (path / "commands.csv").write_text(text)
    with pytest.raises(FileError, match=r"commands\.csv, line 7.*backwards"):
        build([path], tmp_path / "out")


def test_recordings_named_twice_alike_or_not_tracked(tmp_path):
    first = write_recording(tmp_path / "a" / "rec", [SESSION])
    second = write_recording(tmp_path / "b" / "rec", [SESSION])
    with pytest.raises(UserError, match="named twice"):
        build([first, first], tmp_path / "out")
    assert build([first, second], tmp_path / "out").table["recording"].nunique() == 2
    (second / "poses.csv").unlink()
    with pytest.raises(FileError, match="neurosim track"):
        build([second], tmp_path / "other")
    with pytest.raises(UserError, match="not empty"):
        build([first], tmp_path / "out")
    with pytest.raises(UserError, match="at least one"):
        build([], tmp_path / "none")


@pytest.fixture
def folder(tmp_path):
    rows = [
        {"recording": "r", "command": i, "prev_v": 0.0, "v": 0.1 * i, "duration": 1.0}
        | {"dx": 0.1 * i, "dy": 0.0, "dtheta": 0.0, "quality": 1.0}
        for i in range(1, 6)
    ]
    units = {"prev_v": "m/s", "v": "m/s", "duration": "s"}
    make(rows, units, sources=[], left_out={}, settings={}).write(tmp_path / "data")
    return tmp_path / "data"


def test_other_inputs_and_the_split_in_time(folder):
    dataset = Dataset.read(folder)
    assert dataset.inputs == ("prev_v", "v", "duration")
    assert dataset.input_array().shape == (5, 3)
    earlier, later = dataset.split(0.2)
    assert earlier.table["command"].tolist() == [1, 2, 3, 4]
    assert later.table["command"].tolist() == [5]
    assert (earlier.meta["rows"], later.meta["rows"]) == (4, 1)
    with pytest.raises(UserError, match="1 row, too few"):
        later.split(0.2)
    with pytest.raises(UserError, match="between 0 and 1"):
        dataset.split(1.0)


@given(st.integers(2, 6000), st.sampled_from([0.1, 0.2, 0.25, 0.5]))
@settings(max_examples=50, deadline=None)
def test_the_split_holds_out_its_share(n, held_out):
    table = pd.DataFrame({"command": np.arange(n)})
    dataset = Dataset(table, (), (), {})
    if math.floor(round(n * (1 - held_out), 6)) == 0:
        return
    earlier, later = dataset.split(held_out)
    assert len(earlier) + len(later) == n
    assert len(later) == math.ceil(round(n * held_out, 6))
    assert earlier.table["command"].max() < later.table["command"].min()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("r,2,0.0", "r,2,fast", r"dataset\.csv, line 3, field 'prev_v': expected a finite number"),
        ("r,2,0.0", "r,2,nan", r"line 3, field 'prev_v'"),
        ("r,2,0.0", "r,2,", r"line 3, field 'prev_v'"),
        (",dtheta,", ",turn,", r"field 'dtheta': this column is missing"),
        ("r,5,", "r,5.5,", r"line 6, field 'command': expected a whole number"),
        ("r,2,0.0,0.2,1.0", "r,2,0.0,0.2,0.0", r"line 3, field 'duration': expected a number abo"),
    ],
)
def test_bad_csv_is_named_by_line_and_field(folder, old, new, message):
    path = folder / "dataset.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(FileError, match=message):
        Dataset.read(folder)


def test_datasets_without_rows_or_cut_short(folder, tmp_path):
    lines = (folder / "dataset.csv").read_text().splitlines(keepends=True)
    (folder / "dataset.csv").write_text("".join(lines[:-1]))
    with pytest.raises(FileError, match=r"4 rows where its JSON says 5"):
        Dataset.read(folder)
    (folder / "dataset.csv").write_text(lines[0])
    with pytest.raises(FileError, match="holds 0 rows where"):
        Dataset.read(folder)
    with pytest.raises(FileError, match="no such dataset"):
        Dataset.read(tmp_path / "nowhere")


@pytest.fixture
def seen(folder, tmp_path):
    """The dataset of ``folder`` with poses within its first, third and fourth command."""
    instants = {0: (0.5,), 2: (0.25, 0.5, 1.0), 3: (0.75,)}
    rows = [
        row
        | {"within": [{"time": t, "dx": t, "dy": 0.0, "dtheta": -t} for t in instants.get(n, ())]}
        for n, row in enumerate(Dataset.read(folder).table.to_dict("records"))
    ]
    units = {"prev_v": "m/s", "v": "m/s", "duration": "s"}
    make(rows, units, sources=[], left_out={}, settings={}).write(tmp_path / "seen")
    return tmp_path / "seen"


def test_poses_within_go_with_their_rows(seen, tmp_path):
    dataset = Dataset.read(seen)
    assert dataset.within.columns.tolist() == ["row", "time", "dx", "dy", "dtheta"]
    assert dataset.within["row"].tolist() == [0, 2, 2, 2, 3]
    earlier, later = dataset.split(0.6)
    assert earlier.within["row"].tolist() == [0]
    assert later.within["row"].tolist() == [0, 0, 0, 1]
    assert later.within["time"].tolist() == [0.25, 0.5, 1.0, 0.75]
    assert (earlier.meta["within"], later.meta["within"]) == (1, 4)
    last = dataset.part(slice(-2, None))
    assert (last.table["command"].tolist(), last.within["row"].tolist()) == ([4, 5], [0])
    later.write(tmp_path / "later")
    pd.testing.assert_frame_equal(Dataset.read(tmp_path / "later").within, later.within)
    with pytest.raises(ValueError, match="step 1"):
        dataset.part(slice(None, None, 2))


def test_a_dataset_without_poses_within(folder, seen):
    assert not (folder / "within.csv").exists()
    dataset = Dataset.read(folder)
    assert (len(dataset.within), dataset.meta["within"]) == (0, 0)
    assert dataset.within.dtypes.tolist() == Dataset.read(seen).within.dtypes.tolist()
    document = json.loads((folder / "dataset.json").read_text())
    del document["within"]  # as versions without them wrote it
    (folder / "dataset.json").write_text(json.dumps(document))
    assert Dataset.read(folder).meta["within"] == 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "3,0.75",
            "5,0.75",
            r"within\.csv, line 6, field 'row': expected a row of dataset.*0 to 4",
        ),
        ("0,0.5", "-1,0.5", r"within\.csv, line 2, field 'row': expected a row of dataset"),
        ("3,0.75", f"{10**30},0.75", r"line 6, field 'row': expected a whole number"),
        ("3,0.75", "1,0.75", r"line 6, field 'row': expected rows in order"),
        ("3,0.75", "3.5,0.75", r"line 6, field 'row': expected a whole number"),
        ("3,0.75", "3,1.01", r"line 6, field 'time': expected at most the duration"),
        ("2,0.25", "2,0.0", r"line 3, field 'time': expected a number above 0"),
        ("2,0.5,", "2,0.25,", r"line 4, field 'time': expected times that increase"),
        ("2,0.5,0.5", "2,0.5,nan", r"line 4, field 'dx': expected a finite number"),
        (",dtheta", ",turn", r"field 'dtheta': this column is missing"),
        ("3,0.75,0.75,0.0,-0.75\n", "", r"within\.csv: holds 4 rows where its JSON says 5"),
    ],
)
def test_bad_poses_within_are_named(seen, old, new, message):
    path = seen / "within.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(FileError, match=message):
        Dataset.read(seen)


def test_poses_within_that_are_gone(seen):
    (seen / "within.csv").unlink()
    with pytest.raises(FileError, match=r"within\.csv: no such file"):
        Dataset.read(seen)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("version", 3, "reads version 2, found 3"),
        ("format", "neurosim-simulator", "expected 'neurosim-dataset'"),
        ("inputs", ["left"], r"field 'inputs\[0\]': expected an object"),
        ("inputs", [], "expected a list of {name, unit}"),
        ("inputs", [{"name": "v"}, {"name": "v"}], "names a column twice"),
        ("outputs", [{"name": "dx"}], "expected dx, dy, dtheta"),
        (
            "within",
            "many",
            "'within': expected a whole number from 0 to 1,000,000,000, found",
        ),
        ("within", -1, "field 'within': expected a whole number from 0"),
    ],
)
def test_bad_json_is_named_by_field(folder, key, value, message):
    path = folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(FileError, match=message):
        Dataset.read(folder)


@given(
    st.tuples(*[st.floats(-2, 2)] * 2, st.floats(-20, 20)),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.05, 0.05), st.floats(-8, 8)),
    st.lists(st.floats(-0.2, 0.05), min_size=3, max_size=8, unique_by=lambda t: round(t, 3)),
)
@settings(max_examples=60, deadline=None)
def test_the_fit_is_exact_on_motion_of_constant_twist(pose, body_twist, times):
    times = np.array(times)
    poses = se2.compose(np.array(pose), se2.exp(np.array(body_twist) * times[:, None]))
    assert fit_pose(times, poses) == pytest.approx(np.array(pose), abs=1e-7)


def test_the_fit_beats_interpolation_and_has_no_bias():
    # Wheels with a delay and a lag of their own, tracked with noise; Monte Carlo.
    rng = np.random.default_rng(3)
    lag, noise = 0.1, np.array([0.001, 0.001, 0.005])
    fine = np.arange(-1.0, 0.3, 0.001)
    speed = np.where(fine < 0.03, 0.25, 0.25 - 0.5 * (1 - np.exp(-(fine - 0.03) / lag)))
    x = np.cumsum(speed) * 0.001
    x -= np.interp(0.0, fine, x)
    fitted, interpolated = [], []
    for _ in range(400):
        times = np.arange(-0.5, 0.2, FRAME) + rng.uniform(0, FRAME)
        poses = np.zeros((len(times), 3))
        poses[:, 0] = np.interp(times, fine, x)
        poses += noise * rng.standard_normal(poses.shape)
        track = Track(times, poses, np.ones(len(times)))
        fitted.append(track.pose_at(0.0)[0])
        interpolated.append([np.interp(0.0, times, poses[:, i]) for i in range(3)])
    fitted, interpolated = np.array(fitted), np.array(interpolated)
    assert abs(fitted[:, 0].mean()) < 3e-4
    assert fitted.std(axis=0) == pytest.approx(0.75 * interpolated.std(axis=0), rel=0.2)


def test_the_cutting_report():
    sent = [
        {"forward": 50.0, "turn": 0.0, "duration": 2.0, "fate": "cut", "attempt": 1},
        {"forward": 50.0, "turn": 0.0, "duration": 2.0, "fate": "completed", "attempt": 2},
        {"forward": -20.0, "turn": 0.0, "duration": 1.0, "fate": "completed", "attempt": 1},
        {"forward": 0.0, "turn": 0.0, "duration": 1.2, "fate": "completed", "attempt": 1},
        {"forward": 0.0, "turn": -10.0, "duration": 0.5, "fate": "other", "attempt": 1},
    ]
    report = cutting(sent)
    assert report["by_class"] == {
        "random": {"sent": 1, "cut": 0, "completed": 0},
        "equal": {"sent": 3, "cut": 1, "completed": 2},
        "stop": {"sent": 1, "cut": 0, "completed": 1},
    }
    assert report["by_duration"] == [
        {"from": 0.5, "to": 1.0, "sent": 1, "cut": 0, "completed": 0},
        {"from": 1.0, "to": 1.5, "sent": 2, "cut": 0, "completed": 2},
        {"from": 2.0, "to": 2.5, "sent": 2, "cut": 1, "completed": 1},
    ]
    assert report["equal_reach"] == {
        "unit": "% s",
        "sampled": 60.0,
        "completed_first": 20.0,
        "completed": 60.0,
        "ratio_first": pytest.approx(1 / 3),
        "ratio": 1.0,
    }
    assert dataset_module.cutting([])["equal_reach"]["ratio"] is None


def test_settings_must_be_positive():
    with pytest.raises(UserError, match=r"max_speed: expected a number from 0.001"):
        Settings(max_speed=0.0)


def test_recordings_of_different_robots(tmp_path):
    names = [{"address": "1"}, {"address": "1", "version": "newer"}, {"address": "2"}]
    paths = [
        write_recording(tmp_path / f"r{place}", [SESSION], robot=robot)
        for place, robot in enumerate(names)
    ]
    assert len(build(paths[:2], tmp_path / "same")) == 2 * len(build(paths[:1], tmp_path / "one"))
    with pytest.raises(UserError, match=r"r0 and .*r2 are of different robots \(address: '1' and"):
        build(paths, tmp_path / "mixed")
    assert not (tmp_path / "mixed").exists()
    assert len(build(paths, tmp_path / "mixed", mixed=True)) == 3 * len(
        build(paths[:1], tmp_path / "again")
    )
