"""A recording that a network drives, and its dataset."""

import numpy as np
import pytest
from click.testing import CliRunner

from neurosim.cli.main import cli
from neurosim.controllers import FixedPlan, Network, SavedController
from neurosim.lab import CameraParams
from neurosim.lab.camera.optics import Optics
from neurosim.tasks.go_to import GoTo
from tracking.datasets.dataset import Dataset, build
from tracking.datasets.recordings import Recording

SIZE = (320, 240)


def record(folder, controller, *options):
    words = ["record", folder / "r", "--by-network", controller, "--camera-size", "320x240",
             "--calibration", folder / "calibration.json", *options]  # fmt: skip
    return CliRunner().invoke(cli, [*map(str, words)], catch_exceptions=True)


@pytest.fixture
def folder(tmp_path):
    optics = Optics(CameraParams(size=SIZE))
    optics.calibration.write(tmp_path / "calibration.json")
    task = GoTo(goals=((0.4, 0.1, 0.0), (-0.2, 0.0, 0.0)), seconds=3.0, step=0.2, tolerance=0.1)
    weights = np.ravel([[8.0, -8, 0, 0], [8, 8, 0, 0]])
    family = Network(("goal_x", "goal_y", "cos_heading"), scale=50.0)
    SavedController(family, weights, task.describe(), (0.0, 0.0, 0.0)).write(tmp_path / "network")
    plan = FixedPlan(((20.0, 20.0, 1.0),))
    predicted = {
        "poses": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]],
        "rest": [0.1, 0.0, 0.0],
        "fitness": 0.0,
        "completes": False,
    }
    SavedController(plan, np.empty(0), task.describe(), (0.0, 0.0, 0.0), predicted).write(
        tmp_path / "plan"
    )
    return tmp_path


@pytest.mark.slow
def test_a_network_drives_for_so_many_commands_and_its_rows_follow_one_another(folder):
    result = record(folder, folder / "network", "--commands", 30)
    assert result.exit_code == 0, result.output
    recording = Recording(folder / "r")
    sent = [line for line in recording.commands().itertuples() if line.kind == "command"]
    assert len(sent) == 30
    assert np.diff([line.time for line in sent]) == pytest.approx(0.2, abs=0.02)
    assert recording.meta["settings"]["source"]["kind"] == "network"
    build([recording.path], folder / "dataset")
    dataset = Dataset.read(folder / "dataset")
    # All commands, one by one, and the stand before the first.
    assert dataset.meta["windows"] is True
    assert dataset.joined.tolist() == [False, *[True] * (len(dataset) - 1)]
    assert len(dataset) == pytest.approx(31, abs=1)
    given = dataset.table[["left", "right"]].to_numpy()
    assert (
        np.abs(given[1:31] - np.array([line.numbers for line in sent])[: len(given) - 1]).max()
        < 1e-6
    )
    assert dataset.table["duration"].sum() == pytest.approx(30 * 0.2 + 0.25, abs=0.1)
    held = build([recording.path], folder / "held", windows=False)
    assert held.joined is None
    assert len(held) < 31


def test_what_does_not_go_together_is_refused(folder):
    for options, message in (
        (["--by-hand"], "--by-hand and --by-network do not go together"),
        (["--guided"], "--guided and --by-network do not go together"),
        (["--max-speed", 20], "--max-speed is not for --by-network: leave it out"),
    ):
        assert message in str(record(folder, folder / "network", *options).exception)
    refused = str(record(folder, folder / "plan").exception)
    assert "drive it with neurosim run" in refused
    words = ["record", str(folder / "r"), "--by-hand", "--commands", "5"]
    refused = CliRunner().invoke(cli, words)
    assert "--commands is not for --by-hand: leave it out" in str(refused.exception)
    assert not (folder / "r").exists()
