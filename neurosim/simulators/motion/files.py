"""The folder of a motion network: simulator.json and weights.safetensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base import files
from neurosim.base.errors import FileError
from neurosim.networks import Perceptron, ProductSummationNetwork
from neurosim.simulators.base import FORMAT, VERSION
from neurosim.simulators.motion.correction import Correction
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.domain import Domain
from neurosim.simulators.motion.drive import DriveModel
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.network import COORDINATES, OUTPUTS, MotionNetwork
from neurosim.simulators.motion.noise import (
    COMPONENTS,
    COUPLING_FEATURES,
    MOTION_FEATURES,
    SCALE_FEATURES,
    TAIL_FEATURES,
    CommandFeatures,
    NoiseModel,
)

#: The tensors of kernel units.
KERNEL = ("centres", "lengths", "weights")

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
    correction = simulator.correction
    corrects = None if correction == Correction() else asdict(correction)
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
        "drive": None if simulator.drive is None else list(DriveModel.NAMES),
        "derived": asdict(simulator.derived),
        "kernel_units": 0 if simulator.kernel_units is None else len(simulator.kernel_units),
        "members": simulator.members,
        "central": simulator.central,
        "noise": None if simulator.noise is None else NOISE,
        **({} if corrects is None else {"correction": corrects}),
        **({} if simulator.known is None else {"domain": _said_of(simulator.known)}),
        **simulator.meta,
    }
    tensors = {
        name: getattr(simulator, name).cpu().numpy()
        for name in ("genes", "input_scale", "output_scale", "dead_zone")
    }
    if simulator.drive is not None:
        tensors |= {f"drive.{k}": _numbers(simulator.drive, k) for k in DriveModel.NAMES}
    if simulator.kernel_units is not None:
        tensors |= {f"kernel.{k}": _numbers(simulator.kernel_units, k) for k in KERNEL}
    if simulator.noise is not None:
        tensors |= {f"noise.{k}": v.numpy() for k, v in simulator.noise.tensors().items()}
    if simulator.known is not None:
        tensors["domain.seen"] = simulator.known.seen
    files.write_tensors(folder / "weights.safetensors", tensors)
    files.write_json(folder / "simulator.json", FORMAT, VERSION, content)


def _said_of(known: Domain) -> dict[str, Any]:
    ranges = {name: list(ends) for name, ends in known.ranges.items()}
    return {"commands": ranges, "rows": known.rows, "reach": known.reach}


def _numbers(part: object, name: str) -> NDArray[np.float64]:
    return getattr(part, name).detach().cpu().numpy()


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
    expected: dict[str, tuple[int | None, ...]] = dict(
        _tensors(network, len(inputs), members + central)
    )
    actuators = len(CommandFeatures.of(tuple(i["name"] for i in inputs)).driven)
    drives, units = content["coordinates"] == "residual-twist", _units(path, content)
    if drives:
        if content.get("drive") != list(DriveModel.NAMES):
            raise FileError(
                path,
                "is no drive model that this version reads: train the simulator anew",
                field="drive",
            )
        expected |= {f"drive.{k}": v for k, v in DriveModel.shapes(actuators).items()}
    if units:
        given = len(inputs) + len(derived)
        shapes = (units, given), (given,), (members + central, len(OUTPUTS), units)
        expected |= {f"kernel.{k}": v for k, v in zip(KERNEL, shapes, strict=True)}
    if noisy:
        expected |= {f"noise.{name}": shape for name, shape in NoiseModel.SHAPES.items()}
    said = content.get("domain")
    if said is not None:
        expected["domain.seen"] = (None,) * sum(not i["name"].startswith("prev_") for i in inputs)
    if content["version"] == 1:
        expected |= {name: expected[name][1:] for name in ("genes", "output_scale")}
        del expected["dead_zone"]
    tensors = files.read_tensors(Path(folder) / "weights.safetensors", expected)
    if (tensors["input_scale"] <= 0).any():
        weights = Path(folder) / "weights.safetensors"
        raise FileError(weights, "expected numbers above 0", field="input_scale")
    known = None if said is None else _domain(path, said, inputs, tensors.pop("domain.seen"))
    loaded = {name: torch.from_numpy(value).to(device) for name, value in tensors.items()}
    others = ("format", "version", "outputs", "members", "central", "noise", "derived")
    described = (*others, "drive", "kernel_units", "domain", "correction", *fields)
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
            DriveModel(**_part(loaded, "drive.")) if drives else None,
            KernelUnits(**_part(loaded, "kernel.")) if units else None,
            known,
            _correction(path, content),
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
    if isinstance(found, dict) and set(found) <= {"swing"}:
        swing = found.get("swing")
        number = isinstance(swing, int | float) and not isinstance(swing, bool) and abs(swing) < 1
        if swing is None or number:
            return Derived(swing)
    raise FileError(
        path, "expected swing (a number, or null): train the simulator anew", field="derived"
    )


def _correction(path: Path, content: Mapping[str, Any]) -> Correction:
    found = content.get("correction")
    if found is None:
        return Correction()
    names = list(asdict(Correction()))
    numbers = isinstance(found, dict) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in found.values()
    )
    if not numbers or list(found) != names:
        raise FileError(path, f"expected {', '.join(names)}, numbers", field="correction")
    try:
        return Correction(**{name: float(value) for name, value in found.items()})
    except ValueError as error:
        raise FileError(path, str(error), field="correction") from None


def _units(path: Path, content: Mapping[str, Any]) -> int:
    units = content.get("kernel_units", 0)
    if isinstance(units, bool) or not isinstance(units, int) or units < 0:
        raise FileError(path, f"expected a number from 0, found {units!r}", field="kernel_units")
    return units


def _domain(path: Path, said: Any, inputs: list[dict[str, Any]], seen: NDArray[np.uint8]) -> Domain:
    names = tuple(i["name"] for i in inputs if not i["name"].startswith("prev_"))
    try:
        if seen.dtype != np.uint8 or (seen > 1).any():
            raise ValueError("domain.seen is of zeros and ones, uint8")
        ranges, rows = said["commands"], said["rows"]
        if tuple(ranges) != names or isinstance(rows, bool) or not isinstance(rows, int):
            raise ValueError(f"expected commands ({', '.join(names)}), and a number of rows")
        ends = np.array([ranges[name] for name in names], np.float64).reshape(len(names), 2)
        return Domain(names, ends[:, 0], ends[:, 1], rows, float(said["reach"]), seen)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(path, f"is no domain of these commands ({error})", field="domain") from None


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _noise(tensors: Mapping[str, torch.Tensor]) -> NoiseModel:
    return NoiseModel(**{name: tensors[f"noise.{name}"] for name in NoiseModel.SHAPES})


def _tensors(
    network: ProductSummationNetwork | Perceptron, inputs: int, members: int
) -> dict[str, tuple[int, ...]]:
    return {
        "genes": (members, len(OUTPUTS), network.genes),
        "input_scale": (inputs,),
        "output_scale": (members, len(OUTPUTS)),
        "dead_zone": (inputs,),
    }
