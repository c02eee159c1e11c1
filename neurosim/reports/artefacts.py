"""The folders of a report, recognised by the JSON in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import formats
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import made, read_json, sha256
from neurosim.base.place import Place
from neurosim.base.provenance import is_virtual
from neurosim.controllers import read_controller
from neurosim.simulators import read_simulator
from neurosim.simulators.base import VERSION as SIMULATOR
from neurosim.tasks.base import Task
from neurosim.tasks.registry import TASKS, make_task
from tracking.datasets.dataset import OUTPUTS, Dataset
from tracking.datasets.dataset import VERSION as DATASET

#: Kinds of folders, with their JSON's format and newest version, and the reader of the other files.
#: The first kind that fits counts, because a trial is also a recording.
KINDS: dict[str, tuple[type, int, Callable[[Path], Any] | None]] = {
    "trial": (formats.Trial, 1, None),
    "recording": (formats.TrialRecording, 1, None),
    "dataset": (formats.Dataset, DATASET, Dataset.read),
    "simulator": (formats.Simulator, SIMULATOR, read_simulator),
    "controller": (formats.Controller, 1, read_controller),
    "back-to-reality": (formats.BackToReality, 1, None),
}


@dataclass
class Artefact:
    """A folder of one kind, with the content of its JSON.

    Attributes:
        kind: one of :data:`KINDS`.
        path: the folder.
        meta: its JSON.
        content: the dataset, the simulator or the saved controller; None for other kinds.
        recording: the content of a trial's recording.json.
    """

    kind: str
    path: Path
    meta: dict[str, Any]
    content: Any = None
    recording: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.resolve().name

    @property
    def json(self) -> Path:
        """The JSON file of the folder."""
        return self.path / f"{self.kind}.json"

    @cached_property
    def task(self) -> Task | None:
        """The task of a controller or trial; None: its package is not installed here.

        Raises:
            FileError: if the task does not accept the settings in the file.
        """
        return task_of(self.meta["task"], self.json)

    @property
    def learned(self) -> bool:
        """Whether this is a simulator that predicts single commands of a dataset."""
        named = "inputs" in self.meta and "outputs" in self.meta
        return named and (self.content is None or hasattr(self.content, "displacement"))

    @property
    def sampled(self) -> bool:
        """Whether this is a simulator from samples of a robot's own sensors and motors."""
        sensors = getattr(self.content, "sensors", None)
        return hasattr(sensors, "bearings") and hasattr(self.content, "motors")


@dataclass
class Trial(Artefact):
    """A trial of a controller, with its recording."""

    @property
    def by_command(self) -> bool:
        """Whether the poses after each command are compared with predicted ones, as for a plan."""
        return bool(self.meta["errors"])

    @property
    def predicted(self) -> NDArray:
        """Predicted poses [K + 1, 3], the start first; [0, 3] where none are predicted."""
        return np.array(self.meta["predicted"].get("poses") or [], float).reshape(-1, 3)

    @property
    def errors(self) -> NDArray:
        """Distance (m) and difference of heading (rad) after each command [K, 2]; NaN if unseen.

        The error at the start, before the first command, is left out. If commands are not compared
        with a prediction, K is 0.
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

    @property
    def board(self) -> dict[str, float] | None:
        """``length`` along x and ``width`` along y of the board, m, if known."""
        return self.recording.get("board")


@dataclass
class Artefacts:
    """All folders of a report, by kind, in the given order."""

    trials: list[Trial] = field(default_factory=list)
    recordings: list[Artefact] = field(default_factory=list)
    datasets: list[Artefact] = field(default_factory=list)
    simulators: list[Artefact] = field(default_factory=list)
    controllers: list[Artefact] = field(default_factory=list)
    alternations: list[Artefact] = field(default_factory=list)

    @property
    def everything(self) -> list[Artefact]:
        """Every folder, in the order of the pipeline, from recording to trial."""
        return [
            *self.recordings, *self.datasets, *self.simulators, *self.controllers,
            *self.alternations, *self.trials,
        ]  # fmt: skip

    @property
    def by_commands(self) -> bool:
        """Whether any folder has commands with durations, from recordings to plans."""
        return bool(
            self.recordings
            or self.datasets
            or any(trial.by_command for trial in self.trials)
            or any(one.learned for one in self.simulators)
            or any(one.content.controller.open_loop for one in self.controllers)
        )

    @property
    def virtual(self) -> bool | None:
        """Whether any folder is from the virtual lab; None if no origin is known."""
        return is_virtual([artefact.meta for artefact in self.everything])

    def place_of(self, artefact: Artefact) -> list[dict[str, Any]]:
        """Return the shapes of a controller's or trial's place; [] if none is known."""
        if artefact.kind == "trial":
            digest = artefact.meta["controller"].get("sha256")
            own = [one for one in self.controllers if sha256(one.json) == digest]
            return self.place_of(own[0]) if own else []
        place = artefact.meta["evolution"].get("place")
        if place is not None:
            return Place.from_json(artefact.json, place).shapes()
        digest = artefact.meta["simulator"].get("sha256")
        for simulator in self.simulators:
            if sha256(simulator.json) == digest:
                return simulator.content.outline()
        return []


def task_of(task: Mapping[str, Any], json: Path) -> Task | None:
    """Return the task that a file names; None: its package is not installed here.

    Raises:
        FileError: if the task does not take the settings that the file gives it.
    """
    if task.get("name") not in TASKS.names():
        return None
    make = partial(make_task, task["name"])
    return made(json, "task.settings", make, task.get("settings") or {})


def gather(folders: Sequence[str | Path]) -> Artefacts:
    """Read folders; one that is named twice is read once.

    Raises:
        UserError: if no folder is given, or a folder is of no known kind.
        FileError: if a file in one is missing, of another version, cut short or wrong.
    """
    artefacts = Artefacts()
    seen: set[Path] = set()
    for path in map(Path, folders):
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        kind = _kind(path)
        form, version, reader = KINDS[kind]
        meta = read_json(path / f"{kind}.json", f"neurosim-{kind}", version, form)
        if kind == "trial":
            artefacts.trials.append(_trial(path, meta))
            continue
        artefact = Artefact(kind, path, meta, None if reader is None else reader(path))
        if kind == "back-to-reality":
            _check_alternation(artefact)
            artefacts.alternations.append(artefact)
            continue
        if kind == "controller":
            _ = artefact.task
        if kind == "simulator":
            _check_history(artefact)
        getattr(artefacts, f"{kind}s").append(artefact)
    if not seen:
        raise UserError("name at least one folder to report on")
    return artefacts


def _kind(path: Path) -> str:
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise FileError(path, f"{what}; expected the folder of a {', '.join(KINDS)}")
    for kind in KINDS:
        if (path / f"{kind}.json").exists():
            return kind
    names = ", ".join(f"{kind}.json" for kind in KINDS)
    raise FileError(path, f"cannot be shown in a report: it has none of {names}")


def _check_history(artefact: Artefact) -> None:
    """Check that a history has the outputs."""
    outputs, history = artefact.meta.get("outputs"), artefact.meta.get("history")
    names = [output["name"] for output in outputs or ()]
    if history and not set(names) <= set(OUTPUTS):
        raise FileError(artefact.json, f"expected {', '.join(OUTPUTS)}", field="outputs")
    for place, entry in enumerate(history or ()):
        if outputs is None or len(entry["mse"]) != len(outputs):
            raise FileError(
                artefact.json, "expected one for each output", field=f"history[{place}].mse"
            )


def _check_alternation(artefact: Artefact) -> None:
    """Check that the parts of an alternation of controller and simulator fit each other."""
    meta = artefact.meta
    if len(meta["believed"]) != len(meta["real"]):
        raise FileError(artefact.json, "expected a number for each evaluation", field="believed")
    names = {parameter["name"] for parameter in meta["parameters"]}
    for place, cycle in enumerate(meta["cycles"]):
        adapted = cycle.get("L3")
        runs = {"L1": cycle.get("L1"), "L2": cycle.get("L2")}
        if adapted is not None:
            runs["L3.history"] = adapted["history"]
            if not adapted["parameters"] or any(names - set(one) for one in adapted["parameters"]):
                field = f"cycles[{place}].L3.parameters"
                raise FileError(artefact.json, "expected numbers by parameters' names", field=field)
        for name, run in runs.items():
            if run is not None and len(run["best"]) != len(run["mean"]):
                field = f"cycles[{place}].{name}"
                raise FileError(artefact.json, "expected as many best as mean", field=field)


def _trial(path: Path, meta: dict[str, Any]) -> Trial:
    trial = Trial("trial", path, meta)
    count, predicted, actual = len(meta["commands"]), meta["predicted"], meta["actual"]
    _ = trial.task
    for part, values in (("predicted", predicted), ("actual", actual)):
        poses = values.get("poses")
        if part == "predicted" and None in (poses or ()):
            raise FileError(trial.json, "expected a pose, found None", field="predicted.poses")
        if trial.by_command and len(poses or ()) != count + 1:
            raise FileError(
                trial.json,
                f"expected {count + 1} poses (the start, and one for each of {count} commands)",
                field=f"{part}.poses",
            )
    if trial.by_command and (not count or len(meta["errors"]) not in (count, count + 1)):
        raise FileError(trial.json, f"expected one for each of {count} commands", field="errors")
    if (path / "recording.json").exists():
        trial.recording = read_json(
            path / "recording.json", "neurosim-recording", 1, formats.TrialRecording
        )
    return trial


def files_of(artefact: Artefact) -> dict[str, str]:
    """Return the SHA-256 of the files that hold an artefact's content, by name.

    Videos are left out: they are large, and their results are in the poses.
    """
    names = sorted(
        path.name
        for path in artefact.path.iterdir()
        if path.suffix in (".json", ".jsonl", ".csv", ".safetensors") and path.is_file()
    )
    return {name: sha256(artefact.path / name) for name in names}
