"""A task in a simulator, and what becomes of chromosomes in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurosim.evolution.command_sets import decode, pairing_keys
from neurosim.evolve.rollouts import Rollouts
from neurosim.tasks.base import Evaluation, Task

if TYPE_CHECKING:
    from neurosim.evolve.plans import PlanSettings


class Course:
    """A task in a simulator: what becomes of chromosomes.

    Attributes:
        settings: how plans are evolved.
    """

    def __init__(self, drives: Rollouts, task: Task, settings: PlanSettings):
        self._drives, self._task, self.settings = drives, task, settings

    def expected(self, genes: NDArray) -> tuple[Evaluation, NDArray, NDArray, NDArray]:
        """Return evaluation, paths [B, K + 2, 3], commands and given of chromosomes [B, 4 K]."""
        commands, given = self.decode(genes)
        poses = self._drives.expected(commands, given)
        return self._task.evaluate(poses, _with_rest(given)), poses, commands, given

    def drawn(self, genes: NDArray, draws: Any) -> tuple[NDArray, NDArray, NDArray]:
        """Return fitness [B, R], completes [B, R] and the keys of commands [B, K]."""
        commands, given = self.decode(genes)
        poses = self._drives.drawn(commands, given, draws)
        counted = np.repeat(_with_rest(given), len(draws), axis=0)
        judged = self._task.evaluate(poses.reshape(-1, *poses.shape[2:]), counted)
        shape = poses.shape[:2]
        keys = self.keys(poses[:, 0], given)
        return judged.fitness.reshape(shape), judged.completes.reshape(shape), keys

    def draw(self, count: int, seed: int) -> Any:
        """Draw outcomes."""
        return self._drives.draw(count, self.settings.commands, seed, self.settings.placing)

    def keys(self, poses: NDArray, given: NDArray) -> NDArray[np.int64]:
        """Return the keys [B, K] by which crossover pairs the commands of paths."""
        return pairing_keys(self._task.region(poses[:, : given.shape[1]]), given)

    def decode(self, genes: NDArray) -> tuple[NDArray, NDArray]:
        """Return commands [B, K, 3] and given [B, K] of chromosomes [B, 4 K]."""
        return decode(genes, self.settings.max_speed, *map(float, self.settings.durations))


def _with_rest(given: NDArray) -> NDArray[np.bool_]:
    """Return ``given`` with the segment in which the motors run down, which is no command."""
    return np.concatenate([given, np.zeros((len(given), 1), np.bool_)], axis=1)
