"""The folder of a motion network: simulator.json and weights.safetensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from neurosim.base import files
from neurosim.base.errors import FileError
from neurosim.networks import Perceptron, ProductSummationNetwork
from neurosim.simulators.base import FORMAT, VERSION
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.network import COORDINATES, OUTPUTS, MotionNetwork
from neurosim.simulators.motion.noise import (
    COMPONENTS,
    COUPLING_FEATURES,
    MOTION_FEATURES,
    SCALE_FEATURES,
    TAIL_FEATURES,
    NoiseModel,
)

#: What simulator.json says of a noise model; its numbers stand beside the weights.
NOISE = {
    "kind": "cholesky-lognormal-sum",
    "components": list(COMPONENTS),
    "scale_features": list(SCALE_FEATURES),
    "coupling_features": list(COUPLING_FEATURES),
    "tail_features": list(TAIL_FEATURES),
    "motion_features": list(MOTION_FEATURES),
}


def write_motion(simulator: MotionNetwork, folder: str | Path) -> None:
    """Write simulator.json and weights.safetensors into an existing folder."""
    folder = Path(folder)
    content = {
        "kind": simulator.kind,
        "inputs": simulator.inputs,
        "outputs": [
            {"name": name, "unit": unit}
            for name, unit in zip(OUTPUTS, ("m", "m", "rad"), strict=True)
        ],
        "network": {
            **({"kind": "perceptron"} if isinstance(simulator.network, Perceptron) else {}),
            **{k: v for k, v in asdict(simulator.network).items() if k != "inputs"},
        },
        "coordinates": simulator.coordinates,
        "derived": asdict(simulator.derived),
        "members": simulator.members,
        "central": simulator.central,
        "noise": None if simulator.noise is None else NOISE,
        **simulator.meta,
    }
    tensors = {
        name: getattr(simulator, name).cpu().numpy()
        for name in ("genes", "input_scale", "output_scale", "dead_zone")
    }
    if simulator.noise is not None:
        tensors |= {f"noise.{k}": v.numpy() for k, v in simulator.noise.tensors().items()}
    files.write_tensors(folder / "weights.safetensors", tensors)
    files.write_json(folder / "simulator.json", FORMAT, VERSION, content)


def read_motion(folder: str | Path, device: str | torch.device = "cpu") -> MotionNetwork:
    """Read and check a motion network.

    Raises:
        FileError: naming the file and field, if something is missing, cut short, of another
            version, of the wrong shape, or not a number.
    """
    path = Path(folder) / "simulator.json"
    kind = files.read_json(path, FORMAT, VERSION, {"kind": str})["kind"]
    if kind != MotionNetwork.kind:
        raise FileError(path, f"expected {MotionNetwork.kind!r}, found {kind!r}", field="kind")
    fields = {"kind": str, "inputs": list, "network": dict, "coordinates": str}
    content = files.read_json(path, FORMAT, VERSION, fields)
    inputs = content["inputs"]
    if not all(isinstance(i, dict) and isinstance(i.get("name"), str) for i in inputs):
        raise FileError(path, "expected a list of {name, unit}", field="inputs")
    derived = _derived(path, content)
    try:
        shape = dict(content["network"])
        kinds = {"product-summation": ProductSummationNetwork, "perceptron": Perceptron}
        make = kinds[shape.pop("kind", "product-summation")]
        network = make(len(inputs) + len(derived), **shape)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(path, f"is no network ({error})", field="network") from None
    members, noisy = _members_and_noise(path, content)
    if content["coordinates"] not in COORDINATES:
        raise FileError(
            path,
            f"expected one of {', '.join(COORDINATES)}, found {content['coordinates']!r}: train "
            "the simulator anew",
            field="coordinates",
        )
    central = content.get("central", False) is True
    outputs = COORDINATES[content["coordinates"]]
    expected = _tensors(network, len(inputs), members + central, outputs)
    if noisy:
        expected |= {f"noise.{name}": shape for name, shape in NoiseModel.SHAPES.items()}
    if content["version"] == 1:
        expected |= {name: expected[name][1:] for name in ("genes", "output_scale")}
        del expected["dead_zone"]
    tensors = files.read_tensors(Path(folder) / "weights.safetensors", expected)
    if (tensors["input_scale"] <= 0).any():
        weights = Path(folder) / "weights.safetensors"
        raise FileError(weights, "expected numbers above 0", field="input_scale")
    loaded = {name: torch.from_numpy(value).to(device) for name, value in tensors.items()}
    known = ("format", "version", "outputs", "members", "central", "noise", "derived")
    described = (*known, *fields)
    meta = {key: value for key, value in content.items() if key not in described}
    try:
        return MotionNetwork(
            inputs,
            network,
            loaded["genes"],
            loaded["input_scale"],
            loaded["output_scale"],
            content["coordinates"],
            meta,
            _noise(loaded) if noisy else None,
            loaded.get("dead_zone"),
            central,
            derived,
        )
    except ValueError as error:
        raise FileError(path, f"is no motion network ({error})") from None


def _members_and_noise(path: Path, content: Mapping[str, Any]) -> tuple[int, bool]:
    if content["version"] == 1:
        return 1, False
    members, noise = content.get("members"), content.get("noise")
    if isinstance(members, bool) or not isinstance(members, int) or members < 1:
        raise FileError(path, f"expected a number from 1, found {members!r}", field="members")
    if noise is not None and noise != NOISE:
        raise FileError(
            path,
            "is no noise model that this version reads: train the simulator anew",
            field="noise",
        )
    return members, noise is not None


def _derived(path: Path, content: Mapping[str, Any]) -> Derived:
    found = content.get("derived", {})
    if isinstance(found, dict) and set(found) <= {"moving", "swing"}:
        moving, swing = found.get("moving", False), found.get("swing")
        number = isinstance(swing, int | float) and not isinstance(swing, bool) and abs(swing) < 1
        if isinstance(moving, bool) and (swing is None or number):
            return Derived(moving, swing)
    expected = "expected moving (true, false) and swing (number or null)"
    raise FileError(path, expected, field="derived")


def _noise(tensors: Mapping[str, torch.Tensor]) -> NoiseModel:
    return NoiseModel(**{name: tensors[f"noise.{name}"] for name in NoiseModel.SHAPES})


def _tensors(
    network: ProductSummationNetwork | Perceptron, inputs: int, members: int, outputs: int
) -> dict[str, tuple[int, ...]]:
    return {
        "genes": (members, outputs, network.genes),
        "input_scale": (inputs,),
        "output_scale": (members, outputs),
        "dead_zone": (inputs,),
    }
