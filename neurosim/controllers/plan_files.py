"""A plan: a set of commands that is driven blindly.

It is a folder with ``controller.json``. What was predicted of it stands beside it, so
that a trial can be held against it: the pose after each given command, at the instant when the
next one takes over, and the pose at rest, once the motors have run down after the last.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neurosim.base import files
from neurosim.base.errors import FileError

FORMAT, VERSION = "neurosim-controller", 1
KIND = "plan"
INPUTS = ("left", "right", "duration")

Command = tuple[float, float, float]


@dataclass(frozen=True)
class Plan:
    """A set of motor commands, driven one straight after the other.

    Attributes:
        commands: (left, right, duration) each, percent, percent, s; None is a null command.
        task: {"name", "settings"} of the task that it was made for.
        start: x (m), y (m), heading (rad) where it starts, in the board's frame.
        predicted: ``poses`` [[x, y, theta], ...], the start and after each given command;
            ``rest`` [x, y, theta]; ``fitness``; ``completes``. Where the simulator tells outcomes
            apart also ``probability`` of completing the task and ``expected_fitness``, over so
            many ``draws``.
        simulator: {"path", "sha256"} of what it was evolved in.
        evolution: settings and history of its evolution.
    """

    commands: tuple[Command | None, ...]
    task: Mapping[str, Any]
    start: tuple[float, float, float]
    predicted: Mapping[str, Any]
    simulator: Mapping[str, Any] = field(default_factory=dict)
    evolution: Mapping[str, Any] = field(default_factory=dict)

    @property
    def given(self) -> list[Command]:
        """The commands that are sent, without the null ones."""
        return [command for command in self.commands if command is not None]

    def write(self, folder: str | Path) -> None:
        """Write the plan to a new folder, whole or not at all.

        Raises:
            UserError: if there is something at ``folder``.
        """
        content = {
            "kind": KIND,
            "inputs": [
                {"name": name, "unit": unit}
                for name, unit in zip(INPUTS, ("%", "%", "s"), strict=True)
            ],
            "commands": [None if command is None else list(command) for command in self.commands],
            "task": dict(self.task),
            "start": list(self.start),
            "simulator": dict(self.simulator),
            "predicted": dict(self.predicted),
            "evolution": dict(self.evolution),
        }
        with files.new_folder(folder) as partial:
            files.write_json(partial / "controller.json", FORMAT, VERSION, content)

    @classmethod
    def read(cls, folder: str | Path) -> Plan:
        """Read and check a plan.

        Raises:
            FileError: naming file and field: a missing file or key, another version, kind or
                inputs, a command that is not one, a prediction that does not fit the commands.
        """
        path = Path(folder) / "controller.json"
        if not Path(folder).is_dir():
            raise FileError(folder, "no such controller; expected a folder with controller.json")
        kind = files.read_json(path, FORMAT, VERSION, {"kind": str})["kind"]
        if kind != KIND:
            raise FileError(path, f"expected {KIND!r}, found {kind!r}", field="kind")
        content = files.read_json(
            path,
            FORMAT,
            VERSION,
            {
                "inputs": list,
                "commands": list,
                "task": dict,
                "start": list,
                "simulator": dict,
                "predicted": dict,
                "evolution": dict,
            },
        )
        names = [entry.get("name") for entry in content["inputs"] if isinstance(entry, dict)]
        if tuple(names) != INPUTS:
            raise FileError(path, f"expected the names {', '.join(INPUTS)}", field="inputs")
        plan = cls(
            commands=tuple(
                _command(path, f"commands[{index}]", value)
                for index, value in enumerate(content["commands"])
            ),
            task=content["task"],
            start=_numbers(path, "start", content["start"]),
            predicted=content["predicted"],
            simulator=content["simulator"],
            evolution=content["evolution"],
        )
        plan._check(path)
        return plan

    def _check(self, path: Path) -> None:
        if not self.given:
            raise FileError(path, "gives no command at all", field="commands")
        if not isinstance(self.task.get("name"), str):
            raise FileError(path, "expected the name of a task", field="task.name")
        poses = self.predicted.get("poses")
        if not isinstance(poses, list) or len(poses) != len(self.given) + 1:
            raise FileError(
                path,
                f"expected {len(self.given) + 1} poses, the start and one for each given command",
                field="predicted.poses",
            )
        for index, pose in enumerate(poses):
            _numbers(path, f"predicted.poses[{index}]", pose)
        _numbers(path, "predicted.rest", self.predicted.get("rest"))
        if not _is_number(self.predicted.get("fitness")):
            raise FileError(path, "expected a number", field="predicted.fitness")
        if not isinstance(self.predicted.get("completes"), bool):
            raise FileError(path, "expected true or false", field="predicted.completes")
        probability = self.predicted.get("probability", 0.0)
        if not _is_number(probability) or not 0 <= probability <= 1:
            raise FileError(path, "expected a number in 0 to 1", field="predicted.probability")


def _command(path: Path, field: str, value: Any) -> Command | None:
    if value is None:
        return None
    left, right, duration = _numbers(path, field, value)
    if max(abs(left), abs(right)) > 100 or duration <= 0:
        raise FileError(
            path,
            f"expected speeds in -100 to 100 % and a duration above 0 s, found {value}",
            field=field,
        )
    return left, right, duration


def _numbers(path: Path, field: str, value: Any) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3 or not all(map(_is_number, value)):
        raise FileError(path, f"expected three numbers, found {value!r:.60}", field=field)
    return tuple(float(number) for number in value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
