"""The sources of simulators and controllers, and whether they are from the virtual lab."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neurosim.base.files import read_json, sha256
from neurosim.base.provenance import is_virtual
from neurosim.simulators.base import FORMAT, VERSION

#: Files that name the robot of a folder of samples or of a dataset.
_ABOUT = {"sampling.json": ("neurosim-sampling", 2), "dataset.json": ("neurosim-dataset", 2)}


def sources(paths: Sequence[str | Path]) -> dict[str, Any]:
    """Describe the source files of a simulator for simulator.json.

    A ``.sample`` file cannot name its robot; the ``sampling.json`` of ``neurosim sample`` next to
    it does.

    Args:
        paths: sample files, files of motor samples, or datasets.

    Returns:
        ``source``: path and SHA-256 of each, and ``virtual`` if it is known whether it is from the
            virtual lab.

    Raises:
        FileError: if such a file is damaged.
    """
    entries = []
    for path in map(Path, paths):
        entry: dict[str, Any] = {
            "path": str(path),
            "sha256": sha256(path / "dataset.csv" if path.is_dir() else path),
        }
        folder = path if path.is_dir() else path.parent
        virtual = is_virtual(
            [
                read_json(folder / name, *which)
                for name, which in _ABOUT.items()
                if (folder / name).exists()
            ]
        )
        entries.append(entry if virtual is None else {**entry, "virtual": virtual})
    return {"source": entries}


def named(simulator: str | Path) -> dict[str, Any]:
    """Describe the simulator of a controller for its file.

    Returns:
        ``path``, ``sha256`` of simulator.json, and ``virtual`` if the simulator has it.

    Raises:
        FileError: if simulator.json is wrong.
    """
    path = Path(simulator) / "simulator.json"
    virtual = is_virtual(read_json(path, FORMAT, VERSION))
    about = {"path": str(simulator), "sha256": sha256(path)}
    return about if virtual is None else {**about, "virtual": virtual}


def digest(simulator: str | Path) -> str:
    """Return the SHA-256 of a simulator's files: their names and contents, weights included."""
    folder, hashed = Path(simulator), hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        hashed.update(f"{path.relative_to(folder).as_posix()} {sha256(path)}\n".encode())
    return hashed.hexdigest()
