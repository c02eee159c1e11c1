"""Curves of long computations, for TensorBoard."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from neurosim.base.errors import UserError
from neurosim.base.files import make_folder


class Scalars:
    """A folder of curves, written point by point; without a folder they are dropped.

    Use it as a context manager.
    """

    def __init__(self, folder: str | Path | None):
        """Begin.

        Args:
            folder: the folder for TensorBoard; each run adds a file to it.

        Raises:
            UserError: if tensorboardX is missing, or ``folder`` is a file.
        """
        self._writer: Any = None
        if folder is None:
            return
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            raise UserError(
                "--tensorboard needs the package tensorboardX: pip install 'neurosim[tensorboard]'"
            ) from None
        make_folder(Path(folder))
        self._writer = SummaryWriter(str(folder), flush_secs=5)

    def add(self, name: str, value: float, step: int) -> None:
        """Add a point to a curve; a value that is not finite is left out."""
        if self._writer is not None and math.isfinite(value):
            self._writer.add_scalar(name, float(value), step)

    def __enter__(self) -> Scalars:
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None:
            self._writer.close()
