"""The kinds of simulators by name, and how one is read from its folder."""

from __future__ import annotations

from pathlib import Path

import torch

from neurosim.base import files
from neurosim.base.errors import FileError
from neurosim.base.registry import Registry
from neurosim.simulators.base import FORMAT, VERSION, Simulator

#: By the kind that simulator.json names: what reads such a folder, (folder, device) -> simulator.
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
    """
    path = Path(folder) / "simulator.json"
    if not Path(folder).is_dir():
        raise FileError(folder, "no such simulator; expected a folder with simulator.json")
    kind = files.read_json(path, FORMAT, VERSION, {"kind": str})["kind"]
    if kind not in SIMULATORS.names():
        known = ", ".join(SIMULATORS.names())
        raise FileError(path, f"expected one of {known}, found {kind!r}", field="kind")
    return SIMULATORS.get(kind)(folder, device)
