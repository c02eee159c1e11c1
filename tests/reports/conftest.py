"""Fixtures of the tests of animated drives."""

import pytest
from ideal_simulator import SlippingWheels
from report_artefacts import make_controller, make_trial

from neurosim.base import files
from neurosim.simulators.registry import SIMULATORS


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """A trial, its controller and its simulator, whose wheels slip."""
    monkeypatch.setitem(SIMULATORS._registered, "slipping", lambda folder, device: SlippingWheels())
    simulator = tmp_path / "simulator"
    simulator.mkdir()
    kind = {"kind": "slipping"}
    files.write_json(simulator / "simulator.json", "neurosim-simulator", 2, kind)
    controller = make_controller(tmp_path / "controller")
    trial = make_trial(tmp_path / "trial", seed=3, unseen=(4,))
    content = files.read_json(trial / "trial.json", "neurosim-trial", 1)
    for name in ("simulator", "controller"):
        content[name]["sha256"] = files.sha256(tmp_path / name / f"{name}.json")
    files.write_json(trial / "trial.json", "neurosim-trial", 1, content)
    return trial, controller, simulator
