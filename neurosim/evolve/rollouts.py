"""Plans driven in a simulator: as it expects, or through drawn outcomes.

A plan is a fixed number of commands, some of which may be null (not given); after the last one
the motors are stopped. Every outcome of a plan is a path: the poses at the start, after each
command, and at rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.errors import UserError
from neurosim.simulators.base import Simulator

COMMAND_NAMES = ("left", "right", "duration")
#: The motors run down for this long after the last command before the robot is at rest, s.
RUN_DOWN = 0.5
#: How well a person puts a robot down at a mark: standard deviations, m and rad.
PLACING = (0.003, math.radians(0.5))


@dataclass(frozen=True)
class Draws:
    """Outcomes that were drawn, to be met by every plan alike (common random numbers).

    Attributes:
        starts: [R, 3] where the robot was put down (m, m, rad, board frame).
        member: [R] which of the simulator's members it moves as.
        kept: what else was drawn, as the rollouts that drew it want it.
    """

    starts: NDArray[np.float64]
    member: NDArray[np.int64] | None
    kept: Any

    def __len__(self) -> int:
        return len(self.starts)


class Rollouts(Protocol):
    """Drives plans in a simulator. Plans are ``commands`` [B, K, 3] and ``given`` [B, K] bool."""

    def expected(self, commands: NDArray, given: NDArray) -> NDArray[np.float64]:
        """Return the paths [B, K + 2, 3] without noise, from the start pose itself."""
        ...

    def draw(self, count: int, commands: int, seed: int, placing: tuple[float, float]) -> Draws:
        """Draw outcomes for plans of so many commands.

        Args:
            count: outcomes.
            commands: K.
            seed: of all that is drawn.
            placing: standard deviation of where the robot is put down: m (in x and y), rad.
        """
        ...

    def drawn(self, commands: NDArray, given: NDArray, draws: Draws) -> NDArray[np.float64]:
        """Return the paths [B, R, K + 2, 3] of every plan through the same drawn outcomes."""
        ...


def rollouts(simulator: Simulator, start: Sequence[float]) -> Rollouts:
    """Return the fastest rollouts that there are for a simulator.

    Args:
        simulator: any; motion networks of linear units and tables run in compiled code.
        start: x (m), y (m), heading (rad) of the board's frame.

    Raises:
        UserError: if the simulator takes other commands than left, right, duration.
    """
    from neurosim.simulators import MotionNetwork, TableSimulator

    if tuple(simulator.command_names) != COMMAND_NAMES:
        raise UserError(
            f"plans are of {', '.join(COMMAND_NAMES)}, but this simulator takes "
            f"{', '.join(simulator.command_names)}; use one that was learned from motor commands"
        )
    if isinstance(simulator, MotionNetwork) and simulator.network.linear:
        return CompiledRollouts(simulator, start)
    if isinstance(simulator, TableSimulator):
        return TableRollouts(simulator, start)
    return SteppedRollouts(simulator, start)


class SteppedRollouts:
    """Rollouts of any simulator, through the steps that its protocol offers.

    The same draws are the same numbers for each plan of a batch of the same size, but not the
    same for two plans of a batch: a simulator's noise is its own affair.
    """

    def __init__(self, simulator: Simulator, start: Sequence[float]):
        self._simulator, self._start = simulator, np.asarray(start, np.float64)

    def expected(self, commands: NDArray, given: NDArray) -> NDArray[np.float64]:
        """Return the paths [B, K + 2, 3] without noise."""
        poses = torch.from_numpy(np.tile(self._start, (len(commands), 1)))
        return stepped(self._simulator, poses, _tensor(commands), torch.as_tensor(given)).numpy()

    def draw(self, count: int, commands: int, seed: int, placing: tuple[float, float]) -> Draws:
        """Draw outcomes: where the robot is put down, and a seed for the simulator."""
        generator = torch.Generator().manual_seed(seed)
        return Draws(_starts(self._start, count, placing, generator), None, seed)

    def drawn(self, commands: NDArray, given: NDArray, draws: Draws) -> NDArray[np.float64]:
        """Return the paths [B, R, K + 2, 3]."""
        count = len(draws)
        generator = torch.Generator().manual_seed(draws.kept)
        poses = stepped(
            self._simulator,
            torch.from_numpy(np.tile(draws.starts, (len(commands), 1))),
            _tensor(commands).repeat_interleave(count, 0),
            torch.as_tensor(given).repeat_interleave(count, 0),
            generator,
        )
        return poses.unflatten(0, (-1, count)).numpy()


class CompiledRollouts:
    """Rollouts of a motion network of linear units."""

    def __init__(self, simulator: Any, start: Sequence[float]):
        """Lay out the network; ``simulator`` is a :class:`~neurosim.simulators.MotionNetwork`."""
        from neurosim.simulators.motion.rollout_kernels import lay_out

        self._simulator, self._start = simulator, np.asarray(start, np.float64)
        self._arrays = simulator.arrays()
        self._mean = lay_out(self._arrays, mean=True)
        self._members = lay_out(self._arrays, mean=False)
        self._source = np.array([_source(name) for name in simulator.input_names], np.int64)
        self._stop = np.array([0.0, 0.0, RUN_DOWN])

    def expected(self, commands: NDArray, given: NDArray) -> NDArray[np.float64]:
        """Return the paths [B, K + 2, 3] as the mean of the ensemble has them."""
        from neurosim.simulators.motion.rollout_kernels import mean_poses

        plans = np.ascontiguousarray(commands, np.float64), np.ascontiguousarray(given, np.bool_)
        return mean_poses(self._mean, self._source, self._start, *plans, self._stop)

    def draw(self, count: int, commands: int, seed: int, placing: tuple[float, float]) -> Draws:
        """Draw outcomes: placing, member and noise of each."""
        generator = torch.Generator().manual_seed(seed)
        starts = _starts(self._start, count, placing, generator)
        # As many of each member as can be: what is left to chance is noise in the fitness.
        member = torch.arange(count) % self._simulator.members
        member = member[torch.randperm(count, generator=generator)].numpy()
        noise = self._simulator.noise
        if noise is None:
            return Draws(starts, member, np.zeros((count, commands + 1, 0)))
        return Draws(starts, member, noise.draw(count, commands + 1, generator).numpy())

    def drawn(self, commands: NDArray, given: NDArray, draws: Draws) -> NDArray[np.float64]:
        """Return the paths [B, R, K + 2, 3]."""
        from neurosim.simulators.motion.rollout_kernels import drawn_poses

        plans = np.ascontiguousarray(commands, np.float64), np.ascontiguousarray(given, np.bool_)
        outcomes = draws.starts, draws.member, draws.kept
        return drawn_poses(self._members, self._arrays, self._source, *outcomes, *plans, self._stop)


class TableRollouts:
    """Rollouts of a table simulator."""

    def __init__(self, simulator: Any, start: Sequence[float]):
        """Lay out the tables; ``simulator`` is a :class:`~neurosim.simulators.TableSimulator`."""
        self._simulator, self._start = simulator, np.asarray(start, np.float64)
        self._stop = np.array([0.0, 0.0, RUN_DOWN])

    def expected(self, commands: NDArray, given: NDArray) -> NDArray[np.float64]:
        """Return the paths [B, K + 2, 3] without noise."""
        still = np.zeros((1, commands.shape[1] + 1, 3))
        return self._driven(commands, given, self._start[None], still)[:, 0]

    def draw(self, count: int, commands: int, seed: int, placing: tuple[float, float]) -> Draws:
        """Draw outcomes: where the robot is put down, and the noise of every command."""
        generator = torch.Generator().manual_seed(seed)
        starts = _starts(self._start, count, placing, generator)
        shape = (count, commands + 1, 3)
        if self._simulator.noise == "uniform":
            z = 2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0
        else:
            z = torch.randn(shape, generator=generator, dtype=torch.float64)
        return Draws(starts, None, z.numpy())

    def drawn(self, commands: NDArray, given: NDArray, draws: Draws) -> NDArray[np.float64]:
        """Return the paths [B, R, K + 2, 3]."""
        return self._driven(commands, given, draws.starts, draws.kept)

    def _driven(self, commands: NDArray, given: NDArray, starts: NDArray, z: NDArray) -> NDArray:
        from neurosim.simulators.tables.plan_kernels import drive_plans

        commands = np.ascontiguousarray(commands, np.float64)
        return drive_plans(
            self._simulator.arrays,
            starts,
            z,
            commands,
            self._simulator.substeps(commands[..., 2]),
            np.ascontiguousarray(given, np.bool_),
            self._stop,
            int(self._simulator.substeps(RUN_DOWN)),
        )


def stepped(
    simulator: Simulator,
    starts: Tensor,
    commands: Tensor,
    given: Tensor,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Drive plans step by step, then stop the motors.

    Args:
        simulator: any; its commands must be left, right, duration.
        starts: [B, 3] x (m), y (m), heading (rad).
        commands: [B, K, 3] left, right (percent), duration (s).
        given: [B, K] bool; a command that is not given leaves the robot as it is.
        generator: of the simulator's noise; without one there is none.

    Returns:
        [B, K + 2, 3]: the poses at the start, after each command, and at rest.
    """
    state = simulator.start(starts, generator)
    poses = [state[:, :3]]
    for index in range(commands.shape[1]):
        after = simulator.step(state, commands[:, index], generator)
        state = torch.where(given[:, index, None], after, state)
        poses.append(state[:, :3])
    stop = commands.new_tensor([0.0, 0.0, RUN_DOWN]).expand(len(commands), 3)
    poses.append(simulator.step(state, stop, generator)[:, :3])
    return torch.stack(poses, dim=1)


def _starts(
    start: NDArray, count: int, placing: tuple[float, float], generator: torch.Generator
) -> NDArray[np.float64]:
    scatter = torch.randn(count, 3, generator=generator, dtype=torch.float64).numpy()
    return start + scatter * np.array([placing[0], placing[0], placing[1]])


def _source(name: str) -> int:
    """Return where a network's input comes from, as the kernels take it."""
    if name in COMMAND_NAMES:
        return COMMAND_NAMES.index(name)
    return -COMMAND_NAMES.index(name.removeprefix("prev_")) - 1


def _tensor(commands: NDArray) -> Tensor:
    return torch.as_tensor(commands, dtype=torch.float64)
