"""What to expect of a plan before the robot moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.controllers import Plan
from neurosim.evolve.plans import is_uncertain
from neurosim.evolve.rollouts import PLACING, rollouts
from neurosim.simulators.base import Simulator
from neurosim.simulators.registry import read_simulator
from neurosim.tasks.base import Evaluation, Task, make_task

#: 95 % of a normal distribution lie within this many standard deviations.
_Z = 1.959964


@dataclass(frozen=True)
class Failure:
    """A way in which drawn outcomes failed.

    Attributes:
        command: during which given command, from 1; one more than there are: while the motors
            ran down after the last.
        reason: what the robot did, in the task's words.
        share: of all outcomes.
    """

    command: int
    reason: str
    share: float


@dataclass(frozen=True)
class PlanCheck:
    """What a simulator says of a plan, over drawn outcomes.

    Attributes:
        probability: share of outcomes that complete the task.
        interval: 95 % confidence interval of that share, as far as the number of draws goes.
        members: lowest and highest share among the members of the simulator's ensemble, which
            is how far the simulator is in doubt itself; None where there is one member.
        draws: outcomes drawn.
        failures: the ways to fail, the most frequent first.
        spread: radius (m) about the mean position after each given command that holds 95 % of
            the outcomes; the last entry is at rest.
        turn: standard deviation of the heading, likewise, rad.
    """

    probability: float
    interval: tuple[float, float]
    members: tuple[float, float] | None
    draws: int
    failures: tuple[Failure, ...]
    spread: tuple[float, ...]
    turn: tuple[float, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON, in SI units."""
        return asdict(self)


def check_plan(
    controller: str | Path | Plan,
    simulator: str | Path | Simulator,
    *,
    draws: int = 4096,
    seed: int = 0,
    placing: tuple[float, float] = PLACING,
) -> PlanCheck:
    """Drive a plan through drawn outcomes of a simulator.

    Args:
        controller: a plan, or its folder.
        simulator: a simulator with noise or an ensemble, or its folder.
        draws: how many outcomes.
        seed: of all that is drawn.
        placing: standard deviation of where the robot is put down, in x and y (m), heading (rad).

    Raises:
        UserError: if plan or simulator cannot be read or do not fit each other, or the simulator
            has nothing to draw.
    """
    plan = controller if isinstance(controller, Plan) else Plan.read(controller)
    if isinstance(simulator, str | Path):
        simulator = read_simulator(simulator)
    task = make_task(plan.task["name"], **plan.task.get("settings", {}))
    return check_commands(
        plan.given, simulator, task, start=plan.start, draws=draws, seed=seed, placing=placing
    )


def check_commands(
    commands: Sequence[tuple[float, float, float]],
    simulator: Simulator,
    task: Task,
    *,
    start: Sequence[float] | None = None,
    draws: int = 4096,
    seed: int = 0,
    placing: tuple[float, float] = PLACING,
) -> PlanCheck:
    """Drive commands (left %, right %, duration s) through drawn outcomes of a simulator.

    Args:
        commands: at least one.
        simulator, draws, seed, placing: as :func:`check_plan` takes them.
        task: what is to be completed.
        start: x (m), y (m), heading (rad); the task's own if not given.
    """
    if not is_uncertain(simulator):
        raise UserError(
            "this simulator has neither noise nor an ensemble, so that it expects one outcome "
            "only; train one with the default trainer"
        )
    given = np.ones((1, len(commands)), bool)
    drives = rollouts(simulator, task.start if start is None else start)
    drawn = drives.draw(draws, len(commands), seed, placing)
    poses = drives.drawn(np.array([commands]), given, drawn)[0]
    counted = np.tile(np.append(given[0], False), (draws, 1))
    judged = task.evaluate(poses, counted)
    spread, turn = _spread(poses[:, 1:])
    return PlanCheck(
        probability=float(judged.completes.mean()),
        interval=wilson(int(judged.completes.sum()), draws),
        members=_of_members(judged.completes, drawn.member),
        draws=draws,
        failures=_failures(judged, task),
        spread=spread,
        turn=turn,
    )


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a probability (Wilson 1927, J. Am. Stat. Assoc. 22).

    Args:
        successes: out of ``trials``.
        trials: at least 1.
    """
    share, z2 = successes / trials, _Z**2
    middle = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = _Z * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def _of_members(completes: NDArray, member: NDArray | None) -> tuple[float, float] | None:
    if member is None or len(np.unique(member)) < 2:
        return None
    shares = [float(completes[member == m].mean()) for m in np.unique(member)]
    return min(shares), max(shares)


def _failures(judged: Evaluation, task: Task) -> tuple[Failure, ...]:
    ways, counts = np.unique(
        np.stack([judged.segment, judged.reason])[:, ~judged.completes], axis=1, return_counts=True
    )
    total = len(judged.completes)
    found = [
        Failure(int(segment) + 1, task.reasons[reason], float(count / total))
        for (segment, reason), count in zip(ways.T, counts, strict=True)
    ]
    return tuple(sorted(found, key=lambda failure: -failure.share))


def _spread(poses: NDArray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return 95 % radius and standard deviation of the heading after each command [R, K, 3]."""
    away = np.linalg.norm(poses[..., :2] - poses[..., :2].mean(axis=0), axis=-1)
    radius = np.quantile(away, 0.95, axis=0)
    return tuple(radius.tolist()), tuple(poses[..., 2].std(axis=0).tolist())
