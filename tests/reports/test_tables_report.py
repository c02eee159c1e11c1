"""The page of table simulators and networks: the samples, and the results."""

import numpy as np
import pytest
from khepera_data import made_up
from report_page import Page

from neurosim.base.errors import FileError, UserError
from neurosim.base.place import paper_arena
from neurosim.controllers import Network, SavedController
from neurosim.loop.unmet import Unmet
from neurosim.reports import controllers, write_report
from neurosim.simulators import TableSimulator


def simulator(folder):
    folder.mkdir()
    TableSimulator(made_up(3, 0.01)).write(folder)
    return folder


def network(folder, best, mean, fitness="avoidance", unmet=None, **evolution):
    history = {"best": best, "mean": mean}
    if "transfer" in evolution:
        history["transfer"] = evolution.pop("transfer")
    SavedController(
        Network(tuple(f"sensor_{number}" for number in range(8))),
        np.zeros(18),
        {"name": "obstacle-avoidance", "settings": {"steps": 500, "fitness": fitness}},
        predicted={"fitness": best[-1], "spread": 4.0, **({"unmet": unmet} if unmet else {})},
        evolution={"place": paper_arena().to_json(), "history": history, **evolution},
    ).write(folder)
    return folder


@pytest.mark.slow
def test_samples(tmp_path):
    out = tmp_path / "page.html"
    write_report([simulator(tmp_path / "sim")], out)
    page = Page(out)
    assert {"samples", "provenance"} <= set(page.ids)
    assert "controllers" not in page.ids
    sensors, motors = page.tables[:2]
    # The third sensor of the made-up table looks 10 degrees to the left; the wall is 8 / 10 as
    # bright as an obstacle; the spread is the noise's.
    assert sensors[3][0] == "sensor 2"
    assert float(sensors[3][2]) == pytest.approx(0.82, abs=0.03)
    assert sensors[3][3] == "+10"
    assert float(sensors[3][-1]) == pytest.approx(0.01, abs=0.003)
    assert motors[1][:2] == ["both forward at 100 %", "100.0"]
    assert float(motors[3][3]) == pytest.approx(np.degrees(0.2 / 0.053), abs=0.06)


def test_networks_with_transfer_and_trajectories(tmp_path):
    along = np.linspace(0, 0.1, 11)
    simulated = np.column_stack([along - 0.2, 0 * along, 0 * along])
    robot = simulated + np.array([0.0, 0.02, 0.0])
    drives = [{"simulated": simulated.tolist(), "robot": robot.tolist()}]
    folders = [
        network(tmp_path / "a", [100, 200, 190], [50, 90, 80], transfer=2, trajectories=drives),
        network(tmp_path / "b", [100, 300, 300], [50, 90, 100], transfer=2),
    ]
    out = tmp_path / "page.html"
    summary = write_report(folders, out)
    assert summary["controller_fitness"] == pytest.approx(245)
    assert summary["change_at_transfer"] == pytest.approx(-0.025)
    assert "-2.5 % of its fitness on average" in summary["verdict"]
    assert "2 controllers reach a fitness of 245 of at most 500" in summary["verdict"]
    assert "From the same start its path there is 2.0 cm off" in summary["verdict"]
    page = Page(out)
    text = out.read_text()
    assert "from generation 3 on the robot" in text
    assert "2.0 cm apart, median" in text
    (row,) = [row for row in page.table(["controller", "kind"]) if row[0] == "a"]
    assert row == ["a", "network", "18 genes", "190", "4", "3", "90, 80"]


def test_contacts_in_other_arenas_beside_a_vehicle(tmp_path):
    unmet = {"drives": 20, "touched": 0, "fitness": 300.0, "vehicle": 1}
    folders = [
        network(tmp_path / "good", [100], [50], unmet=unmet),
        network(tmp_path / "poor", [100], [50], unmet=unmet | {"touched": 18}),
    ]
    write_report(folders, tmp_path / "page.html")
    rows = Page(tmp_path / "page.html").table(["controller", "kind"])
    column = rows[0].index("touches something in other arenas")
    assert {row[0]: row[column] for row in rows[1:]} == {
        "good": "0 of 20 drives",
        "poor": "18 of 20 drives",
    }
    text = (tmp_path / "page.html").read_text()
    assert f"poor: {Unmet(**unmet | {'touched': 18})}" in text
    assert "good: In arenas" not in text


def test_cells_have_no_highest_number(tmp_path):
    cells = network(tmp_path / "a", [10.0], [5.0], fitness="cells")
    verdict = write_report([cells], tmp_path / "page.html")["verdict"]
    assert verdict == "The controller reaches a fitness of 10 in the simulator."


def test_one_generation_is_drawn_as_a_point(tmp_path, monkeypatch):
    pictures = []
    monkeypatch.setattr(
        controllers, "to_svg", lambda figure, *_: pictures.append(figure) or "<svg></svg>"
    )
    write_report([network(tmp_path / "a", [10.0], [5.0])], tmp_path / "page.html")
    (axes,) = pictures[0].axes
    assert [line.get_marker() for line in axes.lines] == ["o", "o"]
    assert {float(tick) % 1 for tick in axes.get_xticks()} == {0.0}


def test_the_legend_stands_beside_the_lines(tmp_path, monkeypatch):
    pictures = []
    monkeypatch.setattr(
        controllers, "to_svg", lambda figure, *_: pictures.append(figure) or "<svg></svg>"
    )
    low = network(tmp_path / "a", [30.0, 300.0, 20.0], [10.0, 20.0, 10.0], transfer=2)
    write_report([low], tmp_path / "page.html")
    (axes,) = pictures[0].axes
    pictures[0].draw_without_rendering()
    legend, panel = axes.get_legend().get_window_extent(), axes.get_window_extent()
    assert legend.y0 >= panel.y1 - 1


def test_a_report_replaces_no_file_of_another_kind(tmp_path):
    (tmp_path / "poses.csv").write_text("t,x,y,theta\n")
    with pytest.raises(UserError, match=r"a report is written as \.html"):
        write_report([network(tmp_path / "a", [10.0], [5.0])], tmp_path / "poses.csv")
    assert (tmp_path / "poses.csv").read_text() == "t,x,y,theta\n"


@pytest.mark.parametrize(
    ("evolution", "field"),
    [
        ({"transfer": 9}, "evolution.history"),
        ({"trajectories": [{"simulated": [[0, 0, 0]]}]}, "evolution.trajectories"),
    ],
)
def test_what_is_wrong_in_a_network_is_named(tmp_path, evolution, field):
    network(tmp_path / "a", [1.0, 2.0], [0.5, 1.0], **evolution)
    with pytest.raises(FileError, match=field):
        write_report([tmp_path / "a"], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
