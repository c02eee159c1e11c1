"""Controllers on disk: a folder with ``controller.json``, and weights, if any.

A controller's folder has its prediction, so that a trial can be compared with it. For a plan these
are the pose after each given command, at the instant when the next one begins, and the pose at
rest, after the motors have stopped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files, formats
from neurosim.base.errors import FileError, UserError
from neurosim.controllers.base import Controller
from neurosim.controllers.plan import COMMAND_NAMES, Command, FixedPlan, Plan, commands_of
from neurosim.controllers.registry import CONTROLLERS

FORMAT, VERSION = "neurosim-controller", 1
#: Longest command of a plan, s.
LONGEST = 3600.0
_PARTS = ("task", "simulator", "predicted", "evolution")


@dataclass(frozen=True, eq=False)
class SavedController:
    """One controller: a family, an individual's genes, and its origin.

    Attributes:
        controller: the family.
        genes: [G] of the individual; empty for a plan, whose commands are in the family.
        task: {"name", "settings"} of its task.
        start: x (m), y (m), heading (rad) of its start, in the board's frame.
        predicted: the simulator's prediction: ``fitness``; ``completes``, whether the expected
            path does the task, and its ``poses`` [[x, y, theta], ...] and ``rest`` [x, y, theta];
            the ``probability`` of success over ``draws`` random samples.
        simulator: {"path", "sha256"} of the simulator in which it evolved.
        evolution: settings and history of its evolution.

    Example:
        >>> plan = ns.make_controller("plan", slots=3)
        >>> saved = ns.SavedController.of(plan, np.full(plan.genes, 0.5), {"name": "go-to"})
        >>> len(saved.commands)
        3
    """

    controller: Controller
    genes: NDArray[np.float64]
    task: Mapping[str, Any]
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    predicted: Mapping[str, Any] = field(default_factory=dict)
    simulator: Mapping[str, Any] = field(default_factory=dict)
    evolution: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, controller: Controller, genes: NDArray[np.float64], *others: Any
    ) -> SavedController:
        """Return an individual [G] of a family in its saved form: a plan as its commands.

        Args:
            controller: the family.
            genes: of the individual.
            others: from ``task`` on, see the class.
        """
        if isinstance(controller, Plan | FixedPlan):
            names = {"names": controller.names, "units": controller.units}
            controller = FixedPlan(tuple(commands_of(controller, genes)), **names)
            genes = np.empty(0)
        return cls(controller, genes, *others)

    @property
    def kind(self) -> str:
        """The family's name."""
        return self.controller.kind

    @property
    def commands(self) -> tuple[Command | None, ...]:
        """The commands of a plan, None for a null one; empty for other kinds."""
        return self.controller.slots if isinstance(self.controller, FixedPlan) else ()

    @property
    def given(self) -> list[Command]:
        """The commands of a plan that are sent, without the null ones."""
        return [command for command in self.commands if command is not None]

    def write(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write the controller to a new folder, whole or not at all.

        Args:
            folder: the new folder.
            overwrite: whether to replace an existing one.

        Raises:
            UserError: if ``folder`` exists and must not be replaced, a plan has no command, or a
                function was not registered by a name.
        """
        family = self.controller
        check_readable(family)
        if isinstance(family, FixedPlan) and not self.given:
            raise UserError("a plan without any command cannot be written")
        about: dict[str, Any]
        if self.commands:
            assert isinstance(family, FixedPlan)
            columns = zip(family.outputs, (*family.units, "s"), strict=True)
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
    """Raise an error for a family whose controllers could be written, but not read again.

    Raises:
        UserError: if it was not registered by its name.
    """
    if family.kind not in CONTROLLERS.names():
        raise UserError(
            f"a controller of the kind {family.kind!r} is not registered, so it cannot be read "
            'again: register its family first, as in neurosim.register("controller", NAME, FAMILY)'
        )


def read_controller(folder: str | Path) -> SavedController:
    """Read a controller of any kind.

    Raises:
        FileError: naming file and field: a missing file or key, another version or kind, a wrong
            command, a prediction that does not fit the commands, weights that do not fit the
            inputs.
    """
    path = Path(folder) / "controller.json"
    if not Path(folder).is_dir():
        raise FileError(folder, "no such controller; expected a folder with controller.json")
    content = files.read_json(path, FORMAT, VERSION, formats.Controller)
    kind = content["kind"]
    if kind not in CONTROLLERS.names():
        known = ", ".join(CONTROLLERS.names())
        raise FileError(path, f"expected one of {known}, found {kind!r:.60}", field="kind")
    x, y, heading = content.get("start", (0.0, 0.0, 0.0))
    start = float(x), float(y), float(heading)
    family, genes = _plan(path, content) if kind == "plan" else _network(path, content)
    saved = SavedController(family, genes, start=start, **{name: content[name] for name in _PARTS})
    _check_prediction(path, saved)
    return saved


def _plan(path: Path, content: dict[str, Any]) -> tuple[Controller, NDArray[np.float64]]:
    columns = {entry["name"]: entry.get("unit") or "1" for entry in content["inputs"]}
    names = tuple(columns)
    if len(names) < 2 or names[-1] != "duration" or len(names) < len(content["inputs"]):
        expected = ", ".join(COMMAND_NAMES)
        raise FileError(
            path, f"expected the names of a command, such as {expected}", field="inputs"
        )
    if "commands" not in content:
        raise FileError(path, "is missing", field="commands")
    given = (None if one is None else tuple(map(float, one)) for one in content["commands"])
    commands: tuple[Command | None, ...] = tuple(given)
    percent = [place for place, unit in enumerate(columns.values()) if unit == "%"]
    for place, command in enumerate(commands):
        if command is None:
            continue
        beyond = [command[n] for n in percent if n < len(command) and abs(command[n]) > 100]
        if len(command) != len(names):
            expected = f"{len(names)} numbers, found {len(command)}"
        elif not 0 < command[-1] <= LONGEST:
            expected = f"a number above 0, up to {LONGEST:,.0f}, found {command[-1]:g}"
        elif beyond:
            expected = f"a number from -100 to 100, found {beyond[0]:g}"
        else:
            continue
        raise FileError(path, f"expected {expected}", field=f"commands[{place}]")
    if all(command is None for command in commands):
        raise FileError(path, "gives no command at all", field="commands")
    return FixedPlan(commands, names[:-1], tuple(columns.values())[:-1]), np.empty(0)


def _network(path: Path, content: dict[str, Any]) -> tuple[Controller, NDArray[np.float64]]:
    weights = path.with_name("weights.safetensors")
    settings = content.get("settings")
    if settings is None:
        raise FileError(path, "is missing", field="settings")
    kind = content["kind"]
    family = files.made(path, "settings", lambda **given: CONTROLLERS.make(kind, given), settings)
    return family, files.read_tensors(weights, {"genes": (family.genes,)})["genes"].astype(float)


def _check_prediction(path: Path, saved: SavedController) -> None:
    predicted = saved.predicted
    if not saved.commands:
        return
    expected, poses = len(saved.given) + 1, predicted.get("poses")
    if poses is None or len(poses) != expected:
        raise FileError(
            path,
            f"expected {expected} poses, the start and one for each given command",
            field="predicted.poses",
        )
    for name in ("rest", "fitness", "completes"):
        if name not in predicted:
            raise FileError(path, "is missing", field=f"predicted.{name}")
