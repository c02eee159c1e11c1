"""Which goal of an episode is the next: what a controller is told in a simulator and on a robot."""

from __future__ import annotations

import torch
from torch import Tensor

from neurosim.base.trajectory import Episode


class Goals:
    """Which of an episode's goals each robot is to reach next.

    Args:
        episode: of the task.
        rows: robots.
    """

    def __init__(self, episode: Episode, rows: int):
        self._goals = None if episode.goals is None else torch.from_numpy(episode.goals)
        self._reach = episode.reach
        self._next = torch.zeros(rows, dtype=torch.long)

    def restart(self, rows: Tensor) -> None:
        """Begin with the first goal again, in some rows [K]."""
        self._next[rows] = 0

    def at(self, pose: Tensor, rows: Tensor | slice = slice(None)) -> Tensor | None:
        """Return the next goal of robots; None: there are no goals.

        Args:
            pose: [B, 3] where they are.
            rows: which robots of the batch these are; all by default.

        Returns:
            [B, 3].
        """
        if self._goals is None:
            return None
        number = self._next[rows]
        away = (self._goals[number, :2] - pose[:, :2]).norm(dim=1)
        last = len(self._goals) - 1
        self._next[rows] = torch.where(away <= self._reach, (number + 1).clamp(max=last), number)
        return self._goals[self._next[rows]]
