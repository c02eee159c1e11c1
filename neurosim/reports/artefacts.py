"""The folders that a report is made of, recognised by the JSON that lies in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import FileError, UserError
from neurosim.base.files import read_json, sha256
from neurosim.base.provenance import is_virtual
from neurosim.controllers import read_controller
from neurosim.controllers.network_files import KIND as NETWORK
from neurosim.simulators import TableSimulator, read_simulator
from tracking.datasets.dataset import Dataset

#: What may lie in a folder, the first found counts: a trial is also a recording.
KINDS = ("trial", "recording", "dataset", "simulator", "controller")

_FIELDS: dict[str, dict[str, type | tuple]] = {
    "trial": {
        "virtual": bool,
        "controller": dict,
        "task": dict,
        "commands": list,
        "predicted": dict,
        "actual": dict,
        "errors": list,
    },
    "recording": {"robot": dict, "sessions": list},
    "dataset": {"rows": int, "sources": list, "left_out": dict},
    "simulator": {"inputs": list, "outputs": list},
    "controller": {"commands": list, "task": dict, "predicted": dict},
}
#: What else lies in the files of simulators and controllers of these kinds, in place of the above.
_OTHER_FIELDS: dict[str, dict[str, type | tuple]] = {
    TableSimulator.kind: {"sensors": dict, "motors": dict},
    NETWORK: {"task": dict, "predicted": dict, "evolution": dict},
}
#: The newest version of each that this page reads.
_VERSIONS = {"trial": 1, "recording": 1, "dataset": 1, "simulator": 2, "controller": 1}


@dataclass
class Artefact:
    """A folder of one kind, with what its JSON says."""

    kind: str
    path: Path
    meta: dict[str, Any]

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.resolve().name

    @property
    def json(self) -> Path:
        """The file that says what the folder is."""
        return self.path / f"{self.kind}.json"


@dataclass
class Trial(Artefact):
    """A controller at work, with the recording that it was."""

    recording: dict[str, Any] = field(default_factory=dict)

    @property
    def predicted(self) -> NDArray:
        """Predicted poses (K + 1, 3): the start, and one after each given command."""
        return np.array(self.meta["predicted"]["poses"], float).reshape(-1, 3)

    @property
    def errors(self) -> NDArray:
        """Distance (m) and difference of heading (rad) after each command (K, 2); NaN if unseen.

        That at the start, before the first command, is not among them.
        """
        after = self.meta["errors"][-len(self.meta["commands"]) :]
        rows = [
            (math.nan, math.nan) if error is None else (error["position"], error["heading"])
            for error in after
        ]
        return np.abs(np.array(rows, float).reshape(-1, 2))

    @property
    def completes(self) -> bool:
        """Whether the robot completed the task."""
        return bool(self.meta["actual"].get("completes"))


@dataclass
class Artefacts:
    """All that a report is made of, by kind, in the order in which it was named."""

    trials: list[Trial] = field(default_factory=list)
    recordings: list[Artefact] = field(default_factory=list)
    datasets: list[tuple[Artefact, Dataset]] = field(default_factory=list)
    simulators: list[Artefact] = field(default_factory=list)
    controllers: list[Artefact] = field(default_factory=list)
    tables: list[tuple[Artefact, TableSimulator]] = field(default_factory=list)
    networks: list[Artefact] = field(default_factory=list)

    @property
    def everything(self) -> list[Artefact]:
        """Every folder, along the road from recording to trial."""
        datasets = [artefact for artefact, _ in self.datasets]
        tables = [artefact for artefact, _ in self.tables]
        return [
            *self.recordings, *datasets, *self.simulators, *tables, *self.controllers,
            *self.networks, *self.trials,
        ]  # fmt: skip

    @property
    def virtual(self) -> bool | None:
        """Whether any of it is from the virtual lab; None if nothing says where it is from."""
        return is_virtual([artefact.meta for artefact in self.everything])


def gather(folders: Sequence[str | Path]) -> Artefacts:
    """Read folders; one that is named twice is read once.

    Raises:
        UserError: if nothing is named, or a folder is of no known kind.
        FileError: if a file in one is missing, of another version, cut short or wrong.
    """
    found = Artefacts()
    seen: set[Path] = set()
    for path in map(Path, folders):
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        kind = _kind(path)
        json, named = path / f"{kind}.json", (f"neurosim-{kind}", _VERSIONS[kind])
        other = read_json(json, *named).get("kind")
        fields = _OTHER_FIELDS.get(other) if isinstance(other, str) else None
        meta = read_json(json, *named, fields or _FIELDS[kind])
        if kind == "simulator" and other == TableSimulator.kind:
            found.tables.append((Artefact(kind, path, meta), TableSimulator.read(path)))
        elif kind == "controller" and other == NETWORK:
            found.networks.append(_network(path, meta))
        elif kind == "trial":
            found.trials.append(_trial(path, meta))
        elif kind == "dataset":
            found.datasets.append((Artefact(kind, path, meta), Dataset.read(path)))
        else:
            if kind == "controller":
                read_controller(path)  # checks it, to the last number
            elif kind == "simulator":
                read_simulator(path)  # and its weights
            getattr(found, f"{kind}s").append(Artefact(kind, path, meta))
    if not seen:
        raise UserError("name at least one folder to report on")
    return found


def _kind(path: Path) -> str:
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise FileError(path, f"{what}; expected the folder of a {', '.join(KINDS)}")
    for kind in KINDS:
        if (path / f"{kind}.json").exists():
            return kind
    names = ", ".join(f"{kind}.json" for kind in KINDS)
    raise FileError(path, f"is no folder that a report can show: it has none of {names}")


def _network(path: Path, meta: dict[str, Any]) -> Artefact:
    read_controller(path)
    fitness = meta["predicted"].get("fitness")
    if isinstance(fitness, bool) or not isinstance(fitness, int | float):
        raise FileError(
            path / "controller.json",
            f"expected a number, found {fitness!r:.60}",
            field="predicted.fitness",
        )
    return Artefact("controller", path, meta)


def _trial(path: Path, meta: dict[str, Any]) -> Trial:
    json = path / "trial.json"
    count = len(meta["commands"])
    for part in ("predicted", "actual"):
        poses = meta[part].get("poses")
        if not isinstance(poses, list) or len(poses) != count + 1:
            raise FileError(
                json,
                f"expected {count + 1} poses (the start, and one for each of {count} commands)",
                field=f"{part}.poses",
            )
    if not count or len(meta["errors"]) not in (count, count + 1):
        raise FileError(json, f"expected one for each of {count} commands", field="errors")
    recording = {}
    if (path / "recording.json").exists():
        recording = read_json(path / "recording.json", "neurosim-recording", 1)
    trial = Trial("trial", path, meta, recording)
    try:
        _ = trial.predicted, trial.errors
    except (KeyError, TypeError, ValueError):
        raise FileError(
            json, "expected predicted poses [x, y, theta] and errors {position, heading}"
        ) from None
    return trial


def files_of(artefact: Artefact) -> dict[str, str]:
    """Return the SHA-256 of the files that hold an artefact's content, by name.

    Videos are left out: they are large, and what was learned from them stands in the poses.
    """
    names = sorted(
        path.name
        for path in artefact.path.iterdir()
        if path.suffix in (".json", ".csv", ".safetensors") and path.is_file()
    )
    return {name: sha256(artefact.path / name) for name in names}
