"""Controllers on disk: a plan of commands, or a network from sensors to motors.

A controller is a folder with ``controller.json``.
"""

from __future__ import annotations

from pathlib import Path

from neurosim.base import files
from neurosim.base.errors import FileError
from neurosim.controllers.network_files import NetworkController
from neurosim.controllers.plan_files import FORMAT, VERSION, Command, Plan

__all__ = ["FORMAT", "VERSION", "Command", "NetworkController", "Plan", "read_controller"]


def read_controller(folder: str | Path) -> Plan | NetworkController:
    """Read a controller of any kind.

    Raises:
        FileError: if the folder is not a controller that this version reads.
    """
    path = Path(folder) / "controller.json"
    if not Path(folder).is_dir():
        raise FileError(folder, "no such controller; expected a folder with controller.json")
    kind = files.read_json(path, FORMAT, VERSION, {"kind": str})["kind"]
    kinds = {"plan": Plan, "network": NetworkController}
    if kind not in kinds:
        raise FileError(path, f"expected one of {', '.join(kinds)}, found {kind!r}", field="kind")
    return kinds[kind].read(folder)
