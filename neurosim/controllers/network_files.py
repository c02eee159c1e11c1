"""A network from sensors to motors: Figure 2 of Lund and Miglino 1996.

Every sensor and a bias have a weight to each of two outputs; tanh of the sums is the wheels'
speed as a share of full speed. The controller is a folder with ``controller.json`` and
``weights.safetensors``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import files
from neurosim.base.errors import FileError
from neurosim.controllers.plan_files import FORMAT, VERSION

KIND = "network"
OUTPUTS = ("left", "right")


@dataclass(frozen=True, eq=False)
class NetworkController:
    """A network with one layer of weights.

    Attributes:
        weights: (2, S + 1) of the sensors and the bias, to the left and the right motor.
        task: {"name", "settings"} of the task that it was made for.
        predicted: what the simulator says of it, such as ``fitness``.
        simulator: {"path", "sha256"} of what it was evolved in.
        evolution: settings and history of its evolution.
    """

    weights: NDArray[np.float64]
    task: Mapping[str, Any]
    predicted: Mapping[str, Any] = field(default_factory=dict)
    simulator: Mapping[str, Any] = field(default_factory=dict)
    evolution: Mapping[str, Any] = field(default_factory=dict)

    @property
    def genes(self) -> NDArray[np.float64]:
        """The weights in a row, [2 (S + 1)], as evolution has them."""
        return self.weights.reshape(-1)

    def commands(self, readings: ArrayLike) -> NDArray[np.float64]:
        """Return the speeds [..., 2] in percent that follow from readings [..., S] in 0..1."""
        readings = np.asarray(readings, float)
        sums = readings @ self.weights[:, :-1].T + self.weights[:, -1]
        return 100.0 * np.tanh(sums)

    def write(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write the controller to a new folder, whole or not at all.

        Args:
            folder: where.
            overwrite: whether to replace what stands there.

        Raises:
            UserError: if there is something at ``folder`` that is not to be replaced.
        """
        sensors = self.weights.shape[1] - 1
        content = {
            "kind": KIND,
            "inputs": [{"name": f"sensor_{index}", "unit": "1"} for index in range(sensors)],
            "outputs": [{"name": name, "unit": "%"} for name in OUTPUTS],
            "activation": "tanh",
            "task": dict(self.task),
            "simulator": dict(self.simulator),
            "predicted": dict(self.predicted),
            "evolution": dict(self.evolution),
        }
        with files.new_folder(folder, overwrite=overwrite) as partial:
            files.write_tensors(partial / "weights.safetensors", {"weights": self.weights})
            files.write_json(partial / "controller.json", FORMAT, VERSION, content)

    @classmethod
    def read(cls, folder: str | Path) -> NetworkController:
        """Read and check a network.

        Raises:
            FileError: naming file and field: a missing file or key, another version, kind or
                activation, weights that do not fit the inputs.
        """
        path = Path(folder) / "controller.json"
        if not Path(folder).is_dir():
            raise FileError(folder, "no such controller; expected a folder with controller.json")
        fields = {
            "kind": str,
            "inputs": list,
            "activation": str,
            "task": dict,
            "simulator": dict,
            "predicted": dict,
            "evolution": dict,
        }
        content = files.read_json(path, FORMAT, VERSION, fields)
        for name, expected in (("kind", KIND), ("activation", "tanh")):
            if content[name] != expected:
                raise FileError(path, f"expected {expected!r}, found {content[name]!r}", field=name)
        if not isinstance(content["task"].get("name"), str):
            raise FileError(path, "expected the name of a task", field="task.name")
        shape = (len(OUTPUTS), len(content["inputs"]) + 1)
        found = files.read_tensors(Path(folder) / "weights.safetensors", {"weights": shape})
        kept = ("task", "predicted", "simulator", "evolution")
        return cls(found["weights"].astype(float), **{name: content[name] for name in kept})
