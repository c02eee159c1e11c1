"""Run the notebooks and store their outputs: python docs/run_notebooks.py [NOTEBOOK...].

Pictures are stored small, as JPEG or as PNG with a palette. A notebook also stores the SHA-256 of
the code that its outputs are of.
"""

from __future__ import annotations

import base64
import hashlib
import io
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbclient
import nbformat
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
#: Of pictures: colours of a palette, and the quality of a JPEG.
COLOURS = 32
QUALITY = 50


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def digest(notebook: Any) -> str:
    """Return the SHA-256 of a notebook's code."""
    code = "\n\n".join(cell.source for cell in code_cells(notebook))
    return hashlib.sha256(code.encode()).hexdigest()


def run(path: Path, patience: float | None = None, changes: Mapping[str, str] | None = None) -> Any:
    """Run a notebook in a kernel of this interpreter; return it with its outputs.

    Args:
        path: the notebook.
        patience: longest time of a cell, s; None: any.
        changes: text that replaces another text of the code, by that one.

    Raises:
        ValueError: if a text to replace is in no cell, or in several.
    """
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    notebook = nbformat.read(path, as_version=4)
    for old, new in (changes or {}).items():
        (cell,) = (cell for cell in code_cells(notebook) if old in cell.source)
        cell.source = cell.source.replace(old, new)
    metadata = dict(notebook.metadata)
    nbclient.NotebookClient(
        notebook,
        timeout=patience,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(path.parent)}},
    ).execute()
    notebook.metadata = nbformat.from_dict(metadata)
    return notebook


def small(data: Any) -> None:
    """Replace the PNG of an output by a smaller picture."""
    picture = Image.open(io.BytesIO(base64.b64decode(data.pop("image/png")))).convert("RGB")
    made = {}
    for kind, shown, options in (
        ("image/png", picture.quantize(COLOURS, dither=Image.Dither.NONE), {"optimize": True}),
        ("image/jpeg", picture, {"quality": QUALITY, "optimize": True}),
    ):
        file = io.BytesIO()
        shown.save(file, kind.removeprefix("image/"), **options)
        made[kind] = base64.b64encode(file.getvalue()).decode()
    kind = min(made, key=lambda each: len(made[each]))
    data[kind] = made[kind]


def kept(outputs: list[Any]) -> list[Any]:
    """Return outputs without progress (stderr), with joined texts and small pictures."""
    shortened: list[Any] = []
    for output in outputs:
        if output.get("name") == "stderr":
            continue
        if shortened and output.output_type == shortened[-1].output_type == "stream":
            shortened[-1].text += output.text
            continue
        if "image/png" in output.get("data", {}):
            small(output.data)
        shortened.append(output)
    return shortened


def main(paths: list[Path]) -> None:
    for path in paths or sorted((ROOT / "notebooks").glob("*.ipynb")):
        print(path.name, flush=True)
        notebook = run(path)
        for cell in code_cells(notebook):
            cell.outputs = kept(cell.outputs)
        notebook.metadata["outputs_of"] = digest(notebook)
        nbformat.write(notebook, path)
        print(f"{path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
