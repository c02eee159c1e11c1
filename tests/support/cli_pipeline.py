"""The whole pipeline, run once in the virtual lab through the command line."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import pytest
from filelock import FileLock
from processes import neurosim


@dataclass
class Pipeline:
    """The paths of all folders, and the JSON that each command printed."""

    folder: Path
    printed: dict[str, dict]

    def __truediv__(self, name: str) -> Path:
        return self.folder / name


@pytest.fixture(scope="session")
def pipeline(tmp_path_factory) -> Pipeline:
    """Run all stages. Sixty commands are too few to learn from, but suffice to run every stage.

    The stages run once, in whichever worker needs them first.
    """
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    done = shared / "pipeline.json"
    with FileLock(shared / "pipeline.lock"):
        if not done.exists():
            folder = tmp_path_factory.mktemp("pipeline")
            done.write_text(json.dumps([str(folder), stages(folder)]))
    folder, printed = json.loads(done.read_text())
    return Pipeline(Path(folder), printed)


def stages(folder: Path) -> dict[str, dict]:
    """Run all stages in a folder; return the JSON that each printed."""
    steps = {
        "photographs": "lab photographs photographs --count 8",
        "calibrate": "calibrate photographs --square 40 --points photographs/points.csv",
        "record": "record recording --commands 60 --fps 20 --calibration calibration.json --seed 4",
        "track": "track recording",
        "dataset": "dataset recording -o dataset",
        "train": "train dataset -o simulator --seed 1 --members 4",
        "evaluate": "evaluate simulator dataset",
        "evolve": "evolve simulator -o controller --generations 40 --runs 2 --seed 1",
        "run": "run controller -o trial --calibration calibration.json --seed 9",
        "report": "report dataset simulator controller trial -o report.html",
    }
    printed = {}
    for name, line in steps.items():
        printed[name] = json.loads(neurosim(*line.split(), "--json", cwd=folder).stdout)
    return printed
