"""Controllers on disk: a folder with ``controller.json``, and weights where there are any.

What was predicted of a controller stands beside it, so that a trial can be held against it. For a
plan these are the pose after each given command, at the instant when the next one takes over, and
the pose at rest, once the motors have run down after the last.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files
from neurosim.base.errors import FileError, UserError
from neurosim.base.schema import Maybe, Number, Rows, Shape, fields_of
from neurosim.controllers.base import Controller
from neurosim.controllers.plan import COMMAND_NAMES, Command, FixedPlan
from neurosim.controllers.registry import CONTROLLERS

FORMAT, VERSION = "neurosim-controller", 1
#: A command of a plan lasts no longer, s.
LONGEST = 3600.0

_PARTS = ("task", "simulator", "predicted", "evolution")
#: Poses are no farther away, m, and turn no more, rad: pictures of them are drawn.
FARTHEST = 1e5
POSE = Rows(3, most=FARTHEST)
#: What is predicted of a controller, or came of a trial.
OUTCOME: dict[str, Shape] = {
    "poses?": [Maybe(POSE)],
    "rest?": POSE,
    "fitness?": float,
    "spread?": float,
    "expected_fitness?": float,
    "draws?": float,
    "probability?": Number(0.0, 1.0),
    "completes?": bool,
    "unsupported?": float,
}
#: What controller.json says of any kind.
FIELDS: dict[str, Shape] = {
    "kind": str,
    "inputs": [{"name": str, "unit?": str}],
    "start?": POSE,
    "task": {"name": str, "settings?": dict},
    "predicted": {**OUTCOME, "poses?": Rows(None, 3, most=FARTHEST)},
    "simulator": {"path?": str, "name?": str, "sha256?": str, "virtual?": bool},
    "evolution": {
        "settings?": dict,
        "interrupted?": bool,
        "history?": {"best?": Rows(None), "mean?": Rows(None), "transfer?": int},
        "robot_fitness?": {"mean": float, "spread": float, "trials?": int},
        "trajectories?": [
            {
                "simulated": Rows(None, 3, most=FARTHEST),
                "robot": Rows(None, 3, most=FARTHEST),
            }
        ],
        "robot?": {"kind?": str, "virtual?": bool},
        "arena?": dict,
    },
}
#: What it says beside of a plan, and of a kind that has genes.
_OF_A_PLAN: dict[str, Shape] = {"commands": [Maybe(Rows(3))]}
_OF_GENES: dict[str, Shape] = {"settings?": dict}


@dataclass(frozen=True, eq=False)
class SavedController:
    """One controller: a family, an individual's genes, and where it comes from.

    Attributes:
        controller: the family.
        genes: [G] of the individual; empty for a plan, whose commands are in the family.
        task: {"name", "settings"} of the task that it was made for.
        start: x (m), y (m), heading (rad) where it starts, in the board's frame.
        predicted: what the simulator says of it: ``fitness``; ``completes``, whether the expected
            path does the task, and its ``poses`` [[x, y, theta], ...] and ``rest`` [x, y, theta];
            over so many drawn outcomes (``draws``) the ``probability`` of success.
        simulator: {"path", "sha256"} of what it was evolved in.
        evolution: settings and history of its evolution.
    """

    controller: Controller
    genes: NDArray[np.float64]
    task: Mapping[str, Any]
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    predicted: Mapping[str, Any] = field(default_factory=dict)
    simulator: Mapping[str, Any] = field(default_factory=dict)
    evolution: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """The family's name."""
        return self.controller.kind

    @property
    def commands(self) -> tuple[Command | None, ...]:
        """The commands of a plan, None for a null one; of other kinds none."""
        return self.controller.slots if isinstance(self.controller, FixedPlan) else ()

    @property
    def given(self) -> list[Command]:
        """The commands of a plan that are sent, without the null ones."""
        return [command for command in self.commands if command is not None]

    def write(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write the controller to a new folder, whole or not at all.

        Args:
            folder: where.
            overwrite: whether to replace what stands there.

        Raises:
            UserError: if there is something at ``folder`` that is not to be replaced, a plan gives
                no command, or a function was not registered by a name.
        """
        family = self.controller
        check_readable(family)
        if isinstance(family, FixedPlan) and not self.given:
            raise UserError(
                "a plan that gives no command cannot be written: nothing could drive it"
            )
        about: dict[str, Any]
        if self.commands:
            columns = zip(COMMAND_NAMES, ("%", "%", "s"), strict=True)
            about = {
                "inputs": [{"name": name, "unit": unit} for name, unit in columns],
                "commands": [None if one is None else list(one) for one in self.commands],
            }
        else:
            about = {
                "inputs": [{"name": name, "unit": "1"} for name in family.inputs],
                "outputs": [{"name": name, "unit": family.unit} for name in family.outputs],
                "settings": family.settings(),
            }
        content = {
            "kind": family.kind,
            **about,
            "start": list(self.start),
            **{name: dict(getattr(self, name)) for name in _PARTS},
        }
        with files.new_folder(folder, overwrite=overwrite) as partial:
            if not self.commands:
                files.write_tensors(partial / "weights.safetensors", {"genes": self.genes})
            files.write_json(partial / "controller.json", FORMAT, VERSION, content)


def check_readable(family: Controller) -> None:
    """Refuse a family whose controllers could be written, but not read again.

    Raises:
        UserError: if it was not registered by its name.
    """
    if family.kind not in CONTROLLERS.names():
        raise UserError(
            f"a controller of the kind {family.kind!r} cannot be read again: register its "
            'family first, as in neurosim.register("controller", NAME, FAMILY)'
        )


def read_controller(folder: str | Path) -> SavedController:
    """Read a controller of any kind.

    Raises:
        FileError: naming file and field: a missing file or key, another version or kind, a
            command that is not one, a prediction that does not fit the commands, weights that do
            not fit the inputs.
    """
    path = Path(folder) / "controller.json"
    if not Path(folder).is_dir():
        raise FileError(folder, "no such controller; expected a folder with controller.json")
    content = files.read_json(path, FORMAT, VERSION, FIELDS)
    kind = content["kind"]
    if kind not in CONTROLLERS.names():
        known = ", ".join(CONTROLLERS.names())
        raise FileError(path, f"expected one of {known}, found {kind!r:.60}", field="kind")
    files.check_fields(path, content, _OF_A_PLAN if kind == "plan" else _OF_GENES)
    x, y, heading = content.get("start", (0.0, 0.0, 0.0))
    start = float(x), float(y), float(heading)
    family, genes = _plan(path, content) if kind == "plan" else _network(path, content)
    found = SavedController(family, genes, start=start, **{name: content[name] for name in _PARTS})
    _check_prediction(path, found)
    return found


def _plan(path: Path, content: dict[str, Any]) -> tuple[Controller, NDArray[np.float64]]:
    if tuple(entry["name"] for entry in content["inputs"]) != COMMAND_NAMES:
        raise FileError(path, f"expected the names {', '.join(COMMAND_NAMES)}", field="inputs")
    commands = tuple(
        None if value is None else _command(path, f"commands[{index}]", value)
        for index, value in enumerate(content["commands"])
    )
    if all(command is None for command in commands):
        raise FileError(path, "gives no command at all", field="commands")
    return FixedPlan(commands), np.empty(0)


def _network(path: Path, content: dict[str, Any]) -> tuple[Controller, NDArray[np.float64]]:
    names = [entry["name"] for entry in content["inputs"]]
    weights = path.with_name("weights.safetensors")
    settings, shape, name = content.get("settings"), None, "genes"
    if settings is None:
        # As version 0.1.0 wrote it before there were hidden layers.
        if content.get("activation") != "tanh":
            raise FileError(
                path, f"expected 'tanh', found {content.get('activation')!r}", field="activation"
            )
        settings, name, shape = {"inputs": names}, "weights", (2, len(names) + 1)
    files.check_fields(path, settings, fields_of(CONTROLLERS.get(content["kind"])), "settings")
    try:
        family = CONTROLLERS.make(content["kind"], settings)
    except (UserError, TypeError, ValueError) as error:
        raise FileError(
            path, f"is no controller of this kind ({error})", field="settings"
        ) from None
    found = files.read_tensors(weights, {name: shape or (family.genes,)})
    return family, found[name].astype(float).reshape(-1)


def _check_prediction(path: Path, found: SavedController) -> None:
    predicted = found.predicted
    if not found.commands:
        return
    expected, poses = len(found.given) + 1, predicted.get("poses")
    if poses is None or len(poses) != expected:
        raise FileError(
            path,
            f"expected {expected} poses, the start and one for each given command",
            field="predicted.poses",
        )
    for name in ("rest", "fitness", "completes"):
        if name not in predicted:
            raise FileError(path, "is missing", field=f"predicted.{name}")


def _command(path: Path, field: str, value: list[float]) -> Command:
    left, right, duration = map(float, value)
    if max(abs(left), abs(right)) > 100 or not 0 < duration <= LONGEST:
        raise FileError(
            path,
            "expected speeds in -100 to 100 % and a duration above 0 and up to "
            f"{LONGEST:g} s, found {value}",
            field=field,
        )
    return left, right, duration
