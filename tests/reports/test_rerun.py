"""A trial in rerun's file, read back by rerun."""

import json
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from rerun.chunk import RrdReader

from neurosim.base.errors import UserError
from neurosim.base.files import write_csv
from neurosim.cli.main import cli
from neurosim.reports.artefacts import gather
from neurosim.reports.film import film
from tracking.datasets.recordings import Recording


def rows(out, entity, column):
    """Return times (s) and values of a column of an entity, in the order of time."""
    results = []
    for chunk in RrdReader(out).stream():
        if chunk.entity_path == entity:
            batch = chunk.to_record_batch()
            if column in batch.schema.names:
                values = batch.column(column).to_pylist()
                times = batch.column("drive").cast("int64").to_numpy() / 1e9
                results += [pair for pair in zip(times, values, strict=True) if pair[1]]
    return sorted(results, key=lambda pair: pair[0])


def test_poses_samples_and_readings_are_the_trials(folders, tmp_path):
    trial, controller, simulator = folders
    recording = Recording.create(tmp_path / "r", {})
    (recording.path / "recording.json").rename(trial / "recording.json")
    begun = json.loads((trial / "trial.json").read_text())["actual"]["path"][0][0]
    looks = {"session": [1, 1], "command": [0, 1], "time": [begun, begun + 3.0]}
    looks |= {"x": [0, 0], "y": [0, 0], "theta": [0, 0], "light": [0.25, 0.75]}
    write_csv(trial / "observations.csv", looks)
    out = tmp_path / "drive.rrd"
    words = ["export", trial, simulator, controller, "--to", "rerun", "-o", out, "--json"]
    done = CliRunner().invoke(cli, [*map(str, words)], catch_exceptions=False)
    content = json.loads(done.stdout)
    artefacts = gather(folders)
    shown = film(artefacts, artefacts.trials[0])
    assert content["frames"] == len(shown.times)
    assert (content["samples"], content["sensors"]) == (20, ["light"])
    for name, poses in (("robot", shown.robot), ("predicted", shown.predicted)):
        known = np.isfinite(poses).all(axis=1)
        origins = rows(out, f"/{name}", "Arrows3D:origins")
        vectors = rows(out, f"/{name}", "Arrows3D:vectors")
        assert [time for time, _ in origins] == pytest.approx(shown.times[known].tolist(), abs=1e-6)
        places = np.array([value[0] for _, value in origins])
        assert places[:, :2] == pytest.approx(poses[known, :2], abs=1e-6)
        headings = np.array([np.arctan2(value[0][1], value[0][0]) for _, value in vectors])
        assert np.cos(headings - poses[known, 2]).min() > 1 - 1e-6
    samples = rows(out, "/samples", "Points3D:positions")
    assert np.array(samples[30][1])[:, :2] == pytest.approx(shown.samples[:, 30, :2], abs=1e-6)
    readings = rows(out, "/sensors/light", "Scalars:scalars")
    assert (readings[0][1], readings[-1][1]) == ([0.25], [0.75])


def test_what_cannot_be_exported(folders, tmp_path, monkeypatch):
    trial, controller, _ = folders

    def export(source, out):
        words = ["export", str(source), "--to", "rerun", "-o", str(out)]
        return CliRunner().invoke(cli, words, catch_exceptions=False)

    taken = tmp_path / "taken.rrd"
    taken.touch()
    for source, out, says in (
        (trial, tmp_path / "x.mp4", "ends in .rrd"),
        (trial, taken, "exists; name a new file"),
        (controller, tmp_path / "x.rrd", "is not a trial"),
    ):
        with pytest.raises(UserError, match=says):
            export(source, out)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError, match=r"pip install 'neurosim\[rerun\]'"):
        export(trial, tmp_path / "x.rrd")
    assert not list(tmp_path.glob("x*"))
