"""Every notebook runs from top to bottom, shows its pictures and cleans up after itself."""

from __future__ import annotations

import base64
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from patience import PATIENCE

nbformat = pytest.importorskip("nbformat", reason="pip install 'neurosim[notebooks]'")
run_notebooks = pytest.importorskip(
    "run_notebooks", reason="pip install 'neurosim[notebooks]'", exc_type=ImportError
)

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))
by_name = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)

FEWEST_PICTURES = 3
#: Size of a notebook, bytes.
LARGEST = 300_000
#: Shorter searches, which the tests run.
SHORTER = {
    "nxt_planner": {
        "rows.split(0.7)": "rows.split(0.9)",
        "members=4, seed=1": "members=2, seed=1, centres=20, most_parts=4000",
        "RecordSettings(40)": "RecordSettings(20)",
        '"generations": 800, "runs": 10': '"generations": 50, "runs": 2',
        "RobustSettings(generations=150)": "RobustSettings(generations=2)",
        "range(1, 6)": "range(1, 2)",
        "range(5)": "range(1)",
    },
    "back_to_reality": {
        "gait, task = Gait(), Walking()": "gait, task = Gait(), Walking(seconds=1.0)",
        "standard_normal((24, gait.genes))": "standard_normal((6, gait.genes))",
        "    generations=10,\n    later_generations=8,\n    candidates=10,": (
            "    generations=3,\n    later_generations=3,\n    candidates=4,"
        ),
        "adapt_generations=6": "adapt_generations=3",
        "confirm=3,\n    trials=3,": "confirm=2,\n    trials=1,",
        "np.tile(hand, (5, 1))": "np.tile(hand, (2, 1))",
        "np.tile(genes, (10, 1))": "np.tile(genes, (2, 1))",
    },
    "closed_loop": {
        "members=4, seed=1": "members=2, seed=1, centres=20, most_parts=4000",
        "generations=60, runs=4, robust=RobustSettings(generations=40)": (
            "generations=10, runs=2, robust=RobustSettings(generations=2)"
        ),
        "progress=False, generations=30": "progress=False, generations=5",
        "standard_normal((20, 3))": "standard_normal((2, 3))",
        "range(4)": "range(1)",
        "step=0.2, seconds=16": "step=0.2, seconds=6",
        "step=0.2, seconds=30": "step=0.2, seconds=6",
    },
    "khepera_tables": {
        "distances=8, step=0.005, grid=5": "distances=5, step=0.005, grid=3, duration=0.5",
        "generations=60": "generations=5",
        "range(1, 61)": "range(1, 6)",
    },
    "own_robot": {
        "range(200)": "range(60)",
        "members=4, seed=1": "members=2, seed=1, centres=20",
        "generations=60, runs=2, robust=RobustSettings(generations=20)": (
            "generations=5, runs=1, robust=RobustSettings(generations=2)"
        ),
        "range(10)": "range(2)",
    },
}


def test_there_are_notebooks():
    assert NOTEBOOKS


def shows(cell):
    """Return whether a cell has an output."""
    return bool(re.search(r"^ *(print|plt\.show)\(", cell.source, flags=re.MULTILINE))


@by_name
def test_it_is_stored_with_its_outputs(path):
    again = f"run it and store its outputs: python docs/run_notebooks.py notebooks/{path.name}"
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = run_notebooks.code_cells(notebook)
    assert notebook.metadata["outputs_of"] == run_notebooks.digest(notebook), again
    assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)], again
    assert not [cell.source for cell in cells if shows(cell) and not cell.outputs], again
    for output in (output for cell in cells for output in cell.outputs):
        assert output.output_type != "error"
        assert output.get("name") != "stderr", output.text
        shown = output.get("text", "") + output.get("data", {}).get("text/plain", "")
        assert not re.search(r"/tmp/|/home/|/work/|/Users/", shown), shown
    assert path.stat().st_size < LARGEST


def test_a_picture_is_stored_smaller():
    rows, columns = np.mgrid[:200, :300]
    smooth = np.stack([rows % 256, columns % 256, (rows + columns) % 256], -1).astype(np.uint8)
    sampled = np.full((200, 300, 3), 255, np.uint8)
    sampled[90:110] = 0, 114, 178
    for picture, kind in ((smooth, "image/jpeg"), (sampled, "image/png")):
        _, encoded = cv2.imencode(".png", picture)
        before = base64.b64encode(encoded).decode()
        data = {"image/png": before}
        run_notebooks.small(data)
        assert [*data] == [kind]
        assert len(data[kind]) < len(before)
        shown = cv2.imdecode(np.frombuffer(base64.b64decode(data[kind]), np.uint8), 1)[..., ::-1]
        assert np.abs(shown.astype(float) - picture[..., ::-1]).mean() < 12


@pytest.mark.skipif(
    not os.environ.get("NEUROSIM_EXTRAS"), reason="run by make test-extras: notebooks take minutes"
)
@by_name
def test_it_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    pytest.importorskip("ipykernel", reason="pip install 'neurosim[notebooks]'")
    for name in ("TMPDIR", "TEMP", "TMP"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = run_notebooks.run(path, PATIENCE, SHORTER.get(path.stem))
    outputs = [output for cell in run_notebooks.code_cells(notebook) for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) >= FEWEST_PICTURES
    assert not list(tmp_path.glob("neurosim-*")), "the notebook leaves its folder behind"


def test_away_from_the_reference_dataset_it_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (path,) = (path for path in NOTEBOOKS if path.stem == "nxt_planner")
    first = run_notebooks.code_cells(nbformat.read(path, as_version=4))[0].source
    with pytest.raises(FileNotFoundError, match="run this notebook in neurosim's own folder"):
        exec(first, {})
