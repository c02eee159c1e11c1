"""Samples of trials, and steps of whole batches: the same for all simulators."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.trajectory import Draws, Episode
from neurosim.simulators.numbers import words

#: A person's error in placing a robot at a mark: standard deviations in x and y (m), heading (rad).
PLACING = (0.003, float(np.radians(0.5)))


class Stepper:
    """Steps whole batches in NumPy; each row has its own random numbers.

    It calls the simulator's own ``step`` and ``sense``; the compiled one is a subclass, which a
    test compares with it. The noise of a row depends on its own seed and step, not on other rows.

    Attributes:
        simulator: the simulator of the steps.
    """

    def __init__(self, simulator: Any):
        self.simulator = simulator

    def start(
        self, poses: NDArray[np.float64], member: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] of robots that stand still; see ``Simulator.standing``."""
        return self.simulator.standing(poses, member)

    def noise(self, seeds: NDArray[np.uint64], steps: NDArray[np.int64]) -> NDArray:
        """Return the noise [B, Z] of steps [B] for :meth:`step` and :meth:`sense`."""
        return self.noises(seeds, steps, 1)[:, 0]

    def noises(self, seeds: NDArray[np.uint64], first: NDArray[np.int64], count: int) -> NDArray:
        """Return the noise of successive steps.

        Args:
            seeds: [B] of the rows' samples.
            first: [B] the number of the first of these steps in each row.
            count: number of steps.

        Returns:
            Numbers [B, count, noise_width]; or a seed for each row and step [B, count, 1], if the
            simulator draws its noise itself.
        """
        numbers = self.simulator.noise_of(seeds, count, first)
        if numbers is None:
            numbers = np.stack([words(seeds, first + k)[:, None] for k in range(count)], axis=1)
        return numbers

    def step(
        self, state: NDArray[np.float64], command: NDArray[np.float64], noise: NDArray | None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] after commands [B, C]; ``noise`` of :meth:`noise`, or None."""
        return self._ask(self.simulator.step, noise, state, command)

    def sense(self, state: NDArray[np.float64], noise: NDArray | None) -> NDArray:
        """Return the readings [B, R] in 0..1 in states [B, S]; ``noise`` as in :meth:`step`."""
        return self._ask(self.simulator.sense, noise, state)

    def step_and_sense(
        self,
        state: NDArray[np.float64],
        command: NDArray[np.float64],
        noises: NDArray | None,
        at: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray]:
        """Return the states [B, S] after commands [B, C], and their readings [B, R].

        Args:
            state, command: as in :meth:`step`.
            noises: [B, N, Z] of :meth:`noises`, or None.
            at: which of the N steps this is; the noise of the next is also that of the readings.
        """
        now, after = (None, None) if noises is None else (noises[:, at], noises[:, at + 1])
        state = self.step(state, command, now)
        return state, self.sense(state, after)

    def _ask(self, what: Any, noise: NDArray | None, *given: NDArray) -> NDArray:
        tensors = [torch.from_numpy(one) for one in given]
        with torch.no_grad():
            if noise is None:
                return what(*tensors).numpy()
            if self.simulator.noise_width:
                return what(*tensors, z=torch.from_numpy(noise)).numpy()
            rows = zip(*(one.split(1) for one in tensors), strict=True)
            answers = [
                what(*row, generator=_generator(seed))
                for row, seed in zip(rows, noise[:, 0], strict=True)
            ]
            return torch.cat(answers).numpy()


def _generator(seed: np.uint64) -> torch.Generator:
    return torch.Generator().manual_seed(int(seed) >> 1)


def trial_steps(controller: Any, episode: Episode) -> int:
    """Return the number of steps of a controller's trial, including the stop at its end."""
    if controller.open_loop:
        genes = np.zeros((1, controller.genes))
        return controller.commands(genes, episode.rest)[0].shape[1]
    return episode.steps + (episode.rest > 0)


class SampledRollouts:
    """Rollouts of a controller in a simulator: this base class draws the samples of its trials."""

    def __init__(self, simulator: Any, controller: Any, episode: Episode):
        self._simulator, self._controller, self._episode = simulator, controller, episode

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw samples: each robot's start, ensemble member, and noise or its seed."""
        steps = trial_steps(self._controller, self._episode)
        return draw_samples(self._simulator, starts, rng, placing, steps)


def draw_samples(
    simulator: Any,
    starts: NDArray[np.float64],
    rng: np.random.Generator | int,
    placing: tuple[float, float] | None,
    steps: int,
) -> Draws:
    """Sample each robot's start, ensemble member and noise.

    Args:
        simulator: the simulator of the samples.
        starts, rng, placing: as in :meth:`Rollouts.draw`.
        steps: of a trial.
    """
    rng = np.random.default_rng(rng)
    starts = placed(starts, placing, rng)
    member = noise = seeds = None
    if simulator.members > 1:  # equal numbers of each member lessen the noise of the fitness
        member = rng.permutation(np.arange(len(starts)) % simulator.members)
    if simulator.has_noise:
        seeds = rng.integers(2**64, size=len(starts), dtype=np.uint64)
        noise = simulator.noise_of(seeds, steps)
    return Draws(starts, member, noise, seeds if noise is None else None)


def placed(
    starts: NDArray[np.float64], placing: tuple[float, float] | None, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the poses [R, 3] of robots that a person places at ``starts`` [R, 3]."""
    if placing is None:
        return np.asarray(starts, np.float64)
    return starts + rng.standard_normal((len(starts), 3)) * (placing[0], placing[0], placing[1])


def began(simulator: Any, draws: Draws) -> NDArray[np.float64]:
    """Return the first states [R, S] of the robots in samples."""
    states = simulator.standing(draws.starts, draws.member)
    if draws.state is not None:
        own = [name not in ("x", "y", "theta", "member") for name in simulator.state_names]
        last = simulator.over(torch.from_numpy(draws.state[None]))[0].numpy()
        states[:, own] = last[own]
    return states
