"""The pipeline walked once, in the virtual lab, through the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from patience import PATIENCE


def neurosim(*words, cwd, check=True) -> subprocess.CompletedProcess:
    """Run the command as a user does."""
    done = subprocess.run(
        [sys.executable, "-m", "neurosim", *map(str, words)],
        cwd=cwd,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=PATIENCE,
    )
    if check:
        assert done.returncode == 0, done.stderr
    return done


@dataclass
class Pipeline:
    """Where everything stands, and what each command printed with --json."""

    folder: Path
    printed: dict[str, dict]

    def __truediv__(self, name: str) -> Path:
        return self.folder / name


@pytest.fixture(scope="session")
def pipeline(tmp_path_factory) -> Pipeline:
    """Sixty commands are no data to learn from, but every command has its turn."""
    folder = tmp_path_factory.mktemp("pipeline")
    steps = {
        "photographs": "lab photographs photographs --count 8",
        "calibrate": "calibrate photographs --square 40 --points photographs/points.csv",
        "record": "record recording --commands 60 --calibration calibration.json --seed 4",
        "track": "track recording",
        "dataset": "dataset recording -o dataset",
        "train": "train dataset -o simulator --seed 1",
        "evaluate": "evaluate simulator dataset",
        "evolve": "evolve simulator -o controller --generations 40 --runs 2 --seed 1",
        "run": "run controller -o trial --calibration calibration.json --seed 9",
        "report": "report dataset simulator controller trial -o report.html",
    }
    printed = {}
    for name, line in steps.items():
        printed[name] = json.loads(neurosim(*line.split(), "--json", cwd=folder).stdout)
    return Pipeline(folder, printed)
