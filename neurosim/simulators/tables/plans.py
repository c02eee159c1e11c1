"""Plans driven in a table simulator, in compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.trajectory import Draws, Episode, Trajectory, planned
from neurosim.simulators.base import as_seed, put_down
from neurosim.simulators.tables.plan_kernels import drive_plans


class TablePlans:
    """Rollouts of blind controllers in a table simulator; sensors are not read."""

    def __init__(self, simulator: Any, controller: Any, episode: Episode):
        self._simulator, self._controller, self._rest = simulator, controller, episode.rest

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw outcomes: where the robot is put down, and the noise of every command."""
        generator = torch.Generator().manual_seed(as_seed(rng))
        starts = put_down(starts, placing, generator)
        genes = np.zeros((1, self._controller.genes))
        shape = (len(starts), self._controller.commands(genes, self._rest)[0].shape[1], 3)
        if self._simulator.noise == "uniform":
            z = 2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0
        else:
            z = torch.randn(shape, generator=generator, dtype=torch.float64)
        return Draws(starts, noise=z.numpy())

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...]; see :class:`neurosim.simulators.base.Rollouts`."""
        commands, active = self._controller.commands(genes, self._rest)
        noise = draws.noise
        if noise is None:
            noise = np.zeros((len(draws), commands.shape[1], 3))
        commands = np.ascontiguousarray(commands, np.float64)
        poses = drive_plans(
            self._simulator.arrays,
            np.ascontiguousarray(draws.starts, np.float64),
            np.zeros(4) if draws.state is None else np.array(draws.state[3:7], np.float64),
            noise,
            commands,
            np.ascontiguousarray(active, np.bool_),
            self._rest > 0,
        )
        return planned(poses, commands, active, self._rest)
