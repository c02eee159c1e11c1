"""Plans of given commands, and the obvious method to drive them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.trajectory import RUN_DOWN, Draws, Episode
from neurosim.controllers import Controller
from neurosim.controllers.plan import COMMAND_NAMES, with_rest

EPISODE = Episode(rest=RUN_DOWN)


@dataclass(frozen=True, eq=False)
class GivenPlans(Controller):
    """Plans of given commands [P, K, 3], null where ``given`` [P, K] is False; without genes."""

    kind = "given"
    outputs = COMMAND_NAMES
    open_loop = True

    all_commands: NDArray
    given: NDArray

    @property
    def rows(self) -> NDArray:
        """Empty genes [P, 0], a row for each plan."""
        return np.empty((len(self.given), 0))

    def commands(self, genes, rest):
        rows = slice(len(genes))
        return with_rest(self.all_commands[rows], self.given[rows], rest)


def expected(rollouts, plans: GivenPlans, start) -> NDArray:
    """Return the poses [P, K + 2, 3] that rollouts of plans expect from a start."""
    return rollouts.run(plans.rows, Draws(np.array([start], float))).poses[:, 0]


def sampled_poses(rollouts, plans: GivenPlans, draws: Draws) -> NDArray:
    """Return the poses [P, R, K + 2, 3] of plans through the same samples."""
    return rollouts.run(plans.rows, draws).poses


def by_protocol(simulator, starts, plans: GivenPlans, generator=None) -> NDArray:
    """Drive plans [P] from starts [P, 3] through ``start`` and ``step``; poses [P, K + 2, 3]."""
    commands, given = map(torch.from_numpy, plans.commands(plans.rows, RUN_DOWN))
    given[:, -1] = True
    state = simulator.start(torch.as_tensor(starts, dtype=torch.float64), generator)
    poses = [state[:, :3]]
    for k in range(commands.shape[1]):
        after = simulator.step(state, commands[:, k], generator)
        state = torch.where(given[:, k, None], after, state)
        poses.append(state[:, :3])
    return torch.stack(poses, dim=1).numpy()
