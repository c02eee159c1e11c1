"""From a drawing to a trial: one place in every stage."""

import json

import pytest
from click.testing import CliRunner
from simulators_of_tests import tables

from neurosim.base.place import Place
from neurosim.cli.main import cli
from neurosim.controllers import read_controller
from neurosim.tasks.registry import make_task

DRAWING = """<svg xmlns="http://www.w3.org/2000/svg">
<line id="scale-10cm" x1="0" y1="0" x2="100" y2="0"/>
<rect id="outline" x="0" y="0" width="800" height="600"/>
<g id="walls"><line x1="400" y1="0" x2="400" y2="200"/></g>
<circle class="obstacles" cx="600" cy="300" r="27.5"/>
<line id="start" x1="200" y1="300" x2="250" y2="300"/>
</svg>"""


def call(*words):
    done = CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done


def test_a_drawing_is_imported_and_drawn(tmp_path):
    (tmp_path / "drawing.svg").write_text(DRAWING)
    out = tmp_path / "place.json"
    words = ["place", "import", tmp_path / "drawing.svg", "-o", out]
    result = json.loads(call(*words, "--json").stdout)
    assert result == {
        "place": str(out), "corners": 4, "walls": 1, "obstacles": 1, "lines": 0, "lights": 0,
        "board": False, "start": True,
    }  # fmt: skip
    assert Place.read(out).start == (-0.2, 0.0, 0.0)
    call("view", out, "-o", tmp_path / "place.svg")
    assert "<svg" in (tmp_path / "place.svg").read_text()
    for wrong, message in (
        (words, "exists; name another file, or add --overwrite"),
        ([*words[:-1], tmp_path / "place.txt"], "ends in .json"),
        (["place", "import", out, "-o", tmp_path / "p.json"], "is not XML"),
    ):
        done = CliRunner().invoke(cli, [str(word) for word in wrong])
        assert message in str(done.exception)
    assert call(*words, "--overwrite").stdout.startswith(f"{out}: 4 corners, 1 wall, 1 obstacle")


@pytest.mark.slow
def test_a_plan_is_evolved_checked_driven_and_drawn_in_one_place(tmp_path):
    (tmp_path / "drawing.svg").write_text(DRAWING)
    call("place", "import", tmp_path / "drawing.svg", "-o", tmp_path / "place.json")
    tables().write(tmp_path / "tables")
    call(
        "evolve", tmp_path / "tables", "--task", "go-to", "--goals", "[[0.1, 0.0, 0.0]]",
        "--radius", 0.0275, "--place", tmp_path / "place.json", "--generations", 5, "--population",
        40, "--runs", 1, "--commands", 2, "-o", tmp_path / "plan",
    )  # fmt: skip
    place, saved = Place.read(tmp_path / "place.json"), read_controller(tmp_path / "plan")
    assert make_task(saved.task).place == place
    assert saved.start == place.start
    assert Place.of(saved.evolution["place"]) == place
    # Everything after that reads the place from the controller.
    (tmp_path / "place.json").unlink()
    call("plan-check", tmp_path / "plan", tmp_path / "tables", "--draws", 50)
    call(
        "run", tmp_path / "plan", "--robot", "virtual-khepera", "--camera", "none",
        "-o", tmp_path / "trial",
    )  # fmt: skip
    recording = json.loads((tmp_path / "trial" / "recording.json").read_text())
    assert Place.of(recording["place"]) == place
    call("report", tmp_path / "tables", tmp_path / "plan", tmp_path / "trial", "-o",
         tmp_path / "report.html")  # fmt: skip
    out = tmp_path / "plan.svg"
    sampled = json.loads(
        call(
            "view", tmp_path / "tables", "--controller", tmp_path / "plan", "-o", out, "--json"
        ).stdout
    )
    assert sampled["path"][0] == pytest.approx(place.start)
