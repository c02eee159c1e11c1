"""Shortcuts for scripts: read any artefact, drive commands or a controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from neurosim.base.errors import FileError, UserError
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.controllers import SavedController, read_controller
from neurosim.controllers.base import Controller
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.simulators.base import Simulator, check_commands
from neurosim.simulators.registry import read_simulator, simulator_of
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.base import Task
from neurosim.tasks.registry import make_task
from tracking.datasets.dataset import Dataset

_READERS: dict[str, Callable[..., Any]] = {
    "simulator.json": read_simulator,
    "controller.json": read_controller,
    "dataset.json": Dataset.read,
}


def load(folder: str | Path, device: str | torch.device = "cpu") -> Any:
    """Read a simulator, a controller or a dataset, whichever a folder holds.

    Args:
        folder: its folder.
        device: PyTorch's device on which a simulator computes; without effect for the others.

    Raises:
        FileError: if it is another folder, or a file in it is missing or wrong.
        UserError: if the device does not exist.

    Example:
        >>> simulator = ns.load("simulator")
        >>> simulator.command_names
        ('left', 'right', 'duration')
    """
    if not isinstance(folder, str | Path):
        raise UserError(f"expected the name of a folder, not {type(folder).__name__}")
    folder = Path(folder)
    for name, read in _READERS.items():
        if (folder / name).exists():
            return read(folder, device) if read is read_simulator else read(folder)
    what = f"it has none of {', '.join(_READERS)}" if folder.is_dir() else "no such folder"
    raise FileError(folder, f"is not a simulator, controller or dataset: {what}")


def read_dataset(folder: str | Path) -> Dataset:
    """Read a dataset.

    Raises:
        FileError: if a file is missing or wrong.

    Example:
        >>> dataset = ns.read_dataset("data/reference")
        >>> list(dataset.inputs)
        ['prev_left', 'prev_right', 'left', 'right', 'duration']
    """
    return Dataset.read(folder)


class _Given(Controller):
    """Given commands in a simulator's own columns."""

    kind, open_loop = "commands", True

    def __init__(self, commands: NDArray[np.float64], names: tuple[str, ...]):
        self._commands, self.outputs = commands, names

    def commands(self, genes: NDArray, rest: float) -> tuple[NDArray, NDArray]:
        """Return the commands [P, T, C], without a stop at the end."""
        return self._commands, np.ones(self._commands.shape[:2], np.bool_)


def rollout(
    simulator: str | Path | Simulator,
    what: ArrayLike | Tensor | str | Path | SavedController,
    *,
    start: ArrayLike | None = None,
    task: str | Task | None = None,
    samples: int = 0,
    seed: int = 0,
    placing: tuple[float, float] = PLACING,
) -> Trajectory:
    """Drive commands or a controller in a simulator.

    Args:
        simulator: a simulator or its folder.
        what: commands [T, C] or a batch [B, T, C] in the simulator's columns, NumPy or torch; or
            a saved controller or its folder.
        start: x (m), y (m), heading (rad); by default 0, 0, 0, or the controller's own.
        task: for a controller, a task or its name, which sets the duration; by default its own.
        samples: number of random samples of each; 0: the expected motion.
        seed: of the draws.
        placing: error in placing the robot, in samples: standard deviations in x and y (m), in
            heading (rad).

    Returns:
        The trajectory: [B] trials (none for one command sequence or controller), with
        ``samples`` [B, samples] or [samples]; in tensors where ``what`` was a tensor.

    Raises:
        UserError: if a command is not finite, has no duration or is outside of the simulator's
            data; or a controller does not fit the simulator.

    Example:
        >>> path = ns.rollout("simulator", [[40, 20, 1.0], [0, 30, 0.5]])  # left %, right %, s
        >>> path.poses.shape
        (3, 3)
    """
    simulator = simulator_of(simulator)
    if isinstance(what, str | Path):
        what = read_controller(what)
    single, rollouts = True, None
    rows = np.empty((1, 0))
    if isinstance(what, SavedController):
        task = make_task(what.task if task is None else task)
        evaluator = Evaluator(simulator, task, what.controller)
        rollouts, rows = evaluator.rollouts, what.genes[None]
        start = what.start if start is None else start
    else:
        commands = what.detach().cpu().numpy() if isinstance(what, Tensor) else what
        try:
            commands = np.asarray(commands, np.float64)
        except (TypeError, ValueError):
            raise UserError(
                f"expected commands, a saved controller or its folder, not {type(what).__name__}"
            ) from None
        if commands.ndim not in (2, 3):
            raise UserError(f"commands must be [T, C] or [B, T, C], not of shape {commands.shape}")
        check_commands(simulator, commands)
        single = commands.ndim == 2
        commands = np.ascontiguousarray(commands[None] if single else commands)
        given = _Given(commands, simulator.command_names)
        rollouts = rollouts_of(simulator, given, Episode())
        rows = np.empty((len(commands), 0))
    pose = np.asarray((0.0, 0.0, 0.0) if start is None else start, np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise UserError(f"start must be x (m), y (m), heading (rad), not {start!r}")
    starts = np.tile(pose, (max(samples, 1), 1))
    draws = rollouts.draw(starts, seed, placing) if samples else Draws(starts)
    trajectory = rollouts.run(rows, draws)
    index = ((0,) if single else (slice(None),)) + (() if samples else (0,))
    return _picked(trajectory, index, isinstance(what, Tensor))


def _picked(trajectory: Trajectory, index: tuple[Any, ...], tensors: bool) -> Trajectory:
    """Return some trials of a trajectory, as tensors if requested."""

    def pick(value: Any) -> Any:
        if value is None or np.ndim(value) == 0:
            return value
        part = value[index]
        return torch.from_numpy(np.array(part)) if tensors else part

    names = ("poses", "commands", "durations", "readings", "active")
    return replace(trajectory, **{name: pick(getattr(trajectory, name)) for name in names})
