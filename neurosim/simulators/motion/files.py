"""The folder of a motion network: simulator.json and weights.safetensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base import files, formats
from neurosim.base.errors import FileError
from neurosim.networks import ProductSummationNetwork
from neurosim.networks.control import NOT_READINGS
from neurosim.simulators.base import FORMAT, VERSION
from neurosim.simulators.motion.correction import Correction
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.domain import Domain
from neurosim.simulators.motion.drive import DriveModel
from neurosim.simulators.motion.excess import Excess
from neurosim.simulators.motion.floor import TENSORS as FLOOR
from neurosim.simulators.motion.floor import Floor
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.network import OUTPUTS, MotionNetwork
from neurosim.simulators.motion.noise import (
    COMPONENTS,
    SCALE_FEATURES,
    TAIL_FEATURES,
    CommandFeatures,
    NoiseModel,
)
from neurosim.simulators.motion.sensors import TENSORS, Sensors

#: Oldest version that can be read: in earlier ones a drift is of sideways motion alone. Oldest one
#: in which the errors of measured speeds are known.
_OLDEST, _MEASURED = 13, 14

#: The tensors of kernel units, and of an excess.
KERNEL, EXCESS = ("centres", "lengths", "weights"), ("lasts", "covariance", "errors", "shortest")

#: The name of the noise model in simulator.json; its numbers are stored with the weights.
NOISE = {
    "kind": "lognormal-and-sources-of-the-twist",
    "components": list(COMPONENTS),
    "scale_features": list(SCALE_FEATURES),
    "tail_features": list(TAIL_FEATURES),
}


def write_motion(simulator: MotionNetwork, folder: str | Path) -> None:
    """Write simulator.json and weights.safetensors into an existing folder."""
    folder = Path(folder)
    correction, sensors = simulator.correction, simulator.sensors
    corrects = None if correction == Correction() else asdict(correction)
    content = {
        "kind": simulator.kind,
        "inputs": simulator.inputs,
        "outputs": [
            {"name": name, "unit": unit}
            for name, unit in zip(OUTPUTS, ("m", "m", "rad"), strict=True)
        ],
        "network": {k: v for k, v in asdict(simulator.network).items() if k != "inputs"},
        "coordinates": simulator.coordinates,
        "drive": None if simulator.drive is None else list(DriveModel.NAMES),
        "derived": asdict(simulator.derived),
        "kernel_units": 0 if simulator.kernel_units is None else len(simulator.kernel_units),
        "members": simulator.members,
        "central": simulator.central,
        "noise": None if simulator.noise is None else NOISE,
        "excess": simulator.excess is not None,
        **({} if corrects is None else {"correction": corrects}),
        **({} if simulator.known is None else {"domain": _domain_to_json(simulator.known)}),
        **(
            {}
            if sensors is None
            else {"sensors": {"names": list(sensors.names), "cell": sensors.cell}}
        ),
        **(
            {}
            if simulator.floor is None
            else {"floor": {"length": simulator.floor.length, "ahead": simulator.floor.ahead}}
        ),
        **simulator.meta,
    }
    tensors = {
        name: getattr(simulator, name).cpu().numpy()
        for name in ("genes", "input_scale", "output_scale", "dead_band")
    }
    if simulator.drive is not None:
        tensors |= {f"drive.{k}": _numbers(simulator.drive, k) for k in DriveModel.NAMES}
    if simulator.kernel_units is not None:
        tensors |= {f"kernel.{k}": _numbers(simulator.kernel_units, k) for k in KERNEL}
    if simulator.noise is not None:
        tensors |= {f"noise.{k}": v.numpy() for k, v in simulator.noise.tensors().items()}
    if simulator.excess is not None:
        tensors |= {f"excess.{k}": _numbers(simulator.excess, k) for k in EXCESS}
    if simulator.known is not None:
        tensors["domain.seen"] = simulator.known.seen
    if sensors is not None:
        tensors |= {f"sensors.{k}": _numbers(sensors, k) for k in TENSORS}
    if simulator.floor is not None:
        tensors |= {f"floor.{k}": _numbers(simulator.floor, k) for k in FLOOR}
    files.write_tensors(folder / "weights.safetensors", tensors)
    files.write_json(folder / "simulator.json", FORMAT, VERSION, content)


def _domain_to_json(known: Domain) -> dict[str, Any]:
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
    content = files.read_json(path, FORMAT, VERSION, formats.MotionNetwork, oldest=_OLDEST)
    inputs = content["inputs"]
    derived = Derived(content.get("derived", {}).get("swing"))
    shape = partial(ProductSummationNetwork, len(inputs) + len(derived))
    network = files.made(path, "network", shape, content["network"])
    members, noisy = content["members"], "noise" in content
    if noisy and content["noise"] != NOISE:
        raise FileError(
            path,
            "is not a noise model that this version reads: train the simulator again",
            field="noise",
        )
    central = content.get("central", False)
    expected: dict[str, tuple[int | None, ...]] = dict(
        _tensors(network, len(inputs), members + central)
    )
    actuators = len(CommandFeatures.of(tuple(i["name"] for i in inputs)).driven)
    drives, units = content["coordinates"] == "residual-twist", content.get("kernel_units", 0)
    if drives:
        if content.get("drive") != list(DriveModel.NAMES):
            raise FileError(
                path,
                "is not a drive model that this version reads: train the simulator again",
                field="drive",
            )
        expected |= {f"drive.{k}": v for k, v in DriveModel.shapes(actuators).items()}
    if units:
        given = len(inputs) + len(derived)
        shapes = (units, given), (given,), (members + central, len(OUTPUTS), units)
        expected |= {f"kernel.{k}": v for k, v in zip(KERNEL, shapes, strict=True)}
    if noisy:
        expected |= {f"noise.{name}": shape for name, shape in NoiseModel.SHAPES.items()}
    exceeds = content.get("excess", False)
    if exceeds and content["version"] < _MEASURED:
        raise FileError(
            path,
            "does not tell how certain measured speeds are: train the simulator again",
            field="excess",
        )
    if exceeds:
        expected |= dict(
            zip((f"excess.{k}" for k in EXCESS), ((3,), (3, 3), (3,), (1,)), strict=True)
        )
    stored = content.get("domain")
    if stored is not None:
        expected["domain.seen"] = (None,) * sum(not i["name"].startswith("prev_") for i in inputs)
    if content.get("sensors") is not None:
        count = len(content["sensors"]["names"])
        expected |= {"sensors.mount": (count, 2), "sensors.noise": (count, 2)}
        expected |= {"sensors.place": (count,), "sensors.origin": (2,)}
        expected["sensors.maps"] = (None, None, None)
    floor = content.get("floor")
    if floor is not None:
        expected |= {"floor.weights": (1 + members, None, None), "floor.origin": (2,)}
    tensors = files.read_tensors(Path(folder) / "weights.safetensors", expected)
    if (tensors["input_scale"] <= 0).any():
        weights = Path(folder) / "weights.safetensors"
        raise FileError(weights, "expected numbers above 0", field="input_scale")
    known = None if stored is None else _domain(path, stored, inputs, tensors.pop("domain.seen"))
    loaded = {name: torch.from_numpy(value).to(device) for name, value in tensors.items()}
    described = {"format", "version", "outputs", *formats.MotionNetwork.__annotations__}
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
            loaded["dead_band"],
            central,
            derived,
            DriveModel(**_part(loaded, "drive.")) if drives else None,
            KernelUnits(**_part(loaded, "kernel.")) if units else None,
            known,
            files.made(path, "correction", Correction, content.get("correction", {})),
            _sensors(path, content, loaded),
            None if floor is None else _floor(floor, loaded),
            Excess(**_part(loaded, "excess.")) if exceeds else None,
        )
    except ValueError as error:
        raise FileError(path, f"is not a motion network ({error})") from None


def _sensors(
    path: Path, content: Mapping[str, Any], loaded: Mapping[str, torch.Tensor]
) -> Sensors | None:
    stored = content.get("sensors")
    if stored is None:
        return None
    for name in stored["names"]:
        if not name or name in NOT_READINGS:
            raise FileError(
                path, f"{name!r:.60} is not the name of a sensor", field="sensors.names"
            )
    try:
        return Sensors(
            tuple(stored["names"]), cell=float(stored["cell"]), **_part(loaded, "sensors.")
        )
    except ValueError as error:
        weights = path.with_name("weights.safetensors")
        raise FileError(weights, str(error), field="sensors") from None


def _domain(
    path: Path, stored: Any, inputs: list[dict[str, Any]], seen: NDArray[np.uint8]
) -> Domain:
    names = tuple(i["name"] for i in inputs if not i["name"].startswith("prev_"))
    try:
        if seen.dtype != np.uint8 or (seen > 1).any():
            raise ValueError("domain.seen is of zeros and ones, uint8")
        ranges, rows = stored["commands"], stored["rows"]
        if tuple(ranges) != names:
            raise ValueError(f"expected commands ({', '.join(names)})")
        ends = np.array([ranges[name] for name in names], np.float64).reshape(len(names), 2)
        return Domain(names, ends[:, 0], ends[:, 1], rows, float(stored["reach"]), seen)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(
            path, f"is not a domain of these commands ({error})", field="domain"
        ) from None


def _part(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _noise(tensors: Mapping[str, torch.Tensor]) -> NoiseModel:
    return NoiseModel(**{name: tensors[f"noise.{name}"] for name in NoiseModel.SHAPES})


def _floor(numbers: Mapping[str, Any], loaded: Mapping[str, torch.Tensor]) -> Floor:
    return Floor(
        loaded["floor.weights"], loaded["floor.origin"], numbers["length"], numbers["ahead"]
    )


def _tensors(
    network: ProductSummationNetwork, inputs: int, members: int
) -> dict[str, tuple[int, ...]]:
    return {
        "genes": (members, len(OUTPUTS), network.genes),
        "input_scale": (inputs,),
        "output_scale": (members, len(OUTPUTS)),
        "dead_band": (inputs,),
    }
