"""Pages and pictures of any registered task, controller and simulator."""

import json
import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from click.testing import CliRunner
from ideal_simulator import IdealWheels
from khepera_data import made_up
from matplotlib.axes import Axes
from matplotlib.image import imread
from matplotlib.patches import Wedge
from report_artefacts import COLUMNS, make_trial
from report_page import Page

from neurosim.base import files
from neurosim.base.errors import FileError, UserError
from neurosim.base.place import Place
from neurosim.cli.main import cli
from neurosim.controllers import CONTROLLERS, FixedPlan, Function, Network, SavedController
from neurosim.reports import write_report
from neurosim.reports.course import Paths, Scene, course, draw_course, draw_scene
from neurosim.reports.view import draw_view, picture
from neurosim.simulators import TableSimulator
from neurosim.simulators.registry import SIMULATORS
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.go_to import GoTo
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.tasks.registry import TASKS


@dataclass(frozen=True)
class Dock(Task):
    """A user's own: stop in the harbour."""

    name: ClassVar[str] = "dock"
    reasons: ClassVar[tuple[str, ...]] = ("did not reach the harbour",)
    highest_fitness: ClassVar[float] = 0.0
    where: tuple[float, float] = (0.5, 0.2)

    def worth(self, record):
        away = np.linalg.norm(record[:, 4:6] - np.array(self.where), axis=-1)
        return Judgement.of(-away, away < 0.1)

    def outline(self):
        x, y = self.where
        return [
            {"circle": [x, y, 0.1]},
            {"text": "harbour", "at": [x, y]},
            {"polygon": [[0.2, 0.3], [0.4, 0.3], [0.4, 0.5]], "forbidden": True},
        ]


def ahead(seen):
    return 40 + 0 * seen["time"], 40 + 0 * seen["time"]


FAMILY = Function(ahead, ("time",), name="straight-ahead")


class Compass(IdealWheels):
    """A robot that reads its compass heading; the position of its sensor is unknown."""

    kind = "compass"
    reading_names = ("north",)

    def sense(self, state, generator=None):
        return (0.5 + 0.5 * state[:, 2:3].sin()).to(state)


@pytest.fixture
def registered(monkeypatch):
    """Register the user's things for one test."""
    own = {"dock": (TASKS, Dock), "straight-ahead": (CONTROLLERS, lambda **_: FAMILY),
           "compass": (SIMULATORS, lambda folder, device: Compass())}  # fmt: skip
    for name, (registry, item) in own.items():
        monkeypatch.setitem(registry._registered, name, item)


def simulator(folder):
    folder.mkdir()
    files.write_json(folder / "simulator.json", "neurosim-simulator", 2, {"kind": "compass"})
    return folder


def along(count=31, length=0.6):
    x = np.linspace(0, length, count)
    return np.column_stack([x, 0.3 * x, np.full(count, 0.3)]).tolist()


def controller(folder, family=FAMILY, genes=(), task=None, **predicted):
    SavedController(
        family,
        np.array(genes, float),
        task or {"name": "dock", "settings": {"where": [0.5, 0.2]}},
        predicted={
            "poses": along(), "rest": along()[-1], "fitness": -0.14, "completes": True,
            "probability": 0.75, "draws": 4096, **predicted,
        },
        evolution={
            "settings": {"objective": "progress", "robust": {"objective": "probability"}},
            "history": {
                "best": [-1.0, -0.5, -0.2], "mean": [-2.0, -1.0, -0.5],
                "robust_best": [0.5, 0.75], "robust_mean": [0.1, 0.3],
            },
        },
    ).write(folder)  # fmt: skip
    return folder


def test_a_users_controller_at_a_users_task(registered, tmp_path):
    out = tmp_path / "page.html"
    folders = [controller(tmp_path / "sailor"), simulator(tmp_path / "sea")]
    summary = write_report(folders, out)
    assert summary["verdict"].startswith(
        "The controller reaches a fitness of -0.14 of at most 0 in the simulator, and succeeds "
        "with a probability of 75 %."
    )
    page = Page(out)
    row = page.table(["controller", "kind"])[1]
    assert row == ["sailor", "straight-ahead", "0 genes", "-0.14", "yes", "75.0%", "4,096",
                   "3 + 2 robust"]  # fmt: skip
    assert page.table(["task", "settings"])[1] == ["dock", "where [0.5, 0.2]", "sailor"]
    assert page.table(["simulator", "kind"])[1] == [
        "sea", "compass", "left, right, duration", "north", "-"
    ]  # fmt: skip
    # Evolution, robust evolution, and the path; the outline's labels are text of the page.
    labels = [svg["aria-label"] for svg in page.svgs]
    assert len(labels) == 3
    assert "graded progress" in labels[0]
    assert "probability of success + fitness / 10,000" in labels[1]
    assert "the path that the simulator expects" in labels[2]
    assert "harbour" in page.text
    assert "not registered" not in page.text


def test_a_task_of_a_package_that_is_not_here(tmp_path):
    made = controller(tmp_path / "net", Network(("x",)), np.zeros(4))
    summary = write_report([made], tmp_path / "page.html")
    text = Page(tmp_path / "page.html").text
    assert text.count("The task dock is not registered on this computer") == 1
    assert "harbour" not in text
    assert "a fitness of -0.14 in the simulator" in summary["verdict"]
    assert len(Page(tmp_path / "page.html").svgs) == 3  # its path all the same


def test_controllers_of_several_tasks_are_not_averaged(tmp_path):
    folders = [
        controller(tmp_path / "a", Network(("x",)), np.zeros(4), {"name": "go-to", "settings": {}}),
        controller(tmp_path / "b", Network(("x",)), np.zeros(4), {"name": "dock"}, fitness=7.0),
    ]
    summary = write_report(folders, tmp_path / "page.html")
    assert "controller_fitness" not in summary
    assert "At go-to, the controller reaches a fitness of -0.14 of at most 2" in summary["verdict"]
    assert "At dock, the controller reaches a fitness of 7 in" in summary["verdict"]


def seeing_trial(folder, **changes):
    """Write a trial as a closed-loop controller leaves it."""
    poses = along(21)
    content = {
        "kind": "network", "controller": {"path": "c", "sha256": "ab" * 32}, "simulator": None,
        "virtual": True, "task": {"name": "go-to", "settings": {}},
        "columns": COLUMNS,
        "commands": [[40.0, 30.0, 0.1]] * 20,
        "start": {"planned": [0, 0, 0], "actual": poses[0]},
        "predicted": {"poses": None, "rest": None, "fitness": 1.5, "completes": None},
        "actual": {
            "seen_by": "counters", "poses": poses, "cut": None, "rest": poses[-1], "fitness": 0.8,
            "completes": False, "reason": "did not pass all goals",
            "path": [[0.1 * k, *pose] for k, pose in enumerate(poses)],
        },
        "errors": [], "ended_early": False,
        "deadlines": {"steps": 20, "missed": 3, "worst_late_s": 0.027},
        **changes,
    }  # fmt: skip
    folder.mkdir()
    files.write_json(folder / "trial.json", "neurosim-trial", 1, content)
    return folder


def test_a_trial_of_a_controller_that_sees(tmp_path):
    summary = write_report([seeing_trial(tmp_path / "t")], tmp_path / "page.html")
    assert summary["missed_deadlines"] == 3
    assert summary["verdict"] == (
        "The robot did not complete the task: it did not pass all goals. Of 20 commands 3 were "
        "sent late. (Virtual lab.)"
    )
    page = Page(tmp_path / "page.html")
    (label,) = [svg["aria-label"] for svg in page.svgs]
    assert label == (
        "t: actual path, 20 commands; not completed: the robot did not pass all goals"
    )  # fmt: skip
    assert "Of 20 commands 3 were late, the worst by 27 ms." in page.text
    assert "Its path is that of its own counters." in page.text
    assert "growth" not in page.ids  # there are no predictions command by command


def test_trials_of_both_kinds_on_one_page(tmp_path):
    folders = [make_trial(tmp_path / "plan"), seeing_trial(tmp_path / "net")]
    summary = write_report(folders, tmp_path / "page.html")
    assert (summary["trials"], summary["completed"]) == (2, 1)
    page = Page(tmp_path / "page.html")
    rows = page.table(["controllers", "trials"])
    assert [row[0] for row in rows[1:]] == ["plan, 9 commands", "network", "all"]
    rows = {row[0]: row for row in page.table(["trial", "commands"])[1:]}
    assert rows["net"][3:4] + rows["net"][-1:] == ["did not pass all goals", "3 of 20"]
    assert rows["net"][6:9] == ["not known"] * 3
    assert rows["plan"][-1] == "-"


def test_a_robot_that_nobody_saw(tmp_path):
    nowhere = {"seen_by": None, "poses": [None] * 21, "path": [], "rest": None, "fitness": None,
               "completes": True, "reason": None}  # fmt: skip
    trial = seeing_trial(tmp_path / "t", actual=nowhere, deadlines=None, task={"name": "far-away"})
    summary = write_report([trial], tmp_path / "page.html")
    assert summary["verdict"] == "The robot completed the task. (Virtual lab.)"
    assert "The task far-away is not registered" in Page(tmp_path / "page.html").text


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("task", {"name": 3}, r"'task\.name': expected text, found 3"),
        ("task", {"name": "go-to", "settings": {"goals": []}}, r"'task\.settings'"),
        ("task", {"name": "go-to", "settings": {"colour": 1}}, r"'task\.settings'.*colour"),
        ("commands", [["1", 2]], r"'commands\[0\]\[0\]'.*a number from .*, found '1'"),
        (
            "predicted",
            {"poses": [[1, 2]]},
            r"'predicted\.poses\[0\]': expected a list of 3 numbers",
        ),
        ("predicted", {"fitness": "high"}, r"'predicted\.fitness'.*a number, found 'high'"),
        ("actual", {"path": [[1, 2, 3]]}, r"'actual\.path\[0\]': expected a list of 4 numbers"),
        ("actual", {"poses": "none"}, r"'actual\.poses': expected a list, found 'none'"),
        ("errors", [{"position": 1.0}], r"'errors\[0\]\.heading': is missing"),
        ("errors", [None], r"'predicted\.poses'.*expected 21 poses"),
        ("deadlines", {"steps": 5}, r"'deadlines\.missed': is missing"),
    ],
)
def test_a_damaged_field_of_a_trial_is_named(tmp_path, field, value, message):
    trial = seeing_trial(tmp_path / "t", **{field: value})
    with pytest.raises(FileError, match=rf"trial\.json.*{message}"):
        write_report([trial], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("predicted", "fitness"), True, r"'predicted\.fitness'.*a number"),
        (("predicted", "draws"), "many", r"'predicted\.draws'.*a number"),
        (("evolution", "history"), {"mean": [1.0]}, r"'evolution\.history'"),
        (("evolution", "history"), {"best": [1.0, "x"]}, r"'evolution\.history\.best\[1\]'"),
        (("evolution", "history"), {"best": [1.0], "transfer": 2}, r"'evolution\.history'"),
        (
            ("evolution", "place"),
            {"outline": [[0]]},
            r"'evolution\.place\.outline\[0\]'",
        ),
        (("task", "settings"), {"metres": 1}, r"'task\.settings'.*metres"),
    ],
)
def test_a_damaged_field_of_a_controller_is_named(registered, tmp_path, place, value, message):
    made = controller(tmp_path / "c")
    content = json.loads((made / "controller.json").read_text())
    content[place[0]][place[1]] = value
    (made / "controller.json").write_text(json.dumps(content))
    with pytest.raises(FileError, match=rf"controller\.json.*{message}"):
        write_report([made], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def drawing_of(draw, *words):
    """Return the axes that something was drawn into."""
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    draw(axes, *words)
    return axes


def test_rectangles_lie_as_the_task_judges_them():
    task = NineRectangles(length=0.6, course=((1, 2), (0, 3)))
    axes = drawing_of(draw_scene, Scene.of(task))
    places = {text.get_text(): text.get_position() for text in axes.texts}
    assert sorted(places) == ["1", "2", "3", "4"]
    for number, (x, y) in places.items():
        assert task.region(np.array([x, y, 0.0])) == int(number) % task.last
    assert drawing_of(draw_scene, Scene.of(None)).patches[:] == []


def test_small_pictures_are_in_centimetres():
    goals = Scene.of(GoTo(goals=((0.4, 0.1, 0.0),)))
    axes = drawing_of(draw_course, goals, Paths(along()))
    assert axes.get_xlabel() == "x (cm)"
    assert axes.lines[0].get_xydata()[-1] == pytest.approx([60, 18])
    axes = drawing_of(draw_course, Scene.of(NineRectangles()), Paths(along()))
    assert axes.get_xlabel() == "x (m)"
    assert axes.lines[0].get_xydata()[-1] == pytest.approx([0.6, 0.18])


def test_an_outline_that_cannot_be_drawn_is_named():
    with pytest.raises(UserError, match=r"not \{'square': 3\}"):
        course(Scene([{"square": 3}]), Paths(along()), "words", "p")


def view(*words):
    done = CliRunner().invoke(cli, ["view", *map(str, words)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done


def test_a_view_of_any_simulator_with_any_controller(registered, tmp_path):
    out = tmp_path / "x.png"
    words = [simulator(tmp_path / "sea"), "--controller", controller(tmp_path / "c"), "-o", out]
    result = json.loads(view(*words, "--seconds", 2, "--json").stdout)
    path = np.array(result["path"])
    assert path[[0, 20]] == pytest.approx(np.array([[0, 0, 0], [0.4, 0, 0]]), abs=1e-9)
    assert result["fitness"] == pytest.approx(-math.hypot(0.1, 0.2))
    assert (result["completes"], result["note"]) == (False, None)
    assert result["reason"] == "did not reach the harbour"
    assert result["readings"] == pytest.approx([0.5])
    before = imread(out)
    assert before.std() > 0.05
    with pytest.raises(UserError, match=r"x\.png exists; .* add --overwrite"):
        view(*words)
    assert "the robot did not reach the harbour" in view(*words, "--overwrite").stdout
    assert not np.array_equal(imread(out), before)  # ten times as long a drive


def test_a_view_of_a_plan_keeps_to_what_the_simulator_says(tmp_path):
    """Within a command the robot slides along the wall; no arc leads through it."""
    (tmp_path / "sim").mkdir()
    arena = Place.rectangle(0.4, 0.4)
    TableSimulator(made_up(), place=arena, noise="none").write(tmp_path / "sim")
    plan = FixedPlan(((100.0, 100.0, 3.0), (-60.0, -20.0, 1.0)))
    task = {"name": "go-to", "settings": {}}
    made = controller(tmp_path / "c", plan, (), task, poses=along(3))
    result = draw_view(
        tmp_path / "sim", tmp_path / "x.png", controller=made, pose=(0, 0, np.radians(40))
    )
    room = 0.2 - TableSimulator.radius
    assert np.abs(result["path"][:, :2]).max() <= room + 1e-6
    assert len(result["path"]) > 40
    assert result["path"][30, 0] == pytest.approx(room, abs=1e-3)


def wedges_of(simulator, readings):
    figure = picture(Scene(), np.zeros((1, 3)), simulator=simulator, readings=readings)
    return [patch for patch in figure.axes[0].patches if isinstance(patch, Wedge)], figure.axes


def test_sensors_are_drawn_only_where_it_is_known_where_they_look():
    wedges, axes = wedges_of(TableSimulator(made_up()), np.full(8, 0.5))
    middles = [(wedge.theta1 + wedge.theta2) / 2 for wedge in wedges]
    assert middles == pytest.approx([70, 45, 10, -10, -45, -70, -170, 170])
    assert axes[1].get_xticklabels()[0].get_text() == "0\n+70°"
    wedges, axes = wedges_of(Compass(), np.array([0.25]))
    assert wedges == []
    assert [tick.get_text() for tick in axes[1].get_xticklabels()] == ["north"]
    assert isinstance(axes[1], Axes)
    unknown = SimpleNamespace(
        radius=0.03, bearings=np.array([0.1, np.nan]), reading_names=("a", "b")
    )
    wedges, axes = wedges_of(unknown, np.array([0.2, 0.3]))
    assert len(wedges) == 1
    assert [tick.get_text() for tick in axes[1].get_xticklabels()] == ["a\n+6°", "b\n"]
