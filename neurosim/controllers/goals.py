"""The next goal of an episode, for a controller's goal inputs in a simulator and on a robot."""

from __future__ import annotations

import torch
from torch import Tensor

from neurosim.base.trajectory import Episode


class Goals:
    """The next of an episode's goals for each robot.

    Args:
        episode: of the task.
        rows: robots.
    """

    def __init__(self, episode: Episode, rows: int):
        self._goals = None if episode.goals is None else torch.from_numpy(episode.goals)
        self._reach = episode.reach
        self._next = torch.zeros(rows, dtype=torch.long)

    def at(self, pose: Tensor) -> Tensor | None:
        """Return the next goal [B, 3] of robots at ``pose`` [B, 3]; None: there are no goals."""
        if self._goals is None:
            return None
        away = (self._goals[self._next, :2] - pose[:, :2]).norm(dim=1)
        last = len(self._goals) - 1
        self._next = torch.where(away <= self._reach, (self._next + 1).clamp(max=last), self._next)
        return self._goals[self._next]
