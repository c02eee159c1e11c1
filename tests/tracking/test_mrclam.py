"""The MRCLAM importer: the published figures on real data, and small files by hand."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neurosim.base import se2
from neurosim.base.errors import FileError, UserError
from tracking.datasets.dataset import Dataset
from tracking.datasets.logs import Settings, pieces
from tracking.datasets.mrclam import import_mrclam


def test_the_real_robots_rows_and_the_ideal_unicycles_errors(shared_data, tmp_path):
    dataset = import_mrclam(shared_data / "utias", tmp_path / "out")
    assert len(dataset) == 565
    assert dataset.inputs == ("prev_v", "prev_w", "v", "w", "duration")
    _, later = dataset.split(0.25)
    v, w, duration = later.input_array()[:, 2:].T
    ideal = se2.exp(np.stack([v * duration, 0 * v, w * duration], axis=-1))
    errors = np.abs(ideal - later.output_array()).mean(axis=0)
    result = [*(errors[:2] * 100), np.degrees(errors[2])]
    assert [round(value, 2) for value in result] == [0.58, 0.38, 1.52]
    durations = dataset.table["duration"]
    assert (durations.min(), durations.max()) == (0.5, 3.0)
    read = Dataset.read(tmp_path / "out")
    assert len(read) == 565
    pd.testing.assert_frame_equal(read.within, dataset.within)
    counts = dataset.within.groupby("row").size()
    assert (len(counts), counts.max()) == (565, 8)
    assert len(dataset.within) == read.meta["within"]


@pytest.mark.slow
def test_the_real_robots_poses_within_commands_are_those_of_its_track(shared_data, tmp_path):
    # From the files themselves, slowly: where the robot was, seen from the piece's beginning.
    folder = shared_data / "utias"
    dataset = import_mrclam(folder, tmp_path / "out")
    odometry = np.loadtxt(next(folder.glob("*Odometry*")))
    truth = np.loadtxt(next(folder.glob("*Groundtruth*")))
    truth[:, 3] = np.unwrap(truth[:, 3])

    def pose(time):
        return np.array([np.interp(time, truth[:, 0], column) for column in truth[:, 1:].T])

    settings = Settings()
    starts = [
        odometry[start, 0]
        for start, end in pieces(odometry[:, 0], odometry[:, 1:], settings.longest)
        if start and odometry[end, 0] - odometry[start, 0] > settings.shortest - 2e-3
    ]
    assert len(starts) == 565
    for row, time, *moved in dataset.within.iloc[::97].itertuples(index=False):
        expected = se2.between(pose(starts[row]), pose(starts[row] + time))
        assert moved == pytest.approx(expected, abs=1e-5)
    # Near its end a command has moved the robot most of the way.
    last = dataset.within.groupby("row").last()
    fraction = last["time"] / dataset.table["duration"]
    assert 0.7 < fraction.median() < 0.9
    steady = dataset.table["v"] == dataset.table["v"].max()
    reached = (last["dx"] / dataset.table["dx"])[steady]
    assert reached.median() == pytest.approx(fraction[steady].median(), abs=0.1)


def write(folder: Path, odometry, truth, names=("Robot1_Odometry.dat", "Robot1_Groundtruth.dat")):
    folder.mkdir(exist_ok=True)
    paths = [folder / name for name in names]
    for path, rows in zip(paths, (odometry, truth), strict=True):
        lines = ["# a comment", "#  Time [s]  and so on"]
        lines += ["\t".join(f"{value:.6f}" for value in row) for row in rows]
        path.write_text("\n".join(lines) + "\n")
    return paths


def arcs():
    """A robot that turns left on the spot through +-pi, sampled at rates that differ."""
    unix = 1248272272.841
    odometry = [(unix + 0.07 * i, *((0.0, 0.0) if i < 10 else (0.0, 1.0))) for i in range(130)]
    begin = odometry[10][0]
    truth = []
    for time in np.arange(unix - 0.5, odometry[-1][0] + 0.5, 0.013):
        heading = 3.0 + max(time - begin, 0.0)
        truth.append((time, 1.0, 2.0, (heading + np.pi) % (2 * np.pi) - np.pi))
    return odometry, truth


def test_pieces_of_a_run_by_hand(tmp_path):
    dataset = import_mrclam(write(tmp_path / "in", *arcs()), tmp_path / "out")
    # The first run (0.7 s) has nothing before it. The second lasts 119 steps of 0.07 s; 42 of
    # them are the most within 3 s: pieces of 2.94, 2.94 and 2.45 s.
    assert dataset.table["duration"].tolist() == pytest.approx([2.94, 2.94, 2.45], abs=1e-5)
    assert dataset.input_array()[:, :4].tolist() == [[0, 0, 0, 1], [0, 1, 0, 1], [0, 1, 0, 1]]
    assert dataset.output_array()[:, 2] == pytest.approx(dataset.table["duration"], abs=1e-2)
    assert np.abs(dataset.output_array()[:, :2]).max() < 1e-9
    assert dataset.meta["left_out"] == {"too short": 0, "first": 1, "gap": 0}
    # 0.125, 0.25, 0.375, 0.5 s and fifths of 2.94 s, each at the nearest sample of 0.07 s.
    first = dataset.within[dataset.within["row"] == 0]
    samples = [2, 4, 5, 7, 8, 17, 25, 34]
    assert first["time"].tolist() == pytest.approx([0.07 * n for n in samples], abs=2e-6)
    assert first["dtheta"].tolist() == pytest.approx(first["time"].tolist(), abs=1e-2)
    assert first[["dx", "dy"]].abs().to_numpy().max() < 1e-9


def test_a_gap_in_either_file_leaves_its_pieces_out(tmp_path):
    odometry, truth = arcs()
    hole = odometry[10][0] + 4.0
    less = [row for row in truth if not hole < row[0] < hole + 0.6]
    dataset = import_mrclam(write(tmp_path / "a", odometry, less), tmp_path / "a-out")
    assert dataset.meta["left_out"]["gap"] == 1
    less = [row for row in odometry if not hole < row[0] < hole + 0.6]
    dataset = import_mrclam(write(tmp_path / "b", less, truth), tmp_path / "b-out")
    assert dataset.meta["left_out"]["gap"] == 1
    less = [row for row in truth if row[0] < hole]
    dataset = import_mrclam(write(tmp_path / "c", odometry, less), tmp_path / "c-out")
    assert (len(dataset), dataset.meta["left_out"]["gap"]) == (1, 2)


def test_files_are_recognised_by_name_content_or_in_a_folder(tmp_path):
    named = write(tmp_path / "named", *arcs())
    bare = write(tmp_path / "bare", *arcs(), names=("a.txt", "b.txt"))
    (tmp_path / "named" / "Landmark_Groundtruth.dat").write_text("1 2 3 4 5\n")
    (tmp_path / "named" / "Robot1_Measurement.dat").write_text("1 2 3 4\n")
    distances = [named, named[::-1], bare[::-1], tmp_path / "named", [str(tmp_path / "named")]]
    outputs = [
        import_mrclam(arguments, tmp_path / f"out{i}").output_array()
        for i, arguments in enumerate(distances)
    ]
    for output in outputs[1:]:
        assert (output == outputs[0]).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.000000", "fast", r"Odometry\.dat, line \d+, field 'w': expected a finite number"),
        ("1.000000", "nan", r"field 'w': expected a finite number"),
        ("\t1.000000", "", r"expected 3 fields \(time, v, w\), found 2"),
        ("1248272275", "1248272271", r"field 'time': the clock goes backwards"),
    ],
)
def test_bad_lines_are_named(tmp_path, old, new, message):
    paths = write(tmp_path / "in", *arcs())
    text = paths[0].read_text()
    assert old in text
    paths[0].write_text(text.replace(old, new, 1))
    with pytest.raises(FileError, match=message):
        import_mrclam(paths, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_files_that_do_not_belong_together(tmp_path):
    odometry, truth = arcs()
    paths = write(tmp_path / "in", odometry, truth)
    with pytest.raises(UserError, match="both odometry"):
        import_mrclam([paths[0], paths[0]], tmp_path / "out")
    with pytest.raises(UserError, match="expected one odometry and one ground-truth file"):
        import_mrclam(paths[:1], tmp_path / "out")
    with pytest.raises(FileError, match="no such file"):
        import_mrclam([paths[0], tmp_path / "Groundtruth.dat"], tmp_path / "out")
    write(tmp_path / "in", odometry, truth, ("Robot2_Odometry.dat", "Robot2_Groundtruth.dat"))
    with pytest.raises(UserError, match="several robots"):
        import_mrclam(tmp_path / "in", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="found neither"):
        import_mrclam(tmp_path / "empty", tmp_path / "out")
    (tmp_path / "two.txt").write_text("1 2\n")
    with pytest.raises(FileError, match="found 2"):
        import_mrclam([paths[0], tmp_path / "two.txt"], tmp_path / "out")
    far = [(time + 1e4, *rest) for time, *rest in truth]
    with pytest.raises(UserError, match="no time in common"):
        import_mrclam(write(tmp_path / "far", odometry, far), tmp_path / "out")
    with pytest.raises(UserError, match="no usable command"):
        import_mrclam(write(tmp_path / "few", odometry[:12], truth), tmp_path / "out")
    with pytest.raises(FileError, match="too few rows of numbers"):
        import_mrclam(write(tmp_path / "one", odometry[:1], truth), tmp_path / "out")
