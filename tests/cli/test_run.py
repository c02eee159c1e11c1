"""The simulator and the guard of a drive, and the text of its result."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from neurosim.base.files import sha256
from neurosim.cli.run import _simulator, _text
from neurosim.trials.trial import _guarded


@pytest.mark.parametrize(
    ("missed", "replanned", "advice"), [(60, False, False), (61, False, True), (61, True, False)]
)
def test_a_drive_whose_commands_were_often_late_is_not_the_simulated_one(missed, replanned, advice):
    report = {
        "actual": {"completes": True, "fitness": 52.3, "reason": None},
        "predicted": {"fitness": 52.4},
        "guard": {"predicted": True, "driven": True},
        "errors": [],
        "replanned": replanned,  # a plan has no --step
        "deadlines": {"steps": 600, "missed": missed, "worst_late_s": 0.0837},
    }
    text = _text(Path("trial"), Path("network"), report)
    assert f"{missed} of 600 commands were late" in text
    assert ("by 0.08 s at most" in text) == advice
    assert ("evolve with a longer --step" in text) == advice


def test_the_simulator_is_found_from_any_folder(tmp_path, monkeypatch):
    simulator, controller = tmp_path / "sims" / "s", tmp_path / "plans" / "p"
    elsewhere = tmp_path / "other" / "folder"
    for folder in (simulator, controller, elsewhere):
        folder.mkdir(parents=True)
    (simulator / "simulator.json").write_text("{}")
    digest = sha256(simulator / "simulator.json")
    saved = SimpleNamespace(simulator={"path": "sims/s", "sha256": digest})
    for place in (tmp_path, elsewhere):
        monkeypatch.chdir(place)
        assert _simulator(saved, controller).resolve() == simulator
    (simulator / "simulator.json").write_text("{ }")  # another one
    assert _simulator(saved, controller) is None


@pytest.mark.parametrize(
    ("at_line", "by", "sensors", "camera", "guarded"),
    [
        ("end", "both", {"line_left": [0.1, 0.0]}, "none", True),
        ("end", "position", {"line_left": [0.1, 0.0]}, "none", False),
        ("end", "both", {}, "none", False),
        ("end", "both", {}, "lab", True),
        ("return", "position", {}, "lab", True),
        ("ignore", "both", {"line_left": [0.1, 0.0]}, "lab", False),
    ],
)
def test_a_drive_is_guarded_by_light_sensors_or_by_a_camera(at_line, by, sensors, camera, guarded):
    meta = {
        "settings": {"guard": {"at_line": at_line, "by": by}},
        "robot": {"light_sensors": sensors},
        "camera": {"kind": camera},
    }
    assert _guarded(SimpleNamespace(meta=meta)) is guarded
