"""Objectives of evolution: from the trajectories of individuals to one number for each."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Trajectory
from neurosim.tasks.base import Judgement, Task

#: Weight of the fitness where the probability of success counts: among individuals that never
#: succeed it says which is on its way.
TIE = 1e-4
#: Differences between paths (median, m) that cost a ``steady`` individual all of its fitness.
APART = 0.2


class Merit(NamedTuple):
    """The merit of individuals.

    Attributes:
        merit: [P] what is maximised.
        shown: [P] what histories and progress show of it: the fitness where that is clearer.
        success: [P] fraction of samples in which the task is done.
    """

    merit: NDArray[np.float64]
    shown: NDArray[np.float64]
    success: NDArray[np.float64]


#: What is taken off an individual that ranks behind all others: more than any fitness.
BEHIND = 1e9

Objective = Callable[[Task, Trajectory, Judgement], Merit]


def fitness(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The mean fitness over samples."""
    value = mean_fitness(task, judgement.fitness)
    return Merit(value, value, judgement.success.mean(axis=1))


def probability(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The fraction of samples that succeed; where it is the same, the mean fitness."""
    success = judgement.success.mean(axis=1)
    value = success + TIE * mean_fitness(task, judgement.fitness)
    return Merit(value, value, success)


def progress(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The mean graded progress over samples: a fitness without steps."""
    value = mean_fitness(task, judgement.progress)
    return Merit(value, value, judgement.success.mean(axis=1))


def steady(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The mean fitness, less where the same start leads elsewhere through other noise.

    The samples are two halves, the same starts met twice: what noise changes little carries over
    to the robot. Where there is but one half, or nobody saw the poses, the fitness alone counts.
    """
    mean = mean_fitness(task, judgement.fitness)
    success = judgement.success.mean(axis=1)
    half, left = divmod(trajectory.shape[1], 2)
    if trajectory.poses is None or left or half % task.trial_starts:
        return Merit(mean, mean, success)
    places = trajectory.poses[..., :2]
    between = places[:, :half] - places[:, half:]
    apart = np.median(np.linalg.norm(between, axis=-1), axis=(1, 2))
    return Merit(mean - np.abs(mean) * np.minimum(apart / APART, 1.0), mean, success)


#: By name.
OBJECTIVES: dict[str, Objective] = {
    "fitness": fitness,
    "probability": probability,
    "progress": progress,
    "steady": steady,
}


def objective_named(name: str) -> Objective:
    """Return an objective.

    Raises:
        UserError: if there is none of this name.
    """
    if name not in OBJECTIVES:
        raise UserError(f"there is no objective {name!r}; choose from {', '.join(OBJECTIVES)}")
    return OBJECTIVES[name]


def repeats_of(name: str) -> int:
    """Return how often every start is to be met for an objective; see :func:`steady`."""
    return 2 if objective_named(name) is steady else 1


def put_behind(merit: Merit, fraction: NDArray[np.float64], most: float) -> Merit:
    """Return merits in which individuals rank behind all others that do too much of something.

    Args:
        merit: of individuals [P].
        fraction: [P] how much of it each does, 0 to 1; less is better among them.
        most: how much is not too much.
    """
    if fraction.max(initial=0.0) <= most:
        return merit
    return merit._replace(
        merit=np.where(fraction > most, merit.merit - BEHIND * (1.0 + fraction), merit.merit)
    )


def is_behind(merit: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which merits are of individuals that :func:`put_behind` has put there."""
    return merit < -0.5 * BEHIND


def mean_fitness(task: Task, each: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over trials [P] of what each start [P, R] was worth."""
    trials = each.reshape(len(each), -1, task.trial_starts)
    return task.whole(trials).mean(axis=1)
