"""CSV files become rows that were worked out by hand."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neurosim.base import se2
from neurosim.base.errors import FileError, UserError
from neurosim.training.train import MIN_ROWS
from tracking.datasets.csv_files import Conventions, import_csv
from tracking.datasets.dataset import FEWEST_ROWS, Dataset
from tracking.datasets.logs import Settings
from tracking.datasets.mrclam import import_mrclam

TWIST = np.array([0.2, 0.0, 0.5])


def write(path, header, rows, delimiter=","):
    lines = [delimiter.join(map(str, row)) for row in (header, *rows)]
    Path(path).write_text("\n".join(lines) + "\n")
    return path


def log_lines(until=5.0, change=1.0, start=(1.0, -2.0, 3.0), dt=0.1):
    """A robot that stands, and from ``change`` on moves by TWIST at once."""
    lines = []
    for n in range(round(until / dt) + 1):
        time = n * dt
        moving = time > change - 1e-9
        pose = se2.compose(np.array(start), se2.exp(TWIST * max(time - change, 0.0)))
        lines.append([round(time, 3), *pose.round(9), *((0.2, 0.5) if moving else (0.0, 0.0))])
    return lines


HEADER = ("time", "x", "y", "heading", "v", "w")


def test_a_log_by_hand(tmp_path):
    path = write(tmp_path / "log.csv", HEADER, log_lines())
    dataset = import_csv(path, tmp_path / "d")
    # It stood for a second: its earlier motion is unknown. It moves for 4 s: pieces of 3 s and 1 s.
    assert dataset.inputs == ("prev_v", "prev_w", "v", "w", "duration")
    assert dataset.input_array().tolist() == [[0, 0, 0.2, 0.5, 3], [0.2, 0.5, 0.2, 0.5, 1]]
    assert dataset.output_array() == pytest.approx(se2.exp(TWIST * [[3.0], [1.0]]), abs=1e-8)
    assert dataset.meta["left_out"] == {"too short": 0, "first": 1, "gap": 0}
    # Of the first: 0.125, 0.25, 0.375, 0.5 s and 0.6, 1.2, 1.8, 2.4 s, at samples of 0.1 s.
    first = dataset.within[dataset.within["row"] == 0]
    assert first["time"].tolist() == [0.1, 0.2, 0.4, 0.5, 0.6, 1.2, 1.8, 2.4]
    expected = se2.exp(TWIST * first["time"].to_numpy()[:, None])
    assert first[["dx", "dy", "dtheta"]].to_numpy() == pytest.approx(expected, abs=1e-6)
    units = [each["unit"] for each in dataset.meta["inputs"]]
    assert units == ["m/s", "rad/s", "m/s", "rad/s", "s"]
    read = Dataset.read(tmp_path / "d")
    pd.testing.assert_frame_equal(read.table, dataset.table)
    pd.testing.assert_frame_equal(read.within, dataset.within)


def test_units_and_frames_of_a_log(tmp_path):
    expected = import_csv(write(tmp_path / "si.csv", HEADER, log_lines()), tmp_path / "si")
    lines = [
        # As in a picture: y to the right, clockwise headings from 0 to 360 degrees; microseconds.
        [round(1e6 * t), 1000 * x, -1000 * y, np.degrees(-theta) % 360, v, w]
        for t, x, y, theta, v, w in log_lines()
    ]
    names = ("t", "column", "row", "yaw", "v", "w")
    dataset = import_csv(
        write(tmp_path / "picture.csv", names, lines),
        tmp_path / "d",
        columns={"time": "t", "x": "column", "y": "row", "heading": "yaw"},
        conventions=Conventions(length="mm", angle="deg", time="us", y="right"),
    )
    assert dataset.input_array() == pytest.approx(expected.input_array())
    assert dataset.output_array() == pytest.approx(expected.output_array(), abs=1e-8)
    within = dataset.within.to_numpy()
    assert within == pytest.approx(expected.within.to_numpy(), abs=2e-6)
    assert dataset.meta["warnings"] == []


def test_unix_times_in_nanoseconds(tmp_path):
    lines = [[1_700_000_000_000_000_000 + round(1e9 * t), *rest] for t, *rest in log_lines()]
    path = write(tmp_path / "log.csv", HEADER, lines)
    dataset = import_csv(path, tmp_path / "d", conventions=Conventions(time="ns"))
    assert dataset.table["duration"].tolist() == pytest.approx([3.0, 1.0], abs=1e-6)


def test_poses_not_seen(tmp_path):
    lines = log_lines()
    for n, gone in ((12, "nan"), (13, ""), (16, "NaN"), (17, "None")):
        lines[n][1] = gone  # 0.2, 0.3, 0.6, 0.7 s after the command began
    dataset = import_csv(write(tmp_path / "short.csv", HEADER, lines), tmp_path / "short")
    first = dataset.within[dataset.within["row"] == 0]
    # 0.6 s is as near to 0.5 s as to 0.8 s, and each counts once.
    assert first["time"].tolist() == [0.1, 0.4, 0.5, 1.2, 1.8, 2.4]
    assert dataset.output_array() == pytest.approx(se2.exp(TWIST * [[3.0], [1.0]]), abs=1e-8)
    for n in range(20, 26):
        lines[n][3] = ""
    path = write(tmp_path / "long.csv", HEADER, lines)
    dataset = import_csv(path, tmp_path / "long")
    assert dataset.table["duration"].tolist() == [1.0]
    assert dataset.meta["left_out"] == {"too short": 0, "first": 1, "gap": 1}
    longer = import_csv(path, tmp_path / "longer", settings=Settings(longest_gap=0.8))
    assert len(longer) == 2


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " ", ", ", "  "])
def test_delimiters_remarks_and_byte_order_marks(tmp_path, delimiter):
    path = write(tmp_path / "log.csv", HEADER, log_lines(), delimiter)
    expected = import_csv(path, tmp_path / "plain").output_array()
    text = path.read_text()
    header, numbers = text.split("\n", 1)
    others = {
        "bom": b"\xef\xbb\xbf" + text.encode(),
        "windows": text.replace("\n", "\r\n").encode(),
        "remarks": f"# robot 7\n\n# indoors\n{header}\n# here it begins\n{numbers}\n\n".encode(),
        "numpy": f"# seed 3\n# {text}".encode(),
        "quoted": text.replace("heading", '"heading"').encode(),
    }
    if delimiter.strip() == "" and delimiter != "\t":
        del others["quoted"]
    for name, content in others.items():
        path.write_bytes(content)
        result = import_csv(path, tmp_path / name).output_array()
        assert (result == expected).all(), name


@pytest.mark.slow
def test_a_log_gives_the_rows_that_the_same_robots_utias_files_give(shared_data, tmp_path):
    folder = shared_data / "utias"
    # Its held commands are half of the log, so a log is taken whole.
    expected = import_mrclam(folder, tmp_path / "mrclam", settings=Settings(windows=True))
    odometry = np.loadtxt(next(folder.glob("*Odometry*")))
    truth = np.loadtxt(next(folder.glob("*Groundtruth*")))
    assert (odometry[:, 0] == truth[:, 0]).all()
    lines = np.column_stack([truth, odometry[:, 1:]])
    path = write(tmp_path / "log.csv", HEADER, lines.tolist())
    dataset = import_csv(path, tmp_path / "csv")
    assert (dataset.input_array() == expected.input_array()).all()
    assert (dataset.output_array() == expected.output_array()).all()
    pd.testing.assert_frame_equal(dataset.within, expected.within)


def test_several_files_are_recordings_of_their_own(tmp_path):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        write(tmp_path / place / "log.csv", HEADER, log_lines())
    paths = [tmp_path / place / "log.csv" for place in ("a", "b")]
    dataset = import_csv(paths, tmp_path / "d")
    assert dataset.table["recording"].tolist() == [str(path) for path in paths for _ in range(2)]
    assert dataset.table["command"].tolist() == [1, 2, 1, 2]
    assert dataset.meta["left_out"]["first"] == 2
    assert dataset.within["row"].nunique() == 4
    assert len({source["sha256"] for source in dataset.meta["sources"]}) == 1
    with pytest.raises(UserError, match="named twice"):
        import_csv([paths[0], paths[0]], tmp_path / "e")
    with pytest.raises(UserError, match="at least one file"):
        import_csv([], tmp_path / "e")
    with pytest.raises(FileError, match="no such file"):
        import_csv([paths[0], tmp_path / "c.csv"], tmp_path / "e")
    with pytest.raises(FileError, match="is a folder"):
        import_csv(tmp_path / "a", tmp_path / "e")
    assert not (tmp_path / "e").exists()
    with pytest.raises(UserError, match="not empty"):
        import_csv(paths, tmp_path / "d")


# A line for each command


def test_rows_of_displacements(tmp_path):
    lines = [(10, 20, 1.5, 0.1, 0.0, 0.3), (30, 40, 0.5, "", 0.0, 0.3), (50, 60, 1, 0.2, 0.1, 7)]
    header = ("left", "right", "duration", "dx", "dy", "dtheta")
    path = write(tmp_path / "rows.csv", header, lines)
    dataset = import_csv(path, tmp_path / "d")
    assert dataset.inputs == ("prev_left", "prev_right", "left", "right", "duration")
    # The second was not seen, but it is the previous command of the third. A turn of 7 rad stays
    # one.
    assert dataset.input_array().tolist() == [[0, 0, 10, 20, 1.5], [30, 40, 50, 60, 1]]
    assert dataset.output_array().tolist() == [[0.1, 0, 0.3], [0.2, 0.1, 7]]
    assert dataset.table["command"].tolist() == [1, 3]
    assert (len(dataset.within), dataset.meta["left_out"]) == (0, {"not seen": 1})
    rest = import_csv(path, tmp_path / "rest", from_rest=True)
    assert rest.input_array()[:, :2].tolist() == [[0, 0], [0, 0]]


def test_rows_that_say_what_came_before(tmp_path):
    lines = [(1, 2, 100, 400, 10, 0, 90), (3, 4, 600, 700, 20, -5, -45)]
    header = ("was", "u", "start", "end", "dx", "dy", "dtheta")
    path = write(tmp_path / "rows.csv", header, lines)
    dataset = import_csv(
        path,
        tmp_path / "d",
        columns={"u": "u", "prev_u": "was"},
        units={"u": "V"},
        conventions=Conventions(length="cm", angle="deg", time="ms", y="right"),
    )
    assert dataset.input_array() == pytest.approx(np.array([[1, 2, 0.3], [3, 4, 0.1]]))
    expected = [[0.1, 0, -np.pi / 2], [0.2, 0.05, np.pi / 4]]
    assert dataset.output_array() == pytest.approx(np.array(expected))
    assert [each["unit"] for each in dataset.meta["inputs"]] == ["V", "V", "s"]
    swapped = write(tmp_path / "swapped.csv", header, lines[::-1])
    with pytest.raises(FileError, match=r"line 3, field 'start': the clock goes backwards"):
        import_csv(swapped, tmp_path / "e", columns={"u": "u", "prev_u": "was"})
    ended = write(tmp_path / "ended.csv", header, [(1, 2, 100, 100, 10, 0, 90)])
    with pytest.raises(FileError, match=r"line 2, field 'end': a command must end after its st"):
        import_csv(ended, tmp_path / "e", columns={"u": "u"})


POSES = ("u", "duration", "x0", "y0", "heading0", "x1", "y1", "heading1")


def test_rows_of_poses(tmp_path):
    # Looking along y, 2 ahead and 1 to the left. Then over the seam at 180 degrees.
    lines = [(1, 1, 5, 5, 90, 4, 7, 100), (1, 1, 0, 0, 170, 0, 0, -170)]
    dataset = import_csv(
        write(tmp_path / "rows.csv", POSES, lines),
        tmp_path / "d",
        columns=("u",),
        conventions=Conventions(angle="deg"),
    )
    expected = [[2, 1, np.radians(10)], [0, 0, np.radians(20)]]
    assert dataset.output_array() == pytest.approx(np.array(expected))
    # Headings that continue over more than a turn are used unchanged.
    lines.append((1, 1, 0, 0, -170, 0, 0, 300))
    dataset = import_csv(
        write(tmp_path / "rows.csv", POSES, lines),
        tmp_path / "e",
        columns={"u": "u"},
        conventions=Conventions(angle="deg"),
    )
    turns = np.degrees(dataset.output_array()[:, 2])
    assert turns.tolist() == pytest.approx([10, -340, 470])


@pytest.mark.parametrize("y", ["left", "right"])
def test_displacements_in_the_frame_of_the_room(tmp_path, y):
    # The robot looks along y of the room; it goes 2 along -x, which is to its left.
    lines = [(1, 1, -2, 0, 0.3, np.pi / 2)]
    header = ("u", "duration", "dx", "dy", "dtheta", "heading0")
    dataset = import_csv(
        write(tmp_path / "rows.csv", header, lines),
        tmp_path / "d",
        columns={"u": "u"},
        conventions=Conventions(frame="world", y=y),
    )
    side = 1 if y == "left" else -1
    assert dataset.output_array() == pytest.approx(np.array([[0, 2 * side, 0.3 * side]]))


def test_a_file_of_both_shapes_is_a_log_unless_the_user_says_otherwise(tmp_path):
    lines = [[*line, 1.0, 0.1, 0.0, 0.0] for line in log_lines()]
    path = write(tmp_path / "f.csv", (*HEADER, "duration", "dx", "dy", "dtheta"), lines)
    assert import_csv(path, tmp_path / "log").meta["settings"]["shape"] == "log"
    assert len(import_csv(path, tmp_path / "rows", rows=True)) == len(lines)


def test_conventions_that_there_are_not():
    with pytest.raises(UserError, match="length: expected one of 'm', 'cm', 'mm', found 'inch'"):
        Conventions(length="inch")


def test_importers_warn_where_training_refuses():
    assert FEWEST_ROWS == MIN_ROWS
