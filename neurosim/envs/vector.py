"""A task in a simulator as a vector environment: whole batches are stepped at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.envs.face import rate
from neurosim.envs.picture import Picture, check_mode
from neurosim.envs.single import CLOSED, made
from neurosim.envs.trials import Trials
from neurosim.simulators.base import Simulator
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.base import Judgement, Task

Stepped = tuple[
    NDArray[np.float32],
    NDArray[np.float64],
    NDArray[np.bool_],
    NDArray[np.bool_],
    dict[str, Any],
]


class TaskVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray]):
    """Many trials of a task at once, each like :class:`neurosim.envs.single.TaskEnv`.

    With the same seeds its steps equal those of a ``SyncVectorEnv`` of single ones.

    Attributes:
        trials: all of them.
        autoreset_mode: when the next trial begins: in the step after the last (with any action and
            no reward), in the last step itself, or when :meth:`reset` is called for it.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        simulator: str | Path | Simulator,
        task: str | Mapping[str, Any] | Task = "nine-rectangles",
        *,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        observe: Sequence[str] | None = None,
        noise: bool = True,
        placing: tuple[float, float] = PLACING,
        render_mode: str | None = None,
        **settings: Any,
    ):
        """Make environments.

        Args:
            simulator, task, observe, noise, placing, settings: as for a single one.
            num_envs: number of environments.
            autoreset_mode: see the class; a mode or its value.
            render_mode: None or rgb_array.

        Raises:
            UserError: as for a single one; or if the mode is unknown, or there is no environment.
        """
        if num_envs < 1:
            raise UserError(f"there must be 1 environment at least, not {num_envs}")
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(mode.value for mode in AutoresetMode)
            raise UserError(f"autoreset_mode is one of {modes}, not {autoreset_mode!r}") from None
        simulator, goal = made(simulator, task, settings)
        self.trials = Trials(
            simulator, goal, num_envs, observe=observe, noise=noise, placing=placing
        )
        self.num_envs = num_envs
        self.metadata = {
            **self.metadata,
            "render_fps": rate(goal),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = self.trials.face.observation_space
        self.single_action_space = self.trials.face.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = check_mode(render_mode, self.metadata["render_modes"])
        self._picture = None if render_mode is None else Picture(simulator, goal, num_envs)
        seeded = [seeding.np_random() for _ in range(num_envs)]
        self._rngs = [rng for rng, _ in seeded]
        self._rng_seeds = [seed for _, seed in seeded]
        self._begun = np.zeros(num_envs, np.bool_)
        self._ended = np.zeros(num_envs, np.bool_)
        self._seen = np.zeros((num_envs, len(self.trials.face.names)), np.float32)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generators of the environments."""
        return tuple(self._rngs)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds of the environments."""
        return tuple(self._rng_seeds)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a trial in every environment, or in those of ``options["reset_mask"]``.

        Args:
            seed: of the first environment, the others have the next numbers; or one for each.
            options: ``reset_mask`` [num_envs] bool.

        Raises:
            UserError: if the number of seeds or the length of the mask is wrong.
        """
        self._check_open()
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_))
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise UserError(
                f"reset_mask must be {self.num_envs} booleans, one of them True at least"
            )
        if seed is None or isinstance(seed, int):
            seed = [None if seed is None else seed + row for row in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UserError(f"expected {self.num_envs} seeds, one an environment, not {len(seed)}")
        rows = np.flatnonzero(mask)
        for row in map(int, rows):
            if (own := seed[row]) is not None:
                self._rngs[row], self._rng_seeds[row] = seeding.np_random(own)
                self.trials.forget(row)
        self._begin(rows)
        self._seen[rows] = self.trials.see(rows)
        return self._seen.copy(), {}

    def _begin(self, rows: NDArray[np.int64]) -> None:
        self.trials.begin(rows, self._rngs)
        self._begun[rows], self._ended[rows] = True, False
        if self._picture is not None:
            self._picture.begin(rows, self.trials.poses[rows])

    def step(self, actions: NDArray[np.float32]) -> Stepped:
        """Advance all trials by a step of the task.

        Args:
            actions: [num_envs, C].

        Raises:
            UserError: if an action is not in the action space, or a trial is over and its
                environment was not reset.
        """
        self._check_open()
        if not self._begun.all():
            raise UserError("no trials are under way: call reset() before step()")
        again = self._ended.copy()
        if self.autoreset_mode is AutoresetMode.DISABLED and again.any():
            raise UserError(
                f"environment {int(again.argmax())} has ended its trial: call "
                'reset(options={"reset_mask": ...}) before step()'
            )
        rewards, decided, late, judged = self.trials.step(self.trials.checked(actions, again))
        if self._picture is not None:
            self._picture.add(self.trials.poses)
        if again.any():  # NEXT_STEP: these trials were over
            rewards[again], decided[again], late[again] = 0.0, False, False
            self._begin(np.flatnonzero(again))
        self._seen = self.trials.see()
        self._ended = ended = decided | late
        infos = _infos(judged, ended) if ended.any() else {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            rows = np.flatnonzero(ended)
            final = np.full(self.num_envs, None, dtype=object)
            for row in rows:
                final[row] = self._seen[row].copy()
            infos = {"final_obs": final, "final_info": infos}
            infos |= {"_final_obs": ended.copy(), "_final_info": ended.copy()}
            self._begin(rows)
            self._seen[rows] = self.trials.see(rows)
        return self._seen.copy(), rewards, decided, late, infos

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """Return a picture [height, width, 3] of each trial so far.

        Raises:
            UserError: if the environments were made without a render mode.
        """
        self._check_open()
        if self._picture is None:
            raise UserError('nothing is drawn: make the environments with render_mode="rgb_array"')
        return tuple(self._picture.draw(row) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the windows."""
        if self._picture is not None:
            self._picture.close()

    def _check_open(self) -> None:
        if self.closed:
            raise UserError(CLOSED)


def _infos(judged: Judgement, ended: NDArray[np.bool_]) -> dict[str, Any]:
    return {
        "is_success": judged.success & ended,
        "_is_success": ended.copy(),
        "progress": np.where(ended, judged.progress, 0.0),
        "_progress": ended.copy(),
    }
