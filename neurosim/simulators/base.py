"""What every simulator offers, and how one is read from its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from neurosim.base import files
from neurosim.base.errors import FileError

FORMAT, VERSION = "neurosim-simulator", 2


@runtime_checkable
class Simulator(Protocol):
    """Predicts the state that a command leads to, for a whole batch at once.

    A simulator keeps no hidden state: what a trajectory must remember is in its ``state``. A
    controller cannot tell which simulator it runs in.

    Attributes:
        state_names: the columns of a state; the first three are x (m), y (m), theta (rad).
        command_names: the columns of a command.
    """

    state_names: tuple[str, ...]
    command_names: tuple[str, ...]

    def start(self, pose: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the states [B, S] of robots that stand still at ``pose`` [B, 3]."""
        ...

    def step(
        self, state: Tensor, command: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the states [B, S] after ``command`` [B, C] was carried out from ``state``.

        Noise is drawn only where a generator is given; without one the answer is the mean.
        """
        ...


def read_simulator(folder: str | Path, device: str | torch.device = "cpu") -> Simulator:
    """Read a simulator of any kind.

    Raises:
        FileError: if the folder is not a simulator that this version reads, or a file in it is
            missing, cut short or wrong.
    """
    from neurosim.simulators.motion.network import MotionNetwork
    from neurosim.simulators.tables.simulator import TableSimulator

    path = Path(folder) / "simulator.json"
    if not Path(folder).is_dir():
        raise FileError(folder, "no such simulator; expected a folder with simulator.json")
    kinds = {cls.kind: cls for cls in (MotionNetwork, TableSimulator)}
    kind = files.read_json(path, FORMAT, VERSION, {"kind": str})["kind"]
    if kind not in kinds:
        raise FileError(path, f"expected one of {', '.join(kinds)}, found {kind!r}", field="kind")
    return kinds[kind].read(folder, device)
