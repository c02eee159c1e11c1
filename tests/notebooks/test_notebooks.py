"""Every notebook runs from top to bottom, shows its pictures and cleans up after itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from patience import PATIENCE

nbformat = pytest.importorskip("nbformat", reason="pip install 'neurosim[notebooks]'")

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))
by_name = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)

FEWEST_PICTURES = 3


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_there_are_notebooks():
    assert NOTEBOOKS


@by_name
def test_it_is_committed_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    for cell in code_cells(notebook):
        assert not cell.outputs, "clear the outputs before committing"
        assert cell.execution_count is None


@pytest.mark.slow
@by_name
def test_it_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="pip install 'neurosim[notebooks]'")
    pytest.importorskip("ipykernel", reason="pip install 'neurosim[notebooks]'")
    for name in ("TMPDIR", "TEMP", "TMP"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(path, as_version=4)
    # This interpreter's own kernel, whichever kernels the user has installed besides.
    nbclient.NotebookClient(
        notebook,
        timeout=PATIENCE,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.parent)}},
    ).execute()
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) >= FEWEST_PICTURES
    assert not list(tmp_path.glob("neurosim-*")), "the notebook leaves its folder behind"


def test_away_from_the_reference_dataset_it_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (path,) = (path for path in NOTEBOOKS if path.stem == "nxt_planner")
    first = code_cells(nbformat.read(path, as_version=4))[0].source
    with pytest.raises(FileNotFoundError, match="run this notebook in neurosim's own folder"):
        exec(first, {})
