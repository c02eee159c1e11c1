"""Predictions for a controller before the robot moves."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.interrupts import uninterrupted
from neurosim.base.statistics import wilson
from neurosim.base.trajectory import Trajectory
from neurosim.controllers import SavedController, read_controller
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import check_uncertain
from neurosim.simulators.base import Simulator, check_commands
from neurosim.simulators.registry import simulator_of
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.base import Judgement, Task
from neurosim.tasks.registry import make_task

#: Number of times at which a closed-loop controller's spread is given.
_TIMES = 10


@dataclass(frozen=True)
class Failure:
    """A way in which random samples failed.

    Attributes:
        command: number of the given command, from 1; one more than the last: while the motors
            stopped.
        reason: the robot's mistake, in the task's words.
        fraction: of all samples.
    """

    command: int
    reason: str
    fraction: float


@dataclass(frozen=True)
class Check:
    """The prediction for a controller, over random samples.

    Attributes:
        probability: fraction of samples that complete the task.
        interval: 95 % confidence interval of that fraction, by the number of draws.
        members: lowest and highest fraction among the members of the simulator's ensemble, a
            measure of the simulator's uncertainty; None if there is one member.
        draws: samples drawn.
        fitness: mean fitness of a start's samples.
        failures: the ways to fail, the most frequent first.
        after: numbers of the commands (from 1) to which ``spread`` and ``turn`` belong; the last
            one is the end of the trial.
        spread: radius (m) about the mean position that holds 95 % of the samples.
        turn: standard deviation of the heading, likewise, rad.
        unsupported: fraction of the time in commands unlike any in the simulator's data.
    """

    probability: float
    interval: tuple[float, float]
    members: tuple[float, float] | None
    draws: int
    fitness: float
    failures: tuple[Failure, ...]
    after: tuple[int, ...]
    spread: tuple[float, ...]
    turn: tuple[float, ...]
    unsupported: float

    def as_dict(self) -> dict[str, Any]:
        """Return the result for JSON, in SI units."""
        return asdict(self)


def check(
    controller: str | Path | SavedController,
    simulator: str | Path | Simulator,
    task: str | Task | None = None,
    *,
    draws: int = 4096,
    seed: int = 0,
    placing: tuple[float, float] = PLACING,
    extrapolate: bool = False,
) -> Check:
    """Try a controller in random samples of a simulator.

    Args:
        controller: a saved controller, or its folder.
        simulator: a simulator with noise or an ensemble, or its folder.
        task: a task or its name; by default the controller's own.
        draws: number of samples.
        seed: random seed.
        placing: error in placing the robot: standard deviations in x and y (m), in heading
            (rad).
        extrapolate: whether a plan's commands may be outside of the simulator's domain, where they
            count as unsupported.

    Raises:
        UserError: if controller or simulator cannot be read or do not fit each other, the simulator
            has no uncertainty, or a plan's command is outside of its domain.

    Example:
        >>> ns.evolve("tables", "obstacle-avoidance", out="new", generations=2, progress=False)
        [...]
        >>> found = ns.check("new", "tables", draws=100)
        >>> 0 <= found.probability <= 1
        True
    """
    if isinstance(controller, str | Path):
        controller = read_controller(controller)
    if not isinstance(controller, SavedController):
        raise UserError(
            f"expected a saved controller or its folder, not {type(controller).__name__}: "
            "evolve one first"
        )
    simulator = simulator_of(simulator)
    task = make_task(controller.task if task is None else task)
    check_uncertain(simulator)
    evaluator = Evaluator(simulator, task, controller.controller, placing=placing)
    if controller.controller.open_loop and not extrapolate:
        commands, given = controller.controller.commands(controller.genes[None], 0.0)
        with uninterrupted():
            check_commands(simulator, commands[given], "the commands")
    starts, by_task = evaluator.starts(draws, np.random.default_rng(seed))
    if not by_task:
        starts = np.tile(np.asarray(controller.start, np.float64), (draws, 1))
    samples = evaluator.rollouts.draw(starts, seed, None if by_task else placing)
    judged, trajectory = evaluator.judge(controller.genes[None], samples)
    success = judged.success[0]
    after, spread, turn = _spread(trajectory, controller.controller.open_loop)
    return Check(
        probability=float(success.mean()),
        interval=wilson(int(success.sum()), draws),
        members=_of_members(success, samples.member),
        draws=draws,
        fitness=float(judged.fitness.mean()),
        failures=_failures(judged, task),
        after=after,
        spread=spread,
        turn=turn,
        unsupported=float(evaluator.unsupported(trajectory)[0]),
    )


def _of_members(success: NDArray, member: NDArray | None) -> tuple[float, float] | None:
    if member is None or len(np.unique(member)) < 2:
        return None
    fractions = [float(success[member == m].mean()) for m in np.unique(member)]
    return min(fractions), max(fractions)


def _failures(judged: Judgement, task: Task) -> tuple[Failure, ...]:
    failed = ~judged.success[0]
    kinds, counts = np.unique(
        np.stack([judged.segment[0], judged.reason[0]])[:, failed], axis=1, return_counts=True
    )
    failures = [
        Failure(int(segment) + 1, task.why(reason), float(count / failed.size))
        for (segment, reason), count in zip(kinds.T, counts, strict=True)
    ]
    return tuple(sorted(failures, key=lambda failure: -failure.fraction))


def _spread(
    trajectory: Trajectory, open_loop: bool
) -> tuple[tuple[int, ...], tuple[float, ...], tuple[float, ...]]:
    """Return numbers of commands, and the 95 % radius and the heading's deviation after each."""
    assert trajectory.poses is not None
    poses = trajectory.poses[0, :, 1:]
    after = np.arange(poses.shape[1])
    if not open_loop:
        after = np.unique(np.linspace(0, poses.shape[1] - 1, _TIMES + 1).round().astype(int)[1:])
        poses = poses[:, after]
    away = np.linalg.norm(poses[..., :2] - poses[..., :2].mean(axis=0), axis=-1)
    radius, turn = np.quantile(away, 0.95, axis=0), poses[..., 2].std(axis=0)
    return tuple((after + 1).tolist()), tuple(radius.tolist()), tuple(turn.tolist())
