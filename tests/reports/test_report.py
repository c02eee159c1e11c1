"""The page: whole, self-contained, and its numbers those of the folders."""

import re
import subprocess
import sys

import numpy as np
import pytest
from report_artefacts import (
    LEGS,
    make_controller,
    make_dataset,
    make_simulator,
    make_trial,
    predicted_poses,
)
from report_page import Page

from neurosim.base import files
from neurosim.base.errors import FileError, UserError
from neurosim.reports import charts, write_report
from neurosim.reports.svg import drawing, to_svg
from tracking.datasets.recordings import Recording


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A report of one folder of every kind."""
    root = tmp_path_factory.mktemp("whole")
    folders = [make_dataset(root / "data")]
    folders.append(make_simulator(root / "net", folders[0]))
    folders.append(make_controller(root / "plan"))
    folders.append(make_trial(root / "trial-a", seed=3, unseen=(4,)))
    summary = write_report(folders, root / "page.html")
    return folders, summary, root / "page.html", Page(root / "page.html")


def test_page_stands_alone(whole):
    page = whole[3]
    assert page.references
    assert all(reference.startswith("#") for reference in page.references)
    assert not page.tags & {"link", "img", "iframe", "object"}
    source = whole[2].read_text()
    assert "@import" not in source
    assert "http" not in source


def test_ids_are_unique_and_references_lead_somewhere(whole):
    page = whole[3]
    assert len(page.ids) == len(set(page.ids))
    assert {reference[1:] for reference in page.references} <= set(page.ids)


def test_every_figure_is_told_in_words(whole):
    page = whole[3]
    # Trial, two of growth, evolution, a plan that was not tried, three series and scatters,
    # learning, three histograms.
    assert len(page.svgs) == 1 + 2 + 1 + 1 + 3 + 3 + 1 + 3
    assert all(svg["role"] == "img" and svg["aria-label"] for svg in page.svgs)


def test_figures_use_the_colours_of_the_page_only(whole):
    for svg in re.findall(r"<svg.*?</svg>", whole[2].read_text(), flags=re.DOTALL):
        assert not set(re.findall(r"#[0-9a-f]{6}\b", svg)) - {"#000000"}


def test_verdict_gives_the_trials_own_errors(whole):
    _, summary, _, page = whole
    trial = files.read_json(whole[0][3] / "trial.json", "neurosim-trial", 1)
    # The first is that at the start, before any command.
    position = [error["position"] for error in trial["errors"][1:] if error]
    heading = [abs(error["heading"]) for error in trial["errors"][1:] if error]
    assert len(position) == len(LEGS) - 1
    assert summary["mean_position_error"] == pytest.approx(np.mean(position))
    assert summary["final_position_error"] == position[-1]
    assert summary["mean_heading_error"] == pytest.approx(np.mean(heading))
    assert (summary["trials"], summary["completed"], summary["virtual"]) == (1, 1, True)
    assert summary["verdict"].startswith("The robot completed the task.")
    assert (
        f"{100 * np.mean(position):.1f} cm and {np.degrees(np.mean(heading)):.1f} degrees"
        in (summary["verdict"])
    )
    assert f"at the end, {100 * position[-1]:.1f} cm" in summary["verdict"]
    assert "(Virtual lab.)" in summary["verdict"]
    assert summary["verdict"] in page.text


def test_commands_and_poses_are_the_trials(whole):
    rows = whole[3].table(["command", "left (%)"])[1:]
    trial = files.read_json(whole[0][3] / "trial.json", "neurosim-trial", 1)
    assert len(rows) == len(LEGS) + 1
    x, y, heading = predicted_poses()[1]
    assert rows[0][:6] == ["1", "40.0", "40.0", "2.00", f"{x:.3f}, {y:.3f}", "90.0"]
    assert rows[3][6:] == ["not seen"] * 4
    assert float(rows[8][8]) == pytest.approx(100 * trial["errors"][9]["position"], abs=0.051)
    # At rest 3 cm and 4 cm away, and two half turns are one whole turn: the same heading.
    assert rows[9][4:] == [
        "-0.750, 0.250", "-270.0", "-0.720, 0.290", "-270.0", "5.0", "0.0"
    ]  # fmt: skip
    assert heading == pytest.approx(np.pi / 2)


def test_what_a_simulator_is_made_of_is_shown(whole):
    page = whole[3]
    assert page.table(["actuator", "lag"]) == [
        ["actuator", "lag", "dead band"],
        ["left", "0.0824", "0.07"],
        ["right", "0.1", "0"],
    ]
    assert page.table(["output", "weight of the process"])[1:] == [
        ["dx, forward (cm)", "30%"],
        ["dy, to the left (cm)", "80%"],
        ["change in angle (deg)", "0%"],
    ]
    assert "answered after 28 ms" in page.text
    assert "the loss of speed in curves has a lag of 2.1 s, drift of 1.3 s" in page.text


def test_table_2_against_an_independent_reckoning(whole):
    from neurosim.simulators import read_simulator
    from tracking.datasets.dataset import Dataset

    folders, summary, _, page = whole
    rows = Dataset.read(folders[0]).table.iloc[120:]
    network = read_simulator(folders[1])
    import torch

    state = torch.zeros(30, 5, dtype=torch.float64)
    state[:, 3:] = torch.tensor(rows[["prev_left", "prev_right"]].to_numpy())
    command = torch.tensor(rows[["left", "right", "duration"]].to_numpy())
    predicted = network.step(state, command)[:, :3].numpy()
    error = (predicted - rows[["dx", "dy", "dtheta"]].to_numpy()) * [100, 100, 180 / np.pi]
    table = page.table(["", "MSE"])
    assert [name for name in table[0] if name] == [
        "paper", "net", "ideal differential drive, two factors fitted"
    ]  # fmt: skip
    papers = [["26.412", "3.585 deg"], ["12.909", "2.143 cm"], ["18.559", "2.782 cm"]]
    for row, column, paper in zip(table[2:], (2, 0, 1), papers, strict=True):
        assert row[1:3] == paper
        assert float(row[3]) == pytest.approx(np.mean(error[:, column] ** 2), abs=5.1e-4)
        assert float(row[4].split()[0]) == pytest.approx(
            np.mean(np.abs(error[:, column])), abs=5.1e-4
        )
    assert summary["test"]["net"]["dx"]["mse"] == pytest.approx(np.mean(error[:, 0] ** 2))


def test_dataset_counts(whole):
    page = whole[3]
    assert page.table(["reason"])[1:] == [
        ["cut: cut short at a line", "7", f"{7 / 159:.1%}"],
        ["jump", "2", f"{2 / 159:.1%}"],
    ]
    assert "150 usable rows" in page.text
    meta = files.read_json(whole[0][0] / "dataset.json", "neurosim-dataset", 2)
    random = meta["cutting"]["by_class"]["random"]
    assert page.table(["commands", "sent"])[1][1:4] == [
        str(random[key]) for key in ("sent", "cut", "completed")
    ]


def test_clocks_and_delays(whole):
    assert whole[3].table(["session", "clock by"])[1:] == [
        ["rec, 1", "2 flashes, +- 1.2 ms", "21 +- 13 ppm", "21 +- 3 ms", "104 ms", "yes"],
        ["rec, 2", "the motion, +- 3.0 ms", "0 +- 0 ppm", *["not known"] * 3],
    ]


def test_provenance_names_every_file_with_its_sum(whole):
    folders, _, _, page = whole
    rows = {row[0]: row[2] for row in page.table(["file"])[1:]}
    for folder in folders:
        for path in folder.iterdir():
            assert rows[f"{folder.name}/{path.name}"] == files.sha256(path)
    assert rows["rec/commands.csv"] == "ab" * 32
    assert "seed" in page.text
    assert "2024-05-06T07:08:09+00:00" in page.text


def test_several_trials(tmp_path):
    trials = [
        make_trial(tmp_path / f"t{k}", seed=k, completes=k != 1, unseen=(9,) if k == 0 else ())
        for k in range(4)
    ]
    summary = write_report(trials, tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    read = [files.read_json(trial / "trial.json", "neurosim-trial", 1) for trial in trials]
    ends = [trial["errors"][9]["position"] for trial in read[1:]]
    assert summary["completed"] == 3
    assert summary["final_position_error"] == pytest.approx(np.median(ends))
    row = page.table(["controllers", "trials"])[1]
    # Wilson's interval of 3 in 4, by hand: (0.75 + 0.4802) / 1.9604 -+ 0.3269.
    assert row[:6] == ["plan, 9 commands", "4", "not known", "3", "75%", "30% to 95%"]
    growth = page.table(["after command"])[1:]
    assert [line[1] for line in growth] == ["4"] * 8 + ["3"]
    third = [100 * trial["errors"][3]["position"] for trial in read]
    expected = [f"{f(third):.1f}" for f in (np.median, np.mean, np.max)]
    assert growth[2][2:5] == expected


def test_missing_parts_are_named(tmp_path):
    write_report([make_dataset(tmp_path / "data")], tmp_path / "page.html")
    text = Page(tmp_path / "page.html").text
    assert "Add the folder of a trial to see it." in text
    assert "Add the folder of a simulator to see it." in text
    assert "whether the robot completes the task is not known" in text


def test_simulator_alone_shows_what_its_training_found(tmp_path):
    data = make_dataset(tmp_path / "data")
    write_report([make_simulator(tmp_path / "net", data)], tmp_path / "page.html")
    page = Page(tmp_path / "page.html")
    assert page.table(["", "MSE"])[3][3:] == ["7.125", "1.375 cm"]
    assert "Add the folder of the dataset that the simulator was trained on" in page.text


@pytest.mark.slow
def test_another_dataset_is_used_whole(tmp_path):
    data, other = make_dataset(tmp_path / "data"), make_dataset(tmp_path / "other", 40, seed=9)
    net = make_simulator(tmp_path / "net", data)
    write_report([net, other], tmp_path / "page.html")
    assert "all 40 commands of another dataset" in Page(tmp_path / "page.html").text
    write_report([net, other, data], tmp_path / "page.html")
    assert "the last 20% of its dataset in time, 30 commands" in Page(tmp_path / "page.html").text


def test_real_robot_is_not_called_virtual(tmp_path):
    folders = [make_dataset(tmp_path / "data", virtual=False),
               make_trial(tmp_path / "trial", virtual=False, completes=False)]  # fmt: skip
    summary = write_report(folders, tmp_path / "page.html")
    assert summary["virtual"] is False
    assert summary["verdict"].startswith(
        "The robot did not complete the task, although the simulator predicted it."
    )
    assert "Virtual lab" not in Page(tmp_path / "page.html").text


@pytest.mark.slow
def test_the_verdict_names_the_chance_that_the_plan_was_given(tmp_path):
    trials = [
        make_trial(tmp_path / f"t{n}", n, completes=n == 0, probability=0.874) for n in range(3)
    ]
    one = write_report(trials[1:2], tmp_path / "one.html")["verdict"]
    assert one.startswith("The robot did not complete the task; the simulator had given it 87 %. ")
    three = write_report(trials, tmp_path / "three.html")["verdict"]
    assert three.startswith(
        "The robot completed the task in 1 of 3 trials; the simulator had given it 87 %. "
    )
    trials[2] = make_trial(tmp_path / "other", 2, completes=False, probability=0.5)
    mixed = write_report(trials, tmp_path / "mixed.html")["verdict"]
    assert mixed.startswith("The robot completed the task in 1 of 3 trials. ")


def test_robot_never_seen(tmp_path):
    trial = make_trial(tmp_path / "trial", unseen=range(10))
    summary = write_report([trial], tmp_path / "page.html")
    assert "did not see" in summary["verdict"]
    assert "mean_position_error" not in summary
    Page(tmp_path / "page.html")


def test_drive_that_ended_at_a_line(tmp_path):
    trial = make_trial(tmp_path / "trial", completes=False, unseen=range(6, 10))
    document = files.read_json(trial / "trial.json", "neurosim-trial", 1)
    document["ended_early"] = True
    files.write_json(trial / "trial.json", "neurosim-trial", 1, document)
    summary = write_report([trial], tmp_path / "page.html")
    assert summary["verdict"].endswith("the drive ended before its last command. (Virtual lab.)")
    assert "final_position_error" not in summary
    growth = Page(tmp_path / "page.html").text
    assert "after command 5" in growth
    assert "after command 6" not in growth


def test_recording_says_where_it_is_from(tmp_path):
    for name, lab in (("real", None), ("lab", {"seed": 1})):
        Recording.create(
            tmp_path / name, {"robot": {"kind": "nxt"}, "camera": {}, "virtual_lab": lab}
        )
        summary = write_report([tmp_path / name], tmp_path / "page.html")
        assert summary["virtual"] is (lab is not None)


def test_names_are_escaped(tmp_path):
    trial = make_trial(tmp_path / "a<b&c")
    write_report([trial], tmp_path / "page.html")
    assert "a<b&c: predicted" in Page(tmp_path / "page.html").text


def test_what_cannot_be_read_is_named(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"empty.*none of trial\.json"):
        write_report([tmp_path / "empty"], tmp_path / "page.html")
    with pytest.raises(UserError, match=r"nowhere.*no such folder"):
        write_report([tmp_path / "nowhere"], tmp_path / "page.html")
    with pytest.raises(UserError, match="at least one"):
        write_report([], tmp_path / "page.html")
    trial = make_trial(tmp_path / "trial")
    with pytest.raises(UserError, match="is a folder"):
        write_report([trial], tmp_path)
    document = files.read_json(trial / "trial.json", "neurosim-trial", 1)
    document["predicted"]["poses"].pop()
    files.write_json(trial / "trial.json", "neurosim-trial", 1, document)
    with pytest.raises(FileError, match=r"trial\.json.*predicted\.poses.*expected 10 poses"):
        write_report([trial], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_path_between_poses_is_the_constant_twist_arc():
    from neurosim.reports.course import planned_path

    path = planned_path(
        [(0, 0, 0), (0.5, 0.5, np.pi / 2)]
    )  # a quarter of a circle, centre (0, 0.5)
    assert np.hypot(path[:, 0], path[:, 1] - 0.5) == pytest.approx(0.5)
    assert np.hypot(*np.diff(path[:, :2], axis=0).T).max() <= 0.02
    # A whole turn that does not end where it began has no arc: a straight line is drawn.
    path = planned_path([(0, 0, 0), (0.3, 0, 2 * np.pi)])
    assert path[:, 1] == pytest.approx(0.0)
    assert path[-1] == pytest.approx([0.3, 0, 2 * np.pi])
    assert len(planned_path([(0, 0, 0), (0, 0, 0), (0, 0, 1)])) == 3


def test_importing_the_package_is_quick():
    code = (
        "import sys, neurosim.reports; "
        "print([name for name in ('matplotlib', 'torch', 'pandas') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("value", [1e150, -3e8, 0.0])
def test_a_histogram_of_one_value(value):
    svg = charts.histogram(np.full(60, value), "dx", "displacements", "a")
    assert "displacements" in svg


def test_labels_of_small_numbers_keep_their_digits():
    with drawing(4.0, 3.0) as (figure, axes):
        axes.set_yticks([0.0, 0.005, 0.0125])
        svg = to_svg(figure, "small", "p")
    assert {"0.0000", "0.0050", "0.0125"} <= set(re.findall(r">([0-9.]+)<", svg))
    assert not re.search(r'="[^"]*\d\.\d{3}', svg)
