"""Plans driven in a motion network, in compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.trajectory import Draws, Episode, Trajectory, planned
from neurosim.simulators.base import draw_outcomes
from neurosim.simulators.motion.kernels import memory_size
from neurosim.simulators.motion.plan_kernels import drawn_poses, lay_out, mean_poses


class MotionPlans:
    """Rollouts of blind controllers in a motion network of linear units."""

    def __init__(self, simulator: Any, controller: Any, episode: Episode):
        """Lay out the networks.

        Args:
            simulator: a motion network of linear units.
            controller: with ``commands(genes, rest)``, in the simulator's columns.
            episode: how a trial runs.
        """
        self._simulator, self._controller, self._rest = simulator, controller, episode.rest
        self._arrays = simulator.arrays()
        self._mean = lay_out(self._arrays, mean=True)
        self._members = lay_out(self._arrays, mean=False)
        self._source = simulator.input_sources()

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw outcomes: where the robot is put down, member and noise of each."""
        genes = np.zeros((1, self._controller.genes))
        steps = self._controller.commands(genes, self._rest)[0].shape[1]
        return draw_outcomes(self._simulator, starts, rng, placing, steps)

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...]; see :class:`neurosim.simulators.base.Rollouts`."""
        commands, active = self._controller.commands(genes, self._rest)
        plans = np.ascontiguousarray(commands, np.float64), np.ascontiguousarray(active, np.bool_)
        rests = self._rest > 0
        member, noise = draws.member, draws.noise
        begun = self._begun(draws.state)
        if noise is None and (member is None or (member < 0).all()):
            each = [
                mean_poses(self._mean, self._source, start, begun, *plans, rests)
                for start in draws.starts
            ]
            poses = each[0][:, None] if len(each) == 1 else np.stack(each, axis=1)
        else:
            count = len(draws)
            if member is None:
                member = np.zeros(count, np.int64)
            if noise is None:
                noise = np.zeros((count, commands.shape[1], self._simulator.noise_width))
            outcomes = draws.starts, member, noise
            poses = drawn_poses(
                self._members, self._arrays, self._source, *outcomes, begun, *plans, rests
            )
        return planned(poses, commands, active, self._rest)

    def _begun(self, state: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """Return what the kernels remember of a robot that goes on from a state [S], or stands."""
        found = np.zeros(memory_size(self._mean))
        if state is not None:
            remembered = self._simulator.remembered(torch.from_numpy(state[None]))[0].numpy()
            found[: len(remembered)] = remembered
        return found
