"""A task in a simulator as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.envs.face import rate
from neurosim.envs.picture import Picture, check_mode
from neurosim.envs.trials import Trials
from neurosim.simulators.base import Simulator
from neurosim.simulators.registry import read_simulator
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.base import Task
from neurosim.tasks.registry import make_task

#: Error of a closed environment.
CLOSED = "this environment is closed; make another one"


class TrialEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The base of environments of one trial: its picture, and closing."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"]}  # noqa: RUF012

    def _prepare(self, simulator: Simulator, task: Task, render_mode: str | None) -> None:
        """Make the picture, if there is a render mode; no trial has begun."""
        self.metadata = {**self.metadata, "render_fps": rate(task)}
        self.render_mode = check_mode(render_mode, self.metadata["render_modes"])
        self._picture = None if render_mode is None else Picture(simulator, task, 1)
        self._begun = self._closed = False

    def _show(self, rate: float) -> None:
        """Show the picture to a person, for 1 / ``rate`` s at least."""
        if self.render_mode == "human" and self._picture is not None:
            self._picture.show(rate)

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture [height, width, 3] of the trial so far, if the mode is rgb_array.

        Raises:
            UserError: if the environment was made without a render mode.
        """
        self._check_open()
        if self._picture is None:
            raise UserError('nothing is drawn: make the environment with render_mode="rgb_array"')
        return self._picture.draw(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._closed = True
        if self._picture is not None:
            self._picture.close()

    def _check_open(self) -> None:
        if self._closed:
            raise UserError(CLOSED)


class TaskEnv(TrialEnv):
    """A trial of a task is an episode.

    The reward of a step is the growth of the task's progress: the sum of rewards is the progress of
    the whole trial, less that of standing still. An episode terminates when the result is decided,
    and is truncated at the end of its time; its last ``info`` has ``is_success`` and ``progress``.

    Attributes:
        trials: the one trial.
    """

    def __init__(
        self,
        simulator: str | Path | Simulator,
        task: str | Mapping[str, Any] | Task = "nine-rectangles",
        *,
        observe: Sequence[str] | None = None,
        noise: bool = True,
        placing: tuple[float, float] = PLACING,
        render_mode: str | None = None,
        **settings: Any,
    ):
        """Make an environment.

        Args:
            simulator: a simulator or its folder.
            task: its name, or the task.
            observe, noise, placing: as in :class:`Trials`.
            render_mode: None, rgb_array or human.
            settings: of a task that is given by name.

        Raises:
            UserError: if the simulator cannot be read, or does not fit the task.
        """
        simulator, goal = made(simulator, task, settings)
        self.trials = Trials(simulator, goal, 1, observe=observe, noise=noise, placing=placing)
        self.observation_space = self.trials.face.observation_space
        self.action_space = self.trials.face.action_space
        self._prepare(simulator, goal, render_mode)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a trial; the same seed gives the same sequence of trials."""
        self._check_open()
        super().reset(seed=seed)
        if seed is not None:
            self.trials.forget(0)
        self.trials.begin(np.zeros(1, np.int64), [self.np_random])
        self._begun = True
        if self._picture is not None:
            self._picture.begin([0], self.trials.poses)
            self._show(self.metadata["render_fps"])
        return self.trials.see()[0], {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by a step of the task.

        Raises:
            UserError: if the action is not in the action space, or no trial is running.
        """
        self._check_open()
        if not self._begun:
            raise UserError("no trial has begun: call reset() before step()")
        commands = self.trials.face.checked(action)
        reward, decided, late, judged = self.trials.step(commands)
        over = bool(decided[0] or late[0])
        self._begun = not over
        if self._picture is not None:
            self._picture.add(self.trials.poses)
            self._show(self.metadata["render_fps"])
        info: dict[str, Any] = {}
        if over:
            info = {"is_success": bool(judged.success[0]), "progress": float(judged.progress[0])}
        return self.trials.see()[0], float(reward[0]), bool(decided[0]), bool(late[0]), info


def made(
    simulator: str | Path | Simulator,
    task: str | Mapping[str, Any] | Task,
    settings: Mapping[str, Any],
) -> tuple[Simulator, Task]:
    """Return an environment's simulator, in the task's place, and its task.

    Raises:
        UserError: if one of them is wrong.
    """
    if isinstance(task, Task) and settings:
        raise UserError(
            f"the task {task.name} exists already, so settings have no effect: give "
            f"{', '.join(settings)} when you make it"
        )
    if not isinstance(simulator, Simulator):
        simulator = read_simulator(simulator)
    goal = make_task(task, **settings)
    return goal.placed(simulator), goal
