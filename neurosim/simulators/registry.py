"""The kinds of simulators by name, and their readers and writers."""

from __future__ import annotations

from pathlib import Path

import torch

from neurosim.base import files, formats
from neurosim.base.errors import FileError, UserError
from neurosim.base.registry import Registry
from neurosim.simulators.base import FORMAT, VERSION, Simulator, Writable
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.motion.network import MotionNetwork

#: The reader of each kind in simulator.json: (folder, device) -> simulator.
SIMULATORS = Registry(
    "kind of simulator",
    "neurosim.simulators",
    {
        "motion-network": "neurosim.simulators.motion.files:read_motion",
        "tables": "neurosim.simulators.tables.simulator:TableSimulator.read",
        "legged": "neurosim.simulators.legged.simulator:LeggedSimulator.read",
    },
)


def read_simulator(folder: str | Path, device: str | torch.device = "cpu") -> Simulator:
    """Read a simulator of any kind.

    Raises:
        FileError: if the folder is not a simulator that this version reads, or a file in it is
            missing, cut short or wrong.
        UserError: if the device does not exist.
    """
    check_device(device)
    path = Path(folder) / "simulator.json"
    if not Path(folder).is_dir():
        raise FileError(folder, "no such simulator; expected a folder with simulator.json")
    kind = files.read_json(path, FORMAT, VERSION, formats.Kind)["kind"]
    if kind not in SIMULATORS.names():
        known = ", ".join(SIMULATORS.names())
        raise FileError(path, f"expected one of {known}, found {kind!r}", field="kind")
    return SIMULATORS.get(kind)(folder, device)


def simulator_of(simulator: str | Path | Simulator) -> Simulator:
    """Return a simulator that is given as an object or by its folder.

    Raises:
        UserError: if it is something else, or its folder cannot be read.
    """
    if isinstance(simulator, str | Path):
        return read_simulator(simulator)
    if not isinstance(simulator, Simulator):
        raise UserError(
            f"expected a simulator or its folder, not {type(simulator).__name__}; read one with "
            "neurosim.load, or subclass neurosim.Simulator"
        )
    if not hasattr(simulator, "command_names"):
        raise UserError(f"{type(simulator).__name__} has no command_names: name its commands")
    return simulator


def check_device(device: str | torch.device) -> None:
    """Raise an error for a device that PyTorch does not have.

    Raises:
        UserError: naming it.
    """
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        raise UserError(
            f"PyTorch has no device {str(device)!r} on this computer; try cpu"
        ) from None


def write_simulator(simulator: Simulator, folder: str | Path) -> bool:
    """Write a simulator as a new folder; return whether its kind can be written.

    Raises:
        UserError: if the folder exists.
    """
    if isinstance(simulator, MotionNetwork):
        with files.new_folder(folder) as partial:
            write_motion(simulator, partial)
    elif isinstance(simulator, Writable):
        simulator.write(folder)
    else:
        return False
    return True
