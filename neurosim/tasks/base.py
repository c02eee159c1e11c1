"""What every task offers, and the tasks by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError


@dataclass(frozen=True)
class Evaluation:
    """What a task thinks of a batch of trajectories.

    Attributes:
        fitness: (B,) float64, finite; the higher the better.
        completes: (B,) bool, whether the task is done.
        reason: (B,) why not: a place in the task's ``reasons``, or -1 where it is done.
        segment: (B,) the segment during which that was settled; the last where it is done.
        detail: name -> (B,) array: what the fitness was made of; a task's own.
    """

    fitness: NDArray[np.float64]
    completes: NDArray[np.bool_]
    reason: NDArray[np.int64]
    segment: NDArray[np.int64]
    detail: dict[str, NDArray]


@runtime_checkable
class Task(Protocol):
    """Something to be achieved by driving, judged by one function of the trajectory.

    A trajectory is the poses at the boundaries of commands, in the board's frame (origin at
    the board's centre, x along its long side); whether it was simulated or tracked makes no
    difference.

    Attributes:
        name: what ``--task`` takes.
        start: x (m), y (m), heading (rad) where every trial starts.
        reasons: the ways in which a trial can fail, in words that follow "the robot".
    """

    name: str
    start: tuple[float, float, float]
    reasons: tuple[str, ...]

    def evaluate(self, poses: ArrayLike, given: ArrayLike) -> Evaluation:
        """Judge trajectories.

        Args:
            poses: (B, K + 1, 3) before the first of K segments and after each.
            given: (B, K) bool; False where a segment is no command of the plan: a null
                command, or the motors running down after the last one.
        """
        ...

    def evaluate_track(self, track: ArrayLike, segment: ArrayLike, given: ArrayLike) -> Evaluation:
        """Judge one trajectory by all poses that were seen, not only those at the boundaries.

        Args:
            track: (M, 3) poses in order of time.
            segment: (M,) the index of the segment during which each was seen.
            given: (K,) bool, as in :meth:`evaluate`.
        """
        ...

    def region(self, poses: ArrayLike) -> NDArray[np.int64]:
        """Return which part of the course each pose (..., 3) is in, a number per part."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return name and settings, enough to make the same task again."""
        ...


def make_task(name: str, **settings: Any) -> Any:
    """Return the task of that name: a :class:`Task` of plans, or an ObstacleAvoidance.

    Raises:
        UserError: if there is none, or it has no such setting.
    """
    from neurosim.tasks.nine_rectangles import NineRectangles
    from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance

    tasks = {task.name: task for task in (NineRectangles, ObstacleAvoidance)}
    if name not in tasks:
        raise UserError(f"there is no task {name!r}; there is {', '.join(tasks)}")
    try:
        return tasks[name](**settings)
    except TypeError:
        raise UserError(
            f"the task {name} does not take the settings {', '.join(map(repr, settings))}"
        ) from None
