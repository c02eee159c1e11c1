"""The motion network: three networks predict how a command displaces the robot.

Pretorius et al. 2009, section 5.3: the networks are given the motors' speeds before and during
the command and its duration, and predict the displacement in the robot's own frame; displacements
are composed into a path. Which inputs there are is the dataset's matter: those called ``prev_...``
are remembered in the state, the others are the command.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neurosim.base import files
from neurosim.base.errors import FileError
from neurosim.networks import Prediction, ProductSummationNetwork
from neurosim.simulators.base import FORMAT, VERSION

OUTPUTS = ("dx", "dy", "dtheta")

#: What the networks' outputs are: the displacement itself, or the constant body twist whose
#: exponential it is (see :mod:`neurosim.base.se2`), the duration taken as unit time.
COORDINATES = ("displacement", "twist")


class MotionNetwork:
    """A simulator of a robot in the plane, learned from a dataset.

    Attributes:
        inputs: names and units of the inputs, [{name, unit}].
        network: the shape that its three networks have.
        genes: their weights, [3, G], float64.
        input_scale: [I]; inputs are divided by it.
        output_scale: [3]; the networks' outputs times this are metres, metres and radians.
        coordinates: one of :data:`COORDINATES`.
        meta: what else simulator.json says: training, test errors, source.
    """

    kind = "motion-network"

    def __init__(
        self,
        inputs: Sequence[Mapping[str, str]],
        network: ProductSummationNetwork,
        genes: Tensor,
        input_scale: Tensor,
        output_scale: Tensor,
        coordinates: str = "displacement",
        meta: Mapping[str, Any] | None = None,
    ):
        names = tuple(entry["name"] for entry in inputs)
        remembered = tuple(name for name in names if name.startswith("prev_"))
        self.command_names = tuple(name for name in names if name not in remembered)
        self.state_names = ("x", "y", "theta", *remembered)
        for name in remembered:
            if name.removeprefix("prev_") not in self.command_names:
                raise ValueError(f"there is an input {name}, but no {name.removeprefix('prev_')}")
        if len(names) != network.inputs or genes.shape != (len(OUTPUTS), network.genes):
            raise ValueError("inputs, network and genes do not fit each other")
        if coordinates not in COORDINATES:
            raise ValueError(f"coordinates must be one of {', '.join(COORDINATES)}")
        self.inputs = [dict(entry) for entry in inputs]
        self.network = network
        self.genes = genes.double()
        self.input_scale = input_scale.to(self.genes)
        self.output_scale = output_scale.to(self.genes)
        self.coordinates = coordinates
        self.meta = dict(meta or {})
        given = (*remembered, *self.command_names)
        device = self.genes.device
        self._predict = Prediction(network, self.genes)
        self._order = torch.tensor([given.index(name) for name in names], device=device)
        self._next = torch.tensor(
            [self.command_names.index(name.removeprefix("prev_")) for name in remembered],
            dtype=torch.long,
            device=device,
        )

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in the order of :meth:`displacement`'s columns."""
        return tuple(entry["name"] for entry in self.inputs)

    def start(self, pose: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the states [B, S] of robots that stand still at ``pose`` [B, 3]."""
        pose = pose.to(self.genes)
        return torch.cat([pose, pose.new_zeros(len(pose), len(self.state_names) - 3)], dim=1)

    def step(
        self, state: Tensor, command: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the states [B, S] after ``command`` [B, C] was carried out from ``state``.

        This simulator has no noise: the generator is not used.
        """
        inputs = torch.cat([state[:, 3:], command], dim=1)[:, self._order]
        pose = compose(state[:, :3], self.displacement(inputs))
        return torch.cat([pose, command[:, self._next]], dim=1)

    def displacement(self, inputs: Tensor) -> Tensor:
        """Return the displacements [B, 3] (m, m, rad) that follow from ``inputs`` [B, I].

        They are in the robot's frame at the command's start, REP 103.
        """
        outputs = self._predict(inputs / self.input_scale) * self.output_scale
        return exp(outputs) if self.coordinates == "twist" else outputs

    def write(self, folder: str | Path) -> None:
        """Write simulator.json and weights.safetensors into an existing folder."""
        folder = Path(folder)
        content = {
            "kind": self.kind,
            "inputs": self.inputs,
            "outputs": [
                {"name": name, "unit": unit}
                for name, unit in zip(OUTPUTS, ("m", "m", "rad"), strict=True)
            ],
            "network": {k: v for k, v in asdict(self.network).items() if k != "inputs"},
            "coordinates": self.coordinates,
            **self.meta,
        }
        tensors = {name: getattr(self, name).cpu().numpy() for name in _tensors(self.network)}
        files.write_tensors(folder / "weights.safetensors", tensors)
        files.write_json(folder / "simulator.json", FORMAT, VERSION, content)

    @classmethod
    def read(cls, folder: str | Path, device: str | torch.device = "cpu") -> MotionNetwork:
        """Read and check a motion network.

        Raises:
            FileError: naming the file and field, if something is missing, cut short, of another
                version, of the wrong shape, or not a number.
        """
        path = Path(folder) / "simulator.json"
        fields = {"kind": str, "inputs": list, "network": dict, "coordinates": str}
        content = files.read_json(path, FORMAT, VERSION, fields)
        if content["kind"] != cls.kind:
            raise FileError(path, f"expected {cls.kind!r}, found {content['kind']!r}", field="kind")
        inputs = content["inputs"]
        if not all(isinstance(i, dict) and isinstance(i.get("name"), str) for i in inputs):
            raise FileError(path, "expected a list of {name, unit}", field="inputs")
        try:
            network = ProductSummationNetwork(inputs=len(inputs), **content["network"])
        except (TypeError, ValueError) as error:
            raise FileError(path, f"is no network ({error})", field="network") from None
        tensors = files.read_tensors(Path(folder) / "weights.safetensors", _tensors(network))
        if (tensors["input_scale"] <= 0).any():
            weights = Path(folder) / "weights.safetensors"
            raise FileError(weights, "expected numbers above 0", field="input_scale")
        loaded = {name: torch.from_numpy(value).to(device) for name, value in tensors.items()}
        described = ("format", "version", "outputs", *fields)
        meta = {key: value for key, value in content.items() if key not in described}
        try:
            return cls(
                inputs,
                network,
                loaded["genes"],
                loaded["input_scale"],
                loaded["output_scale"],
                content["coordinates"],
                meta,
            )
        except ValueError as error:
            raise FileError(path, f"is no motion network ({error})") from None


def compose(pose: Tensor, displacement: Tensor) -> Tensor:
    """Return the poses [B, 3] after displacements [B, 3] in their own frames; as base.se2."""
    x, y, theta = pose.unbind(-1)
    dx, dy, dtheta = displacement.unbind(-1)
    cos, sin = theta.cos(), theta.sin()
    return torch.stack([x + cos * dx - sin * dy, y + sin * dx + cos * dy, theta + dtheta], dim=-1)


def exp(twist: Tensor) -> Tensor:
    """Return the displacements [B, 3] of constant body twists [B, 3] over unit time."""
    vx, vy, omega = twist.unbind(-1)
    # torch.sinc(t) is sin(pi t) / (pi t): the chord of the arc, turned by half the angle.
    chord = torch.sinc(omega / (2.0 * torch.pi))
    cos, sin = chord * (omega / 2.0).cos(), chord * (omega / 2.0).sin()
    return torch.stack([cos * vx - sin * vy, sin * vx + cos * vy, omega], dim=-1)


def _tensors(network: ProductSummationNetwork) -> dict[str, tuple[int, ...]]:
    return {
        "genes": (len(OUTPUTS), network.genes),
        "input_scale": (network.inputs,),
        "output_scale": (len(OUTPUTS),),
    }
