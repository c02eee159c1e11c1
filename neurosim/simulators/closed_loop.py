"""What compiled rollouts of networks share, whatever the simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray

from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.networks.control import NOT_READINGS, input_sources
from neurosim.networks.control_kernels import make_loop, room
from neurosim.simulators.base import as_seed, put_down


class ClosedLoop:
    """A simulator, a family of networks that drive in it, and the trial.

    A simulator's own subclass has :class:`~neurosim.simulators.base.Rollouts`' methods.
    """

    def __init__(self, simulator: Any, controller: Any, episode: Episode):
        """Lay out the network; ``controller`` is any whose ``arrays()`` there are."""
        names = simulator.reading_names
        self.simulator, self.episode = simulator, episode
        self.loop = make_loop(controller.arrays(), input_sources(controller.inputs, names), episode)
        self.room = room(self.loop)
        sees = any(name not in NOT_READINGS for name in controller.inputs)
        self._reads = bool(names) and (sees or episode.readings)
        self.steps = episode.steps + (episode.rest > 0)
        self._genes = controller.genes
        self._kept: dict[str, NDArray] = {}

    def checked(self, genes: NDArray, draws: Draws) -> tuple[NDArray, NDArray, NDArray]:
        """Return genes [P, G], starts [R, 3] and noise [R, T, Z] as kernels take them.

        Where the draws have no noise, T is 0.

        Raises:
            ValueError: if genes or noise are not as many as this trial takes; kernels do not look.
        """
        if genes.ndim != 2 or genes.shape[1] != self._genes:
            raise ValueError(f"expected genes [P, {self._genes}], got {list(genes.shape)}")
        if draws.state is not None:
            raise ValueError("compiled controllers that see begin with a robot that stands still")
        noise, width = draws.noise, self.simulator.noise_width
        if noise is None:
            noise = np.empty((len(draws), 0, width))
        elif len(noise) != len(draws) or noise.shape[1] < self.steps or noise.shape[2] < width:
            raise ValueError(
                f"expected noise [{len(draws)}, {self.steps}, {width}], got {list(noise.shape)}"
            )
        found = [np.ascontiguousarray(v, np.float64) for v in (genes, draws.starts, noise)]
        return found[0], found[1], found[2]

    def put_down(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator,
        placing: tuple[float, float] | None,
    ) -> NDArray[np.float64]:
        """Return the poses [R, 3] that robots put down at ``starts`` have."""
        if placing is None:
            return np.asarray(starts, np.float64)
        return put_down(starts, placing, torch.Generator().manual_seed(as_seed(rng)))

    def buffers(self, count: int, outcomes: int, kind: DTypeLike, reuse: bool) -> list[NDArray]:
        """Return arrays [P, R, ...] for poses, commands and readings to be written to.

        New memory of tens of megabytes takes as long as the driving: with ``reuse`` it is that of
        the run before where it is large enough.
        """
        sensors = len(self.simulator.reading_names)
        shapes = {
            "poses": ((self.steps + 1, 3), np.float64),
            "commands": ((self.steps, len(self.loop.scale)), kind),
            "readings": ((self.steps * self._reads, sensors), np.float32),
        }
        found = []
        for name, (each, dtype) in shapes.items():
            kept = self._kept.get(name)
            if not reuse or kept is None or len(kept) < count or kept.shape[1] != outcomes:
                kept = np.empty((count, outcomes, *each), dtype)
                if reuse:
                    self._kept[name] = kept
            found.append(kept[:count])
        return found

    def trajectory(self, poses: NDArray, commands: NDArray, readings: NDArray) -> Trajectory:
        """Return the trajectories [P, R, ...] of arrays that were written."""
        durations: float | NDArray = self.episode.step
        active, shape = None, commands.shape[:-1]
        if self.episode.rest > 0:
            each = np.full(self.steps, self.episode.step)
            each[-1] = self.episode.rest
            durations = np.broadcast_to(each, shape)
            active = np.broadcast_to(np.arange(self.steps) < self.episode.steps, shape)
        return Trajectory(poses, commands, durations, readings if self._reads else None, active)
