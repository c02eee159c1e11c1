"""Checkpoints, from which an interrupted search can be resumed."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files, formats
from neurosim.base.errors import FileError, UserError

FORMAT, VERSION = "neurosim-checkpoint", 1
#: The name of the digest among a state's arrays.
_DIGEST = "digest"


class Checkpoint:
    """A folder next to the output, ``OUT.checkpoint``, that exists while a long computation runs.

    ``checkpoint.json`` holds the settings and is written once, before the first generation;
    ``state.safetensors`` holds the rest and is replaced whole, so that a kill at any moment leaves
    a usable one. A digest of the arrays is stored among them: damaged or foreign arrays are an
    error.

    Args:
        out: path of the output.
        what: the computation, for messages: ``training`` or ``evolution``.
    """

    def __init__(self, out: str | Path, what: str):
        out = Path(out)
        self._what = what
        self.folder = out.with_name(out.name + ".checkpoint")
        self._settings = self.folder / "checkpoint.json"
        self._state = self.folder / "state.safetensors"

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock the folder for this process while the block runs; see :func:`files.locked`.

        Raises:
            UserError: if another process has it.
        """
        files.make_folder(self.folder)
        try:
            with files.locked(self.folder, "used"):
                yield
        finally:
            with suppress(OSError):
                self.folder.rmdir()  # nothing was saved

    def check_none(self) -> None:
        """Raise an error if there is a checkpoint.

        Raises:
            UserError: if there is one, of an interrupted run.
        """
        if self._settings.exists():
            raise UserError(
                f"{self.folder} has an interrupted {self._what}: continue it (--resume), or "
                "remove the folder yourself"
            )

    def begin(self, settings: Mapping[str, Any], options: Mapping[str, Any] | None = None) -> None:
        """Start again.

        Args:
            settings: values that must be equal when it is resumed.
            options: kept for resuming, and returned by :meth:`options`.

        Raises:
            UserError: if there is a checkpoint of an interrupted run.
        """
        self.check_none()
        files.make_folder(self.folder)
        self._state.unlink(missing_ok=True)
        content = {"settings": dict(settings), "options": dict(options or {})}
        files.write_json(self._settings, FORMAT, VERSION, content)

    @property
    def begun(self) -> bool:
        """Whether there is a run to resume."""
        return self._settings.exists()

    @property
    def saved(self) -> bool:
        """Whether a state was saved."""
        return self._state.exists()

    def options(self) -> dict[str, Any]:
        """Return the options of the first start; empty if there is no checkpoint.

        Raises:
            FileError: if the checkpoint is damaged.
        """
        if not self.begun:
            return {}
        return files.read_json(self._settings, FORMAT, VERSION, formats.Checkpoint).get(
            "options", {}
        )

    def resume(self, settings: Mapping[str, Any]) -> dict[str, np.ndarray] | None:
        """Return the saved state, None if nothing had been saved yet.

        Raises:
            UserError: if there is nothing to resume, or it was begun with other settings.
            FileError: if the checkpoint is damaged.
        """
        if not self._settings.exists():
            raise UserError(
                f"there is no interrupted {self._what} at {self.folder}; start it without --resume"
            )
        begun = files.read_json(self._settings, FORMAT, VERSION, formats.Checkpoint)["settings"]
        settings = json.loads(json.dumps(dict(settings)))  # a tuple comes back as a list
        if (wrong := difference(begun, settings)) is not None:
            name, before, now = wrong
            raise UserError(
                f"{self.folder} was begun with {name} = {before!r}, not {now!r}; resume it with "
                "the same, or remove it yourself"
            )
        if not self.saved:
            return None
        state = files.read_tensors(self._state)
        stored = state.pop(_DIGEST, np.empty(0))
        if not np.array_equal(stored, _digest(state)):
            raise self.damaged()
        return state

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the saved state."""
        arrays = {name: np.ascontiguousarray(value) for name, value in state.items()}
        files.write_tensors(self._state, {**arrays, _DIGEST: _digest(arrays)})

    def damaged(self) -> FileError:
        """Return the error for a saved state that does not fit its settings."""
        return FileError(
            self._state, f"is not the state of this {self._what}; remove its folder and start again"
        )

    def remove(self) -> None:
        """Remove the folder, at the end of the computation."""
        shutil.rmtree(self.folder, ignore_errors=True)


def difference(was: Any, now: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Return the first entry that differs: its name, as in ``task.name``, and both values."""
    if not isinstance(was, dict) or not isinstance(now, dict):
        return None if was == now else (name, was, now)
    for key in [*now, *(key for key in was if key not in now)]:
        path = f"{name}.{key}" if name else key
        if (inner := difference(was.get(key), now.get(key), path)) is not None:
            return inner
    return None


def _digest(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return the SHA-256 [32] of arrays: their names, kinds, shapes and numbers."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
