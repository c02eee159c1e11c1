"""Rollouts of any controller in any simulator, step by step through ``act()`` and ``step()``.

Tests compare compiled rollouts with these.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.trajectory import Draws, Episode, Trajectory, stepped
from neurosim.controllers.base import Controller, observe
from neurosim.controllers.goals import Goals
from neurosim.networks.control import NOT_READINGS
from neurosim.simulators.base import Simulator
from neurosim.simulators.sampling import SampledRollouts, began


class SteppedRollouts(SampledRollouts):
    """Rollouts through the steps of the protocols.

    A simulator that takes its noise as an argument gives every controller the same noise. A
    simulator that draws it itself draws the same for a batch of the same size, but not for two
    controllers of a batch.
    """

    def __init__(self, simulator: Simulator, controller: Controller, episode: Episode):
        super().__init__(simulator, controller, episode)
        self._sees = [name for name in controller.inputs if name not in NOT_READINGS]
        self._reads = bool(simulator.reading_names) and (bool(self._sees) or episode.readings)

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        trial = _Trial(self._simulator, self._episode, len(genes), draws, self._reads)
        with torch.no_grad():
            if self._controller.open_loop:
                return trial.open_loop(*self._controller.commands(genes, self._episode.rest))
            return trial.seeing(self._controller, torch.from_numpy(np.ascontiguousarray(genes)))


class _Trial:
    """A batch of running trials: P individuals, each through R samples."""

    def __init__(
        self,
        simulator: Simulator,
        episode: Episode,
        count: int,
        draws: Draws,
        reads: bool,
    ):
        self._simulator, self._episode, self._reads = simulator, episode, reads
        self._shape = count, len(draws)
        self._noise = None if draws.noise is None else torch.from_numpy(draws.noise).double()
        self._generator = None
        if self._noise is None and draws.seeds is not None:
            self._generator = torch.Generator().manual_seed(int(draws.seeds[0]) % 2**63)
        if self._generator is None or draws.member is not None:
            self._state = self._each(torch.from_numpy(began(simulator, draws)))
        else:  # it may draw random numbers at the start, too
            starts = self._each(torch.from_numpy(np.asarray(draws.starts, np.float64)))
            self._state = simulator.start(starts, self._generator)
        self._poses = [self._state[:, :3]]
        self._readings: list[Tensor] = []

    def _each(self, sample: Tensor) -> Tensor:
        """Return values of samples [R, ...] repeated for every row [P R, ...]."""
        return sample.expand(self._shape[0], *sample.shape).flatten(0, 1)

    def _random(self, step: int) -> dict[str, Any]:
        """Return the noise for ``step`` and ``sense``."""
        if self._noise is not None:
            return {"z": self._each(self._noise[:, step])}
        return {} if self._generator is None else {"generator": self._generator}

    def _sense(self, step: int) -> Tensor | None:
        if not self._reads:
            return None
        seen = self._simulator.sense(self._state, **self._random(step))
        self._readings.append(seen)
        return seen

    def _step(self, command: Tensor, step: int) -> None:
        self._state = self._simulator.step(self._state, command, **self._random(step))
        self._poses.append(self._state[:, :3])

    def open_loop(self, commands: NDArray, active: NDArray) -> Trajectory:
        """Drive commands [P, T, 3]; inactive ones do not change the robot's state."""
        count, steps, _ = commands.shape
        samples = self._shape[1]
        rests = self._episode.rest > 0
        sent = torch.zeros(count * samples, dtype=torch.long)
        for step in range(steps):
            command = torch.from_numpy(commands[:, step]).repeat_interleave(samples, 0)
            given = torch.from_numpy(active[:, step]).repeat_interleave(samples, 0)
            if rests and step == steps - 1:
                given = torch.ones_like(given)
            self._sense(step)
            self._step_given(command, sent, given)
            sent = sent + given
        shape = (*self._shape, steps)
        poses, readings = self._driven()
        return Trajectory(
            poses,
            np.broadcast_to(commands[:, None], (*shape, commands.shape[-1])),
            np.broadcast_to(self._durations(commands, active)[:, None], shape),
            readings,
            np.broadcast_to(active[:, None], shape),
        )

    def _durations(self, commands: NDArray, active: NDArray) -> NDArray:
        """Return the duration of each of the commands [P, T, C], [P, T]."""
        durations = np.full(active.shape, self._episode.step)
        if "duration" in self._simulator.command_names:
            durations = commands[..., -1]
        durations = np.where(active, durations, 0.0)
        if self._episode.rest > 0:
            durations[:, -1] = self._episode.rest
        return durations

    def _step_given(self, command: Tensor, sent: Tensor, given: Tensor) -> None:
        """Step with the noise of the n-th given command: null ones do not use any."""
        random = self._random(0)
        if self._noise is not None:
            rows = torch.arange(len(sent)) % self._shape[1]
            random = {"z": self._noise[rows, sent]}
        after = self._simulator.step(self._state, command, **random)
        self._state = torch.where(given.unsqueeze(-1), after, self._state)
        self._poses.append(self._state[:, :3])

    def seeing(self, controller: Controller, genes: Tensor) -> Trajectory:
        """Drive by a controller with genes [P, G], which gives a command at every step."""
        episode, simulator = self._episode, self._simulator
        genes = genes.repeat_interleave(self._shape[1], 0)
        memory, goals = controller.start(len(genes)), Goals(episode, len(genes))
        timed = "duration" in simulator.command_names
        given = []
        for step in range(episode.steps):
            readings, pose = self._sense(step), self._state[:, :3]
            seen = observe(
                controller.inputs,
                readings,
                simulator.reading_names,
                pose,
                goals.at(pose),
                step * episode.step,
            )
            command, memory = controller.act(genes, seen, memory)
            given.append(command)
            if timed:
                lasting = torch.full_like(command[:, :1], episode.step)
                command = torch.cat([command, lasting], dim=1)
            self._step(command, step)
        if episode.rest > 0:
            stop = torch.zeros_like(given[0])
            lasting = torch.full_like(stop[:, :1], episode.rest)
            self._sense(episode.steps)
            self._step(torch.cat([stop, lasting], 1) if timed else stop, episode.steps)
            given.append(stop)
        poses, read = self._driven()
        return stepped(poses, self._stacked(given), read, episode)

    def _driven(self) -> tuple[NDArray, NDArray | None]:
        """Return poses [P, R, T + 1, 3] and readings [P, R, T, S], if they were read."""
        return self._stacked(self._poses), self._stacked(self._readings) if self._reads else None

    def _stacked(self, steps: list[Tensor]) -> NDArray:
        return torch.stack(steps, dim=1).unflatten(0, self._shape).numpy()
