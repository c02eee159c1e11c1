"""Objectives of evolution: from the trajectories of individuals to one number for each."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.trajectory import Trajectory
from neurosim.tasks.base import Judgement, Task

#: Weight of the fitness in the probability of success, which ranks individuals that never succeed.
TIE = 1e-4
#: Difference between paths (median, m) that costs a ``steady`` individual all of its fitness.
APART = 0.2


class Merit(NamedTuple):
    """The merit of individuals.

    Attributes:
        merit: [P] the value that is maximised.
        shown: [P] the value for histories and progress: the fitness if it is clearer.
        success: [P] fraction of samples in which the task is done.
    """

    merit: NDArray[np.float64]
    shown: NDArray[np.float64]
    success: NDArray[np.float64]


#: Loss of an individual that ranks behind all others, larger than any fitness.
BEHIND = 1e9

Objective = Callable[[Task, Trajectory, Judgement], Merit]


def fitness(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The mean fitness over samples."""
    value = mean_fitness(task, judgement.fitness)
    return Merit(value, value, judgement.success.mean(axis=1))


def probability(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The fraction of samples that succeed; if it is the same, the mean fitness counts."""
    success = judgement.success.mean(axis=1)
    value = success + TIE * mean_fitness(task, judgement.fitness)
    return Merit(value, value, success)


def progress(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The mean graded progress over samples: a fitness without steps."""
    value = mean_fitness(task, judgement.progress)
    return Merit(value, value, judgement.success.mean(axis=1))


def steady(task: Task, trajectory: Trajectory, judgement: Judgement) -> Merit:
    """The mean fitness, less a loss if the same start leads to another path through other noise.

    The samples are two halves with the same starts: a controller that noise changes little also
    works on the robot. If there is only one half, or no poses, the fitness alone counts.
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
        UserError: if the name is unknown.
    """
    if name not in OBJECTIVES:
        raise UserError(f"there is no objective {name!r}; choose from {', '.join(OBJECTIVES)}")
    return OBJECTIVES[name]


def repeats_of(name: str) -> int:
    """Return the number of samples of every start for an objective; see :func:`steady`."""
    return 2 if objective_named(name) is steady else 1


def put_behind(merit: Merit, fraction: NDArray[np.float64], most: float) -> Merit:
    """Return merits in which individuals above a limit rank behind all others.

    Args:
        merit: of individuals [P].
        fraction: [P] value with the limit, 0 to 1; among those above it, less is better.
        most: the limit.
    """
    if fraction.max(initial=0.0) <= most:
        return merit
    return merit._replace(
        merit=np.where(fraction > most, merit.merit - BEHIND * (1.0 + fraction), merit.merit)
    )


def is_behind(merit: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether merits belong to individuals that :func:`put_behind` ranked last."""
    return merit < -0.5 * BEHIND


def mean_fitness(task: Task, each: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean fitness over trials [P] from that of each start [P, R]."""
    trials = each.reshape(len(each), -1, task.trial_starts)
    return task.whole(trials).mean(axis=1)
