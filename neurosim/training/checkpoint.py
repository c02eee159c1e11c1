"""Checkpoints: what an interrupted training goes on from."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurosim.base import files
from neurosim.base.errors import FileError, UserError

FORMAT, VERSION = "neurosim-checkpoint", 1


class Checkpoint:
    """A folder beside the output, ``OUT.checkpoint``, that is there while a training runs.

    ``checkpoint.json`` holds the settings and is written once, before the first generation;
    ``state.safetensors`` holds all the rest and is replaced whole, so that a kill at any moment
    leaves one that can be gone on from.
    """

    def __init__(self, out: str | Path):
        out = Path(out)
        self.folder = out.with_name(out.name + ".checkpoint")
        self._settings = self.folder / "checkpoint.json"
        self._state = self.folder / "state.safetensors"

    def begin(self, settings: Mapping[str, Any]) -> None:
        """Start anew.

        Raises:
            UserError: if there is a checkpoint of an interrupted training.
        """
        if self._settings.exists():
            raise UserError(
                f"{self.folder} holds an interrupted training; "
                "go on with it (--resume), or remove it yourself"
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        self._state.unlink(missing_ok=True)
        files.write_json(self._settings, FORMAT, VERSION, {"settings": dict(settings)})

    def resume(self, settings: Mapping[str, Any]) -> dict[str, np.ndarray] | None:
        """Return the saved state, None if the training had not saved any yet.

        Raises:
            UserError: if there is nothing to resume, or it was begun with other settings.
            FileError: if the checkpoint is damaged.
        """
        if not self._settings.exists():
            raise UserError(f"there is no interrupted training at {self.folder}; start it anew")
        fields = {"settings": dict}
        begun = files.read_json(self._settings, FORMAT, VERSION, fields)["settings"]
        settings = json.loads(json.dumps(dict(settings)))  # a tuple comes back as a list
        for name in [*settings, *(name for name in begun if name not in settings)]:
            if begun.get(name) != settings.get(name):
                raise UserError(
                    f"{self.folder} was begun with {name} = {begun.get(name)!r}, not "
                    f"{settings.get(name)!r}; resume it with the same, or remove it yourself"
                )
        return files.read_tensors(self._state) if self._state.exists() else None

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the saved state."""
        files.write_tensors(self._state, state)

    def damaged(self) -> FileError:
        """Return the error to raise where the saved state does not fit its settings."""
        return FileError(
            self._state, "is not the state of this training; remove its folder and start anew"
        )

    def remove(self) -> None:
        """Remove the folder: the training is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)
