"""Spaces, observations, actions and rewards of an environment.

They are the same for a simulator and for the robot: a learner sees no difference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from neurosim.base.compiled import njit
from neurosim.base.errors import UserError
from neurosim.controllers.base import WHEELS
from neurosim.controllers.registry import usual_inputs
from neurosim.loop.evaluate import check_readings
from neurosim.networks.control import (
    FEED_FORWARD,
    GOAL_INPUTS,
    NOT_READINGS,
    OF_GOALS,
    POLAR_INPUTS,
    POSE_INPUTS,
    TIME_INPUTS,
    NetworkArrays,
    input_sources,
)
from neurosim.networks.control_kernels import closed_loop, observe
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Interval, Judgement, Records, Rows, Task

#: Observed positions reach so far beyond the outline of simulator and task, m.
BEYOND = 0.5
#: Without an outline, observed positions reach so far from the start, m.
AROUND = 5.0


class Face:
    """Spaces, observations, and rewards of B trials of a task.

    Attributes:
        simulator, task: those of the environment.
        names: of the columns of an observation.
        outputs: of the columns of an action.
        reads: whether the sensors must be read.
        records: of the task, one for each trial.
        progress: [B] of the trials at their last step.
    """

    def __init__(
        self, simulator: Simulator, task: Task, count: int, names: Sequence[str] | None = None
    ):
        """Define the spaces.

        Args:
            simulator, task: see the class.
            count: trials.
            names: the observations; by default all sensors and the position of the next goal;
                without both, pose and time.

        Raises:
            UserError: if an observation does not exist, or the task needs sensors and there are
                none.
        """
        task = task.within_perimeter(simulator.perimeter)
        self.simulator, self.task, self.episode = simulator, task, task.episode
        check_readings(simulator, task)
        self.names = tuple(names or usual_inputs(simulator, task)) or (*POSE_INPUTS, *TIME_INPUTS)
        goals = OF_GOALS if self.episode.goals is not None else ()
        known = (*simulator.reading_names, *POSE_INPUTS, *goals, *TIME_INPUTS)
        missing = [name for name in self.names if name not in known]
        if missing:
            raise UserError(
                f"{', '.join(missing)} cannot be observed in this simulator ({simulator.kind}) "
                f"with the task {task.name}; choose from {', '.join(known)}"
            )
        self.outputs = tuple(name for name in simulator.command_names if name != "duration")
        self.timed = len(self.outputs) < len(simulator.command_names)
        seen = any(name not in NOT_READINGS for name in self.names)
        self.reads = bool(simulator.reading_names) and (seen or self.episode.readings)
        self.action_space, self.observation_space = self._actions(), self._observations()
        self.records = Records(task, np.tile(np.asarray(task.start, np.float64), (count, 1)))
        self.progress = self.records.score().progress
        sources = input_sources(self.names, simulator.reading_names)
        # Only the inputs of this network are used.
        shape = NetworkArrays(len(self.names), np.empty(0, np.int64), np.empty(0), FEED_FORWARD)
        self._pilot = closed_loop(shape, sources, self.episode, False)
        self._goal, self._every = np.zeros(count, np.int64), np.arange(count)

    def _actions(self) -> Box[np.float32]:
        """Return the ranges of the simulator's commands, without a duration."""
        usual = dict.fromkeys(WHEELS, (-100.0, 100.0))
        limits = {**usual, **self.simulator.domain}
        pairs = np.array([limits.get(name, (-np.inf, np.inf)) for name in self.outputs])
        return _box(pairs)

    def _observations(self) -> Box[np.float32]:
        low, high = place(self.simulator, self.task)
        far = float(np.linalg.norm(high - low))
        seconds = self.episode.step * self.episode.steps + self.episode.rest
        limits = {
            **dict.fromkeys(self.simulator.reading_names, (0.0, 1.0)),
            **dict.fromkeys((*POSE_INPUTS, *GOAL_INPUTS), (-1.0, 1.0)),
            **dict.fromkeys((*GOAL_INPUTS[:2], POLAR_INPUTS[0]), (-far, far)),
            **dict.fromkeys(POLAR_INPUTS[1:], (-math.pi, math.pi)),
            **{name: (low[k], high[k]) for k, name in enumerate(POSE_INPUTS[:2])},
            **dict.fromkeys(TIME_INPUTS, (0.0, seconds)),
        }
        return _box(np.array([limits[name] for name in self.names]))

    def begin(self, rows: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
        """Begin trials in rows [K] at poses [K, 3]."""
        self.records.begin(rows, poses)
        self.progress[rows] = self.records.score(rows).progress
        self._goal[rows] = 0

    def observation(
        self,
        rows: Rows,
        poses: NDArray[np.float64],
        readings: NDArray | None,
        times: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        """Return the observations [K, len(names)], within the limits of the space.

        Args:
            rows: K of the trials.
            poses: [K, 3] (m, m, rad); NaN of a robot with unknown pose, which become 0.
            readings: [K, S] in 0..1, or None.
            times: [K] since the start, s.
        """
        if readings is not None and self.names == self.simulator.reading_names:
            return readings.astype(np.float32)
        out = np.empty((len(poses), len(self.names)), np.float32)
        space = self.observation_space
        limits = space.low, space.high
        if readings is None:
            readings = np.empty((len(poses), 0), np.float32)
        _observe(self._pilot, self._goal, self._every[rows], poses, times, readings, *limits, out)
        return out

    def checked(self, actions: ArrayLike, count: int | None = None) -> NDArray[np.float64]:
        """Return actions [B, C] in the simulator's columns, those of one step.

        Args:
            actions: [count, C], or [C] of a single environment.
            count: of environments; None: of a single one.

        Raises:
            UserError: if their number is wrong, or one is not a number or out of range.
        """
        try:
            given = np.asarray(actions, np.float32)
        except (TypeError, ValueError):
            raise UserError(f"actions must be numbers, not {actions!r:.60}") from None
        shape = (*(() if count is None else (count,)), len(self.outputs))
        if given.shape != shape:
            raise UserError(
                f"expected {'an action' if count is None else 'actions'} of shape {shape} "
                f"({', '.join(self.outputs)}), got shape {given.shape}"
            )
        space, commands = self.action_space, given.reshape(-1, len(self.outputs))
        flat = _outside(commands, space.low, space.high)
        if flat >= 0:
            at = np.unravel_index(flat, shape)
            which = "" if count is None else f" of environment {at[0]}"
            low, high = space.low[at[-1]], space.high[at[-1]]
            raise UserError(
                f"the action{which} has {self.outputs[at[-1]]} = {given[at]:g}; expected a number "
                f"of {low:g} to {high:g}"
            )
        return self.lasting(commands, self.episode.step)

    def lasting(self, commands: NDArray, duration: float) -> NDArray[np.float64]:
        """Return commands [B, C] followed by the duration (s), if that is a column."""
        out = np.empty((len(commands), len(self.outputs) + self.timed))
        out[:, : len(self.outputs)] = commands
        if self.timed:
            out[:, -1] = duration
        return out

    def add(self, rows: Rows, interval: Interval) -> None:
        """Add an interval to K trials; a duration may follow the commands."""
        assert interval.commands is not None
        own = interval._replace(commands=interval.commands[:, : len(self.outputs)])
        self.records.add(own, rows)

    def reward(self) -> tuple[NDArray[np.float64], Judgement]:
        """End a step; return the rewards [B], the growth of progress in it, and the fitness."""
        judged = self.records.score()
        rewards, self.progress = judged.progress - self.progress, judged.progress.copy()
        return rewards, judged


def _box(pairs: NDArray[np.float64]) -> Box[np.float32]:
    """Return the space of columns whose lowest and highest values are pairs [I, 2]."""
    low, high = pairs.T.astype(np.float32)
    return Box(low, high, dtype=np.float32)


def place(simulator: Simulator, task: Task) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lowest and highest x and y [2] (m) of observations.

    They are those of the outlines of simulator and task, plus :data:`BEYOND`; or :data:`AROUND` the
    start.
    """
    corners = []
    for shape in (*simulator.outline(), *task.outline()):
        corners += [np.asarray(corner, float) for corner in shape.get("polygon", [])]
        if "circle" in shape:
            x, y, radius = shape["circle"]
            corners += [np.array([x, y]) - radius, np.array([x, y]) + radius]
    start = np.asarray(task.start[:2], float)
    if not corners:
        return start - AROUND, start + AROUND
    every = np.array([*corners, start])
    return every.min(axis=0) - BEYOND, every.max(axis=0) + BEYOND


def rate(task: Task) -> float:
    """Return a task's number of steps per second."""
    return 1.0 / task.episode.step if math.isfinite(task.episode.step) else 1.0


@njit
def _outside(values: NDArray, low: NDArray, high: NDArray) -> int:
    """Return the index in values [B, C] of the first value beyond its limits [C], or -1."""
    for b in range(values.shape[0]):
        for c in range(values.shape[1]):
            if not low[c] <= values[b, c] <= high[c]:
                return b * values.shape[1] + c
    return -1


@njit(error_model="numpy")
def _observe(pilot, goal, rows, poses, times, readings, low, high, out):  # type: ignore[no-untyped-def]
    """Write observations [K, I], cut at their limits; ``goal`` [B] is each row's next one."""
    for k in range(len(rows)):
        x, y, heading = poses[k, 0], poses[k, 1], poses[k, 2]
        if math.isnan(x + y + heading):
            x, y, heading = 0.0, 0.0, 0.0
        row = rows[k]
        goal[row] = observe(pilot, x, y, heading, goal[row], times[k], readings[k], out[k])
        for i in range(out.shape[1]):
            out[k, i] = min(max(out[k, i], low[i]), high[i])
